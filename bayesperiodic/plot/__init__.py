"""Figures of data, estimates, posteriors, branches and orbits; every function returns the matplotlib Figure."""

from bayesperiodic.plot.branches import branch, orbits, section
from bayesperiodic.plot.data import fit, loops
from bayesperiodic.plot.diagnostics import comparison, profile, ranks
from bayesperiodic.plot.posterior import corner, marginals, traces
from bayesperiodic.plot.style import COLOURS

__all__ = [
    "COLOURS", "branch", "comparison", "corner", "fit", "loops", "marginals", "orbits", "profile", "ranks", "section",
    "traces",
]  # fmt: skip
