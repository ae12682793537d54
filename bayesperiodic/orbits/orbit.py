"""Orbit and Orbits: unstable periodic orbits as they were found in a section, and polished with a model."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesperiodic import _checks, _fourier
from bayesperiodic._io import Result
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.models.integrate import integrate
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.solution import PeriodicSolution

if TYPE_CHECKING:
    import pandas as pd


NOISE_FLOOR = 5.0
MOST_TRIED = 12
TURN = 2 * np.pi


def seeds(
    orbit: Orbit, build: Callable[[int], PeriodicEquations], parameters: np.ndarray
) -> Iterator[tuple[PeriodicEquations, np.ndarray]]:
    """Yield the equations of a winding number and a guess z (points, states), the likeliest first.

    The measured cycle comes first. Where there is none, or it leads to nothing, the model is integrated over one
    forcing period from each section point, and its pieces are bent so that they meet; where that leaves the turns of an
    angle open, the windings follow in the order of how much bending they need.

    Parameters
    ----------
    orbit : Orbit
    build : callable
        Returns the equations for a winding number.
    parameters : array (parameters,)

    Raises
    ------
    ValueError
        If the section's coordinates do not tell the model's states.
    """
    winding = counted_turns(orbit)
    if orbit.cycle is not None:
        assert winding is not None
        equations = build(winding)
        yield equations, _from_cycle(orbit, equations, parameters, winding)
    for turns, z in _from_points(orbit, build(0), parameters):
        if winding is None or turns == winding:
            equations = build(turns)
            yield equations, z - equations.drift * equations.grid.tau[:, None]


def counted_turns(orbit: Orbit) -> int | None:
    """Return the winding number that the section counted, or that its cycle shows; None where neither can tell."""
    if orbit.winding is not None or orbit.cycle is None:
        return orbit.winding
    turns = [round(float(_end(orbit.cycle[name]) - orbit.cycle[name][0]) / TURN) for name in orbit.angles]
    return int(turns[0]) if turns else 0


def resampled_cycle(orbit: Orbit, winding: int, samples: int) -> np.ndarray:
    """Return the measured cycle (samples·period, 2) on another grid, closed, without harmonics that are mere noise.

    The gap between its end and its beginning is spread over the cycle. A harmonic is noise where it and all above it
    stay below five times the median amplitude of the upper half of the spectrum.
    """
    assert orbit.cycle is not None
    tau, columns = np.arange(samples * orbit.period) / samples, []
    for name in orbit.coordinates:
        values = np.asarray(orbit.cycle[name], dtype=float)
        turns = TURN * winding if name in orbit.angles else 0.0
        share = np.arange(values.size) / values.size
        gap = _end(values) - values[0] - turns
        amplitudes = _fourier.coefficients(values - (turns + gap) * share + 0.5 * gap)
        floor = NOISE_FLOOR * np.median(np.abs(amplitudes[amplitudes.size // 2 :]))
        kept = np.flatnonzero(np.abs(amplitudes) > floor).max(initial=1)
        columns.append(_fourier.on_grid(amplitudes[: kept + 1], tau.size) + turns * tau / orbit.period)
    return np.stack(columns, axis=-1)


def _end(values: np.ndarray) -> float:
    """Return where a cycle without its end point ends."""
    return float(3.0 * values[-1] - 3.0 * values[-2] + values[-3])


def _from_cycle(orbit: Orbit, equations: PeriodicEquations, parameters: np.ndarray, winding: int) -> np.ndarray:
    values = resampled_cycle(orbit, winding, equations.grid.samples)
    known = _phases(orbit, equations, parameters, values, equations.grid.tau, equations.inputs)[:, : equations.count]
    return known - equations.drift * equations.grid.tau[:, None]


def _from_points(
    orbit: Orbit, equations: PeriodicEquations, parameters: np.ndarray
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield winding numbers and states (points, states), turns included, that go through the section points."""
    model, samples, periods = equations.model, equations.grid.samples, orbit.period
    tau = np.arange(periods, dtype=float)
    starts = _phases(orbit, equations, parameters, orbit.points, tau, equations.inputs[::samples], rates=True)
    half = _fourier.on_grid(_fourier.coefficients(equations.inputs[:samples].T), 2 * samples).T
    pieces = []
    for start in starts:
        piece = integrate(
            model,
            start,
            half,
            parameters,
            frequency=equations.frequency,
            samples=samples,
            steps=samples + 1,
            kept=samples + 1,
        )
        if piece is None:
            return
        pieces.append(piece[:, : equations.count])
    path = np.stack(pieces)
    missed = path[:, -1] - np.roll(starts[:, : equations.count], -1, axis=0)
    angle = next((i for i, state in enumerate(model.states) if state in model.angles), None)
    if angle is None:
        yield 0, _joined(path, missed, None, np.zeros(periods))
        return
    exact = missed[:, angle] / TURN
    choices = [(np.floor(turns), np.ceil(turns)) for turns in exact]
    ranked = sorted(product(*choices), key=lambda turns: float(np.sum((exact - np.array(turns)) ** 2)))
    for turns in ranked[:MOST_TRIED]:
        yield int(sum(turns)), _joined(path, missed, angle, np.array(turns))


