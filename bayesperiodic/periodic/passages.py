"""The orbits of a branch at one value of what was varied."""

from itertools import pairwise

import numpy as np

from bayesperiodic import checks
from bayesperiodic.models.model import Model
from bayesperiodic.periodic.continuation import Branch
from bayesperiodic.periodic.equations import FREQUENCY
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.periodic.solve import solve_periodic


def solutions_at(model: Model, branch: Branch, value: float) -> tuple[PeriodicSolution, ...]:
    """Return the orbits of a branch, stable and unstable, at one value of what was varied.

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
        If the branch has no orbit there: the nearest fold or end is told. If it is of another model, or was followed in
        an input.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = np.cos(2 * np.pi * np.arange(100) / 100)
    >>> start = bp.solve_periodic(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, {"force": force},
    ...                           frequency=0.1, samples=100)
    >>> branch = bp.continue_periodic(bp.models.duffing, start, "frequency", until=0.4, progress=False)
    >>> [orbit.stable for orbit in bp.solutions_at(bp.models.duffing, branch, 0.25)]
    [True, False, True]
    """
    if branch[0].model != model.name:
        raise ValueError(f"model: {model.name!r} is not allowed; the branch is one of {branch[0].model!r}.")
    if branch.vary not in (*model.parameters, FREQUENCY):
        raise ValueError(f"branch: one in the input {branch.vary!r} is not allowed; take a parameter or the frequency.")
    value = checks.finite_number("value", value)
    found = []
    for (low, before), (high, after) in pairwise(zip(branch.values, branch.solutions, strict=True)):
        inside = low <= value < high or high < value <= low
        if inside:
            share = (value - low) / (high - low)
            found.append(_between(model, branch.vary, value, before, after, share))
    if branch.values[-1] == value:
        found.append(_between(model, branch.vary, value, branch[-1], branch[-1], 0.0))
    if not found:
        raise ValueError(_absent(branch, value))
    return tuple(found)


def _between(
    model: Model, vary: str, value: float, before: PeriodicSolution, after: PeriodicSolution, share: float
) -> PeriodicSolution:
    free = (1.0 - share) * before.frequency + share * after.frequency
    guess = {n: (1.0 - share) * before.states[n] + share * after.states[n] for n in before.states}
    return solve_periodic(
        model,
        before.parameters | ({vary: value} if vary != FREQUENCY else {}),
        before.inputs,
        frequency=value if vary == FREQUENCY else free,
        samples=before.samples,
        scheme=before.scheme,
        periods=before.periods,
        winding=before.winding,
        guess=guess,
    )


def _absent(branch: Branch, value: float) -> str:
    index = int(np.argmin(np.abs(branch.values - value)))
    place, unit = branch.values[index], branch.units.get(branch.vary, "")
    kind = branch.kinds[index] or ("end" if index in (0, len(branch) - 1) else "turn")
    return (
        f"value: {branch.vary} = {value:.6g} {unit} is not allowed; the branch of {branch[0].model!r} has no orbit "
        f"there, the nearest is at its {kind} at {place:.6g} {unit}."
    )
