"""What all figures share: colours, and words.

One colour means one thing everywhere: measured, MAP, Laplace, MCMC.
"""

import textwrap

from bayesperiodic.posterior import labels
from bayesperiodic.sampling.posterior import Posterior

#: The colour of what was measured, of the MAP point, of the Laplace approximation and of MCMC, in all figures.
COLOURS = {"measured": "#000000", "map": "#0072B2", "laplace": "#D55E00", "mcmc": "#56B4E9"}
ENSEMBLES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
LABEL_LENGTH = 24


def caveats(posterior: Posterior) -> str:
    """Return what a reader of a figure of these draws must be told, in words."""
    return said_of(bool(posterior.data.attrs.get("synthetic")), posterior.converged)


def said_of(synthetic: bool, converged: bool) -> str:
    """Return what a reader must be told of data and draws, in words."""
    return ", ".join((["synthetic data"] if synthetic else []) + ([] if converged else ["NOT CONVERGED"]))


def unit_of(posterior: Posterior, name: str) -> str:
    """Return the unit of what has this full name; "" where there is none."""
    return labels.unit(posterior.data["posterior"].to_dataset(), name)


def wrapped_label(name: str, unit: str) -> str:
    """Return a label of short lines, the unit on its own."""
    return axis_label(textwrap.fill(name, LABEL_LENGTH), unit).replace(" [", "\n[")


def axis_label(name: str, unit: str) -> str:
    """Return a name with its unit, as matplotlib shows it."""
    text = f"{name} [{unit}]" if unit else name
    return text.replace("$", r"\$")
