"""Sensors between the signals of a model and the measured channels: gain, offset, delay and low-pass filter.

Sensors of outputs act on the response, see `likelihood.sensing`. The model is driven by what the sensors of inputs have
measured, corrected: known entries correct the measured inputs, unknown ones become parameters of the model, whose
inputs are replaced by those that gain, offset and filter give back. A Butterworth filter has no zeros, so that its
inverse is a sum of time derivatives. A delay of the only input is one of all outputs with the other sign.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesperiodic import _checks, _fourier
from bayesperiodic._io import Storable
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.sensing import SensorNames, lowpass
from bayesperiodic.models.model import Model
from bayesperiodic.models.sensed import (
    CUTOFF,
    DELAY,
    GAIN,
    OFFSET,
    SENSOR_KINDS,
    SHIFT,
    sensor_name,
    with_sensed_inputs,
)
from bayesperiodic.priors.joint import as_prior

HIGHEST_ORDER = 10
# Response of a filter below which the correction of an input would be mostly noise, and amplitudes that are rounding
# errors, relative to the largest.
LEAST_RESPONSE, ROUNDED_AMPLITUDE = 0.05, 1e-10
# Entries of a sensor that changes nothing.
PLAIN: dict[str, Any] = {GAIN: 1.0, OFFSET: 0.0, DELAY: 0.0, CUTOFF: None}
UNITS = {GAIN: "1", DELAY: "s", CUTOFF: "Hz"}


@dataclass(frozen=True)
class Sensor(Storable):
    """The path from a signal to the measured channel, for ``Problem(sensors={channel: Sensor(…)})``.

    The channel is gain · lowpass(signal(t − delay)) + offset. Every entry but the order is a number, or a prior of a
    parameter, called ``gain[channel]``, ``offset[channel]``, ``delay[channel]`` or ``cutoff[channel]``.

    Parameters
    ----------
    gain : float or prior
        Not zero.
    offset : float or prior
        In the channel's unit.
    delay : float or prior
        [s], positive if the channel is late.
    cutoff : float or prior, optional
        Frequency [Hz] at which the filter has lost 3 dB; by default there is no filter.
    order : int
        Number of poles of the filter, 1 to 10. It is a Butterworth filter [1]_, flat below the cutoff, as
        anti-aliasing filters are.

    Raises
    ------
    ValueError
        For an entry that is neither a finite number nor a prior, a gain of zero, a cutoff that is not positive.

    References
    ----------
    .. [1] S. Butterworth, On the theory of filter amplifiers, Experimental Wireless and the Wireless Engineer 7, 1930,
       536-541.

    Examples
    --------
    >>> bp.Sensor(gain=bp.LogNormal(1.0, 0.02), cutoff=50.0)
    Sensor(gain=LogNormal(median=1.0, spread=0.02), cutoff=50.0, order=2)
    """

    gain: Any = 1.0
    offset: Any = 0.0
    delay: Any = 0.0
    cutoff: Any = None
    order: int = 2

    def __post_init__(self) -> None:
        for kind, value in self.entries():
            if value is not None:
                number = np.ndim(value) == 0 and isinstance(value, int | float | np.number)
                checked = _checks.finite_number(kind, value) if number else as_prior(kind, value)
                object.__setattr__(self, kind, checked)
            elif kind != CUTOFF:
                raise ValueError(f"{kind}: must be a number or a prior, got None.")
        if self.gain == 0.0:
            raise ValueError("gain: must not be 0, got 0.0.")
        if self.cutoff is not None:
            low = self.cutoff if isinstance(self.cutoff, float) else self.cutoff.support[0] or 1.0
            if not low > 0.0:
                raise ValueError(
                    f"cutoff: must be > 0, got {self.cutoff!r}. Give a number or a prior of positive values, such as "
                    "bp.LogNormal(…)."
                )
        _checks.integer("order", self.order, 1)
        if self.order > HIGHEST_ORDER:
            raise ValueError(f"order: must be at most {HIGHEST_ORDER}, got {self.order}.")

    def entries(self) -> Iterator[tuple[str, Any]]:
        """Return all entries but the order.

        Returns
        -------
        iterator of (str, float or prior or None)
            Kinds and values.
        """
        return ((kind, getattr(self, kind)) for kind in SENSOR_KINDS)

    def acting(self) -> Iterator[tuple[str, Any]]:
        """Return the entries that change the signal.

        Returns
        -------
        iterator of (str, float or prior)
            Kinds and values.
        """
        return ((kind, value) for kind, value in self.entries() if not _is_plain(kind, value))

    def __repr__(self) -> str:
        shown = [f"{kind}={value!r}" for kind, value in self.acting()]
        shown += [f"order={self.order}"] * (self.cutoff is not None)
        return f"Sensor({', '.join(shown)})"


def _is_plain(kind: str, value: Any) -> bool:
    """Return whether an entry has the value of a sensor that changes nothing."""
    return value is None or (isinstance(value, float) and value == PLAIN[kind])


class Sensors:
    """The sensors of a problem: parameters, the model that contains those of its inputs, and known corrections.

    Attributes
    ----------
    channels : tuple of str
        The outputs of which something was measured, in the order of the model.
    given : dict of str to Sensor
    plain_model, model : Model
        Of the true inputs, and of the measured ones with the known entries corrected.
    names : tuple of str
        Parameters that act on the outputs: all entries of outputs, and unknown delays of inputs.
    priors, fixed : dict
        By full name.
    units : dict of str to str
    """

    def __init__(
        self, sensors: Mapping[str, Sensor] | None, model: Model, experiments: Sequence[Experiment], *, joint: bool
    ):
        self.channels = tuple(c for c in model.outputs if any(c in e.channels for e in experiments))
        self.given = _checked({} if sensors is None else sensors, model, self.channels)
        self._inputs = {name: self.given[name] for name in model.inputs if name in self.given}
        if joint and self._inputs:
            raise ValueError("input_noise: must be 'measured' or 'exact' where inputs have sensors, got 'joint'.")
        acting = [(c, kind, value) for c, sensor in self.given.items() for kind, value in sensor.acting()]
        unknown = {sensor_name(kind, c): value for c, kind, value in acting if not isinstance(value, float)}
        outputs = [(sensor_name(kind, c), value) for c, kind, value in acting if c not in model.inputs]
        self.late_inputs = tuple(name for name in self._inputs if sensor_name(DELAY, name) in unknown)
        for name in self.late_inputs:
            _check_late_input(name, model)
        self.names = (*(name for name, _ in outputs), *(sensor_name(DELAY, name) for name in self.late_inputs))
        self.priors = unknown
        self.fixed = {name: value for name, value in outputs if name not in unknown}
        self.units = {
            sensor_name(kind, c): UNITS.get(kind, model.units.get(c, "")) for c, kind, _ in acting
        }  # fmt: skip
        self.plain_model, self.model = model, self._with_unknown_inputs(model)
        for e in experiments:
            if e.name in self.given:
                raise ValueError(
                    f"experiments: must have other names than channels with sensors, got {e.name!r}. Name it with "
                    "fold(name=…)."
                )
            for name, sensor in self._inputs.items():
                _check_passed(e, name, sensor)

    @property
    def of_inputs(self) -> bool:
        """Whether any input has a sensor."""
        return bool(self._inputs)

    @property
    def known_delays(self) -> list[str]:
        """Names of the delays that are numbers other than zero."""
        return [
            sensor_name(DELAY, c)
            for c, sensor in self.given.items()
            if isinstance(sensor.delay, float) and sensor.delay
        ]

    def with_entries(
        self, priors: Mapping[Any, Any], fixed: Mapping[str, Any]
    ) -> tuple[dict[Any, Any], dict[str, Any]]:
        """Return priors and values with those of the sensors, unless a name has one of its own."""
        taken = {*fixed}.union(*(key if isinstance(key, tuple) else (key,) for key in priors))
        free = {name: prior for name, prior in self.priors.items() if name not in taken}
        known = {name: value for name, value in self.fixed.items() if name not in taken}
        return {**free, **priors}, {**fixed, **known}

    def parameters(self, delayed: bool) -> SensorNames:
        """Return the parameters that act on the outputs, the delay of all of them last."""
        orders = {channel: sensor.order for channel, sensor in self.given.items()}
        return SensorNames((*self.names, SHIFT), orders, self.late_inputs, delayed)

    def planned(self) -> dict[str, Sensor]:
        """Return the sensors of a problem whose measured inputs are corrected already."""
        return self.given | {
            name: replace(sensor, **{k: PLAIN[k] for k, v in sensor.entries() if isinstance(v, float)})
            for name, sensor in self._inputs.items()
        }

    def _with_unknown_inputs(self, model: Model) -> Model:
        """Return the model of the measured inputs, with the unknown gains, offsets and cutoffs as parameters."""
        unknown = {n: [k for k, v in s.acting() if not isinstance(v, float)] for n, s in self._inputs.items()}
        orders = {name: sensor.order for name, sensor in self._inputs.items()}
        gains = {name: sensor.gain for name, sensor in self._inputs.items() if isinstance(sensor.gain, float)}
        other = with_sensed_inputs(model, unknown, orders, gains)
        if other is not model:
            other.units = {**model.units, **{name: u for name, u in self.units.items() if name in other.parameters}}
        return other

    def corrected(
        self, experiment: Experiment, inputs: Mapping[str, np.ndarray], parameters: Mapping[str, float] | None = None
    ) -> dict[str, np.ndarray]:
        """Return measured inputs (points,) corrected by the known entries, and by unknown ones if they are given."""
        result = dict(inputs)
        for name, sensor in self._inputs.items():
            here = self._known(name, sensor, parameters)
            result[name] = _corrected(experiment, here, result[name] - here.offset)
        return result

    def corrected_changes(
        self, experiment: Experiment, name: str, changes: np.ndarray, parameters: Mapping[str, float] | None = None
    ) -> np.ndarray:
        """Return changes (…, points) of a measured input, or of its rates, as those of the corrected one."""
        if name not in self._inputs:
            return changes
        return _corrected(experiment, self._known(name, self._inputs[name], parameters), changes)

    def _known(self, name: str, sensor: Sensor, parameters: Mapping[str, float] | None) -> Sensor:
        """Return the sensor of an input with its unknown entries at their values, or without them."""
        unknown = {kind: sensor_name(kind, name) for kind, v in sensor.acting() if not isinstance(v, float)}
        given = parameters or {}
        return replace(sensor, **{kind: given.get(full, PLAIN[kind]) for kind, full in unknown.items()})


def _checked(sensors: Any, model: Model, measured: Sequence[str]) -> dict[str, Sensor]:
    """Return the sensors by channel, those that do something; raise a ValueError if one is impossible."""
    result = {}
    for channel, sensor in _checks.mapping("sensors", sensors, "{'force': bp.Sensor(delay=1e-3)}").items():
        argument = f"sensors[{channel!r}]"
        _checks.one_of("sensors", channel, (*measured, *model.inputs))
        if not isinstance(sensor, Sensor):
            raise ValueError(f"{argument}: must be a Sensor, got {_checks.shortened(sensor)}.")
        acting = dict(sensor.acting())
        if channel in model.angles and (wrong := next((k for k in (GAIN, CUTOFF) if k in acting), "")):
            raise ValueError(
                f"{argument}: must be without {wrong} for an angle, which is compared modulo 2 pi, got {sensor!r}."
            )
        if channel in model.inputs and model.autonomous:
            raise ValueError(
                f"{argument}: must be of an output for {model.name!r}, whose equations have no input, got {sensor!r}."
            )
        if acting:
            result[channel] = sensor
    return result


def _check_late_input(name: str, model: Model) -> None:
    """Refuse an unknown delay of an input where it is not one of all outputs."""
    explicit = any(e.has(model.time_symbols["tau"]) for e in (*model.equations, *model.output_expressions))
    if explicit or len(model.inputs) > 1:
        reason = "equations contain tau" if explicit else f"inputs are {', '.join(model.inputs)}"
        raise ValueError(
            f"sensors[{name!r}]: delay must be a number for an input of {model.name!r}, whose {reason}, got a prior. "
            "Give its value, or delays of the outputs."
        )


def _response(experiment: Experiment, sensor: Sensor, size: int) -> np.ndarray:
    """Return what a sensor with known entries makes of the harmonics of an experiment, complex (size,)."""
    harmonic = np.arange(float(size))
    rate = harmonic * experiment.frequency / experiment.periods
    factors = sensor.gain * np.exp(-2j * np.pi * rate * sensor.delay)
    return factors if sensor.cutoff is None else factors * lowpass(rate / sensor.cutoff, sensor.order).complex


def _corrected(experiment: Experiment, sensor: Sensor, signals: np.ndarray) -> np.ndarray:
    """Return measured signals (…, points) as they were before gain, delay and filter.

    Rounding errors are set to zero where the filter has left nothing else.
    """
    amplitudes = _fourier.coefficients(signals)
    factors, sizes = _response(experiment, sensor, amplitudes.shape[-1]), np.abs(amplitudes)
    lost = np.abs(factors) < LEAST_RESPONSE * np.abs(factors[0])
    amplitudes[lost & (sizes < ROUNDED_AMPLITUDE * sizes.max(axis=-1, keepdims=True))] = 0.0
    return _fourier.on_grid(amplitudes / factors, signals.shape[-1])


def _check_passed(experiment: Experiment, name: str, sensor: Sensor) -> None:
    """Refuse harmonics of a measured input of which a filter has left next to nothing."""
    if sensor.cutoff is None:
        return
    cutoff = sensor.cutoff if isinstance(sensor.cutoff, float) else float(sensor.cutoff.quantile(np.array(0.5)))
    amplitudes = _fourier.coefficients(experiment.inputs[name])
    passed = np.abs(_response(experiment, Sensor(cutoff=cutoff, order=sensor.order), amplitudes.size))
    present = np.abs(amplitudes) > ROUNDED_AMPLITUDE * np.abs(amplitudes[1:]).max(initial=0.0)
    highest = int(np.flatnonzero(present).max(initial=0))
    if passed[highest] < LEAST_RESPONSE:
        most = int(np.flatnonzero(passed >= LEAST_RESPONSE).max())
        raise ValueError(
            f"sensors[{name!r}]: the filter must pass at least {LEAST_RESPONSE:.0%} of the harmonics of "
            f"{experiment.name!r}, got {passed[highest]:.1%} of harmonic {highest}; its correction would amplify noise "
            f"{1.0 / passed[highest]:.3g} times. Fold with harmonics={{{name!r}: {most}}}, or less."
        )
