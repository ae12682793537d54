"""The section on how the results were made: settings, seed and versions."""

import importlib.metadata
import platform

import numpy as np

from bayesperiodic.inference.sampling.checkpoint import fingerprint
from bayesperiodic.inference.sampling.posterior import Posterior
from bayesperiodic.periodic.schemes import find_scheme
from bayesperiodic.reporting import text
from bayesperiodic.reporting.blocks import Column, Section, Table, code
from bayesperiodic.reporting.evidence import Evidence

PACKAGES = ("bayesperiodic", "numpy", "scipy", "sympy", "numba", "emcee", "arviz", "xarray", "matplotlib")


def section(evidence: Evidence) -> Section:
    """Return settings and versions."""
    settings = _of_the_fit(evidence) | ({} if evidence.posterior is None else _of_the_draws(evidence.posterior))
    return Section(
        "record",
        "How this was made",
        [
            _two_columns("table-settings", "Settings.", ("Setting", "Value"), settings),
            _two_columns(
                "table-versions", "Versions in use when this page was written.", ("Program", "Version"), versions()
            ),
        ],
    )


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that matter."""
    return {"Python": platform.python_version()} | {name: importlib.metadata.version(name) for name in PACKAGES}


def _of_the_fit(evidence: Evidence) -> dict[str, str]:
    problem, fit = evidence.problem, evidence.fit
    shifts = {name: abs(shift) for name, shift in fit.doubling_shift.items() if np.isfinite(shift)}
    worst = max(shifts, key=lambda name: shifts[name], default="")
    steps, starts = text.counted("step", len(fit.history) - 1), text.counted("start", len(fit.starts))
    finer = f"{text.number(shifts[worst], 2)} sd ({worst})" if worst else "not known"
    return {
        "Problem": fingerprint(problem).removeprefix("problem "),
        "Difference scheme": find_scheme(problem.scheme).name,
        "Noise model": repr(problem.noise),
        "Search for the MAP": f"{fit.status}, {steps}, {starts}",
        "Largest move of an estimate on twice as many points": finer,
        "Degrees of freedom": text.number(fit.degrees_of_freedom, 5),
    }


def _of_the_draws(posterior: Posterior) -> dict[str, str]:
    group, made_by = posterior.data["posterior"], posterior.data.attrs
    chains, steps = group.sizes["chain"], group.sizes["draw"]
    ensembles = np.unique(group["ensemble"].to_numpy()).size
    return {
        "Seed": str(posterior.seed),
        "Draws": f"{ensembles} ensembles, {chains // ensembles} chains each, {steps} draws a chain",
        "Drawn with": ", ".join(
            f"{name} {made_by[name]}" for name in ("bayesperiodic", "emcee", "nutpie") if name in made_by
        ),
    }


def _two_columns(id: str, caption: str, heads: tuple[str, str], content: dict[str, str]) -> Table:
    columns = tuple(Column(head, numeric=False) for head in heads)
    return Table(id, caption, columns, tuple((name, code(value)) for name, value in content.items()))
