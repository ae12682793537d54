"""select_orbits: the orbits that contain information about the parameters."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.models.model import Model
from bayesperiodic.orbits.orbit import Orbit, Orbits
from bayesperiodic.periodic.solution import PeriodicSolution, multiplier_sensitivities

# Directions with less information than this fraction of the largest are ignored.
LEAST_EIGENVALUE = 1e-10


@in_one_thread
def select_orbits(
    orbits: Orbits,
    parameters: Iterable[str],
    *,
    model: Model | None = None,
    largest_multiplier: float = 50.0,
    least_quality: float = 1e-3,
    least_gain: float = 0.01,
) -> Orbits:
    """Choose polished orbits as data for the estimation of some parameters.

    States of rest, orbits that disagree with their own returns, and very unstable orbits are left out. A return map
    with ``|μ|`` = 50 stretches 1 % of the attractor to half its size within one period; linear maps do not hold over
    such distances, few close returns remain, and the error estimates become unreliable. Of the others, those with
    little information are left out. The information of an orbit about the parameters is SᵀC⁻¹S, with the sensitivities
    S of its section points (and unstable eigenvalues) and their covariance C. The least informative orbit is removed
    repeatedly, as long as the standard deviation of no combination of the parameters rises by more than `least_gain` in
    total. Both of a pair of symmetric partners may remain, because their noise is independent.

    Parameters
    ----------
    orbits : Orbits
        From `polish_orbits`.
    parameters : iterable of str
        The parameters to be estimated.
    model : Model, optional
        If given, unstable eigenvalues are included, as in ``orbit.experiment(multipliers=True)``.
    largest_multiplier : float
        Limit of the modulus of the largest multiplier of the model's orbit.
    least_quality : float
        Lower limit of `Orbit.quality`.
    least_gain : float
        Largest acceptable relative rise of a standard deviation.

    Returns
    -------
    Orbits
        Those left out are added to `.rejected` with the reasons; partners are positions among the selected ones.

    Raises
    ------
    ValueError
        For an orbit that is not polished, an unknown parameter, or a limit that is not positive.

    Examples
    --------
    With the orbits of `polish_orbits`' example; the pendulum at rest does not depend on the parameters:

    >>> import bayesperiodic as bp
    >>> polished = bp.polish_orbits(bp.models.pendulum, pendulum_orbits, pendulum_parameters, samples=200)
    >>> best = bp.select_orbits(polished, ["m", "l"])
    >>> 0 < len(best) < len(polished), "a state of rest" in [reason for _, reason in best.rejected]
    (True, True)
    """
    names = list(parameters)
    _checks.positive("largest_multiplier", largest_multiplier)
    _checks.finite_number("least_quality", least_quality)
    _checks.positive("least_gain", least_gain)
    kept: list[Orbit] = []
    rejected = list(orbits.rejected)
    for orbit in orbits:
        reason = _unsuitable(orbit, largest_multiplier, least_quality)
        if reason:
            rejected.append((orbit, reason))
        else:
            kept.append(orbit)
    dropped = _uninformative([orbit_information(orbit, names, model) for orbit in kept], least_gain)
    for i, rise in dropped.items():
        rejected.append((kept[i], f"little information: without it, standard deviations rise by {rise:.2%} at most"))
    chosen = [orbit for i, orbit in enumerate(kept) if i not in dropped]
    position = {orbit.name: i for i, orbit in enumerate(chosen)}
    partners = [None if orbit.partner is None else position.get(orbits[orbit.partner].name) for orbit in chosen]
    selected = tuple(replace(orbit, partner=partner) for orbit, partner in zip(chosen, partners, strict=True))
    return replace(orbits, orbits=selected, rejected=tuple(rejected))


def _polished(orbit: Orbit) -> PeriodicSolution:
    if orbit.solution is None:
        raise ValueError(f"orbits: must be polished, got {orbit.name!r} without a solution. Use polish_orbits first.")
    return orbit.solution


def orbit_information(orbit: Orbit, parameters: list[str], model: Model | None = None) -> np.ndarray:
    """Return SᵀC⁻¹S (parameters, parameters), with the derivatives S by relative changes of the parameters."""
    solution = _polished(orbit)
    for name in parameters:
        _checks.one_of("parameters", name, solution.parameters)
    experiment = orbit.experiment(samples=solution.samples, multipliers=model is not None)
    by_name = multiplier_sensitivities(model, solution) if model is not None else {}
    count = 0 if experiment.multipliers is None else experiment.multipliers.size
    columns = []
    for name in parameters:
        by = [solution.sensitivities[c][name][:: solution.samples] for c in orbit.coordinates]
        column = np.stack(by, axis=-1).ravel()
        if count:
            column = np.concatenate([column, (by_name[name] / solution.multipliers).real[:count]])
        columns.append(column * (solution.parameters[name] or 1.0))
    slopes = np.stack(columns, axis=-1)
    assert experiment.covariance is not None
    return slopes.T @ np.linalg.solve(experiment.covariance, slopes)


def _unsuitable(orbit: Orbit, largest_multiplier: float, least_quality: float) -> str:
    """Return why an orbit cannot be used as data; empty if it can."""
    modulus = float(np.abs(_polished(orbit).multipliers).max())
    if orbit.equilibrium:
        return "a state of rest"
    if orbit.quality < least_quality:
        return f"disagrees with its returns: quality {orbit.quality:.2g} < {least_quality:g}"
    return f"too unstable: |μ| = {modulus:.4g} > {largest_multiplier:g}" if modulus > largest_multiplier else ""


def _uninformative(information: list[np.ndarray], most: float) -> dict[int, float]:
    """Return the orbits to leave out, with the rise of standard deviations without them and all before them."""
    dropped: dict[int, float] = {}
    if not information:
        return dropped
    values, vectors = np.linalg.eigh(np.sum(information, axis=0))
    informed = values > LEAST_EIGENVALUE * values.max()
    whitening = vectors[:, informed] / np.sqrt(values[informed])
    parts = [whitening.T @ one @ whitening for one in information]
    remaining = np.eye(whitening.shape[1])
    while len(dropped) < len(parts) - 1:
        least = {i: np.linalg.eigvalsh(remaining - part)[0] for i, part in enumerate(parts) if i not in dropped}
        best = max(least, key=least.__getitem__)
        rise = float(1.0 / np.sqrt(least[best]) - 1.0) if least[best] > 0.0 else np.inf
        if rise > most:
            break
        dropped[best], remaining = rise, remaining - parts[best]
    return dropped
