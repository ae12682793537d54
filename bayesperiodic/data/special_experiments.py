"""Experiments of which only a special point was measured: a jump, or a resonance by its phase."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesperiodic import _checks, _fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.special_points import FREQUENCY, Fold, PhaseLag

JITTER_OF_PLACES = 0.1  # standard deviation of the places of a sweep, in steps
POINT_SAMPLES = 400


def jump(
    name: str,
    frequency: float,
    inputs: Mapping[str, complex],
    *,
    direction: str,
    vary: str = FREQUENCY,
    step: float | None = None,
    sd: float | None = None,
    samples: int = POINT_SAMPLES,
) -> Experiment:
    """Make an experiment from the place where the response jumped in a sweep.

    The model's place is a fold of its branch, where the swept quantity has a maximum along the branch (sweep up) or a
    minimum (sweep down). Nothing else of the response is compared. Noise makes real responses jump before the fold,
    sweeps faster than the response settles after it; neither is modelled.

    Parameters
    ----------
    name : str
    frequency : float
        Forcing frequency [Hz], that of the first point after the jump.
    inputs : mapping of str to complex
        Amplitudes of the harmonic inputs, that of the first point after the jump for `vary`; a cosine has a real one.
    direction : "up" or "down"
        Of the sweep.
    vary : str
        What was swept: "frequency", or an input whose level was.
    step : float, optional
        Step of the sweep [Hz, or the input's unit]: the fold is between the last point before and the first one after
        the jump. Its probability is that of an interval with errors of 10 % of a step at both ends.
    sd : float, optional
        In place of `step`, the standard deviation of the place [Hz, or the input's unit].
    samples : int
        Grid points per period.

    Returns
    -------
    Experiment
        Without outputs.

    Raises
    ------
    ValueError
        For another direction, an unknown `vary`, neither or both of `step` and `sd`, values ≤ 0, a step as large as the
        place itself.

    Examples
    --------
    >>> up = bp.jump("up", 0.215, {"force": 0.2}, direction="up", step=0.001)
    >>> up.condition
    Fold(direction='up', vary='frequency', step=0.001, sd=0.0001)
    """
    _checks.one_of("direction", direction, ("up", "down"))
    _checks.mapping("inputs", inputs, "{'force': 0.2}")
    points = _checks.integer("samples", samples, 4)
    given = {input_name: _amplitude(f"inputs[{input_name!r}]", value) for input_name, value in inputs.items()}
    _checks.one_of("vary", vary, (FREQUENCY, *given))
    if (step is None) == (sd is None):
        raise ValueError(f"step: must be given, or sd in its place, got step={step!r} and sd={sd!r}.")
    place = _checks.positive("frequency", frequency) if vary == FREQUENCY else abs(given[vary])
    if not place > 0.0:
        raise ValueError(f"inputs[{vary!r}]: must not be zero, got {given[vary]}; it is the level of the jump.")
    unit = 1.0 if vary == FREQUENCY else place
    width = 0.0 if step is None else _checks.positive("step", step) / unit
    if width * unit >= place:
        raise ValueError(f"step: must be less than the measured {vary}, {place:g}, got {step!r}.")
    error = JITTER_OF_PLACES * width if sd is None else _checks.positive("sd", sd) / unit
    return Experiment(
        name, frequency, {}, _waves(given, points), samples=points, condition=Fold(direction, vary, width, error)
    )


def resonance_point(
    name: str,
    frequency: float,
    amplitude: Mapping[str, float],
    inputs: Mapping[str, complex | None],
    *,
    frequency_sd: float,
    amplitude_sd: float = 0.0,
    lag: float = np.pi / 2,
    harmonic: int = 1,
    samples: int = POINT_SAMPLES,
) -> Experiment:
    """Make an experiment from a resonance: the frequency at which an output lags the input by a given angle.

    Such points come from phase-locked loops. With a known level of the input both frequency and amplitude are
    compared. Without it the level is an unknown of the point, which the amplitude determines, and the frequency alone
    is compared: a point of a backbone. The backbone of a free decay is that of the undamped, unforced system; at a lag
    of 90° damping and force nearly balance, so that it is a good approximation where the damping is light and the
    harmonics are small.

    Parameters
    ----------
    name : str
    frequency : float
        Forcing frequency [Hz].
    amplitude : mapping of one str to float
        Amplitude (peak) of the harmonic of an output.
    inputs : mapping of str to complex or None
        Amplitude of every harmonic input, a cosine has a real one; None for one of unknown level. The lag is that
        against the first of them. A level that is known up to a factor is given here, and the factor as the gain
        of a sensor, ``sensors={"force": bp.Sensor(gain=prior)}``.
    frequency_sd : float
        Standard deviation of the frequency [Hz].
    amplitude_sd : float
        Standard deviation of the amplitude, needed if the level is known. With an unknown level the amplitude is exact;
        add its error times the slope of the backbone to that of the frequency, in squares.
    lag : float
        Angle [rad] by which the harmonic of the output lags `harmonic` times the phase of the input.
    harmonic : int
    samples : int
        Grid points per period.

    Returns
    -------
    Experiment

    Raises
    ------
    ValueError
        For more than one amplitude, values ≤ 0, an amplitude_sd that is missing or that an unknown level excludes,
        more than one unknown level, too few samples for the harmonic.

    Examples
    --------
    >>> point = bp.resonance_point("1 mm", 12.1, {"x": 1e-3}, {"force": None}, frequency_sd=0.01)
    >>> point.condition.free, point.independent
    (('frequency', 'force'), {'x': 2})
    """
    _checks.mapping("inputs", inputs, "{'force': None}")
    if len(_checks.mapping("amplitude", amplitude, "{'x': 0.01}")) != 1:
        raise ValueError(f"amplitude: must be that of one output, such as {{'x': 0.01}}, got {dict(amplitude)!r}.")
    ((output, size),) = amplitude.items()
    size = _checks.positive(f"amplitude[{output!r}]", size)
    if not inputs:
        raise ValueError("inputs: must have at least one input, such as {'force': None}, got {}.")
    drive = next(iter(inputs))
    if any(value is None for input_name, value in inputs.items() if input_name != drive):
        raise ValueError(f"inputs: must have known levels of all but the first, {drive!r}, got {dict(inputs)!r}.")
    unknown = inputs[drive] is None
    given = {
        input_name: 1.0 + 0.0j if value is None else _amplitude(f"inputs[{input_name!r}]", value)
        for input_name, value in inputs.items()
    }
    if given[drive] == 0.0:
        raise ValueError(f"inputs[{drive!r}]: must not be zero, got 0; the lag is that against this input.")
    if unknown and amplitude_sd:
        raise ValueError(
            f"amplitude_sd: must be 0 with an unknown level of {drive!r}, got {amplitude_sd!r}; add its square times "
            "that of the slope of the backbone to the square of frequency_sd."
        )
    error = 0.0 if unknown else _checks.positive("amplitude_sd", amplitude_sd)
    lag, harmonic = _checks.finite_number("lag", lag), _checks.integer("harmonic", harmonic, 1)
    points = _checks.integer("samples", samples, 4)
    if harmonic > _fourier.highest_harmonic(points):
        raise ValueError(f"samples: must be at least {2 * harmonic + 1} for harmonic {harmonic}, got {samples}.")
    lines = np.zeros(harmonic + 1, dtype=complex)
    lines[harmonic] = size * np.exp(1j * (harmonic * np.angle(given[drive]) - lag))
    sd = _checks.positive("frequency_sd", frequency_sd)
    return Experiment(
        name,
        frequency,
        {output: _fourier.on_grid(lines, points)},
        _waves(given, points),
        samples=points,
        harmonics={output: harmonic},
        unmeasured={output: range(harmonic)},
        condition=PhaseLag(output, drive, lag, harmonic, sd, size, error),
    )


def _amplitude(argument: str, value: Any) -> complex:
    try:
        number = complex(value)
    except (TypeError, ValueError):
        raise ValueError(f"{argument}: must be a number, the amplitude of a harmonic input, got {value!r}.") from None
    if not np.isfinite(number):
        raise ValueError(f"{argument}: must be finite, got {value!r}.")
    return number


def _waves(amplitudes: Mapping[str, complex], samples: int) -> dict[str, np.ndarray]:
    """Return one period (samples,) of harmonic inputs."""
    return {name: _fourier.on_grid(np.array([0.0, value]), samples) for name, value in amplitudes.items()}
