"""What defines the response of an experiment at a special point: a jump (fold) or a given phase lag."""

from dataclasses import dataclass

from bayesperiodic._io import Storable

FREQUENCY = "frequency"


@dataclass(frozen=True)
class Fold(Storable):
    """The response jumps: a fold of the branch, with the resolution of its measured place.

    Attributes
    ----------
    direction : "up" or "down"
        Of the sweep that jumped.
    vary : str
        "frequency", or the input whose level was swept.
    step : float
        Step of the sweep [Hz, or relative to the level]: the fold is within one step before the measured place. Zero
        if `sd` is given.
    sd : float
        Standard deviation of the place [Hz, or relative to the level]; with a step that of an error of each place.

    Examples
    --------
    >>> bp.jump("down", 0.19, {"force": 0.2}, direction="down", sd=0.001).condition
    Fold(direction='down', vary='frequency', step=0.0, sd=0.001)
    >>> bp.Fold("up", "force", 0.05, 0.005).free
    ('force',)
    """

    direction: str
    vary: str
    step: float
    sd: float

    @property
    def free(self) -> tuple[str, ...]:
        """The unknowns of the point besides the states."""
        return (self.vary,)


@dataclass(frozen=True)
class PhaseLag(Storable):
    """A harmonic of an output lags a harmonic of an input by an angle.

    Attributes
    ----------
    output, drive : str
        Output and input.
    lag : float
        Angle [rad].
    harmonic : int
        Of the forcing frequency.
    frequency_sd : float
        Standard deviation of the frequency [Hz].
    amplitude, amplitude_sd : float
        Of the harmonic of the output [its unit], and its standard deviation; that is zero if the level of the input is
        unknown.

    Examples
    --------
    >>> bp.PhaseLag("x", "force", 1.57, 1, frequency_sd=0.01, amplitude=0.002, amplitude_sd=0.0).level_known
    False
    """

    output: str
    drive: str
    lag: float
    harmonic: int
    frequency_sd: float
    amplitude: float
    amplitude_sd: float

    @property
    def level_known(self) -> bool:
        """Whether the level of the input is known."""
        return self.amplitude_sd > 0.0

    @property
    def free(self) -> tuple[str, ...]:
        """The unknowns of the point besides the states."""
        return (FREQUENCY,) if self.level_known else (FREQUENCY, self.drive)
