"""First solves of special points at one parameter vector, found along branches that start away from the resonance."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice, pairwise

import numpy as np

from bayesperiodic.periodic.arclength import BranchPoint, trace
from bayesperiodic.periodic.compiled import CONVERGED, STALLED
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations
from bayesperiodic.periodic.solve import solve_driven
from bayesperiodic.periodic.special import SolvedPoint, SpecialEquations, SpecialPoint

BRANCH_SPANS = (2.0, 5.0)  # the branch is followed from the measured value over this factor to that times it
LOWEST_SCALE = 0.01  # of an input at which a branch in its scale starts
RESPONSE_STEPS, MOST_BRANCH_POINTS = 100, 600
TINY_SCALE, SMALL_AMPLITUDE = 1e-9, 1e-3  # of an unknown input; of the amplitude from which the backbone is followed
CLIMB, LEAST_CLIMB = 0.5, 0.01  # of the logarithm of the amplitude


def fold_equations(
    equations: PeriodicEquations, vary: str, direction: str, *, input_slope: np.ndarray | None = None
) -> SpecialEquations:
    """Return the equations of a fold at which a sweep "up" or "down" of the frequency or an input's scale jumps."""
    return SpecialEquations(equations, (vary,), sign=-1.0 if direction == "up" else 1.0, input_slope=input_slope)


def phase_equations(
    equations: PeriodicEquations,
    output: str,
    drive: str,
    lag: float,
    *,
    harmonic: int = 1,
    amplitude: float | None = None,
) -> SpecialEquations:
    """Return the equations of the frequency at which a harmonic of an output lags a harmonic of an input by an angle.

    With an amplitude of the output's harmonic the scale of the input is an unknown too. The lag [rad] is against
    `harmonic` times the phase of the input's fundamental.
    """
    model, tau = equations.model, equations.grid.tau
    first = np.exp(-2j * np.pi * tau) @ equations.inputs[:, model.inputs.index(drive)]
    turn = np.exp(1j * (lag - harmonic * np.angle(first)))
    wave = 2.0 / len(tau) * turn * np.exp(-2j * np.pi * harmonic * tau)
    rows = np.zeros((2, len(tau), len(model.outputs)))
    rows[:, :, list(model.outputs).index(output)] = wave.imag, wave.real
    forward = rows[1]
    if amplitude is None:
        return SpecialEquations(equations, (FREQUENCY,), rows=rows[:1], targets=np.zeros(1), forward=forward)
    return SpecialEquations(equations, (FREQUENCY, drive), 0.0, rows, np.array([0.0, amplitude]), forward)


def find_special(special: SpecialEquations, parameters: np.ndarray) -> SolvedPoint:
    """Return the special point nearest to the measured one, at which `equations` are; "stalled" if none is found."""
    if special.is_fold:
        return _find_fold(special, parameters)
    if len(special.free) == 1:
        return _find_phase(special, parameters)
    return _climb(special, parameters)


def _branches(special: SpecialEquations, parameters: np.ndarray) -> Iterator[Iterator[BranchPoint]]:
    """Yield branches in the first unknown, wider and wider ones, from where the response is not resonant."""
    measured = special.start_values[0]
    for span in BRANCH_SPANS:
        low, high = measured / span, measured * span
        if special.free[0] != FREQUENCY:
            low = LOWEST_SCALE * measured
        elif special.sign > 0.0:
            low, high = high, low
        here = special.at(np.array([low, *special.start_values[1:]]))
        solved = solve_driven(here, parameters, "static")[0]
        if solved.code != CONVERGED:
            continue
        parametrised, step = special.parametrised(parameters), abs(high - low) / RESPONSE_STEPS
        branch = trace(parametrised, solved.z, np.array([low]), until=high, step=step)
        yield islice(branch, MOST_BRANCH_POINTS)


def _nearest(special: SpecialEquations, solutions: list[SolvedPoint]) -> SolvedPoint:
    """Return the point whose first unknown is nearest to the measured one."""
    measured = special.start_values[0]
    return min(solutions, key=lambda solved: abs(float(np.log(solved.point.values[0] / measured))))


def _nothing(special: SpecialEquations) -> SolvedPoint:
    z = np.zeros((special.equations.grid.points, special.equations.count))
    return SolvedPoint(SpecialPoint(z, special.start_values, z), STALLED, 0)


