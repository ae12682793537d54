"""A chaotic pendulum, identified from the unstable periodic orbits in its recording (section 5 of the paper).

φ'' + c1 tanh(φ'/v0) + c2 φ' + c3 φ'|φ'| + (g + a ω² cos ωt)/l · sin φ = 0 with c_i = k_i/(m l²), driven at ω = 9.09 rad/s:
from 42,754 drive periods to orbits with error bars, to m and l, to k3, and to what all five parameters cannot be told.
"""

from __future__ import annotations

import argparse
from typing import Any

import bayesperiodic as bp
from studies import (
    common,
    pendulum_estimates,
    pendulum_figures,
    pendulum_orbits,
    pendulum_recording,
    pendulum_replicates,
    pendulum_ridge,
)
from studies.pendulum_estimates import Identified
from studies.pendulum_orbits import Reference
from studies.pendulum_recording import TRUTH
from studies.pendulum_search import Found, search

NOISE_LEVELS = (0.0, 0.001, 0.01)
PERIODS, QUICK = range(1, 6), range(1, 4)


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    if options.replicates < 0 or not 0.0 <= options.noise < 1.0:
        raise ValueError(
            f"--replicates, --noise: {options.replicates}, {options.noise} is not allowed; replicates must be at least "
            "0, the noise a fraction of the attractor's size from 0 to 1."
        )
    if options.replicates:
        pendulum_replicates.run(options)
        return
    watch = common.Stopwatch()
    results: dict[str, Any] = {}
    with watch.part("recording", "the recording"):
        recording, about = pendulum_recording.get(options)
    print(f"  {'SYNTHETIC' if about['synthetic'] else 'measured'}: {about['periods']} drive periods, {about['values']} numbers")
    levels = () if not about["synthetic"] else (options.noise,) if options.quick else NOISE_LEVELS
    with watch.part("orbits", "finding periodic orbits, without a model"):
        found = search(recording, options, levels, QUICK if options.quick else PERIODS)
    orbits = found[options.noise].chained
    print(f"  {orbits!r}")
    truths: list[Reference] = []
    if about["synthetic"]:
        with watch.part("reference", "the same orbits by shooting"):
            truths, results["found"] = _against_shooting(found, min(found))
    with watch.part("estimates", "m and l, k3, and all five from the orbits, from the paper's start"):
        identified = pendulum_estimates.identify(orbits)
    print(_account(identified))
    with watch.part("ridge", "sampling the posterior of all five with emcee"):
        ridge = pendulum_ridge.sample(identified.problems["all five"], identified.fits["all five"], options.seed, options.quick)
    print(f"  {ridge.posterior.reason}\n{ridge.identifiability}\n{ridge.natural}")
    with watch.part("figures", "drawing"):
        figures = pendulum_figures.figures(found[options.noise].section, identified, ridge, results)
        paths = common.save_figures(options.out, figures)
    results |= collect(about, orbits, identified, ridge) | {"noise": options.noise, "seed": options.seed}
    path = common.write_results(options.out, results | {"seconds": watch.total(), "versions": common.versions()})
    print(f"figures{' (synthetic data)' if about['synthetic'] else ''}: {', '.join(map(str, paths))}\nresults: {path}")
