"""Orbit and Orbits: unstable periodic orbits found in a section, and the experiments made of them."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesperiodic import _checks, _fourier
from bayesperiodic._io import Result
from bayesperiodic.data.experiment import DATA, Experiment
from bayesperiodic.orbits.coordinates import channels_of, integrand_of, is_output
from bayesperiodic.orbits.waveform import INDEPENDENT, Waveform
from bayesperiodic.periodic.solution import PeriodicSolution

if TYPE_CHECKING:
    import pandas as pd

# The last significant harmonic exceeds this multiple of the median amplitude of the spectrum's upper half.
NOISE_FLOOR = 5.0
# Largest bias of an eigenvalue that is used as data, in standard deviations.
MOST_BIAS = 0.5
TURN = 2.0 * np.pi
# Harmonics of the forcing that are compared of a waveform with independent values at 16 phases.
WAVEFORM_HARMONICS = INDEPENDENT // 2 - 1
_COLUMNS = (
    "name", "period", "duration", "duration_sd", "winding", "returns", "quality", "multiplier", "multiplier_sd",
    "contraction", "contraction_sd", "estimated", "modulus", "partner", "equilibrium", "remark", "rejected",
)  # fmt: skip


@dataclass(frozen=True)
class Orbit(Result):
    """One periodic orbit of a section.

    Attributes
    ----------
    name : str
        Unique among the orbits of a section, such as ``"period 3, winding 1, orbit 2"``.
    coordinates, angles : tuple of str
        The section's d coordinates, and those of them that are angles. Their channels are outputs of the model;
        delayed ones are written as in `PoincareSection`.
    frequency : float
        Of the forcing [Hz]; for a section by crossings the orbit's own returns per second.
    period : int
        Prime period in forcing periods, or in returns.
    winding : int or None
        Turns of the angle per response period, 0 without an angle; None if the section does not determine it.
    points : array (period, d)
        Section values at tau = 0, 1, …, angles in (−π, π].
    joint_covariance : array (d·period + d, d·period + d)
        Of the points, point by point, and of log|eigenvalue|, largest first; NaN where not estimated.
    eigenvalues, eigenvalue_bias : array (d,)
        Of the linearised return map over the period, largest modulus first, real or complex, and the estimated bias of
        log|eigenvalue|, which is not subtracted. With more coordinates than states, the last ones belong to no state.
    returns : int
        Number of measured close returns.
    quality : float
        P-value of the closest return under the orbit and its linearised map; small where there is no orbit.
    partner : int or None
        Position of the orbit with all signs changed among the orbits; its own if it is symmetric.
    partner_delay : float
        Forcing periods by which the partner is later: 0, or 0.5 where the forcing changes its sign in half a period,
        which is looked for in waveforms.
    sections : int
        Number of sections in which it was found, where `find_orbits` had several.
    cycle : mapping of str to array (samples·period,) or None
        The closest measured cycle by channel, angles continuous; None for a section of points alone. The waveform's
        coordinates for an orbit of another section than the first.
    waveform : Waveform or None
        All channels over the period with errors, by local regression of the motion that follows the points, from
        `find_orbits` with ``waveforms=True``; None for a section of points alone, and for the method "boxes".
    solution : PeriodicSolution or None
        The model's orbit, from `polish_orbits`.
    equilibrium : bool
        Whether it is a state of rest, which contains little information about the parameters.
    synthetic : bool
        True if the data were simulated.
    remark : str
        What is impossible, by three standard deviations and the estimated bias, about the determinant of the linearised
        return map: that of a flow is positive, with damping everywhere it is below one. Another one means that the
        coordinates do not determine the next point, or that there is no such orbit. Empty otherwise, also where the
        error is too large to tell, as is frequent for strong contraction.
    return_times : array (period,) or None
        For a section by crossings, the times from each point to the next one [s]; None with a forcing.
    duration_sd : float
        Standard error of the orbit's `duration` [s], with the estimated bias; zero with a forcing, NaN for the method
        "boxes".

    Examples
    --------
    The fixed point of the Hénon map (section as in `find_orbits`) is x = (√6.09 − 0.7)/2.8; its multipliers are the
    roots of μ² + 2.8 x μ = 0.3:

    >>> orbit = bp.find_orbits(henon_section, periods=[1])[0]
    >>> orbit.points.round(4).tolist(), orbit.eigenvalues.round(3).tolist()
    ([[0.6314, 0.1894]], [-1.924, 0.156])
    """

    name: str
    coordinates: tuple[str, ...]
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
    waveform: Waveform | None = None
    solution: PeriodicSolution | None = None
    equilibrium: bool = False
    synthetic: bool = False
    remark: str = ""
    return_times: np.ndarray | None = None
    duration_sd: float = 0.0
    partner_delay: float = 0.0
    sections: int = 1

    def __repr__(self) -> str:
        kind = ", at rest" if self.equilibrium else ""
        large = self.eigenvalues[0]
        shown = f"{large.real:.5g}" if np.isreal(large) else f"{large.real:.4g} ± {abs(large.imag):.4g}i"
        sd = self.eigenvalue_sd[0]
        error = f"sd {sd:.2g}" if np.isfinite(sd) else "sd not estimated"
        remark = f"; {self.remark}" if self.remark else ""
        lasting = "" if self.return_times is None else f"duration {self.duration:.6g} s (sd {self.duration_sd:.2g} s), "
        return f"Orbit({self.name!r}{kind}: {lasting}eigenvalue {shown} ({error}), {self.returns} returns{remark})"

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the points, (d·period, d·period), point by point."""
        size = self.points.size
        return self.joint_covariance[:size, :size]

    @property
    def duration(self) -> float:
        """Prime period in seconds."""
        return self.period / self.frequency

    @property
    def eigenvalue_sd(self) -> np.ndarray:
        """Standard deviations of the eigenvalues' moduli, (d,); NaN where not estimated."""
        return np.abs(self.eigenvalues) * np.sqrt(np.diag(self.joint_covariance)[self.points.size :])

    @property
    def _undelayed(self) -> tuple[list[str], np.ndarray]:
        """The coordinates that are outputs, without delay, and whether each coordinate is one of them (d,)."""
        present = np.array([is_output(name) for name in self.coordinates])
        if not present.any():
            raise ValueError(
                f"coordinates: must have an output without delay, got {self.coordinates}. Add one to the section's, or "
                "compare whole waveforms."
            )
        return [name for name, kept in zip(self.coordinates, present, strict=True) if kept], present

    def experiment(
        self,
        *,
        samples: int = 800,
        multipliers: bool = False,
        whole: bool = False,
        model_error: bool = False,
        states: Mapping[str, str] | None = None,
    ) -> Experiment:
        """Return the orbit as an experiment: its section points at tau = 0, 1, …, as in de Kraker et al. (1997).

        Their covariance is known up to one factor, the noise parameter "scale", common to all orbits of a problem. The
        inputs are those of the waveform, taken as exact. Delayed coordinates are left out, because all outputs of an
        experiment are compared at the same tau, and so are integrals, which are no outputs.

        For a section by crossings give ``whole=True``: the experiment, of an autonomous model, is the waveform over the
        orbit's own period. The frequency 1/`duration` with its standard error is data too; its covariance with the
        waveform is neglected.

        Parameters
        ----------
        samples : int
            Grid points per forcing period.
        multipliers : bool
            Compare the unstable eigenvalues too, as log|μ| with fixed sign and with their covariance with the points.
            One that is complex, not estimated, or whose bias exceeds half its standard deviation is left out, and so
            are all smaller ones.
        whole : bool
            Compare the waveforms of all outputs instead, at 16 phases a forcing period and with their covariance,
            which contain nearly all information. Without a waveform, all samples of the measured cycle are compared,
            with a variance per channel: it is a close return and does not close exactly; the gap counts as noise.
        model_error : bool
            With the whole waveform, compare its Fourier components, to seven times the forcing frequency, with an
            unknown variance per channel in place of the covariance: for models whose errors exceed those of the
            waveform. Residuals are then tested, and robust standard deviations take into account what they contain.
        states : mapping of str to str, optional
            The output that measures each state of the model, such as ``{"phi": "angle"}``: the first solve then starts
            from the waveform, or from the measured cycle. By default it starts from the polished solution; without one,
            the whole waveform starts it from states that are found from the waveform and the equations (guess "data" of
            `Experiment`), as hidden states need.

        Returns
        -------
        Experiment

        Raises
        ------
        ValueError
            If all coordinates are delayed or integrals, if the orbit is not polished and `states` or the winding are
            not known, if `whole` or `states` are given and there is neither waveform nor measured cycle, for the whole
            waveform together with `multipliers`, or if `samples` is not a multiple of the phases compared.

        Warns
        -----
        UserWarning
            If an unstable eigenvalue is left out.
        """
        _checks.integer("samples", samples, 4)
        if self.return_times is not None and not (whole and self.waveform is not None):
            raise ValueError(
                f"whole: must be True for {self.name!r}, whose points are crossings at unequal times, got {whole}, and "
                "the orbit must have the waveform of find_orbits(..., waveforms=True)."
            )
        winding = counted_turns(self) if self.solution is None else sum(self.solution.winding.values())
        if winding is None:
            raise ValueError(f"winding: must be known, got None for {self.name!r}. Use polish_orbits first.")
        turns = winding if self.solution is None else self.solution.winding
        compared = _compared(self, winding, samples, multipliers, whole, model_error)
        if self.solution is not None:
            inputs = {name: _on_grid(values, samples * self.period) for name, values in self.solution.inputs.items()}
        else:
            inputs = _resampled(self, winding, samples, () if self.waveform is None else self.waveform.inputs)
        free = self.return_times is not None
        experiment = Experiment(
            self.name,
            1.0 / self.duration if free else self.frequency,
            compared.pop("outputs"),
            inputs,
            samples=samples * self.period if free else samples,
            periods=1 if free else self.period,
            frequency_se=self.duration_sd / self.duration**2,
            winding=turns,
            guess=_guess(self, samples, winding, states, hidden=whole),
            synthetic=self.synthetic,
            **compared,
        )
        return _with_multipliers(self, experiment) if multipliers else experiment


