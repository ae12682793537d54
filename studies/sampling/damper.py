"""The damper's posterior by three samplers: emcee, emcee with the variance integrated out, and NUTS."""

import argparse
import importlib.util
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from scipy import stats

import bayesperiodic as bp
from studies.common import Row, row, shown
from studies.damper import run as damper
from studies.sampling.ridge import BATCHES, Runs, standard_error
from studies.timing import timed

SAMPLERS: dict[str, dict[str, Any]] = {
    "emcee": {},
    "emcee, collapsed": {"variances": "collapsed"},
    "NUTS": {"sampler": "nuts"},
}
FALSE_ALARM = 0.01
MISSING = 'nutpie is not installed (pip install "bayesperiodic[nuts]")'


def sample_damper(options: argparse.Namespace) -> tuple[Runs, dict[str, Any]]:
    """Return the posterior by every sampler that is installed, and the data's path, digest and whether synthetic."""
    recording, data = damper.read_recording(options.data, options.seed)
    problem = bp.Problem(bp.models.dahl, [recording.fold()], priors=damper.PRIORS)
    fit = bp.map_estimate(problem, progress=False)
    found: Runs = {}
    for name, settings in SAMPLERS.items():
        if name == "NUTS" and importlib.util.find_spec("nutpie") is None:
            continue
        shorter: dict[str, Any] = {"max_steps": 250, "ensembles": 2} if options.quick else {}
        run = partial(bp.sample, problem, fit, seed=options.seed, progress=False, **shorter, **settings)
        found[name] = timed(run)
        print(f"  {name}: {found[name][0].reason}, {found[name][1]:.0f} s")
    return found, data


def moments(posterior: bp.Posterior) -> dict[str, dict[str, float]]:
    """Return mean and sd of every quantity with their Monte Carlo errors.

    What a draw contributes to the sd is, to first order, ((x − mean)² − sd²)/(2 sd).
    """
    found = {}
    for name in posterior.names:
        values = posterior.draws(name)
        mean, sd = float(values.mean()), float(values.std())
        found[name] = {
            "mean": mean,
            "sd": sd,
            "mean_error": standard_error(posterior, values),
            "sd_error": standard_error(posterior, (values - mean) ** 2 / (2.0 * sd)),
        }
    return found


def compare_all(posteriors: dict[str, bp.Posterior]) -> list[dict[str, Any]]:
    """Return every difference of two samplers in a mean or sd, over the combined Monte Carlo error."""
    tables = {name: moments(posterior) for name, posterior in posteriors.items()}
    return [
        {
            "samplers": [one, other],
            "quantity": f"{kind} of {name}",
            "errors": abs(tables[one][name][kind] - tables[other][name][kind])
            / float(np.hypot(tables[one][name][f"{kind}_error"], tables[other][name][f"{kind}_error"])),
        }
        for one, other in combinations(tables, 2)
        for name in tables[one]
        for kind in ("mean", "sd")
    ]


def limit(count: int, ensembles: int) -> float:
    """Return the limit that the largest of `count` differences exceeds with a probability of at most 1 % (Bonferroni).

    Each is Student's t; its degrees of freedom are at least those of one sampler's error, one less than it has batches.
    """
    return float(stats.t.isf(0.5 * FALSE_ALARM / count, ensembles * BATCHES - 1))


def collect(sampled: Runs, data: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of results.json on the damper."""
    differences = compare_all({name: posterior for name, (posterior, _) in sampled.items()})
    ensembles = [np.unique(posterior.data["posterior"]["ensemble"]).size for posterior, _ in sampled.values()]
    return {
        "data": data,
        "units": {name: bp.models.dahl.units[name] for name in bp.models.dahl.parameters} | {"variance[force]": "N²"},
        "samplers": {name: _account(posterior, seconds) for name, (posterior, seconds) in sampled.items()},
        "differences": differences,
        "limit": limit(len(differences), min(ensembles)),
        "false_alarm_rate": FALSE_ALARM,
    }


def _account(posterior: bp.Posterior, seconds: float) -> dict[str, Any]:
    smallest = min(posterior.ess.values())
    return {
        "converged": posterior.converged,
        "reason": posterior.reason,
        "moments": moments(posterior),
        "ess_min": smallest,
        "rhat_max": max(posterior.rhat.values()),
        "log_posteriors": posterior.log_posterior_calls,
        "seconds": seconds,
        "ess_per_second": smallest / seconds,
        "ess_per_1000_log_posteriors": 1e3 * smallest / posterior.log_posterior_calls,
    }


def rows(found: dict[str, Any], quick: bool) -> list[Row]:
    """Return the targets of the damper: pairwise agreement of the samplers, and convergence unless `quick`."""
    kind = "damper, synthetic" if found["data"]["synthetic"] else "damper"
    result = []
    for name in SAMPLERS:
        entry = found["samplers"].get(name)
        what = f"{kind}, {name}: called converged (1: yes)"
        if entry is None:
            result.append(row(what, None, 1.0, 1.0, MISSING))
        else:
            judged = row(what, entry["converged"], 1.0, 1.0, "" if entry["converged"] else entry["reason"])
            result.append(judged | ({"met": None, "note": f"a quick run: {entry['reason']}"} if quick else {}))
    for one, other in combinations(SAMPLERS, 2):
        pair = [d for d in found["differences"] if d["samplers"] == [one, other]]
        worst = max(pair, key=lambda d: d["errors"], default=None)
        what = f"{kind}, {one} against {other}: largest difference over its Monte Carlo error"
        note = MISSING if worst is None else f"largest in the {worst['quantity']}"
        result.append(row(what, None if worst is None else worst["errors"], 0.0, found["limit"], note))
    return result


def table(found: dict[str, Any]) -> str:
    """Return the samplers' costs as text."""
    kind = "SYNTHETIC data" if found["data"]["synthetic"] else "measured data"
    columns = ["reason", "ess_min", "log_posteriors", "seconds", "ess_per_second", "ess_per_1000_log_posteriors"]
    return shown(f"The damper by three samplers, {kind}", found["samplers"], columns)
