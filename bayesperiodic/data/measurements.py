"""What instruments tell of a periodic response in place of its time history: amplitudes, phases, sizes."""

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import ClassVar

from bayesperiodic import _checks
from bayesperiodic._io import Storable

__all__ = ["Amplitude", "Measurement", "PeakToPeak", "Phase", "RootMeanSquare"]


@dataclass(frozen=True)
class Measurement(Storable):
    """A number that an instrument tells of a channel's periodic response.

    Parameters
    ----------
    channel : str
        Output of the model.
    value : float
        In the channel's unit; of a `Phase` in rad.
    sd : float, optional
        Standard deviation of the value. By default it is unknown: a noise parameter, which all measurements of this
        kind and channel share.

    Raises
    ------
    ValueError
        For a value that is not finite, or ≤ 0 where it is a size, and for an sd ≤ 0.

    Examples
    --------
    Measurements are made as one of its kinds:

    >>> isinstance(bp.measurements.PeakToPeak("acceleration", 3.1), bp.measurements.Measurement)
    True
    """

    channel: str
    value: float
    sd: float | None = field(default=None, kw_only=True)

    word: ClassVar[str]  # what it is of a channel
    signed: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _checks.text("channel", self.channel)
        value = _checks.finite_number("value", self.value)
        object.__setattr__(self, "value", value if self.signed else _checks.positive("value", value))
        if self.sd is not None:
            object.__setattr__(self, "sd", _checks.positive("sd", self.sd))

    @property
    def place(self) -> tuple[str | int, ...]:
        """What tells measurements of the same kind and channel apart."""
        return ()

    @property
    def others(self) -> tuple[str, ...]:
        """Further channels that it is about."""
        return ()

    @property
    def label(self) -> str:
        """What is measured, as in the name of its variance."""
        return f"{self.word} of {self.channel}"


@dataclass(frozen=True)
class _OfHarmonic(Measurement):
    harmonic: int = field(default=1, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "harmonic", _checks.integer("harmonic", self.harmonic, 1))

    @property
    def place(self) -> tuple[str | int, ...]:
        """The harmonic."""
        return (self.harmonic,)


@dataclass(frozen=True)
class Amplitude(_OfHarmonic):
    r"""Amplitude \|c\| of a harmonic Re c exp(2πi h τ) of the response period, without its phase.

    With a given standard deviation, that of the real and of the imaginary part of c, the amplitude has the distribution
    of Rice [1]_, which small amplitudes need: of noise alone it is σ√(π/2) on average. With an unknown one it is
    taken as normal, which holds for amplitudes above about four standard deviations.

    Parameters
    ----------
    channel, value, sd
        See `Measurement`.
    harmonic : int
        Of the response period, from 1.

    Raises
    ------
    ValueError
        As for `Measurement`, and for a harmonic below 1.

    References
    ----------
    .. [1] S. O. Rice, Mathematical analysis of random noise, Bell System Technical Journal 24, 1945, 46-156,
       section 3.10.

    Examples
    --------
    >>> bp.measurements.Amplitude("displacement", 0.012, sd=1e-4)
    Amplitude(channel='displacement', value=0.012, sd=0.0001, harmonic=1)
    """

    word: ClassVar[str] = "amplitude"


@dataclass(frozen=True)
class Phase(_OfHarmonic):
    """Phase of a harmonic of a channel less that of another channel or input, such as response against force.

    Of harmonics cos(2πhτ + φ); a response that lags has a negative phase.

    Parameters
    ----------
    channel : str
    value : float
        In rad.
    to : str
        The other output or input, whose phase of the same harmonic is subtracted.
    sd : float, optional
        In rad.
    harmonic : int

    Raises
    ------
    ValueError
        As for `Amplitude`, and if both channels are the same.

    Examples
    --------
    >>> bp.measurements.Phase("displacement", -0.5, to="force", sd=0.01).label
    'phase of displacement'
    """

    to: str = field(kw_only=True)

    word: ClassVar[str] = "phase"
    signed: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if _checks.text("to", self.to) == self.channel:
            raise ValueError(f"to: must be another channel than {self.channel!r}.")
        object.__setattr__(self, "value", math.remainder(self.value, 2 * math.pi))

    @property
    def place(self) -> tuple[str | int, ...]:
        """The harmonic and the other channel."""
        return self.harmonic, self.to

    @property
    def others(self) -> tuple[str, ...]:
        """The other channel."""
        return (self.to,)


@dataclass(frozen=True)
class PeakToPeak(Measurement):
    """Largest less smallest value over the response period.

    Parameters
    ----------
    channel, value, sd
        See `Measurement`.

    Raises
    ------
    ValueError
        As for `Measurement`.

    Examples
    --------
    >>> bp.measurements.PeakToPeak("acceleration", 3.1, sd=0.05).label
    'peak-to-peak value of acceleration'
    """

    word: ClassVar[str] = "peak-to-peak value"


@dataclass(frozen=True)
class RootMeanSquare(Measurement):
    """Root mean square over the response period, about the mean, as AC-coupled instruments show it.

    Parameters
    ----------
    channel, value, sd
        See `Measurement`.

    Raises
    ------
    ValueError
        As for `Measurement`.

    Examples
    --------
    >>> bp.measurements.RootMeanSquare("velocity", 0.7, sd=0.01).label
    'rms value of velocity'
    """

    word: ClassVar[str] = "rms value"


def checked(given: object, outputs: Collection[str]) -> tuple[Measurement, ...]:
    """Return the measurements of an experiment with these outputs, in groups of one kind and channel.

    A ValueError is raised if two are of the same quantity, or a group has known and unknown standard deviations.
    """
    if not isinstance(given, list | tuple) or not all(isinstance(one, Measurement) for one in given):
        raise ValueError(
            f"measurements: must be a list such as [bp.measurements.Amplitude('x', 0.1, sd=0.001)], got "
            f"{_checks.shortened(given)}."
        )
    groups: dict[tuple[type, str], list[Measurement]] = {}
    for one in given:
        if one.channel in outputs:
            raise ValueError(
                f"measurements: must be of channels without a time history, got the {one.label}; harmonics of it that "
                "were not measured are left out by `unmeasured`."
            )
        group = groups.setdefault((type(one), one.channel), [])
        if any(one.place == other.place for other in group):
            raise ValueError(f"measurements: must be of different quantities, got the {one.label} twice.")
        if group and (one.sd is None) != (group[0].sd is None):
            raise ValueError(f"measurements: must all have an sd or none, got both for the {one.label}.")
        group.append(one)
    return tuple(one for group in groups.values() for one in group)