def _find_fold(special: SpecialEquations, parameters: np.ndarray) -> SolvedPoint:
    with np.errstate(all="ignore"):
        for branch in _branches(special, parameters):
            solutions = []
            for before, after in pairwise(branch):
                slopes = float(before.tangent[1][0]), float(after.tangent[1][0])
                if not (slopes[0] * special.sign < 0.0 <= slopes[1] * special.sign):
                    continue
                near = before if abs(slopes[0]) < abs(slopes[1]) else after
                guess = SpecialPoint(near.z, near.values, near.tangent[0])
                solved = special.newton(guess, parameters, special.row(guess.vector))
                solutions += [solved] if solved.code == CONVERGED else []
            if solutions:
                return _nearest(special, solutions)
    return _nothing(special)


def _find_phase(special: SpecialEquations, parameters: np.ndarray) -> SolvedPoint:
    with np.errstate(all="ignore"):
        for branch in _branches(special, parameters):
            solutions, last = [], None
            for point in branch:
                missed = special.missed(special.at(point.values).outputs(point.z, parameters))[0]
                if last is not None and missed * last[1] <= 0.0:
                    before, value = last
                    share = value / (value - missed) if value != missed else 0.0
                    guess = SpecialPoint(
                        before.z + share * (point.z - before.z),
                        before.values + share * (point.values - before.values),
                        np.zeros_like(point.z),
                    )
                    solved = special.newton(guess, parameters, guess.vector)
                    solutions += [solved] if solved.code == CONVERGED and _lags(special, parameters, solved) else []
                last = point, missed
            if solutions:
                return _nearest(special, solutions)
    return _nothing(special)


def _lags(special: SpecialEquations, parameters: np.ndarray, solved: SolvedPoint) -> bool:
    """Return whether an output lags by the angle, and not by half a turn more."""
    outputs = special.at(solved.point.values).outputs(solved.point.z, parameters)
    return bool(np.sum(special.forward * outputs) > 0.0)


def _climb(special: SpecialEquations, parameters: np.ndarray) -> SolvedPoint:
    """Return the point of a given amplitude, along the backbone from the resonance of a tiny input."""
    assert special.rows is not None and special.targets is not None
    equations = special.at(np.array([special.start_values[0], TINY_SCALE]))
    linear = replace(special, equations=equations, free=(FREQUENCY,), rows=special.rows[:1], targets=np.zeros(1))
    solved = _find_phase(linear, parameters)
    if solved.code != CONVERGED:
        return solved
    z, goal = solved.point.z, float(special.targets[1])
    point = SpecialPoint(z, np.array([solved.point.values[0], TINY_SCALE]), np.zeros_like(z))
    target = float(np.sum(special.forward * special.at(point.values).outputs(z, parameters)))
    growth, first = CLIMB, target < SMALL_AMPLITUDE * goal
    while target != goal:
        ratio = float(np.clip(np.log(goal / target), -growth, growth))
        wanted = SMALL_AMPLITUDE * goal if first else target * np.exp(ratio) if abs(ratio) == growth else goal
        guess = _towards(special, parameters, point, wanted - target)
        there = replace(special, targets=np.array([0.0, wanted]))
        if guess is not None and np.all(guess.values > 0.0):
            solved = there.newton(guess, parameters, point.vector)
        if guess is not None and solved.code == CONVERGED and not special.leapt(solved.point, guess, point):
            point, target, growth, first = solved.point, wanted, min(CLIMB, 1.5 * growth), False
            continue
        growth *= 0.5
        if first or growth < LEAST_CLIMB:
            return SolvedPoint(point, STALLED, solved.steps)
    return SolvedPoint(point, CONVERGED, solved.steps)


def _towards(
    special: SpecialEquations, parameters: np.ndarray, point: SpecialPoint, more: float
) -> SpecialPoint | None:
    """Return the linear prediction of the point whose amplitude is larger; None if the equations are singular."""
    factors = special.linear(point, parameters, point.vector).factors
    solved = factors.solve_bordered(np.zeros((1, *point.z.shape)), np.array([[0.0, more]]))
    return solved and point.moved(SpecialPoint(solved[0][0], solved[1][0], point.vector))
