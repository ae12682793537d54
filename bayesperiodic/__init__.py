"""Bayesian identification of nonlinear systems from their periodic equilibrium states.

You give a model (equations) and recordings (measured periods); you get back what the recordings say about the
parameters, how far to trust it, and which combinations they cannot tell you.

Names are imported at their first use, so that ``import bayesperiodic`` is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bayesperiodic import models, plot
    from bayesperiodic._io import load
    from bayesperiodic.data.experiment import Experiment
    from bayesperiodic.data.recording import Recording
    from bayesperiodic.diagnostics.calibration import Calibration, calibrate
    from bayesperiodic.diagnostics.comparison import Comparison, compare
    from bayesperiodic.diagnostics.identifiability import Identifiability, identifiability
    from bayesperiodic.diagnostics.predictive import Prediction, predict
    from bayesperiodic.diagnostics.prior_predictive import PriorPredictive, prior_predictive
    from bayesperiodic.estimation.map_estimate import map_estimate
    from bayesperiodic.estimation.profile import Profile, profile
    from bayesperiodic.estimation.result import MapEstimate
    from bayesperiodic.models.model import Model, smooth_abs, smooth_sign
    from bayesperiodic.orbits.find import find_orbits
    from bayesperiodic.orbits.orbit import Orbit, Orbits
    from bayesperiodic.orbits.polish import polish_orbits
    from bayesperiodic.orbits.section import PoincareSection
    from bayesperiodic.orbits.select import select_orbits
    from bayesperiodic.periodic.continuation import (
        Branch,
        continue_periodic,
        double_period,
        iterate_periodic,
        solutions_at,
    )
    from bayesperiodic.periodic.hopf import HopfPoint, emerging_cycle, hopf_points
    from bayesperiodic.periodic.schemes import Scheme
    from bayesperiodic.periodic.solution import PeriodicSolution
    from bayesperiodic.periodic.solve import solve_periodic
    from bayesperiodic.periodic.stability import multiplier_sensitivities
    from bayesperiodic.posterior import noise as noise
    from bayesperiodic.posterior.joint_priors import MultivariateNormal
    from bayesperiodic.posterior.priors import (
        HalfNormal,
        InverseGamma,
        LogNormal,
        LogUniform,
        Normal,
        StudentT,
        TruncatedNormal,
        Uniform,
    )
    from bayesperiodic.posterior.problem import Problem
    from bayesperiodic.reporting.build import report
    from bayesperiodic.sampling.posterior import Posterior
    from bayesperiodic.sampling.sample import sample
    from bayesperiodic.simulation import simulate
    from bayesperiodic.symmetry.structure import Structure, structure

_HOMES = {
    "bayesperiodic._io": ["load"],
    "bayesperiodic.data.experiment": ["Experiment"],
    "bayesperiodic.data.recording": ["Recording"],
    "bayesperiodic.diagnostics.calibration": ["Calibration", "calibrate"],
    "bayesperiodic.diagnostics.comparison": ["Comparison", "compare"],
    "bayesperiodic.diagnostics.identifiability": ["Identifiability", "identifiability"],
    "bayesperiodic.diagnostics.predictive": ["Prediction", "predict"],
    "bayesperiodic.diagnostics.prior_predictive": ["PriorPredictive", "prior_predictive"],
    "bayesperiodic.estimation.map_estimate": ["map_estimate"],
    "bayesperiodic.estimation.profile": ["Profile", "profile"],
    "bayesperiodic.estimation.result": ["MapEstimate"],
    "bayesperiodic.models.model": ["Model", "smooth_abs", "smooth_sign"],
    "bayesperiodic.orbits.find": ["find_orbits"],
    "bayesperiodic.orbits.orbit": ["Orbit", "Orbits"],
    "bayesperiodic.orbits.polish": ["polish_orbits"],
    "bayesperiodic.orbits.section": ["PoincareSection"],
    "bayesperiodic.orbits.select": ["select_orbits"],
    "bayesperiodic.periodic.continuation": [
        "Branch",
        "continue_periodic",
        "double_period",
        "iterate_periodic",
        "solutions_at",
    ],
    "bayesperiodic.periodic.hopf": ["HopfPoint", "emerging_cycle", "hopf_points"],
    "bayesperiodic.periodic.schemes": ["Scheme"],
    "bayesperiodic.periodic.solution": ["PeriodicSolution"],
    "bayesperiodic.periodic.solve": ["solve_periodic"],
    "bayesperiodic.periodic.stability": ["multiplier_sensitivities"],
    "bayesperiodic.posterior.joint_priors": ["MultivariateNormal"],
    "bayesperiodic.posterior.priors": [
        "HalfNormal",
        "InverseGamma",
        "LogNormal",
        "LogUniform",
        "Normal",
        "StudentT",
        "TruncatedNormal",
        "Uniform",
    ],
    "bayesperiodic.posterior.problem": ["Problem"],
    "bayesperiodic.reporting.build": ["report"],
    "bayesperiodic.sampling.posterior": ["Posterior"],
    "bayesperiodic.sampling.sample": ["sample"],
    "bayesperiodic.simulation": ["simulate"],
    "bayesperiodic.symmetry.structure": ["Structure", "structure"],
}
_MODULES = {
    "models": "bayesperiodic.models",
    "noise": "bayesperiodic.posterior.noise",
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