@dataclass(frozen=True)
class Orbits(Result):
    """The orbits found in a section, and the rejected candidates.

    Attributes
    ----------
    orbits : tuple of Orbit
    rejected : tuple of (Orbit, str)
        With the reason.
    values : int
        Number of values in the recording or section from which they were found.
    method : str
        "chained" or "boxes", see `find_orbits`.
    prediction_error : tuple of two float
        Median error with which local maps predict the next point, and the part that known noise explains, as fractions
        of the distance of random points. An error well above the noise means that there are states that the
        coordinates do not determine, or too few points; compare sections with other coordinates.

    Examples
    --------
    Two orbits of the Hénon map (section as in `find_orbits`):

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
    prediction_error: tuple[float, float] = (np.nan, np.nan)

    @property
    def table(self) -> pd.DataFrame:
        """One row per orbit, followed by the rejected candidates with the reason in the column ``rejected``.

        `winding` is missing if unknown; `multiplier` and `contraction` are the two largest eigenvalues, whose standard
        deviations are NaN if not estimated; `remark` says which determinants are impossible (see `Orbit`);
        ``sd[angle]`` is the largest standard deviation of a point in the coordinate angle.
        """
        import pandas as pd

        names = [orbit.name for orbit in self.orbits]
        rows = [_row(orbit, names, reason) for orbit, reason in (*((o, "") for o in self.orbits), *self.rejected)]
        some = [*self.orbits[:1], *(orbit for orbit, _ in self.rejected[:1])]
        columns = [*_COLUMNS, *(f"sd[{name}]" for name in (some[0].coordinates if some else ()))]
        return pd.DataFrame(rows, columns=columns).astype({"winding": "Int64"})

    def __repr__(self) -> str:
        if not self.orbits:
            return (
                f"Orbits(none, {len(self.rejected)} rejected): try more periods, sections at several phases, steps=3 "
                "where neighbours separate fast, or a longer recording"
            )
        counts = [(p, sum(o.period == p for o in self.orbits)) for p in sorted({o.period for o in self.orbits})]
        table, empty = self.table, ["rejected"] + ["remark"] * (not any(orbit.remark for orbit in self.orbits))
        listed = ", ".join(f"{count} of period {period}" for period, count in counts)
        return (
            f"Orbits({listed}; {len(self.rejected)} rejected; method {self.method!r}, from {self.values:,} numbers)\n"
            f"{table.drop(columns=empty).head(len(self.orbits)).to_string(index=False)}"
        )

    def __len__(self) -> int:
        return len(self.orbits)

    def __getitem__(self, index: int) -> Orbit:
        return self.orbits[index]

    def __iter__(self) -> Iterator[Orbit]:
        return iter(self.orbits)


def counted_turns(orbit: Orbit) -> int | None:
    """Return the winding number counted in the section or in its measured cycle; None if neither determines it."""
    if orbit.winding is not None or orbit.cycle is None:
        return orbit.winding
    return sum(round(float(_end(orbit.cycle[name]) - orbit.cycle[name][0]) / TURN) for name in orbit.angles)


def resampled_cycle(orbit: Orbit, winding: int, samples: int) -> np.ndarray:
    """Return the motion (samples·period, channels) of the coordinates on another grid, see `_resampled`."""
    return np.stack(list(_resampled(orbit, winding, samples, channels_of(orbit.coordinates)).values()), axis=-1)


def _resampled(orbit: Orbit, winding: int, samples: int, channels: Iterable[str]) -> dict[str, np.ndarray]:
    """Return channels of the waveform, else of the cycle, on another grid, closed, with significant harmonics only.

    The gap between its end and its start is distributed over the period.
    """
    motion = orbit.cycle if orbit.waveform is None else orbit.waveform.values
    tau, result = np.arange(samples * orbit.period) / samples, {}
    for name in channels:
        assert motion is not None
        values = np.asarray(motion[name], dtype=float)
        turns = TURN * winding if name in orbit.angles else 0.0
        gap = _end(values) - values[0] - turns
        amplitudes = _fourier.coefficients(values - (turns + gap) * (np.arange(values.size) / values.size) + 0.5 * gap)
        floor = NOISE_FLOOR * np.median(np.abs(amplitudes[amplitudes.size // 2 :]))
        kept = np.flatnonzero(np.abs(amplitudes) > floor).max(initial=1)
        result[name] = _fourier.on_grid(amplitudes[: kept + 1], tau.size) + turns * tau / orbit.period
    return result


def _end(values: np.ndarray) -> float:
    """Return the end point of a cycle whose samples exclude it, by extrapolation."""
    return float(3.0 * values[-1] - 3.0 * values[-2] + values[-3])


def _on_grid(values: np.ndarray, points: int) -> np.ndarray:
    return values if values.size == points else _fourier.on_grid(_fourier.coefficients(values), points)


def _compared(
    orbit: Orbit, winding: int, samples: int, multipliers: bool, whole: bool, model_error: bool
) -> dict[str, Any]:
    """Return the arguments of the experiment that say what is compared, with which errors."""
    if model_error:
        return _components(orbit, winding, samples, multipliers, whole)
    measured: Mapping[str, np.ndarray]
    covariance: np.ndarray | None
    if whole and orbit.waveform is not None:
        measured, covariance = _of_waveform(orbit, orbit.waveform, samples, multipliers)
    elif whole:
        measured, covariance = _measured_cycle(orbit, samples), None
    else:
        used, present = orbit._undelayed
        measured = dict(zip(used, orbit.points[:, present].T, strict=True))
        rows = np.flatnonzero(np.tile(present, orbit.period))
        covariance = orbit.joint_covariance[np.ix_(rows, rows)]
    points = samples * orbit.period
    mask = np.arange(points) % (points // len(next(iter(measured.values())))) == 0
    outputs = {name: np.zeros(points) for name in measured}
    for name, values in measured.items():
        outputs[name][mask] = values
    return {"outputs": outputs, "mask": mask, "covariance": covariance}


def _components(orbit: Orbit, winding: int, samples: int, multipliers: bool, whole: bool) -> dict[str, Any]:
    """Return the arguments that compare the Fourier components of the waveform."""
    if multipliers or not whole or orbit.waveform is None:
        raise ValueError(
            f"model_error: must be False without the whole waveform of {orbit.name!r}, or with multipliers, got True. "
            "Give whole=True, with find_orbits(..., waveforms=True)."
        )
    names, highest = orbit.waveform.outputs, WAVEFORM_HARMONICS * orbit.period
    sd = orbit.waveform.sd
    return {
        "outputs": _resampled(orbit, winding, samples, names),
        "harmonics": dict.fromkeys(names, highest),
        "scatter": {name: float(np.sqrt(np.mean(sd[name] ** 2))) for name in names},
    }


def _of_waveform(
    orbit: Orbit, waveform: Waveform, samples: int, multipliers: bool
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the outputs of the waveform where their noise is independent, (values,) each, and their covariance."""
    if multipliers:
        raise ValueError(f"multipliers: must be False with the whole waveform of {orbit.name!r}, got True.")
    if samples % INDEPENDENT:
        raise ValueError(f"samples: must be a multiple of {INDEPENDENT} for the whole waveform, got {samples}.")
    every = waveform.noise.shape[1] // (INDEPENDENT * orbit.period)
    values = {name: np.array(waveform.values[name][::every]) for name in waveform.outputs}
    return values, waveform.covariance(waveform.outputs, every)


