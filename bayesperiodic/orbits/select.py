"""`select_orbits`: the orbits worth having as data, the information in them weighed against their noise."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.models.model import Model
from bayesperiodic.orbits.orbit import Orbit, Orbits
from bayesperiodic.periodic.stability import multiplier_sensitivities

DIRECTIONS = 1e-10


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

    Left out are states of rest, orbits that their own returns speak against, and orbits so unstable that nothing near
    them is linear any more: a return map that stretches by ``|μ|`` = 50 takes points from 1 % of the attractor's size
    half across it within one period, so that closer and ever fewer returns must tell the points, and their error bars
    are not to be trusted. Of the others, those go that tell hardly anything: the information of an orbit about the
    parameters is SᵀC⁻¹S, with the sensitivities S of its section points (and unstable eigenvalues) and their covariance
    C; one by one the least informative is dropped, as long as without all those dropped the standard deviation of no
    combination of the parameters rises by more than `least_gain`. Both of a pair of symmetric partners may stay, for
    their noise is independent.

    Parameters
    ----------
    orbits : Orbits
        From `polish_orbits`.
    parameters : iterable of str
        Those to be estimated.
    model : Model, optional
        With it, unstable eigenvalues count too, as in ``orbit.experiment(multipliers=True)``.
    largest_multiplier : float
        Limit of the largest multiplier's modulus, of the model's orbit.
    least_quality : float
        Limit of `Orbit.quality`.
    least_gain : float
        The rise of a standard deviation that is put up with.

    Returns
    -------
    Orbits
        With those left out, and the reasons, added to `.rejected`; partners are counted anew.

    Raises
    ------
    ValueError
        For an orbit that is not polished, an unknown parameter, a negative limit.

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
    left: list[tuple[Orbit, str]] = []
    for orbit in orbits:
        reason = _unfit(orbit, largest_multiplier, least_quality)
        if reason:
            left.append((orbit, reason))
        else:
            kept.append(orbit)
    dropped = _uninformative([orbit_information(orbit, names, model) for orbit in kept], least_gain)
    for i, rise in dropped.items():
        left.append((kept[i], f"tells little more: without it, standard deviations rise by {rise:.2%} at most"))
    chosen = [i for i in range(len(kept)) if i not in dropped]
    return replace(orbits, orbits=_renumbered(orbits, [kept[i] for i in chosen]), rejected=(*orbits.rejected, *left))


def orbit_information(orbit: Orbit, parameters: list[str], model: Model | None = None) -> np.ndarray:
    """Return SᵀC⁻¹S (parameters, parameters), the derivatives S taken by relative changes of the parameters."""
    solution = orbit.solution
    if solution is None:
        raise ValueError(f"orbits: {orbit.name!r} is not allowed; it is not polished, see polish_orbits.")
    for name in parameters:
        _checks.one_of("parameters", name, solution.parameters)
    columns = []
    experiment = orbit.experiment(samples=solution.samples, multipliers=model is not None)
    by_name = multiplier_sensitivities(model, solution) if model is not None else {}
    count = 0 if experiment.multipliers is None else experiment.multipliers.size
    for name in parameters:
        by = [solution.sensitivities[c][name][:: solution.samples] for c in orbit.coordinates]
        column = np.stack(by, axis=-1).ravel()
        if count:
            column = np.concatenate([column, (by_name[name] / solution.multipliers).real[:count]])
        columns.append(column * (solution.parameters[name] or 1.0))
    slopes = np.stack(columns, axis=-1)
    assert experiment.covariance is not None
    return slopes.T @ np.linalg.solve(experiment.covariance, slopes)


def _unfit(orbit: Orbit, largest_multiplier: float, least_quality: float) -> str:
    """Return why an orbit is no data at all; nothing if it is."""
    if orbit.solution is None:
        raise ValueError(f"orbits: {orbit.name!r} is not allowed; it is not polished, see polish_orbits.")
    if orbit.equilibrium:
        return "a state of rest"
    if orbit.quality < least_quality:
        return f"its returns speak against it (quality {orbit.quality:.2g} < {least_quality:g})"
    modulus = float(np.abs(orbit.solution.multipliers).max())
    return f"too unstable: |μ| = {modulus:.4g} > {largest_multiplier:g}" if modulus > largest_multiplier else ""


def _uninformative(information: list[np.ndarray], most: float) -> dict[int, float]:
    """Return which orbits may go, and by how much standard deviations rise without them and all that went before."""
    dropped: dict[int, float] = {}
    if not information:
        return dropped
    total = np.sum(information, axis=0)
    values, vectors = np.linalg.eigh(total)
    told = values > DIRECTIONS * values.max()
    white = vectors[:, told] / np.sqrt(values[told])
    parts = [white.T @ one @ white for one in information]
    now = np.eye(white.shape[1])
    while len(dropped) < len(parts) - 1:
        left = {i: np.linalg.eigvalsh(now - part)[0] for i, part in enumerate(parts) if i not in dropped}
        best = max(left, key=lambda i: left[i])
        rise = float(1.0 / np.sqrt(left[best]) - 1.0) if left[best] > 0.0 else np.inf
        if rise > most:
            break
        dropped[best], now = rise, now - parts[best]
    return dropped


def _renumbered(before: Orbits, chosen: list[Orbit]) -> tuple[Orbit, ...]:
    """Return the chosen orbits, partners as positions among them."""
    places = {orbit.name: i for i, orbit in enumerate(chosen)}
    partners = [None if o.partner is None else places.get(before[o.partner].name) for o in chosen]
    return tuple(replace(o, partner=partner) for o, partner in zip(chosen, partners, strict=True))
