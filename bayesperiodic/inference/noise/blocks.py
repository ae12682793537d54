"""What is compared: the residual of one channel in one experiment as components that white noise makes independent."""

from dataclasses import dataclass

import numpy as np

SPECTRAL, POINTS, CORRELATED, KNOWN = "spectral", "points", "correlated", "known"
SCALE = "scale"


@dataclass(frozen=True)
class Block:
    """What a noise model must know about one vector of residual components.

    Attributes
    ----------
    experiment : str
    channel : str
        An output; "scale" for all section values of an experiment together, "multipliers" or "frequency".
    kind : str
        "spectral": real Fourier components, of which white noise of variance v has independent ones of variance v;
        "points": values at the points of a mask; "correlated": values whitened by their given covariance, up to one
        unknown factor; "known": values in units of their known standard deviations.
    count : float
        Independent values behind the components.
    size : int
        Number of components.
    harmonic : array (size,)
        Of the response period, of each spectral component.
    position : array (size,)
        Of each point, in response periods.
    points : int
        Grid points of the response period.
    measured : float
        Variance of one value that the scatter of the measured cycles explains; NaN where that is not known.
    """

    experiment: str
    channel: str
    kind: str
    count: float
    size: int
    harmonic: np.ndarray
    position: np.ndarray
    points: int
    measured: float

    @property
    def weight(self) -> float:
        """Independent values per component."""
        return self.count / self.size

    @property
    def counted(self) -> bool:
        """Whether the variance is unknown, so that eq. (7) counts the values."""
        return self.kind != KNOWN