def _joined(path: np.ndarray, missed: np.ndarray, angle: int | None, turns: np.ndarray) -> np.ndarray:
    """Return the pieces (periods, samples + 1, states) bent so that each ends where the next one starts."""
    periods, length, count = path.shape
    bend, before = missed.copy(), np.zeros((periods, count))
    if angle is not None:
        bend[:, angle] -= TURN * turns
        before[1:, angle] = TURN * np.cumsum(turns[:-1])
    # Errors grow along an unstable orbit, so most of the bending belongs to the end of a piece.
    share = (np.arange(length - 1) / (length - 1)) ** 2
    return (path[:, :-1] - share[:, None] * bend[:, None] + before[:, None]).reshape(-1, count)


def _phases(
    orbit: Orbit,
    equations: PeriodicEquations,
    parameters: np.ndarray,
    values: np.ndarray,
    tau: np.ndarray,
    inputs: np.ndarray,
    rates: bool = False,
) -> np.ndarray:
    """Return the states, then the rates of the second-order ones, (points, size), from the section's coordinates.

    Rates may stay untold unless they are asked for.
    """
    model, count = equations.model, equations.count
    columns = [model.outputs.index(name) for name in orbit.coordinates]
    second = [i for i, state in enumerate(model.states) if model.orders[state] == 2]
    places = [*range(count), *(count + i for i in second)]

    def outputs(phase: np.ndarray) -> np.ndarray:
        states = np.zeros((tau.size, 3 * count))
        states[:, places] = phase
        inputs_here = np.ascontiguousarray(inputs)
        return model.kernels.evaluate("outputs", states, inputs_here, parameters, tau, equations.frequency)[:, columns]

    offset = outputs(np.zeros(len(places)))
    slopes = np.stack([outputs(unit) - offset for unit in np.eye(len(places))], axis=-1)
    inverse = np.linalg.pinv(slopes)
    wanted = len(places) if rates else count
    phases = np.einsum("nip,np->ni", inverse, values - offset)
    told = np.allclose((inverse @ slopes)[:, :wanted], np.eye(len(places))[:wanted], atol=1e-6)
    if not told or not np.allclose(outputs(phases), values, rtol=1e-6, atol=1e-9):
        what = "states and rates" if rates else "states"
        raise ValueError(
            f"coordinates: {orbit.coordinates} are not allowed; the {what} of {model.name!r}, {list(model.states)}, "
            "must follow from them by linear equations. Make the section of outputs that are linear in these, such as "
            "a state and its rate."
        )
    return phases


MOST_BIAS = 0.5


def orbit_experiment(
    orbit: Orbit, *, samples: int, multipliers: bool, whole: bool, states: Mapping[str, str] | None
) -> Experiment:
    """Return an orbit as an experiment; see `Orbit.experiment`."""
    _checks.integer("samples", samples, 4)
    winding = counted_turns(orbit) if orbit.solution is None else sum(orbit.solution.winding.values())
    if winding is None:
        raise ValueError(f"winding: that of {orbit.name!r} is not known; polish the orbit with a model first.")
    points = samples * orbit.period
    covariance: np.ndarray | None = None
    if whole:
        outputs, mask = _whole(orbit, samples)
    else:
        covariance, mask = orbit.covariance, np.arange(points) % samples == 0
        outputs = {name: np.zeros(points) for name in orbit.coordinates}
        for name, values in zip(orbit.coordinates, orbit.points.T, strict=True):
            outputs[name][mask] = values
    experiment = Experiment(
        orbit.name,
        orbit.frequency,
        outputs,
        _inputs(orbit, points),
        samples=samples,
        periods=orbit.period,
        winding=winding if orbit.solution is None else orbit.solution.winding,
        mask=mask,
        covariance=covariance,
        guess=_guess(orbit, samples, winding, states),
        synthetic=orbit.synthetic,
    )
    return _with_multipliers(orbit, experiment) if multipliers else experiment


