"""Figures; every function takes the data and returns the matplotlib Figure."""

from bayesperiodic.plot.branches import branch
from bayesperiodic.plot.calibration import ranks
from bayesperiodic.plot.marginal import marginals
from bayesperiodic.plot.pairs import corner
from bayesperiodic.plot.periods import fit, loops
from bayesperiodic.plot.profiles import profile
from bayesperiodic.plot.scorecard import comparison
from bayesperiodic.plot.sections import orbits, section
from bayesperiodic.plot.style import COLOURS
from bayesperiodic.plot.walks import traces

__all__ = [
    "COLOURS", "branch", "comparison", "corner", "fit", "loops", "marginals", "orbits", "profile", "ranks", "section",
    "traces",
]  # fmt: skip
