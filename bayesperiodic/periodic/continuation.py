"""Branches of periodic solutions in one quantity, with folds and period doublings; branch switching."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise
from typing import TYPE_CHECKING, overload

import numpy as np
from tqdm import tqdm

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.models.model import CondensedModel, Model
from bayesperiodic.periodic.arclength import INPUTS, BranchPoint, ParametrisedEquations, Tracer, trace
from bayesperiodic.periodic.compiled import CONVERGED, SINGULAR
from bayesperiodic.periodic.condensed import CondensedEquations
from bayesperiodic.periodic.condensed_branch import with_unknowns
from bayesperiodic.periodic.condensed_solution import described
from bayesperiodic.periodic.equations import FREQUENCY, PeriodicEquations, Solved, null_vector
from bayesperiodic.periodic.solution import (
    PeriodicSolution,
    describe,
    equations_of,
    resolution_warning,
    settings_of,
)
from bayesperiodic.periodic.solve import solve_periodic

if TYPE_CHECKING:
    import xarray as xr


FOLD, PERIOD_DOUBLING = "fold", "period doubling"
BRANCH_STEPS = 50
LOCATED = 1e-9
FOUND_BY = "continuation"
DOUBLED = 0.005
REMEMBERED = 4  # points whose solutions are kept: both ends of a step, and those located between them


@dataclass(frozen=True)
class Branch(Result, Sequence):
    """A branch of periodic solutions: a sequence of PeriodicSolution, in the order in which they were found.

    Attributes
    ----------
    vary : str
        The varied quantity: "frequency" [Hz], a parameter, or an input (its scale, 1 at the start).
    units : dict of str to str
        Of the varied quantity and of the model's parameters, states, inputs and outputs, if known.
    values : array (points,)
        Of the varied quantity, in its unit.
    solutions : tuple of PeriodicSolution
        Without sensitivities.
    kinds : tuple of str
        "fold", "period doubling" or "" for each.
    complete : bool
        True if the branch reached the requested end or returned to its start value.

    Examples
    --------
    The frequency response of a hardening spring, whose bent peak ends in two folds:

    >>> [round(fold.frequency, 3) for fold in branch.folds]
    [0.303, 0.242]
    >>> branch[-1].stable, dict(branch.data.sizes)["tau"]
    (True, 32)
    """

    vary: str
    units: dict[str, str]
    values: np.ndarray
    solutions: tuple[PeriodicSolution, ...]
    kinds: tuple[str, ...]
    complete: bool

    def __len__(self) -> int:
        return len(self.solutions)

    @overload
    def __getitem__(self, index: int) -> PeriodicSolution: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[PeriodicSolution, ...]: ...

    def __getitem__(self, index: int | slice) -> PeriodicSolution | tuple[PeriodicSolution, ...]:
        return self.solutions[index]

    def _of_kind(self, kind: str) -> tuple[PeriodicSolution, ...]:
        return tuple(s for s, k in zip(self.solutions, self.kinds, strict=True) if k == kind)

    @property
    def folds(self) -> tuple[PeriodicSolution, ...]:
        """The solutions where the branch turns back."""
        return self._of_kind(FOLD)

    @property
    def period_doublings(self) -> tuple[PeriodicSolution, ...]:
        """The solutions where a multiplier passes −1."""
        return self._of_kind(PERIOD_DOUBLING)

    @property
    def data(self) -> xr.Dataset:
        """The branch as an xarray Dataset: dims point, tau, state, output, multiplier."""
        import xarray as xr

        first = self.solutions[0]
        multipliers = np.array([s.multipliers for s in self.solutions])
        states = np.array([[s.states[n] for n in first.states] for s in self.solutions])
        outputs = np.array([[s.outputs[n] for n in first.outputs] for s in self.solutions])
        return xr.Dataset(
            {
                "states": (("point", "state", "tau"), states),
                "outputs": (("point", "output", "tau"), outputs),
                "frequency": ("point", [s.frequency for s in self.solutions], {"units": "Hz"}),
                "multiplier_real": (("point", "multiplier"), multipliers.real),
                "multiplier_imaginary": (("point", "multiplier"), multipliers.imag),
                "stable": ("point", [bool(s.stable) for s in self.solutions]),
                "stability_known": ("point", [s.stable is not None for s in self.solutions]),
                "kind": ("point", list(self.kinds)),
            },
            coords={
                "value": ("point", self.values, {"units": self.units.get(self.vary, ""), "long_name": self.vary}),
                "tau": first.tau,
                "state": list(first.states),
                "output": list(first.outputs),
            },
            attrs={"model": first.model, "vary": self.vary},
        )

    def __repr__(self) -> str:
        span = f"{self.values[0]:.6g} … {self.values[-1]:.6g} {self.units.get(self.vary, '')}".rstrip()
        return (
            f"Branch({self.solutions[0].model!r}, {self.vary} {span}, {len(self)} points, {len(self.folds)} folds, "
            f"{len(self.period_doublings)} period doublings{'' if self.complete else ', stuck'})"
        )


@in_one_thread
def continue_periodic(
    model: Model,
    solution: PeriodicSolution,
    vary: str,
    *,
    until: float,
    step: float | None = None,
    progress: bool = True,
) -> Branch:
    """Follow a periodic solution, stable or unstable, along a parameter, the frequency or an input's scale.

    Pseudo-arclength continuation [1]_ with steps adapted to the curvature passes folds; folds and period doublings are
    located to 1e-9 of a step. It ends where the quantity reaches `until` or its start value, or where the steps become
    too small; then the branch is not `complete`.

    Parameters
    ----------
    model : Model
    solution : PeriodicSolution
        A converged one.
    vary : str
        "frequency", a parameter's name, or an input's name (its scale, 1 at the start).
    until : float
    step : float, optional
        The largest step of the varied quantity; by default 1/50 of the way. A change of the orbit by its own range
        counts as much as the way to `until`.
    progress : bool
        Show a progress bar.

    Returns
    -------
    Branch

    Raises
    ------
    ValueError
        If the solution has not converged or is of another model, for an unknown `vary`, the frequency of an autonomous
        model, `until` equal to the start value, a step ≤ 0.

    Warns
    -----
    UserWarning
        If the grid does not resolve some orbits of an autonomous model, see `PeriodicSolution.resolved`.

    References
    ----------
    .. [1] H. B. Keller, Numerical solution of bifurcation and nonlinear eigenvalue problems, in: P. H. Rabinowitz
       (Ed.), Applications of Bifurcation Theory, Academic Press, 1977, 359-384.

    Examples
    --------
    >>> response = bp.continue_periodic(bp.models.duffing, solution, "frequency", until=0.4, progress=False)
    >>> response.complete, len(response.folds), len(response.period_doublings)
    (True, 2, 0)
    """
    _checks.instance("model", model, Model)
    until, points = _checks.finite_number("until", until), []
    with tqdm(desc=f"{model.name}: {vary} to {until:g}", unit=" points", disable=not progress, leave=False) as bar:
        for point in iterate_periodic(model, solution, vary, until=until, step=step):
            points.append(point)
            bar.set_postfix_str(f"{vary} = {point[0]:.6g}", refresh=False)
            bar.update()
    values, solutions, kinds = zip(*points, strict=True)
    units = model.units | ({FREQUENCY: "Hz"} if vary == FREQUENCY else {vary: ""} if vary in model.inputs else {})
    complete = values[-1] == until or (len(values) > 1 and values[-1] == values[0])
    if blurred := [s for s in solutions if not s.resolved]:
        worst = max(blurred, key=lambda s: s.trivial_error)
        orbits = (
            f"{len(blurred)} of {len(solutions)} orbits of the branch are not resolved, and period doublings there "
        )
        warnings.warn(f"{orbits}not found. {resolution_warning(worst, 'The worst')}", UserWarning, stacklevel=3)
    return Branch(vary, units, np.array(values), solutions, kinds, complete)


def iterate_periodic(
    model: Model, solution: PeriodicSolution, vary: str, *, until: float, step: float | None = None
) -> Iterator[tuple[float, PeriodicSolution, str]]:
    """Yield the points of `continue_periodic` one by one.

    Parameters
    ----------
    model, solution, vary, until, step : see `continue_periodic`

    Yields
    ------
    value : float
        Of the varied quantity.
    solution : PeriodicSolution
    kind : str
        "fold", "period doubling" or "".

    Raises
    ------
    ValueError
        As `continue_periodic` does, at the first point.

    Examples
    --------
    >>> for frequency, orbit, kind in bp.iterate_periodic(bp.models.duffing, solution, "frequency", until=0.4):
    ...     if kind == "fold":
    ...         break
    >>> round(frequency, 3)
    0.303
    """
    equations, parameters, z = equations_of(model, solution)
    if isinstance(equations, CondensedEquations):  # on as many points as it takes
        z = equations.find(parameters, z)[0].z
    parametrised, values = _parametrised(equations, parameters, vary)
    until = _checks.finite_number("until", until)
    if vary == FREQUENCY:
        _checks.positive("until", until)
    if until == values[0]:
        raise ValueError(f"until: must differ from the start value of {vary}, got {until!r}.")
    step = abs(until - values[0]) / BRANCH_STEPS if step is None else _checks.positive("step", step)
    solved = lru_cache(REMEMBERED)(partial(_solution, parametrised))
    for point in trace(parametrised, z, values, until=until, step=step, refine=partial(_special_points, solved)):
        yield float(point.values[0]), solved(point), point.kind


def double_period(model: Model, solution: PeriodicSolution, vary: str) -> PeriodicSolution:
    """Step from a period doubling onto the branch of solutions of twice the period.

    Parameters
    ----------
    model : Model
    solution : PeriodicSolution
        One of ``branch.period_doublings``.
    vary : str
        The quantity that the branch varies; it is also free in this step.

    Returns
    -------
    PeriodicSolution
        Of twice the periods (for an autonomous model, twice the samples at half the frequency), half a per cent of the
        orbit's size away from the old one; or with the status "singular" if the step fails.

    Raises
    ------
    ValueError
        If the solution has not converged, has no multiplier near −1, or for an unknown `vary`.

    Examples
    --------
    >>> turning = {"phi": 2 * np.pi * np.arange(100) / 100 - 0.4}
    >>> start = bp.solve_periodic(bp.models.pendulum, pendulum_parameters, frequency=2.07, samples=100,
    ...                           scheme="central4", winding=1, guess=turning)
    >>> route = bp.continue_periodic(bp.models.pendulum, start, "frequency", until=1.8, progress=False)
    >>> doubled = bp.double_period(bp.models.pendulum, route.period_doublings[0], "frequency")
    >>> doubled.periods, doubled.winding, doubled.stable
    (2, {'phi': 2}, True)
    """
    if isinstance(model, CondensedModel):
        raise model.refusal()
    equations, parameters, z = equations_of(model, solution)
    if np.min(abs(solution.multipliers + 1.0), initial=np.inf) > 0.1:
        raise ValueError(
            f"solution: must have a multiplier near -1, got {solution.multipliers}. Take a period doubling of a branch."
        )
    settings = settings_of(solution) | {"winding": {name: 2 * turns for name, turns in solution.winding.items()}}
    if model.autonomous:
        settings |= {"frequency": solution.frequency / 2, "samples": 2 * solution.samples}
    else:
        settings |= {"periods": 2 * solution.periods}
    inputs = {name: np.tile(values, 2) for name, values in solution.inputs.items()}
    twice = PeriodicEquations.build(model, inputs, **settings)
    parametrised, values = _parametrised(twice, parameters, vary)
    start = np.tile(z, (2, 1))
    columns = twice.residual_jacobian(start, parameters)
    doubling = null_vector(twice.grid, columns, twice.count, twice.frequency)
    doubling = 0.5 * (doubling - np.roll(doubling, len(z), axis=0))
    tracer = Tracer(parametrised, np.ptp(start, axis=0), values, 2.0 * values[0] + 1.0)
    point = BranchPoint(start, values, tracer.unit((doubling, np.zeros_like(values))), 0.0)
    corrected = tracer.correct(point, DOUBLED)
    if corrected is None:
        return describe(twice, parameters, Solved(start, SINGULAR, np.empty((0, 3))), FOUND_BY)
    return _solution(parametrised, corrected[0], sensitivities=True)


def _parametrised(
    equations: PeriodicEquations, parameters: np.ndarray, vary: str
) -> tuple[ParametrisedEquations, np.ndarray]:
    """Return the equations with the varied quantity (and an autonomous model's frequency) free, and its values."""
    model = equations.model
    allowed = [*model.parameters, *model.inputs, *([] if model.autonomous else [FREQUENCY])]
    _checks.one_of("vary", vary, allowed)
    free, frequency = ((FREQUENCY,), [equations.frequency]) if model.autonomous else ((), [])
    if vary in model.inputs:
        column, width = model.inputs.index(vary), len(model.inputs)
        change = np.zeros_like(equations.inputs)
        change[:, column::width] = equations.inputs[:, column::width]
        base = replace(equations, inputs=equations.inputs - change)
        return with_unknowns(base, parameters, (INPUTS, *free), change), np.array([1.0, *frequency])
    value = equations.frequency if vary == FREQUENCY else parameters[model.parameters.index(vary)]
    return with_unknowns(equations, parameters, (vary, *free)), np.array([value, *frequency])


def _solution(parametrised: ParametrisedEquations, point: BranchPoint, sensitivities: bool = False) -> PeriodicSolution:
    equations, parameters = parametrised.at(point.values)
    solved = Solved(point.z, CONVERGED, np.empty((0, 3)))
    return described(equations, parameters, solved, FOUND_BY, sensitivities)


def _special_points(
    solved: Callable[[BranchPoint], PeriodicSolution], tracer: Tracer, before: BranchPoint, after: BranchPoint
) -> list[BranchPoint]:
    """Return the folds and period doublings between two neighbouring points, in order."""
    points: list[BranchPoint] = []
    tests: dict[str, Callable[[BranchPoint], float]] = {
        FOLD: lambda point: float(point.tangent[1][0]),  # slope of the varied quantity along the branch
        PERIOD_DOUBLING: lambda point: _doubling_test(solved(point)),
    }
    for kind, test in tests.items():
        if test(before) * test(after) < 0.0:
            points += located(tracer, before, after, kind, test)
    return sorted(points, key=lambda point: point.distance)


def located(
    tracer: Tracer, before: BranchPoint, after: BranchPoint, kind: str, test: Callable[[BranchPoint], float]
) -> list[BranchPoint]:
    """Return the point where a test function is zero, in a list that is empty if a correction fails."""
    from scipy.optimize import brentq

    span = after.distance - before.distance
    known: dict[float, BranchPoint] = {0.0: before, span: after}

    def at(distance: float) -> float:
        if distance not in known:
            corrected = tracer.correct(before, distance)
            if corrected is None:
                raise _Lost
            known[distance] = corrected[0]
        value = test(known[distance])
        if np.isnan(value):
            raise _Lost
        return value

    try:
        root = brentq(at, 0.0, span, xtol=LOCATED * span, rtol=1e-14)
        at(root)
    except _Lost:
        return []
    return [replace(known[root], kind=kind)]


class _Lost(Exception):
    """A correction failed, or the point is not resolved."""


def _doubling_test(solution: PeriodicSolution) -> float:
    """Return a test function that changes its sign where a multiplier passes −1; NaN if the orbit is not resolved."""
    exponents = solution.exponents * solution.period if solution.resolved else np.empty(0)
    if not exponents.size:
        return np.nan
    growth = np.maximum(exponents.real, 0.0)
    return float(np.prod(np.exp(-growth) + np.exp(exponents - growth)).real)


def solutions_at(model: Model, branch: Branch, value: float) -> tuple[PeriodicSolution, ...]:
    """Return the orbits of a branch, stable and unstable, at one value of the varied quantity.

    Every passage of the branch through the value is solved again, from between its neighbours.

    Parameters
    ----------
    model : Model
    branch : Branch
        In a parameter or the frequency.
    value : float

    Returns
    -------
    tuple of PeriodicSolution
        In the order of the branch.

    Raises
    ------
    ValueError
        If the branch has no orbit there (the message names the nearest fold or end), is of another model or varies an
        input.

    Examples
    --------
    >>> [orbit.stable for orbit in bp.solutions_at(bp.models.duffing, branch, 0.25)]
    [True, False, True]
    """
    _checks.instance("model", model, Model)
    _checks.instance("branch", branch, Branch)
    if branch[0].model != model.name:
        raise ValueError(f"model: must be {branch[0].model!r}, as of the branch, got {model.name!r}.")
    if branch.vary not in (*model.parameters, FREQUENCY):
        raise ValueError(f"branch: must be one in a parameter or the frequency, got one in the input {branch.vary!r}.")
    value = _checks.finite_number("value", value)
    orbits = []
    for (low, before), (high, after) in pairwise(zip(branch.values, branch.solutions, strict=True)):
        if low <= value < high or high < value <= low:
            orbits.append(_between(model, branch.vary, value, before, after, (value - low) / (high - low)))
    if branch.values[-1] == value:
        orbits.append(_between(model, branch.vary, value, branch[-1], branch[-1], 0.0))
    if not orbits:
        raise ValueError(_absent(branch, value))
    return tuple(orbits)


def _between(
    model: Model, vary: str, value: float, before: PeriodicSolution, after: PeriodicSolution, share: float
) -> PeriodicSolution:
    free = (1.0 - share) * before.frequency + share * after.frequency
    guess = {n: (1.0 - share) * before.states[n] + share * after.states[n] for n in before.states}
    parameters = before.parameters | ({vary: value} if vary != FREQUENCY else {})
    settings = settings_of(before) | {"frequency": value if vary == FREQUENCY else free}
    return solve_periodic(model, parameters, before.inputs, guess=guess, **settings)


def _absent(branch: Branch, value: float) -> str:
    index = int(np.argmin(np.abs(branch.values - value)))
    place, unit = branch.values[index], branch.units.get(branch.vary, "")
    kind = branch.kinds[index] or ("end" if index in (0, len(branch) - 1) else "turn")
    return (
        f"value: must be on the branch of {branch[0].model!r}, got {branch.vary} = {value:.6g} {unit}; the nearest "
        f"orbit is at its {kind} at {place:.6g} {unit}."
    )