def _measured_cycle(orbit: Orbit, samples: int) -> Mapping[str, np.ndarray]:
    if orbit.cycle is None:
        raise ValueError(f"whole: must be False, got True; {orbit.name!r} has no measured cycle.")
    measured = len(next(iter(orbit.cycle.values()))) // orbit.period
    if samples % measured:
        raise ValueError(f"samples: must be a multiple of the cycle's {measured} a forcing period, got {samples}.")
    return {name: values for name, values in orbit.cycle.items() if not integrand_of(name)}


def _guess(
    orbit: Orbit, samples: int, winding: int, states: Mapping[str, str] | None, hidden: bool
) -> str | dict[str, np.ndarray]:
    """Return the states from which the first solve starts: of outputs, of the solution, or found from the waveform."""
    if states is not None:
        if orbit.cycle is None and orbit.waveform is None:
            raise ValueError(
                f"states: must be None, got {states!r}; {orbit.name!r} has no measured cycle. Use polish_orbits first."
            )
        measured = orbit.waveform.outputs if orbit.waveform is not None else tuple(orbit.cycle or ())
        for name in states.values():
            _checks.one_of("states", name, measured)
        motion = _resampled(orbit, winding, samples, states.values())
        return {state: motion[name] for state, name in states.items()}
    if orbit.solution is None and orbit.waveform is not None and hidden and orbit.return_times is None:
        return DATA
    if orbit.solution is None:
        raise ValueError(
            f"states: must name the coordinate that measures each state, such as {{'phi': 'angle'}}, got None; "
            f"{orbit.name!r} is not polished. If states of a forced model are hidden, give whole=True."
        )
    tau = np.arange(samples * orbit.period) / samples
    guess = {}
    for name, values in orbit.solution.states.items():
        turns = TURN * orbit.solution.winding.get(name, 0) / orbit.solution.periods
        guess[name] = _on_grid(values - turns * orbit.solution.tau, tau.size) + turns * tau
    return guess


