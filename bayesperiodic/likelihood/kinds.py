"""The kinds of data that an experiment may have."""

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.block import Block
from bayesperiodic.likelihood.jump import Jump
from bayesperiodic.likelihood.mean_period import MeanPeriod
from bayesperiodic.likelihood.multipliers import Multipliers
from bayesperiodic.likelihood.orbit_frequency import OrbitFrequency
from bayesperiodic.likelihood.quantities import Amplitudes, PeakToPeaks, RelativePhases, RootMeanSquares
from bayesperiodic.likelihood.reach import Reach
from bayesperiodic.likelihood.resonance import Resonance
from bayesperiodic.likelihood.samples import Samples
from bayesperiodic.likelihood.section_points import SectionPoints
from bayesperiodic.models.model import Model

# In the order in which they are compared; a further kind is one more line.
KINDS: list[type[Block]] = [
    SectionPoints,
    MeanPeriod,
    Samples,
    Multipliers,
    OrbitFrequency,
    Amplitudes,
    RelativePhases,
    PeakToPeaks,
    RootMeanSquares,
    Reach,
    Jump,
    Resonance,
]


def blocks_of(experiment: Experiment, model: Model) -> tuple[Block, ...]:
    """Return the data of an experiment, one block a vector of residual components."""
    return tuple(block for kind in KINDS for block in kind.of(experiment, model))