def _with_multipliers(orbit: Orbit, experiment: Experiment) -> Experiment:
    """Return the experiment with the unstable eigenvalues that are data, and their covariance with the points."""
    size = orbit.points.size
    sd = np.sqrt(np.diag(orbit.joint_covariance)[size:])
    with np.errstate(invalid="ignore"):
        known = np.isfinite(sd) & (np.abs(orbit.eigenvalue_bias) <= MOST_BIAS * sd) & np.isreal(orbit.eigenvalues)
    unstable = np.abs(orbit.eigenvalues) > 1.0
    kept, left = np.flatnonzero(unstable & known), np.flatnonzero(unstable & ~known)
    if left.size:
        why = "complex" if np.iscomplex(orbit.eigenvalues[left[0]]) else "not estimated, or biased by more than sd/2"
        warnings.warn(
            f"The eigenvalue {orbit.eigenvalues[left[0]]:.4g} of {orbit.name!r} is left out; it is {why}.",
            UserWarning,
            stacklevel=4,
        )
        # Multipliers are compared largest first, so none may be used below one that is left out.
        kept = kept[kept < left[0]]
    if not kept.size:
        return experiment
    values = orbit.eigenvalues[kept].real
    if experiment.covariance is None:
        return replace(experiment, multipliers=values, multiplier_sd=sd[kept])
    rows = np.concatenate([np.arange(size), size + kept])
    return replace(experiment, multipliers=values, covariance=orbit.joint_covariance[np.ix_(rows, rows)])


