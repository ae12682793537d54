"""The contenders from other packages, each a row that says so where it is not installed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from studies.benchmark import diffrax
from studies.benchmark import harmonic_balance as balance
from studies.benchmark.contenders import SLOW_DRAWS, SLOW_REPEATS, Compiled, Contest, integrate
from studies.benchmark.integration import EQUILIBRIUM, ESTIMATE, STEADY
from studies.benchmark.problems import DUFFING
from studies.benchmark.timing import Action

DIFFRAX = "diffrax"
DIFFRAX_ROWS = tuple(
    f"{DIFFRAX} {what}"
    for what in (EQUILIBRIUM, ESTIMATE, "shooting from the predicted orbit", "shooting, value and gradient")
)
BALANCE = "harmonic balance from the estimate's orbit"


def add_peers(contest: Contest, compiled: Compiled) -> None:
    """Enter diffrax, and a package for harmonic balance on the one problem that it can state."""
    if diffrax.missing():
        for name in DIFFRAX_ROWS:
            contest.refuse(name, diffrax.missing())
    else:
        _add_diffrax(contest, compiled)
    if contest.setting.name == DUFFING:
        _add_balance(contest, compiled)


def _discretised(compiled: Compiled) -> list[Any]:
    return [method.discretised for method in next(iter(compiled.values()))]


def _add_diffrax(contest: Contest, compiled: Compiled) -> None:
    reference, every = contest.reference, _discretised(compiled)
    tuned = reference.tuned(lambda k, *rest: diffrax.tune_diffrax(every[k], *rest), 1)
    if tuned is None:
        for name in DIFFRAX_ROWS:
            contest.refuse(name, "not right enough at any tolerance")
        return
    ready, error = tuned
    tolerances = [one.relative for one in ready]
    note = f"{diffrax.METHOD}, rtol {min(tolerances):.0e} … {max(tolerances):.0e}"
    for name, start in zip(DIFFRAX_ROWS[:2], (EQUILIBRIUM, ESTIMATE), strict=True):
        if (STEADY, start) not in compiled:
            contest.refuse(name, "not steady within 5000 cycles")
            continue
        seconds = partial(_seconds, contest, ready, start, [m.sweeps for m in compiled[STEADY, start]])
        contest.add(name, error, Action(seconds, 1, 1), f"{note}; 2 cycles timed, times as many as it takes")
    action = Action(partial(integrate, contest, ready, SLOW_DRAWS), SLOW_DRAWS, SLOW_REPEATS)
    contest.add(DIFFRAX_ROWS[2], error, action, f"{note}, one chord step")
    by_theta = np.sum([one.value_and_gradient(p[0])[1] for one, p in zip(ready, reference.parameters, strict=True)], 0)
    off = contest.gradient_error(by_theta + contest.setting.problem.joint_prior.gradient(contest.setting.theta[0]))
    both = Action(partial(_gradients, contest, ready), 1, SLOW_REPEATS)
    contest.add(DIFFRAX_ROWS[3], error, both, f"{note}, one chord step, by its adjoint", off)


def _seconds(contest: Contest, ready: Sequence[diffrax.Integrated], start: str, cycles: Sequence[float]) -> float:
    parameters = contest.reference.parameters
    return sum(one.seconds(p[0], start, n) for one, p, n in zip(ready, parameters, cycles, strict=True))


def _gradients(contest: Contest, ready: Sequence[diffrax.Integrated]) -> None:
    for one, p in zip(ready, contest.reference.parameters, strict=True):
        one.value_and_gradient(p[0])


def _add_balance(contest: Contest, compiled: Compiled) -> None:
    if balance.missing():
        contest.refuse(BALANCE, balance.missing())
        return
    every = _discretised(compiled)
    tuned = contest.reference.tuned(lambda k, *rest: balance.tune_balanced(every[k], *rest))
    if tuned is None:
        contest.refuse(BALANCE, "not right enough with any number of harmonics, or not converged")
        return
    ready, error = tuned
    note = f"harmonicbalance, {min(o.harmonics for o in ready)} … {max(o.harmonics for o in ready)} harmonics"
    action = Action(partial(integrate, contest, ready, SLOW_DRAWS), SLOW_DRAWS, SLOW_REPEATS)
    contest.add(BALANCE, error, action, note)