def _with_multipliers(orbit: Orbit, experiment: Experiment) -> Experiment:
    """Return the experiment with the unstable eigenvalues that can be used, and their covariance with the points."""
    size = orbit.points.size
    sd = np.sqrt(np.diag(orbit.joint_covariance)[size:])
    with np.errstate(invalid="ignore"):
        known = np.isfinite(sd) & (np.abs(orbit.eigenvalue_bias) <= MOST_BIAS * sd) & np.isreal(orbit.eigenvalues)
    unstable = np.abs(orbit.eigenvalues) > 1.0
    kept, omitted = np.flatnonzero(unstable & known), np.flatnonzero(unstable & ~known)
    if omitted.size:
        value = orbit.eigenvalues[omitted[0]]
        why = "complex" if np.iscomplex(value) else "not estimated, or its bias exceeds half its standard deviation"
        text = f"The eigenvalue {value:.4g} of {orbit.name!r} is left out: it is {why}."
        warnings.warn(text, UserWarning, stacklevel=3)
        # Multipliers are compared in the order of their moduli, so none below an omitted one can be used.
        kept = kept[kept < omitted[0]]
    if not kept.size:
        return experiment
    values = orbit.eigenvalues[kept].real
    if experiment.covariance is None:
        return replace(experiment, multipliers=values, multiplier_sd=sd[kept])
    points = np.flatnonzero(np.tile(orbit._undelayed[1], orbit.period))
    rows = np.concatenate([points, size + kept])
    return replace(experiment, multipliers=values, covariance=orbit.joint_covariance[np.ix_(rows, rows)])


def _row(orbit: Orbit, names: list[str], reason: str) -> tuple[Any, ...]:
    sds = np.sqrt(np.diag(orbit.covariance)).reshape(orbit.points.shape).max(axis=0)
    multiplier, contraction = (
        value.real if np.isreal(value) else value for value in np.append(orbit.eigenvalues, np.nan)[:2]
    )
    partner = "" if orbit.partner is None or orbit.partner >= len(names) else names[orbit.partner]
    multiplier_sd, contraction_sd = np.append(orbit.eigenvalue_sd, np.nan)[:2]
    return (
        orbit.name, orbit.period, orbit.duration, orbit.duration_sd, orbit.winding, orbit.returns, orbit.quality,
        multiplier, multiplier_sd, contraction, contraction_sd, bool(np.isfinite(multiplier_sd)),
        float(abs(orbit.eigenvalues[0])), partner, orbit.equilibrium, orbit.remark, reason, *sds,
    )  # fmt: skip
