"""Figures of data, estimates, posteriors, branches, orbits and attractors.

Every function returns the matplotlib Figure; an empty one to draw into can be given as `figure`.
"""

from bayesperiodic.plot.attractors import attractor
from bayesperiodic.plot.branches import branch, orbits, section
from bayesperiodic.plot.diagnostics import comparison, models, profile, ranks
from bayesperiodic.plot.elements import elements
from bayesperiodic.plot.estimates import fit, loops, traces
from bayesperiodic.plot.overview import summary
from bayesperiodic.plot.pairs import corner, marginals
from bayesperiodic.plot.populations import population
from bayesperiodic.plot.recording import recording
from bayesperiodic.plot.style import COLOURS
from bayesperiodic.plot.tables import response
from bayesperiodic.plot.terms import missing_terms

__all__ = [
    "COLOURS", "attractor", "branch", "comparison", "corner", "elements", "fit", "loops", "marginals", "missing_terms",
    "models", "orbits", "population", "profile", "ranks", "recording", "response", "section", "summary", "traces",
]  # fmt: skip