def _whole(orbit: Orbit, samples: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the measured cycle on the grid, and the points at which it was measured."""
    if orbit.cycle is None:
        raise ValueError(f"whole: True is not allowed; {orbit.name!r} has no measured cycle, so leave it out.")
    measured = len(orbit.cycle[orbit.coordinates[0]]) // orbit.period
    if samples % measured:
        raise ValueError(
            f"samples: {samples} is not allowed; the cycle has {measured} a forcing period, so take a multiple of it."
        )
    every, points = samples // measured, samples * orbit.period
    outputs = {name: np.zeros(points) for name in orbit.coordinates}
    for name in orbit.coordinates:
        outputs[name][::every] = orbit.cycle[name]
    return outputs, np.arange(points) % every == 0


def _inputs(orbit: Orbit, points: int) -> dict[str, np.ndarray]:
    if orbit.solution is None:
        return {}
    return {name: _on_grid(values, points) for name, values in orbit.solution.inputs.items()}


def _on_grid(values: np.ndarray, points: int) -> np.ndarray:
    return values if values.size == points else _fourier.on_grid(_fourier.coefficients(values), points)


def _guess(orbit: Orbit, samples: int, winding: int, states: Mapping[str, str] | None) -> dict[str, np.ndarray]:
    """Return the states from which the first solve starts: of the solution, or named coordinates of the cycle."""
    if states is not None:
        if orbit.cycle is None:
            raise ValueError(
                f"states: they are not allowed; {orbit.name!r} has no measured cycle. Polish it with a model first."
            )
        cycle = resampled_cycle(orbit, winding, samples)
        for name in states.values():
            _checks.one_of("states", name, orbit.coordinates)
        return {state: cycle[:, orbit.coordinates.index(name)] for state, name in states.items()}
    solution = orbit.solution
    if solution is None:
        raise ValueError(
            f"states: they are needed; {orbit.name!r} is not polished, so tell which coordinate is which state of the "
            "model, such as states={'phi': 'angle'}."
        )
    tau = np.arange(samples * orbit.period) / samples
    guess = {}
    for name, values in solution.states.items():
        turns = 2 * np.pi * solution.winding.get(name, 0) / solution.periods
        guess[name] = _on_grid(values - turns * solution.tau, tau.size) + turns * tau
    return guess


_COLUMNS = (
    "name", "period", "winding", "returns", "quality", "multiplier", "multiplier_sd", "contraction", "contraction_sd",
    "estimated", "modulus", "sd_first", "sd_second", "partner", "equilibrium", "rejected",
)  # fmt: skip


@dataclass(frozen=True)
class Orbit(Result):
    """One periodic orbit of a section.

    Attributes
    ----------
    name : str
        Unique among the orbits of a section, such as ``"period 3, winding 1, orbit 2"``.
    coordinates : tuple of str
        The two outputs of the model that the section shows.
    angles : tuple of str
        The coordinates that are angles.
    frequency : float
        Of the forcing [Hz].
    period : int
        Prime period in forcing periods.
    winding : int or None
        Turns of the angle per response period; None where the section cannot tell, 0 where no coordinate is an angle.
    points : array (period, 2)
        Section values at tau = 0, 1, …, angles in (−π, π].
    joint_covariance : array (2·period + 2, 2·period + 2)
        Of the points, point by point, and of log|eigenvalue|, largest first; NaN for eigenvalues that are not
        estimated.
    eigenvalues : array (2,)
        Of the linearised return map over the period, largest modulus first, real or complex.
    eigenvalue_bias : array (2,)
        Estimated bias of log|eigenvalue|, which was not taken off.
    returns : int
        Measured close returns behind the orbit.
    quality : float
        P-value of the returns under the orbit and its linearised map; small where there is no orbit.
    partner : int or None
        Position of the orbit with all signs changed among the orbits; its own where it is symmetric.
    cycle : mapping of str to array (samples·period,) or None
        The closest measured cycle by coordinate, angles running on without jumps; None where the section is of points
        alone.
    solution : PeriodicSolution or None
        The model's orbit, once polished.
    equilibrium : bool
        Whether it is a state of rest, which says little of the parameters.
    synthetic : bool
        True if the data were simulated.

    Examples
    --------
    The fixed point of the Hénon map (section as in `find_orbits`) is x = (√6.09 − 0.7)/2.8; its multipliers are the
    roots of μ² + 2.8 x μ = 0.3:

    >>> import bayesperiodic as bp
    >>> orbit = bp.find_orbits(henon_section, periods=[1])[0]
    >>> orbit.points.round(4).tolist(), orbit.eigenvalues.round(3).tolist()
    ([[0.6314, 0.1894]], [-1.924, 0.156])
    """

    name: str
    coordinates: tuple[str, str]
    angles: tuple[str, ...]
    frequency: float
    period: int
    winding: int | None
    points: np.ndarray
    joint_covariance: np.ndarray
    eigenvalues: np.ndarray
    eigenvalue_bias: np.ndarray
    returns: int
    quality: float
    partner: int | None = None
    cycle: Mapping[str, np.ndarray] | None = None
    solution: PeriodicSolution | None = None
    equilibrium: bool = False
    synthetic: bool = False

    def __repr__(self) -> str:
        kind = ", at rest" if self.equilibrium else ""
        large = self.eigenvalues[0]
        shown = f"{large.real:.5g}" if np.isreal(large) else f"{large.real:.4g} ± {abs(large.imag):.4g}i"
        sd = self.eigenvalue_sd[0]
        error = f"sd {sd:.2g}" if np.isfinite(sd) else "sd not estimated"
        return f"Orbit({self.name!r}{kind}: eigenvalue {shown} ({error}), {self.returns} returns)"

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the points, (2·period, 2·period), point by point."""
        size = self.points.size
        return self.joint_covariance[:size, :size]

    @property
    def eigenvalue_sd(self) -> np.ndarray:
        """Standard deviations of the eigenvalues' moduli, (2,); NaN where not estimated."""
        size = self.points.size
        return np.abs(self.eigenvalues) * np.sqrt(np.diag(self.joint_covariance)[size:])

    def experiment(
        self,
        *,
        samples: int = 800,
        multipliers: bool = False,
        whole: bool = False,
        states: Mapping[str, str] | None = None,
    ) -> Experiment:
        """Return the orbit as an experiment: its section points at tau = 0, 1, …, as in de Kraker et al. (1997).

        Their covariance is known up to one factor, the noise parameter "scale", common to all orbits of a problem.

        Parameters
        ----------
        samples : int
            Grid points per forcing period.
        multipliers : bool
            Compare the unstable eigenvalues too, as log|μ| with fixed sign and with the covariance they share with the
            points. One that is complex, not estimated, or whose bias exceeds half its standard deviation is left out,
            and so is every smaller one.
        whole : bool
            Compare all samples of the measured cycle instead, with a variance per channel. A cycle that is but a close
            return does not close; the gap counts as noise.
        states : mapping of str to str, optional
            Which coordinate is which state of the model, such as ``{"phi": "angle"}``: the first solve then starts from
            the measured cycle. By default it starts from the polished solution.

        Returns
        -------
        Experiment

        Raises
        ------
        ValueError
            If the orbit is not polished and `states` or the winding are not known, if `whole` or `states` are given and
            there is no measured cycle, if `samples` is no multiple of the cycle's.

        Warns
        -----
        UserWarning
            If an unstable eigenvalue is left out.
        """
        return orbit_experiment(self, samples=samples, multipliers=multipliers, whole=whole, states=states)


@dataclass(frozen=True)
class Orbits(Result):
    """The orbits found in a section, and what was not taken.

    Attributes
    ----------
    orbits : tuple of Orbit
    rejected : tuple of (Orbit, str)
        With the reason.
    values : int
        Numbers in the recording or section from which they were found.
    method : str
        "chained" or "boxes", see `find_orbits`.

    Examples
    --------
    Two orbits of the Hénon map (section as in `find_orbits`):

    >>> import bayesperiodic as bp
    >>> orbits = bp.find_orbits(henon_section, periods=[1, 2])
    >>> len(orbits), orbits[1].name, orbits.rejected
    (2, 'period 2, winding 0, orbit 1', ())
    >>> orbits.table[["period", "modulus"]].round(3)
       period  modulus
    0       1    1.924
    1       2    3.010
    """

    orbits: tuple[Orbit, ...]
    rejected: tuple[tuple[Orbit, str], ...] = field(default=())
    values: int = 0
    method: str = ""

    @property
    def table(self) -> pd.DataFrame:
        """One row an orbit, those not taken below with their reason.

        Columns: name, period, winding (missing where unknown), returns, quality, multiplier and contraction (the two
        eigenvalues), their standard deviations (NaN: not estimated), `estimated` (whether that of the multiplier is),
        modulus of the multiplier, largest standard deviation of a point in the first and in the second coordinate,
        the partner's name, equilibrium, rejected (the reason, empty for orbits that were taken).
        """
        import pandas as pd

        names = [orbit.name for orbit in self.orbits]
        rows = [_row(orbit, names, "") for orbit in self.orbits]
        rows += [_row(orbit, names, reason) for orbit, reason in self.rejected]
        table = pd.DataFrame(rows, columns=list(_COLUMNS))
        return table.astype({"winding": "Int64"})

    def __repr__(self) -> str:
        if not self.orbits:
            return f"Orbits(none, {len(self.rejected)} rejected)"
        counts = [(p, sum(o.period == p for o in self.orbits)) for p in sorted({o.period for o in self.orbits})]
        listed = ", ".join(f"{count} of period {period}" for period, count in counts)
        return (
            f"Orbits({listed}; {len(self.rejected)} rejected; method {self.method!r}, from {self.values:,} numbers)\n"
            f"{self.table.drop(columns=['rejected']).head(len(self.orbits)).to_string(index=False)}"
        )

    def __len__(self) -> int:
        return len(self.orbits)

    def __getitem__(self, index: int) -> Orbit:
        return self.orbits[index]

    def __iter__(self) -> Iterator[Orbit]:
        return iter(self.orbits)


def _row(orbit: Orbit, names: list[str], reason: str) -> tuple[Any, ...]:
    sds = np.sqrt(np.diag(orbit.covariance)).reshape(-1, 2).max(axis=0)
    multiplier, contraction = (value.real if np.isreal(value) else value for value in orbit.eigenvalues)
    partner = "" if orbit.partner is None or orbit.partner >= len(names) else names[orbit.partner]
    return (
        orbit.name,
        orbit.period,
        orbit.winding,
        orbit.returns,
        orbit.quality,
        multiplier,
        orbit.eigenvalue_sd[0],
        contraction,
        orbit.eigenvalue_sd[1],
        bool(np.isfinite(orbit.eigenvalue_sd[0])),
        float(abs(orbit.eigenvalues[0])),
        *sds,
        partner,
        orbit.equilibrium,
        reason,
    )
