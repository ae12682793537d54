"""A problem cannot be changed after its construction; what is changed in a copy is validated by the constructor."""

import copy
import pickle

import numpy as np
import pytest

import bayesperiodic as bp
from tests.known import LINEAR, linear_experiment
from tests.problems import duffing_run

TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.LogNormal(30.0, 0.4), "coulomb": bp.Uniform(0.0, 50.0)}
AT = {"k": 870.0, "c": 37.0, "coulomb": 22.0}, {"force": 7.0}


def stated(**changes) -> bp.Problem:
    return bp.Problem(**({"model": LINEAR, "experiments": [linear_experiment(TRUTH, 3.0, seed=1)], "priors": PRIORS} | changes))


def noisy(**changes) -> bp.Problem:
    run, other = duffing_run("run 1"), duffing_run("run 2")
    settings = {
        "model": bp.models.duffing, "experiments": [run, other], "noise": bp.noise.Independent(per="experiment"),
        "priors": {"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1.0, 0.5)},
        "fixed": {"m": 1.0, "k3": 1.0}, "local": ["c"],
    }  # fmt: skip
    return bp.Problem(**settings | changes)
