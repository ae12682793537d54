"""Hints where a fit fails: measured against modelled frequency and amplitude, and units as a likely cause."""

from collections.abc import Mapping
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from bayesperiodic.density.problem import Problem
from bayesperiodic.likelihood.observation import Response
from bayesperiodic.periodic.compiled import CONVERGED, NOT_FINITE, STATUSES
from bayesperiodic.periodic.condensed import CondensedEquations
from bayesperiodic.periodic.equations import FREQUENCY
from bayesperiodic.periodic.isolation import MANY_CYCLES
from bayesperiodic.periodic.singular_terms import singular_term
from bayesperiodic.periodic.solution import as_guess
from bayesperiodic.periodic.solve import is_one_of_many

# Experiments named in a message, and the powers of ten that point to a unit.
SHOWN_EXPERIMENTS, UNIT_DECADES = 3, 2.0


class Scales(NamedTuple):
    """Frequency [Hz] and amplitudes by channel, measured and of the model linearised about its equilibrium."""

    measured: dict[str, float]
    modelled: dict[str, float]


def _scales(problem: Problem, theta: np.ndarray) -> dict[str, Scales]:
    """Return by experiment the measured and the modelled sizes at θ, where the linearised model has any.

    The frequency of the model is that of the eigenvalue whose modulus is nearest to the measured frequency; condensed
    models have none here.
    """
    scales = {}
    for e in problem.experiments:
        equations, (parameters, sensors) = problem.equations[e.name], problem.parameter_maps[e.name].split(theta)
        measured, modelled = {FREQUENCY: e.frequency}, {}
        with np.errstate(all="ignore"), suppress(np.linalg.LinAlgError):
            rates = equations.linear_rates(parameters)
            sizes = np.abs(rates) / (2 * np.pi)
            if sizes.size:
                modelled[FREQUENCY] = float(sizes[np.argmin(np.abs(np.log(sizes / e.frequency)))])
            if not problem.model.autonomous and e.condition is None:
                outputs = equations.linear_outputs(parameters)
                response = Response(outputs, np.array(e.frequency), np.empty(0), sensors)
                for channel, values in problem.observations[e.name].predicted(response).items():
                    measured[channel] = 0.5 * float(np.ptp(e.outputs[channel]))
                    modelled[channel] = 0.5 * float(np.ptp(values))
        scales[e.name] = Scales(measured, {name: size for name, size in modelled.items() if 0.0 < size < np.inf})
    return scales


def singular_start(problem: Problem, theta: np.ndarray, statuses: Mapping[str, str]) -> str:
    """Return the term that is singular where the solve of an experiment, whose status is "not finite", starts."""
    for e in problem.experiments:
        if statuses[e.name] == STATUSES[NOT_FINITE]:
            equations, parameters = problem.equations[e.name], problem.parameters(theta[None], e.name)[0]
            if isinstance(equations, CondensedEquations):
                return ""
            given = None if isinstance(e.guess, str) else e.guess
            start = as_guess(equations, given) if given else equations.static_guess(parameters)
            return singular_term(equations, start, parameters)
    return ""


def not_isolated(problem: Problem, theta: np.ndarray, statuses: Mapping[str, str]) -> str:
    """Return what is wrong with an autonomous model whose cycles are not isolated, where a solve has failed."""
    for e in problem.experiments if problem.model.autonomous else ():
        if statuses[e.name] != STATUSES[CONVERGED]:
            equations, parameters = problem.equations[e.name], problem.parameters(theta[None], e.name)[0]
            given = None if isinstance(e.guess, str) else e.guess
            if is_one_of_many(equations, parameters, given or "static"):
                return (
                    f"model: must have isolated cycles, got {problem.model.name!r}: {MANY_CYCLES} If the model "
                    "has them, but they are zero at this start, as a damping with a prior about zero, give start={…} "
                    "where they are not, or priors with other medians."
                )
    return ""


def _quantity(name: str) -> str:
    return "frequency [Hz]" if name == FREQUENCY else f"amplitude of {name!r}"


def compared_with_data(problem: Problem, theta: np.ndarray) -> str:
    """Return a sentence that compares the frequency and the amplitudes of the data with those of the model at θ."""
    lines = []
    for run, (measured, modelled) in _scales(problem, theta).items():
        parts = [f"{_quantity(name)} {measured[name]:.3g} against {size:.3g}" for name, size in modelled.items()]
        lines += [f"{run!r}: {', '.join(parts)}"] if parts else []
    more = f"; and {len(lines) - SHOWN_EXPERIMENTS} more" if len(lines) > SHOWN_EXPERIMENTS else ""
    return f"Measured against the linearised model: {'; '.join(lines[:SHOWN_EXPERIMENTS])}{more}." if lines else ""


def unit_error(problem: Problem, theta: np.ndarray | None = None) -> str:
    """Return a sentence if data and model at θ, or at the medians, differ by powers of ten in every experiment."""
    theta = problem.median() if theta is None else theta
    scales, texts = list(_scales(problem, theta).values()), []
    for name in scales[0].modelled if scales else ():
        ratios = [one.measured[name] / one.modelled[name] for one in scales if name in one.modelled]
        decades = np.log10(np.median(ratios)) if len(ratios) == len(scales) and min(ratios) > 0.0 else 0.0
        if abs(decades) >= UNIT_DECADES:
            texts.append(f"the measured {_quantity(name)} is 1e{round(decades):+d} times that of the linearised model")
    if not texts:
        return ""
    return f"Check the units, such as mm for m or ms for s: {'; '.join(texts)}."
