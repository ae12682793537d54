"""Bayesian identification of nonlinear systems from their periodic equilibrium states.

You give a model (equations) and recordings (measured periods); you get back what the recordings say about the
parameters, how far to trust it, and which combinations they cannot tell you.

Names are imported at their first use, so that ``import bayesperiodic`` is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bayesperiodic import models, plot
    from bayesperiodic.data.experiment import Experiment
    from bayesperiodic.data.recording import Recording
    from bayesperiodic.diagnosis.calibration import Calibration, calibrate
    from bayesperiodic.diagnosis.comparison import Comparison, compare
    from bayesperiodic.diagnosis.identifiability import Identifiability, identifiability
    from bayesperiodic.diagnosis.predictive import Prediction, predict
    from bayesperiodic.diagnosis.prior_predictive import PriorPredictive, prior_predictive
    from bayesperiodic.inference.estimation.estimate import MapEstimate
    from bayesperiodic.inference.estimation.map_estimate import map_estimate
    from bayesperiodic.inference.estimation.profile import Profile, profile
    from bayesperiodic.inference.noise import models as noise
    from bayesperiodic.inference.priors.multivariate import MultivariateNormal
    from bayesperiodic.inference.priors.univariate import (
        HalfNormal,
        InverseGamma,
        LogNormal,
        LogUniform,
        Normal,
        StudentT,
        TruncatedNormal,
        Uniform,
    )
    from bayesperiodic.inference.problem import Problem
    from bayesperiodic.inference.sampling.posterior import Posterior
    from bayesperiodic.inference.sampling.sampling import sample
    from bayesperiodic.models.model import Model
    from bayesperiodic.models.smooth import smooth_abs, smooth_sign
    from bayesperiodic.models.structure.result import Structure
    from bayesperiodic.models.structure.structure import structure
    from bayesperiodic.orbits.find import find_orbits
    from bayesperiodic.orbits.orbit import Orbit, Orbits
    from bayesperiodic.orbits.polish import polish_orbits
    from bayesperiodic.orbits.section import PoincareSection
    from bayesperiodic.orbits.selection import select_orbits
    from bayesperiodic.periodic.continuation import Branch, continue_periodic, double_period, iterate_periodic
    from bayesperiodic.periodic.hopf import HopfPoint, emerging_cycle, hopf_points
    from bayesperiodic.periodic.passages import solutions_at
    from bayesperiodic.periodic.schemes import Scheme
    from bayesperiodic.periodic.solution import PeriodicSolution
    from bayesperiodic.periodic.solve import solve_periodic
    from bayesperiodic.periodic.stability import multiplier_sensitivities
    from bayesperiodic.reporting.report import report
    from bayesperiodic.simulation import simulate
    from bayesperiodic.store import load

_HOMES = {
    "bayesperiodic.data.experiment": ["Experiment"],
    "bayesperiodic.data.recording": ["Recording"],
    "bayesperiodic.diagnosis.calibration": ["Calibration", "calibrate"],
    "bayesperiodic.diagnosis.comparison": ["Comparison", "compare"],
    "bayesperiodic.diagnosis.identifiability": ["Identifiability", "identifiability"],
    "bayesperiodic.diagnosis.predictive": ["Prediction", "predict"],
    "bayesperiodic.diagnosis.prior_predictive": ["PriorPredictive", "prior_predictive"],
    "bayesperiodic.inference.estimation.estimate": ["MapEstimate"],
    "bayesperiodic.inference.estimation.map_estimate": ["map_estimate"],
    "bayesperiodic.inference.estimation.profile": ["Profile", "profile"],
    "bayesperiodic.inference.priors.multivariate": ["MultivariateNormal"],
    "bayesperiodic.inference.priors.univariate": [
        "HalfNormal",
        "InverseGamma",
        "LogNormal",
        "LogUniform",
        "Normal",
        "StudentT",
        "TruncatedNormal",
        "Uniform",
    ],
    "bayesperiodic.inference.problem": ["Problem"],
    "bayesperiodic.inference.sampling.posterior": ["Posterior"],
    "bayesperiodic.inference.sampling.sampling": ["sample"],
    "bayesperiodic.models.model": ["Model"],
    "bayesperiodic.models.smooth": ["smooth_abs", "smooth_sign"],
    "bayesperiodic.models.structure.result": ["Structure"],
    "bayesperiodic.models.structure.structure": ["structure"],
    "bayesperiodic.orbits.find": ["find_orbits"],
    "bayesperiodic.orbits.orbit": ["Orbit", "Orbits"],
    "bayesperiodic.orbits.polish": ["polish_orbits"],
    "bayesperiodic.orbits.section": ["PoincareSection"],
    "bayesperiodic.orbits.selection": ["select_orbits"],
    "bayesperiodic.periodic.continuation": ["Branch", "continue_periodic", "double_period", "iterate_periodic"],
    "bayesperiodic.periodic.hopf": ["HopfPoint", "emerging_cycle", "hopf_points"],
    "bayesperiodic.periodic.passages": ["solutions_at"],
    "bayesperiodic.periodic.schemes": ["Scheme"],
    "bayesperiodic.periodic.solution": ["PeriodicSolution"],
    "bayesperiodic.periodic.solve": ["solve_periodic"],
    "bayesperiodic.periodic.stability": ["multiplier_sensitivities"],
    "bayesperiodic.reporting.report": ["report"],
    "bayesperiodic.simulation": ["simulate"],
    "bayesperiodic.store": ["load"],
}
_MODULES = {
    "models": "bayesperiodic.models",
    "noise": "bayesperiodic.inference.noise.models",
    "plot": "bayesperiodic.plot",
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [  # noqa: PLE0604
    "Branch", "Calibration", "Comparison", "Experiment", "HalfNormal", "HopfPoint", "Identifiability",
    "InverseGamma", "LogNormal", "LogUniform", "MapEstimate", "Model", "MultivariateNormal", "Normal", "Orbit",
    "Orbits", "PeriodicSolution", "PoincareSection", "Posterior", "Prediction", "PriorPredictive", "Problem",
    "Profile", "Recording", "Scheme", "Structure", "StudentT", "TruncatedNormal", "Uniform", "calibrate", "compare",
    "continue_periodic", "double_period", "emerging_cycle", "find_orbits", "hopf_points", "identifiability",
    "iterate_periodic", "load", "map_estimate", "models", "multiplier_sensitivities", "noise", "plot",
    "polish_orbits", "predict", "prior_predictive", "profile", "report", "sample", "select_orbits", "simulate",
    "smooth_abs", "smooth_sign", "solutions_at", "solve_periodic", "structure",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
        globals()[name] = value
        return value
    if name in _MODULES:
        return import_module(_MODULES[name])
    raise AttributeError(f"module 'bayesperiodic' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
