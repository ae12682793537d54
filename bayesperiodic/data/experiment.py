"""Experiments: one measured period on an equidistant grid, with its uncertainty."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from bayesperiodic import _checks, _fourier
from bayesperiodic._io import Result, Storable
from bayesperiodic._linalg import asymmetric_entry, covariance_cholesky
from bayesperiodic.data import measurements as kinds
from bayesperiodic.data.measurements import Measurement
from bayesperiodic.data.recording_check import Finding
from bayesperiodic.data.response_period import summary
from bayesperiodic.data.special_points import Fold, PhaseLag
from bayesperiodic.data.sweep import Sweep

if TYPE_CHECKING:
    import pandas as pd

MEANING, DATA = "samples·periods", "data"
CHANNEL_MAPPINGS = (
    "scatter", "independent", "harmonics", "amplitude_variance", "amplitude_freedom", "left_out", "drift", "middle",
)  # fmt: skip


@dataclass(frozen=True)
class LeftOut(Storable):
    """Harmonics of a recording above those that an experiment keeps, which are no data: (harmonics,) each."""

    harmonic: np.ndarray
    amplitude: np.ndarray  # complex
    variance: np.ndarray  # of the complex amplitude
    freedom: np.ndarray  # degrees of freedom of the variance

    def __post_init__(self) -> None:
        for member in fields(self):
            object.__setattr__(self, member.name, _checks.read_only(getattr(self, member.name)))


@dataclass(frozen=True)
class Experiment(Result):
    """One response period of measured outputs and inputs.

    Its arrays and mappings are read-only copies of those given.

    Parameters
    ----------
    name : str
        Any text without ``/``, ``[`` and ``]``.
    frequency : float
        Forcing frequency [Hz].
    outputs, inputs : mapping of str to array (samples·periods,)
        Values on the grid, end point excluded.
    samples, periods : int
        Grid points per forcing period, and forcing periods per response period.
    winding : int or mapping of str to int
        Turns of an angle per response period.
    scatter : mapping of str to float, optional
        Standard deviation of **one** cycle about the mean, within the kept harmonics, by channel.
    cycles : int
        Number of averaged cycles.
    averaged : int, optional
        Number of measured samples of each channel that the period averages; by default the grid points, or
        the points of the mask, times ``cycles``.
    independent : mapping of str to int, optional
        Effective number of independent values, by output; by default the number of measured samples, at most
        2·harmonics + 1.
    harmonics : mapping of str to int, optional
        Highest harmonic of the response period that each channel keeps; the model's outputs are projected onto the
        same harmonics before the comparison. By default all harmonics are kept.
    unmeasured : mapping of str to sequence of int, optional
        Harmonics among those kept that the outputs do not contain, such as 0, the mean, of an AC-coupled sensor: they
        are no data, are not compared, and do not count as independent values.
    amplitude_variance : mapping of str to array (harmonics + 1,), optional
        Variance of the mean's complex Fourier amplitudes.
    amplitude_freedom : mapping of str to array (harmonics + 1,), optional
        Degrees of freedom of ``amplitude_variance``; by default 2(cycles − 1), and cycles − 1 for harmonic 0.
    left_out : mapping of str to LeftOut, optional
        By output, the harmonics above those kept that the recording resolves, with the noise in them. They are no
        data, but count in the size of the error of the model (`predict`).
    error_slopes : mapping of str to mapping of str to complex array (harmonics + 1,), optional
        By input and output, the regression of the errors of the output's complex amplitudes on those of the input's;
        none where they are independent.
    frequency_se, periodicity, origin : float
        Standard error of the frequency [Hz], zero if it is known; fraction of the variance that the mean period
        explains, of the channel with the smallest one; time [s] of the recording at which τ = 0.
    middle : mapping of str to float, optional
        Time [s] from τ = 0 to the middle of the samples that a channel averages, by default zero: an error δ of the
        frequency turns its harmonics h, of the forcing period, by −2π h δ·middle.
    phase_diffusion : float
        Variance per time [rad²/s] by which the phase of the drive, or of a free-running oscillation, wanders at random.
        Zero unless the phases of the cycles show it; ``frequency_se`` contains what it causes.
    drift : mapping of str to float
        Relative growth of the strongest harmonic of each channel over the recording.
    period_drift : float
        Relative change of the period over the averaged cycles, by linear regression.
    period_test : DataFrame, optional
        Evidence of ``fold(periods="auto")``, a row for each response period tested: drive ``periods``, ``cycles``
        used, ``explained`` fraction of the variance (smallest of the channels), share of the variance ``between`` the
        lines (largest, of ``channel``; 0 if white), ``p`` of the lines that divisors lack, the ``share`` of a
        channel's variance in those of them that stand out, the ``contrast`` of the strongest to the lines beside it,
        ``verdict`` ("chosen", "not periodic", "adds no lines", "lines too small", "lines fade", "mains or alias" or
        "lacks lines"), and ``remark``, which lines there are and what would be needed.
    findings : tuple of Finding
        What the check of the recording found, see `Recording.check`.
    clocks : mapping of str to tuple of str
        Channels that other clocks than the first one have sampled, by clock. How late they are is unknown, and has to
        be a parameter of a `Problem`.
    synthetic : bool
        True if the data were simulated.
    units : mapping of str to str, optional
        Units of channels, as far as they are known, see `Recording`.
    measurements : sequence of Measurement, optional
        What instruments tell of channels without a time history, see `bp.measurements`: amplitudes, phases,
        peak-to-peak and rms values. Then `outputs` may be empty.
    sweep : Sweep, optional
        The table of responses that the experiment is a point of; see `response_table`.
    mask : bool array (samples·periods,), optional
        True at the points where the outputs were measured, such as the points of a Poincaré section; other entries
        are ignored.
    covariance : array (values, values) or (values + multipliers, values + multipliers), optional
        Covariance of the outputs at the points of the mask, point by point and in the order of `outputs` within a
        point, up to one unknown factor ("scale"). It may have further rows for the logarithms of ``multipliers``.
    multipliers, multiplier_sd : array (multipliers,), optional
        Measured Floquet multipliers, real and signed, largest modulus first, which are compared as log|μ|, and the
        standard deviations of log|μ|, if ``covariance`` has no rows for them.
    guess : "data" or mapping of str to array (samples·periods,), optional
        States of the model, including turns of angles, from which the first periodic solve starts; by default the
        equilibrium. An unstable orbit needs a guess, and so does a subharmonic one. "data", for driven models, finds
        the states that give the measured outputs and, where the outputs leave them free, solve the equations best at
        the parameters of the start.

    condition : Fold or PhaseLag, optional
        The special point at which the response is, see `jump` and `resonance_point`; its place is the data.

    Raises
    ------
    ValueError
        For arrays of a wrong length, NaN in measured samples, a frequency ≤ 0, an unknown channel, a name with ``/``,
        ``[`` or ``]``, a mask without points, a covariance that is not symmetric and positive definite, multipliers
        that are zero or have no standard deviation, variances of amplitudes that are negative, or for which there are
        too few degrees of freedom.

    Examples
    --------
    A force measured over 20 cycles, with five harmonics kept:

    >>> tau = np.arange(64) / 64
    >>> force, stroke = 30.0 * np.sin(2 * np.pi * tau), 0.01 * np.cos(2 * np.pi * tau)
    >>> run = bp.Experiment("run 1", 2.0, {"force": force}, {"stroke": stroke}, samples=64,
    ...                     harmonics={"force": 5}, scatter={"force": 0.8}, cycles=20)
    >>> run.independent, round(float(run.time[-1]), 4)
    ({'force': 11}, 0.4922)
    """

    name: str
    frequency: float
    outputs: Mapping[str, np.ndarray]
    inputs: Mapping[str, np.ndarray] = field(default_factory=dict)
    samples: int = field(kw_only=True)
    periods: int = field(default=1, kw_only=True)
    winding: int | Mapping[str, int] = field(default=0, kw_only=True)
    scatter: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    cycles: int = field(default=1, kw_only=True)
    averaged: int | None = field(default=None, kw_only=True)
    independent: Mapping[str, int] = field(default_factory=dict, kw_only=True)
    harmonics: Mapping[str, int] = field(default_factory=dict, kw_only=True)
    unmeasured: Mapping[str, Sequence[int]] = field(default_factory=dict, kw_only=True)
    amplitude_variance: Mapping[str, np.ndarray] = field(default_factory=dict, kw_only=True)
    amplitude_freedom: Mapping[str, np.ndarray] = field(default_factory=dict, kw_only=True)
    left_out: Mapping[str, LeftOut] = field(default_factory=dict, kw_only=True)
    error_slopes: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict, kw_only=True)
    frequency_se: float = field(default=0.0, kw_only=True)
    periodicity: float = field(default=1.0, kw_only=True)
    drift: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    period_drift: float = field(default=0.0, kw_only=True)
    origin: float = field(default=0.0, kw_only=True)
    middle: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    phase_diffusion: float = field(default=0.0, kw_only=True)
    period_test: "pd.DataFrame | None" = field(default=None, kw_only=True)
    findings: tuple[Finding, ...] = field(default=(), kw_only=True)
    clocks: Mapping[str, tuple[str, ...]] = field(default_factory=dict, kw_only=True)
    synthetic: bool = field(default=False, kw_only=True)
    units: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    measurements: Sequence[Measurement] = field(default=(), kw_only=True)
    sweep: Sweep | None = field(default=None, kw_only=True)
    mask: np.ndarray | None = field(default=None, kw_only=True)
    covariance: np.ndarray | None = field(default=None, kw_only=True)
    multipliers: np.ndarray | None = field(default=None, kw_only=True)
    multiplier_sd: np.ndarray | None = field(default=None, kw_only=True)
    guess: str | Mapping[str, np.ndarray] = field(default_factory=dict, kw_only=True)
    condition: Fold | PhaseLag | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if not _checks.text("name", self.name) or any(c in self.name for c in "/[]"):
            raise ValueError(f"name: must be a text without '/', '[' and ']', got {self.name!r}.")
        object.__setattr__(self, "frequency", _checks.positive("frequency", self.frequency))
        points = _checks.integer("samples", self.samples, 4) * _checks.integer("periods", self.periods, 1)
        if self.mask is not None:
            object.__setattr__(self, "mask", _checked_mask(self.mask, points))
        for kind in ("outputs", "inputs"):
            _checks.mapping(kind, getattr(self, kind), "{'force': values}")
            channels = {
                key: _checks.measured_vector(f"{kind}[{key!r}]", self._measured(kind, values), points, MEANING)
                for key, values in getattr(self, kind).items()
            }
            _checks.identifiers(kind, channels)
            object.__setattr__(self, kind, channels)
        if isinstance(self.guess, str):
            _checks.one_of("guess", self.guess, (DATA,))
        else:
            guess = {
                key: _checks.finite_vector(f"guess[{key!r}]", values, points, MEANING)
                for key, values in _checks.optional_mapping("guess", self.guess, "{'x': values}").items()
            }
            object.__setattr__(self, "guess", guess)
        if _checks.finite_number("frequency_se", self.frequency_se) < 0.0:
            raise ValueError(f"frequency_se: must be a finite number, at least 0 [Hz], got {self.frequency_se!r}.")
        for argument in CHANNEL_MAPPINGS:
            given = _checks.optional_mapping(argument, getattr(self, argument), "{'displacement': …}")
            object.__setattr__(self, argument, given)
            for key in given:
                _checks.one_of(argument, key, (*self.inputs, *self.outputs))
        self._check_sweep_and_variances()
        self._check_clocks_and_slopes()
        object.__setattr__(self, "measurements", kinds.checked(self.measurements, self.outputs))
        object.__setattr__(self, "units", _checks.checked_units(self.units, (*self.inputs, *self.channels)))
        if self.measurements and self.mask is not None:
            raise ValueError(
                "mask: must be left out of an experiment with measurements of amplitudes, phases or sizes."
            )
        measured = int(self.measured_points.sum())
        _checks.integer("cycles", self.cycles, 1)
        if self.averaged is not None:
            object.__setattr__(self, "averaged", _checks.integer("averaged", self.averaged, 1))
        counts = {key: min(measured, 2 * self.harmonics.get(key, points) + 1) for key in self.outputs}
        counts |= self.independent
        _checks.same_names("independent", counts, self.outputs)
        for key, without in self._checked_unmeasured(points).items():
            kept = min(points, 2 * self.harmonics.get(key, points) + 1)
            counts[key] = min(counts[key], kept - 2 * len(without) + (0 in without))
        object.__setattr__(self, "independent", counts)
        self._check_multipliers()
        self._check_covariance(measured * len(self.outputs))
        for member in fields(self):
            object.__setattr__(self, member.name, _checks.read_only(getattr(self, member.name)))

    def _check_clocks_and_slopes(self) -> None:
        clocks = _checks.optional_mapping("clocks", self.clocks, "{'second': ['x']}").items()
        object.__setattr__(
            self, "clocks", {name: _checks.several(f"clocks[{name!r}]", named) for name, named in clocks}
        )
        for name, named in self.clocks.items():
            for channel in named:
                _checks.one_of(f"clocks[{name!r}]", channel, (*self.inputs, *self.outputs))
        for name, slopes in _checks.mapping("error_slopes", self.error_slopes, "{'force': {'x': slopes}}").items():
            _checks.one_of("error_slopes", name, self.inputs)
            for channel in slopes:
                _checks.one_of(f"error_slopes[{name!r}]", channel, self.outputs)

    def _measured(self, kind: str, values: ArrayLike) -> ArrayLike:
        """Return the values of a channel, with zeros at points of an output that the mask excludes."""
        array, mask = np.asarray(values), self.measured_points
        if mask.all() or kind == "inputs" or array.shape != mask.shape or array.dtype.kind not in "fiu":
            return values
        return np.where(mask, array, 0.0)

    def _checked_unmeasured(self, points: int) -> dict[str, tuple[int, ...]]:
        """Store and return the harmonics that were not measured, by output, in ascending order."""
        checked = {}
        for key, without in _checks.optional_mapping("unmeasured", self.unmeasured, "{'displacement': [0]}").items():
            _checks.one_of("unmeasured", key, self.outputs)
            highest = _fourier.highest_harmonic(points)
            highest = min(self.harmonics.get(key, highest), highest)
            lines = tuple(sorted({_checks.integer(f"unmeasured[{key!r}]", h, 0) for h in without}))
            if self.mask is not None or len(lines) > highest or max(lines, default=0) > highest:
                raise ValueError(
                    f"unmeasured[{key!r}]: must be some of the harmonics 0 … {highest} that a whole period keeps, got "
                    f"{list(without)}{' and a mask' * (self.mask is not None)}."
                )
            if lines:
                checked[key] = lines
        object.__setattr__(self, "unmeasured", checked)
        return checked

    def _check_sweep_and_variances(self) -> None:
        if self.sweep is not None:
            _checks.instance("sweep", self.sweep, Sweep)
        for key, given in self.amplitude_variance.items():
            variance = np.asarray(given, dtype=float)
            if variance.ndim != 1 or not np.all(np.isfinite(variance) & (variance >= 0.0)):
                raise ValueError(
                    f"amplitude_variance[{key!r}]: must be a vector of finite values, at least 0, got {given}."
                )
            freedom = np.asarray(self.amplitude_freedom.get(key, np.ones(variance.size)), dtype=float)
            if freedom.ndim != 1 or freedom.size < variance.size or not np.all(freedom > 0.0):
                raise ValueError(
                    f"amplitude_freedom[{key!r}]: must be {variance.size} values > 0, one for each variance of the "
                    f"amplitudes, got {freedom.tolist()}."
                )

    def _check_condition(self) -> None:
        whole = self.mask is None and self.covariance is None and self.multipliers is None and self.frequency_se == 0.0
        if self.condition is not None and not (whole and self.periods == 1):
            raise ValueError(
                "condition: must be None for experiments with several periods, a mask, a covariance, multipliers, or "
                f"a frequency_se, got {self.condition!r}."
            )

    def _check_multipliers(self) -> None:
        self._check_condition()
        if self.multipliers is None:
            if self.multiplier_sd is not None:
                raise ValueError("multiplier_sd: requires `multipliers`.")
            return
        values = _checks.finite_vector("multipliers", self.multipliers)
        if not values.size or np.any(values == 0.0) or np.any(np.diff(np.abs(values)) > 0.0):
            raise ValueError(
                f"multipliers: must be real, not zero, and ordered by descending modulus, got {values.tolist()}."
            )
        object.__setattr__(self, "multipliers", values)
        if self.multiplier_sd is not None:
            sd = _checks.finite_vector("multiplier_sd", self.multiplier_sd, values.size)
            if np.any(sd <= 0.0):
                raise ValueError(f"multiplier_sd: must be > 0, got {sd.tolist()}.")
            object.__setattr__(self, "multiplier_sd", sd)

    def _check_covariance(self, values: int) -> None:
        logarithms = self.measured_multipliers.size
        if self.covariance is None:
            if logarithms and self.multiplier_sd is None:
                raise ValueError("multipliers: must have standard deviations; give multiplier_sd.")
            return
        matrix = _checks.real_array("covariance", self.covariance)
        size = values if self.multiplier_sd is not None else values + logarithms
        if matrix.shape != (size, size):
            further = f" and {logarithms} multipliers" if size > values else ""
            raise ValueError(
                f"covariance: must have shape {(size, size)}, for {values} measured values{further}, "
                f"got {matrix.shape}."
            )
        if bad := np.count_nonzero(~np.isfinite(matrix)):
            raise ValueError(f"covariance: must be finite and symmetric, got {bad} entries that are not finite.")
        if entry := asymmetric_entry(matrix):
            i, j = entry
            raise ValueError(
                f"covariance: must be finite and symmetric, got {matrix[i, j]:g} in entry [{i}, {j}] and "
                f"{matrix[j, i]:g} in entry [{j}, {i}]."
            )
        try:
            covariance_cholesky(matrix)
        except np.linalg.LinAlgError:
            raise ValueError(
                "covariance: must be positive definite, so that every combination of the values has a variance > 0."
            ) from None
        object.__setattr__(self, "covariance", matrix)

    @classmethod
    def from_harmonics(
        cls,
        name: str,
        frequency: float,
        outputs: Mapping[str, ArrayLike],
        inputs: Mapping[str, ArrayLike] | None = None,
        *,
        samples: int = 800,
        frequency_se: float = 0.0,
    ) -> "Experiment":
        """Make an experiment from harmonic amplitudes.

        Parameters
        ----------
        name : str
        frequency : float
            Frequency of harmonic 1, the forcing frequency [Hz].
        outputs, inputs : mapping of str to complex array (harmonics + 1,)
            Amplitudes c of harmonics 0, 1, 2, …: the signal is Re Σ c[h] exp(2πi h τ), so that c[0] is the mean (real),
            ``|c[h]|`` the amplitude, and c[h] of a cosine real and positive. None in outputs is a harmonic that was
            not measured; so is exactly zero, which no measurement with noise gives.
        samples : int
            Grid points per period, more than twice the highest harmonic.
        frequency_se : float
            Standard error of the frequency [Hz], zero if it is known.

        Returns
        -------
        Experiment
            Only the measured harmonics of the outputs are compared, each with two independent values, the mean with
            one.

        Raises
        ------
        ValueError
            As for `Experiment`, and for amplitudes that are not a finite vector, a mean that is not real, too few
            samples for the highest harmonic.

        Examples
        --------
        >>> run = bp.Experiment.from_harmonics("run", 2.0, {"x": [0.1, 0.02 - 0.01j]}, {"force": [0, 5]}, samples=8)
        >>> run.independent, run.inputs["force"].round(3)[:3].tolist()
        ({'x': 3}, [5.0, 3.536, 0.0])

        A stepped sine, of which only the fundamental was measured:

        >>> bp.Experiment.from_harmonics("run", 2.0, {"x": [None, 0.02 - 0.01j]}, {"force": [0, 5]}).independent
        {'x': 2}
        """
        samples = _checks.integer("samples", samples, 4)
        example = "{'displacement': [0, 1 - 0.5j]}"
        given = {c: _without_none(values) for c, values in _checks.mapping("outputs", outputs, example).items()}
        measured, driven = (
            {channel: _amplitudes(f"{kind}[{channel!r}]", values, samples) for channel, values in values_of.items()}
            for kind, values_of in (("outputs", given), ("inputs", _checks.optional_mapping("inputs", inputs, example)))
        )
        for channel, amplitudes in measured.items():
            if not amplitudes.any():
                raise ValueError(f"outputs[{channel!r}]: must have an amplitude that is not zero or None, got none.")
        return cls(
            name,
            frequency,
            {channel: _fourier.on_grid(amplitudes, samples) for channel, amplitudes in measured.items()},
            {channel: _fourier.on_grid(amplitudes, samples) for channel, amplitudes in driven.items()},
            samples=samples,
            harmonics={channel: amplitudes.size - 1 for channel, amplitudes in measured.items()},
            unmeasured={channel: np.flatnonzero(c == 0.0).tolist() for channel, c in measured.items()},
            frequency_se=frequency_se,
        )

    @property
    def tau(self) -> np.ndarray:
        """Time in forcing periods, (samples·periods,)."""
        return np.arange(self.samples * self.periods) / self.samples

    @property
    def time(self) -> np.ndarray:
        """Time within the response period [s], (samples·periods,)."""
        return self.tau / self.frequency

    @property
    def measured_points(self) -> np.ndarray:
        """The points at which the outputs were measured, bool (samples·periods,)."""
        return np.ones(self.samples * self.periods, dtype=bool) if self.mask is None else self.mask

    @property
    def measured_multipliers(self) -> np.ndarray:
        """The Floquet multipliers that were measured, (multipliers,); none by default."""
        return np.empty(0) if self.multipliers is None else self.multipliers

    @property
    def channels(self) -> tuple[str, ...]:
        """The outputs of which something was measured."""
        of = (channel for one in self.measurements for channel in (one.channel, *one.others))
        return tuple(dict.fromkeys((*self.outputs, *(channel for channel in of if channel not in self.inputs))))

    def without_multipliers(self) -> "Experiment":
        """Return the experiment without its multipliers.

        Returns
        -------
        Experiment
        """
        count, covariance = self.measured_multipliers.size, self.covariance
        if count and covariance is not None and self.multiplier_sd is None:
            covariance = covariance[:-count, :-count]
        return replace(self, multipliers=None, multiplier_sd=None, covariance=covariance) if count else self

    def compared(self, channel: str, values: np.ndarray) -> np.ndarray:
        """Return what is compared of signals: the harmonics kept, or the values at the points of the mask.

        Parameters
        ----------
        channel : str
        values : array (…, samples·periods)

        Returns
        -------
        array (…, samples·periods)
            Zero at points that were not measured.
        """
        return self.project(channel, values) if self.mask is None else np.where(self.mask, values, 0.0)

    def project(self, channel: str, values: np.ndarray) -> np.ndarray:
        """Project signals onto the harmonics that the measured channel keeps.

        Parameters
        ----------
        channel : str
        values : array (…, samples·periods)

        Returns
        -------
        array (…, samples·periods)
        """
        points, without = values.shape[-1], list(self.unmeasured.get(channel, ()))
        if channel in self.harmonics:
            values = _fourier.on_grid(_fourier.coefficients(values, self.harmonics[channel]), points)
        if not without:
            return values
        amplitudes = _fourier.coefficients(values)
        others = np.delete(np.arange(amplitudes.shape[-1]), without)
        amplitudes[..., others] = 0.0
        return values - _fourier.on_grid(amplitudes, points)

    def __repr__(self) -> str:
        shown = [f"{k} ({n} independent values)" for k, n in self.independent.items()]
        shown += dict.fromkeys(one.label for one in self.measurements)
        counts = ", ".join(shown)
        without = (f"{k} without harmonics {', '.join(map(str, h))}" for k, h in self.unmeasured.items())
        text = "".join(f"; {each}" for each in without)
        text += f"; {self.condition!r}" if self.condition else ""
        error = f" ± {self.frequency_se:.2g} Hz" if self.frequency_se else ""
        if self.phase_diffusion:
            error += f" with a phase diffusion of {self.phase_diffusion:.2g} rad²/s"
        if self.period_test is not None:
            text += f"; {summary(self.period_test, self.periods)}"
        if self.clocks:
            text += f"; other clocks: {', '.join(f'{name} {list(named)}' for name, named in self.clocks.items())}"
        return (
            f"Experiment({self.name!r}: {self.cycles} cycles at {self.frequency:.6g} Hz{error}, {self.samples} "
            f"samples per period, outputs {counts}, periodicity {self.periodicity:.4f}"
            f"{', synthetic' if self.synthetic else ''}{text}{''.join(f'; {finding}' for finding in self.findings)})"
        )


def _checked_mask(given: ArrayLike, points: int) -> np.ndarray:
    mask = np.asarray(given)
    if mask.dtype != bool or mask.shape != (points,) or not mask.any():
        raise ValueError(
            f"mask: must be a bool array of shape {(points,)}, True at one point or more, got {mask.dtype} of shape "
            f"{mask.shape} with {np.count_nonzero(mask)} points."
        )
    return mask


def _without_none(values: Any) -> Any:
    """Return amplitudes with zero in place of None."""
    listed = isinstance(values, list | tuple) or (isinstance(values, np.ndarray) and values.ndim == 1)
    return [0.0 if value is None else value for value in values] if listed else values


def _amplitudes(argument: str, values: ArrayLike, samples: int) -> np.ndarray:
    try:
        amplitudes = np.array(values, dtype=complex)
    except (TypeError, ValueError):
        raise ValueError(f"{argument}: must be an array of complex numbers, got {values!r}.") from None
    if amplitudes.ndim != 1 or not amplitudes.size or not np.isfinite(amplitudes).all():
        raise ValueError(
            f"{argument}: must be a vector of finite amplitudes of harmonics 0, 1, 2, …, got {amplitudes.tolist()}. "
            "Give None for harmonics of outputs that were not measured."
        )
    if amplitudes[0].imag != 0.0:
        raise ValueError(f"{argument}: must have a real mean (harmonic 0), got {amplitudes[0]}.")
    if amplitudes.size - 1 > _fourier.highest_harmonic(samples):
        raise ValueError(
            f"samples: must be at least {2 * amplitudes.size - 1} for harmonic {amplitudes.size - 1} of {argument}, "
            f"got {samples}."
        )
    return amplitudes
