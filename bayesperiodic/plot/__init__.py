"""Figures of data, estimates, posteriors, branches and orbits.

Every function returns the matplotlib Figure; an empty one to draw into can be given as `figure`.
"""

from bayesperiodic.plot.branches import branch, orbits, section
from bayesperiodic.plot.diagnostics import comparison, models, profile, ranks
from bayesperiodic.plot.estimates import corner, fit, loops, marginals, traces
from bayesperiodic.plot.style import COLOURS

__all__ = [
    "COLOURS", "branch", "comparison", "corner", "fit", "loops", "marginals", "models", "orbits", "profile", "ranks",
    "section", "traces",
]  # fmt: skip
