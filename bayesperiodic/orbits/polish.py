"""`polish_orbits`: orbits of a section become periodic solutions of a model, or are rejected with a reason."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bayesperiodic.blas import in_one_thread
from bayesperiodic.models.model import Model
from bayesperiodic.orbits.identity import nearest_shift
from bayesperiodic.orbits.orbit import Orbit, Orbits
from bayesperiodic.orbits.polisher import Polisher
from bayesperiodic.periodic.schemes import Scheme

SAME = 1e-5


@in_one_thread
def polish_orbits(
    model: Model,
    orbits: Orbits | Sequence[Orbit],
    parameters: Mapping[str, float],
    *,
    inputs: Mapping[str, np.ndarray] | None = None,
    parameter_sd: Mapping[str, float] | None = None,
    samples: int = 800,
    scheme: str | Scheme = "central4",
    tolerance: float = 0.01,
) -> Orbits:
    """Solve a model for every orbit of a section, and keep those that are still the measured ones.

    Newton's method starts from the whole measured cycle with its winding number; from section points alone, from the
    model integrated over one forcing period from each of them, for the winding numbers that this leaves open. A
    solution that repeats itself is brought to its prime period, and the measured points with it. It is accepted if
    every section point lies within five standard errors of the measured one: the covariance of the points, the floor
    `tolerance` and the doubt about the parameters taken together, and if its unstable multiplier has the sign of the
    measured eigenvalue, where that is known to 30 %. Of several on one orbit (cyclic shifts included) the
    one with the most returns is kept. An orbit and its mirror image under the change of all signs are two orbits, whose
    noise is independent; they know each other as partners.

    Parameters
    ----------
    model : Model
        A forced one, whose states (and rates, where there is no measured cycle) follow from the section's coordinates.
    orbits : Orbits, or sequence of Orbit
        From `find_orbits`; what was rejected before stays rejected.
    parameters : mapping of str to float
        A value for every parameter.
    inputs : mapping of str to array (samples,), optional
        Every input over one forcing period.
    parameter_sd : mapping of str to float, optional
        Standard deviations of parameters that are but a rough guess: section points may be off by as much more as these
        would move them, to first order.
    samples : int
        Grid points per forcing period.
    scheme : str or Scheme
        See `solve_periodic`.
    tolerance : float
        Standard error that every measured coordinate may have beyond its covariance, as a fraction of the range of all
        that was measured, of a turn for an angle.

    Returns
    -------
    Orbits
        The accepted ones with `.solution`, `.winding` and `.partner`, states of rest marked `.equilibrium`; in
        `.rejected` all others with the reason.

    Raises
    ------
    ValueError
        For an autonomous model, unknown names, coordinates that do not tell the model's states, and arguments that
        `solve_periodic` refuses.

    Examples
    --------
    Two thousand periods of a driven pendulum in chaotic motion; its model, integrated with Newton's method on the
    return map, has the multiplier −1.7059 on the orbit that turns once a period:

    >>> import bayesperiodic as bp
    >>> theta = {"m": 0.1, "l": 0.3, "k1": 1.8e-4, "k2": 4.5e-4, "k3": 4.5e-4, "a": 0.11, "g": 9.81, "v0": 0.05}
    >>> recording = bp.simulate(bp.models.pendulum, theta, frequency=1.4467, duration=1400, sampling_rate=60,
    ...                         start={"phi": 1})
    >>> section = bp.PoincareSection.from_recording(recording, ("angle", "rate"), frequency=1.4467, angles=["angle"])
    >>> orbits = bp.find_orbits(section, periods=[1])
    >>> polished = bp.polish_orbits(bp.models.pendulum, orbits, theta, samples=200)
    >>> [turning] = [orbit for orbit in polished if orbit.winding == 1 and orbit.eigenvalues[0].real < 0]
    >>> print(f"{turning.solution.multipliers[0].real:.3f}")
    -1.706
    """
    given = orbits if isinstance(orbits, Orbits) else Orbits(tuple(orbits))
    polisher = Polisher(model, given.orbits, parameters, inputs or {}, parameter_sd or {}, samples, scheme, tolerance)
    rejected: list[tuple[Orbit, str]] = []
    polished: list[Orbit] = []
    for orbit in given:
        found, reason = polisher.polish(orbit)
        if reason:
            rejected.append((orbit, reason))
        else:
            polished.append(found)
    accepted, doubles = _without_doubles(polished, polisher)
    return replace(given, orbits=_with_partners(accepted, polisher), rejected=(*given.rejected, *rejected, *doubles))


def _without_doubles(orbits: list[Orbit], polisher: Polisher) -> tuple[list[Orbit], list[tuple[Orbit, str]]]:
    """Return each orbit once, as the candidate with the most returns, and the other candidates with the reason."""
    kept: list[int] = []
    doubles: list[tuple[Orbit, str]] = []
    for i in sorted(range(len(orbits)), key=lambda i: -orbits[i].returns):
        for k in kept:
            shift = _shift(orbits[i], orbits[k], polisher)
            if shift is not None:
                how = f", shifted by {shift} forcing periods" if shift else ""
                doubles.append((orbits[i], f"the same orbit as {orbits[k].name!r}{how}"))
                break
        else:
            kept.append(i)
    return [orbits[i] for i in sorted(kept)], doubles


def _shift(one: Orbit, other: Orbit, polisher: Polisher, sign: int = 1) -> int | None:
    """Return the cyclic shift under which two polished orbits, all signs of one changed, are the same; None if none."""
    if one.period != other.period or one.winding is None or one.winding * sign != other.winding:
        return None
    shift, distance = nearest_shift(
        sign * polisher.points(one), polisher.points(other), polisher.angles, polisher.scales
    )
    return shift if distance <= SAME else None


def _with_partners(orbits: list[Orbit], polisher: Polisher) -> tuple[Orbit, ...]:
    found = []
    for one in orbits:
        partner = next((j for j, other in enumerate(orbits) if _shift(one, other, polisher, -1) is not None), None)
        found.append(replace(one, partner=partner))
    return tuple(found)
