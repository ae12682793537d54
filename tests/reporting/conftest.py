import warnings
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from tests.known import LINEAR, linear_experiment
from tests.problems import named, pendulum_problem, pendulum_run
from tests.reporting.reading import Page

ATTACK = "\"><script>alert(1)</script><img src=x onerror=alert(2)> & 'more' $x^$"
NAME = ATTACK.replace("/", "")


@pytest.fixture(scope="session")
def scored(solved):
    """Return the comparison of Laplace with MCMC of a plain problem."""
    return bp.compare(*solved)


@pytest.fixture(scope="session")
def written(solved, scored, tmp_path_factory):
    """Return the path of the report on a plain problem."""
    path = tmp_path_factory.mktemp("report") / "report.html"
    return bp.report(*solved, path, title="A linear damper", comparison=scored)


@pytest.fixture(scope="session")
def page(written):
    return Page(written.read_text(encoding="utf-8"))


def attacked():
    """Return a problem whose names, units and texts are hostile, with all that can be local, tied or fixed."""
    model = bp.Model(
        "hostile",
        states=["w"],
        inputs=["x"],
        parameters={"k": ATTACK, "c": "N s/m", "coulomb": "N"},
        units={"x": ATTACK, "force": "<b>N</b>", "w": "&lt;"},
        equations=lambda s, p, u: [s.dw + s.w - u.x],
        outputs=lambda s, p, u: dict(
            zip(LINEAR.outputs, [p.k * u.x + p.c * u.dx + p.coulomb * sp.tanh(u.dx / 0.1)], strict=True)
        ),
    )
    first, second = (linear_experiment(np.array([900.0, 40.0, 0.0]), 3.0, seed=seed) for seed in (1, 2))
    names = (NAME, f"{NAME} again")
    runs = [
        bp.Experiment(n, e.frequency, e.outputs, e.inputs, samples=40)
        for n, e in zip(names, (first, second), strict=True)
    ]
    priors = {"k": bp.Normal(800.0, 60.0), "c": bp.LogNormal(30.0, 0.5)}
    noise = bp.noise.Independent(per="experiment")
    return bp.Problem(model, runs, priors=priors, local=["k"], tied={"coulomb": "0*c"}, noise=noise)


@pytest.fixture(scope="session")
def hostile(tmp_path_factory):
    """Return the path of the report on a hostile problem, whose draws have not converged."""
    problem = attacked()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit = bp.map_estimate(problem, progress=False)
        posterior = bp.sample(problem, fit, seed=1, ensembles=2, max_steps=100, progress=False)
        return bp.report(problem, fit, posterior, tmp_path_factory.mktemp("hostile") / "it's <b>.html", title=ATTACK)


@pytest.fixture(scope="session")
def several():
    """Return a problem of two experiments with two channels, one of them measured at 20 points, and its estimate."""
    masked = replace(pendulum_run(seed=2), name=NAME, mask=np.arange(200) % 10 == 0, independent={})
    problem = pendulum_problem([named(pendulum_run(), "whole"), masked])
    return problem, bp.map_estimate(problem, starts=1, progress=False)


@pytest.fixture(scope="session")
def several_written(several, tmp_path_factory):
    """Return the path of its report."""
    return bp.report(*several, None, tmp_path_factory.mktemp("several") / "report.html")
