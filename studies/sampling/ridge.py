"""The ridge a·b = 1 ± 2 %, known by quadrature, where convergence diagnostics can pass although chains have not mixed.

With b integrated out in closed form the density of a is known up to its scale. Two priors: N(1, 1) for a and b, cut at
zero, and uncut, which leaves 1.2 % of the mass on a second branch where both are negative. Monte Carlo errors come from
the means of batches of draws.
"""

from functools import partial
from typing import Any

import numpy as np
from scipy import stats
from scipy.special import log_ndtr

import bayesperiodic as bp
from studies.common import Row, row
from studies.timing import timed

BATCHES = 5


def standard_error(ensembles: np.ndarray) -> float:
    """Return the Monte Carlo error of the mean of values (ensembles, steps, walkers).

    Each ensemble, or chain of NUTS, is cut into consecutive batches. Their means reflect the dependence in time,
    between walkers, and the differences between ensembles.
    """
    return float(stats.sem([batch.mean() for steps in ensembles for batch in np.array_split(steps, BATCHES)]))


WIDTH = 0.02
POINTS = 20
SHORT, LONG = 1500, 5000
CUT = bp.TruncatedNormal(1.0, 1.0, 0.0, np.inf)
UNCUT = {"uncut": "laplace", "uncut_prior": "prior"}
LARGEST = 8.0
CELLS = 400_000
# A normal value lies beyond four of its standard errors once in 16,000 times.
ERRORS = 4.0
# Posteriors with their seconds, by name.
Runs = dict[str, tuple[bp.Posterior, float]]


def sample_ridge(seed: int, quick: bool) -> Runs:
    """Sample both ridges; a quick run gives the uncut one few steps, and the natural chain a third.

    "natural": priors cut at zero, a short chain in natural coordinates. Priors over both signs: "uncut", the default
    settings but for fewer steps at most, and "uncut_prior", as many from draws of the priors, which lie on both
    branches.
    """
    positive, both = ridge_problem(CUT), ridge_problem(bp.Normal(1.0, 1.0))
    few = {"max_steps": 250, "ensembles": 2} if quick else {"max_steps": LONG}
    runs: dict[str, tuple[bp.Problem, dict[str, Any]]] = {
        "natural": (positive, {"coordinates": "natural", "max_steps": 150 if quick else SHORT}),
        "uncut": (both, few),
        "uncut_prior": (both, {"start": "prior"} | few),
    }
    found: Runs = {}
    for name, (problem, settings) in runs.items():
        fit = bp.map_estimate(problem, progress=False)
        found[name] = timed(partial(bp.sample, problem, fit, seed=seed, progress=False, **settings))
        print(f"  {name}: sd(a) = {found[name][0].draws('a').std():.4f}; {found[name][0].reason}")
    return found


def ridge_problem(prior: Any) -> bp.Problem:
    """Return the problem of two factors of which the product is measured, the mean square of x being 1."""
    model = bp.Model(
        "ridge", states=["w"], inputs=["x"], parameters=["a", "b"],
        equations=lambda s, p, u: [s.dw + s.w - u.x], outputs=lambda s, p, u: {"product": p.a * p.b * u.x},
    )  # fmt: skip
    tau = np.arange(POINTS) / POINTS
    x = np.sqrt(2.0) * np.sin(2 * np.pi * tau)
    # A second harmonic, which the model lacks, makes the residual finite.
    outputs = {"product": x + 1e-3 * np.sin(4 * np.pi * tau)}
    run = bp.Experiment("run", 1.0, outputs, {"x": x}, samples=POINTS, synthetic=True)
    known = {"variance[product]": POINTS * WIDTH**2}
    return bp.Problem(model, [run], priors={"a": prior, "b": prior}, fixed=known)


