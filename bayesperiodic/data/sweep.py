"""The sweep that an experiment of a table of responses belongs to."""

from dataclasses import dataclass

from bayesperiodic import _checks
from bayesperiodic._io import Storable

UP, DOWN = "up", "down"
# Resolution of a measured frequency, relative to it, where none is given.
RESOLUTION = 1e-4


@dataclass(frozen=True)
class Sweep(Storable):
    """The table of an experiment, and the direction in which its frequency was stepped.

    Experiments with the same sweep are points of one branch of responses; their periodic solves start from it.

    Parameters
    ----------
    table : str
        Name of the table, the same for all of its points.
    direction : "up", "down" or None
        Order of the frequencies. In a sweep the response stays on its branch up to a fold, and jumps there to another
        one. None: each point was approached by itself, so that neighbours may be on different branches.
    resolution : float
        Standard deviation of a frequency relative to it. It says how far beyond a fold of the model a frequency may
        lie; see `response_table`.

    Raises
    ------
    ValueError
        For another direction, a name that is no text, or a resolution ≤ 0.

    Examples
    --------
    >>> bp.Sweep("shaker, 2 N", "up")
    Sweep(table='shaker, 2 N', direction='up', resolution=0.0001)
    """

    table: str
    direction: str | None = None
    resolution: float = RESOLUTION

    def __post_init__(self) -> None:
        if not _checks.text("table", self.table):
            raise ValueError(f"table: must be a text, got {self.table!r}.")
        if self.direction is not None:
            _checks.one_of("direction", self.direction, (UP, DOWN))
        object.__setattr__(self, "resolution", _checks.positive("resolution", self.resolution))

    @property
    def sign(self) -> int:
        """−1 for a sweep down, otherwise 1."""
        return -1 if self.direction == DOWN else 1
