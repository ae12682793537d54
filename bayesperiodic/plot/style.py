"""Colours and labels of all figures; each colour has one meaning everywhere."""

import textwrap

from bayesperiodic.posterior.parameters import unit
from bayesperiodic.sampling.posterior import Posterior

#: Colours of measurements, of the MAP estimate, of the Laplace approximation and of MCMC, in all figures.
COLOURS = {"measured": "#000000", "map": "#0072B2", "laplace": "#D55E00", "mcmc": "#56B4E9"}
ENSEMBLES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
LABEL_LENGTH = 24


def caveats_of(posterior: Posterior) -> str:
    """Return the caveats on draws, for the title of a figure."""
    return caveats(bool(posterior.data.attrs.get("synthetic")), posterior.converged)


def caveats(synthetic: bool, converged: bool) -> str:
    """Return the caveats on data and draws, for the title of a figure."""
    return ", ".join((["synthetic data"] if synthetic else []) + ([] if converged else ["NOT CONVERGED"]))


def unit_of(posterior: Posterior, name: str) -> str:
    """Return the unit of a quantity by its full name; "" without one."""
    return unit(posterior.data["posterior"].to_dataset(), name)


def wrapped_label(name: str, unit: str) -> str:
    """Return a label in short lines, with the unit on the last one."""
    return axis_label(textwrap.fill(name, LABEL_LENGTH), unit).replace(" [", "\n[")


def axis_label(name: str, unit: str) -> str:
    """Return a name with its unit, escaped for matplotlib."""
    text = f"{name} [{unit}]" if unit else name
    return text.replace("$", r"\$")