def marginal(*, cut: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return a on a grid and its posterior density.

    The integral over b is that of a normal density with precision 1 + a²/s², s the width of the ridge, over b > 0 where
    the priors are cut, and over all b where they are not.
    """
    step = 2 * LARGEST / CELLS
    a = -LARGEST + step * (np.arange(CELLS) + 0.5)
    precision = 1.0 + (a / WIDTH) ** 2
    mean = (1.0 + a / WIDTH**2) / precision
    # −½ (1 + 1/s² − mean²·precision), without the difference of large numbers.
    log = -0.5 * (a - 1.0) ** 2 - 0.5 * ((a - 1.0) / WIDTH) ** 2 / precision - 0.5 * np.log(precision)
    if cut:
        log = np.where(a > 0.0, log + log_ndtr(mean * np.sqrt(precision)), -np.inf)
    density = np.exp(log - log.max())
    return a, density / (density.sum() * step)


def spread(*, cut: bool) -> float:
    """Return the standard deviation of a, by quadrature."""
    a, density = marginal(cut=cut)
    weight = density / density.sum()
    return float(np.sqrt(np.sum(weight * (a - np.sum(weight * a)) ** 2)))


def negative_mass() -> float:
    """Return the posterior mass of the uncut ridge where both factors are negative, by quadrature."""
    a, density = marginal(cut=False)
    return float(density[a < 0.0].sum() / density.sum())


def collect(ridge: Runs) -> dict[str, Any]:
    """Return the entries of results.json on the ridge."""
    table: dict[str, Any] = {"width": WIDTH, "sd_by_quadrature": {"cut": spread(cut=True), "uncut": spread(cut=False)}}
    for name, (posterior, seconds) in ridge.items():
        judged = {key: getattr(posterior, key) for key in ("converged", "reason", "tau", "ess", "rhat")}
        cost = {"log_posteriors": posterior.log_posterior_calls, "seconds": seconds}
        table[name] = {"sd": float(posterior.draws("a").std())} | judged | cost
        if name in UNCUT:
            table[name]["negative_mass"] = _negative_share(posterior)
    return table


def _negative_share(posterior: bp.Posterior) -> dict[str, float]:
    """Return the fraction of draws on the second branch and its Monte Carlo error.

    If all draws have the same sign, the error is that of as many independent draws as the effective sample size.
    """
    negative, truth = (posterior.draws("a") < 0.0).astype(float), negative_mass()
    error = standard_error(posterior.by_step(negative))
    if np.ptp(negative) == 0.0:
        error = float(np.sqrt(truth * (1.0 - truth) / posterior.ess["a"]))
    return {"by_quadrature": truth, "found": float(negative.mean()), "monte_carlo_error": error}


def rows(found: dict[str, Any]) -> list[Row]:
    """Return the targets of the ridge."""
    natural, truth = found["natural"], found["sd_by_quadrature"]
    what = "ridge, natural, short: sd(a) over that by quadrature"
    judged = row(what, natural["sd"] / truth["cut"], 0.97, 1.03, natural["reason"])
    return [
        row("ridge, sd(a) by quadrature, cut", truth["cut"], 0.5945, 0.5955),
        row("ridge, sd(a) by quadrature, uncut", truth["uncut"], 0.6405, 0.6415),
        judged if natural["converged"] else _not_claimed(judged),
        *(_second_branch(found[name], start) for name, start in UNCUT.items()),
    ]


def _second_branch(uncut: dict[str, Any], start: str) -> Row:
    mass = uncut["negative_mass"]
    off = abs(mass["found"] - mass["by_quadrature"]) / mass["monte_carlo_error"]
    what = f"ridge, uncut, start={start!r}: mass of the second branch, off by Monte Carlo errors"
    note = f"found {mass['found']:.2%}, true {mass['by_quadrature']:.2%}; {uncut['reason']}"
    result = row(what, off, 0.0, ERRORS, note)
    return result if uncut["converged"] else _not_claimed(result)


def _not_claimed(judged: Row) -> Row:
    """Return a row that is met because the run is not called converged."""
    return judged | {"met": True, "note": f"not called converged: {judged['note']}"}
