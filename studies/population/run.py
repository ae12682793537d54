"""Populations: how springs and friction dampers differ from unit to unit, and which unit is none of them.

Simulated springs with a known spread of the damping and none of the stiffness, one more like them and one that is not.
Measured: twelve steady-sine tests of a banded rotary friction damper with backlash (github.com/ARTS-Laboratory/
Dataset-Friction-Damper-with-Backlash, commit 0e09aa9d), friction force Kw and sharpness rho of Dahl's model by
amplitude, frequency and band tension; with ``--replicates N`` the first N tests are predicted from all others. Without
the files only the springs. ``--scaling`` only counts the evaluations that springs one by one take, and in one problem;
with ``--replicates N`` it measures each stage of populations of 10, 100, …, N stored units instead.
"""

import argparse
from typing import Any

from matplotlib.figure import Figure

import bayesperiodic as bp
from studies import common
from studies.population.damper import ADDRESS, damper_population, find_tests, sampled_test
from studies.population.scaling import scaling, table
from studies.population.springs import QUICK_SPRINGS, SPRINGS, spring_population
from studies.population.stored import stored, stored_table


def run(options: argparse.Namespace) -> None:
    """Run the study."""
    watch = common.Stopwatch()
    if options.scaling and options.replicates:
        with watch.part("stored", f"populations of up to {options.replicates} stored units"):
            costs = stored(options.replicates, options.seed)
        print(stored_table(costs))
        common.finish(options.out / "stored", costs, watch, synthetic=True)
        return
    if options.scaling:
        with watch.part("scaling", "simulated springs one by one, and in one joint problem"):
            found = scaling(options.seed, quick=options.quick)
        print(table(found))
        common.finish(options.out / "scaling", found, watch, synthetic=True)
        return
    figures: dict[str, Figure] = {}
    with watch.part("springs", "sampling simulated springs one by one, and their population"):
        springs, account = spring_population(QUICK_SPRINGS if options.quick else SPRINGS, options.seed)
        figures["springs"] = _titled(bp.plot.population(springs), "Simulated springs (synthetic data)")
    print(springs)
    results: dict[str, Any] = {"seed": options.seed, "springs": account}
    paths = [] if options.quick else find_tests(options.data)
    if paths:
        with watch.part("tests", "sampling the tests of the friction damper one by one"):
            every = {path.stem: sampled_test(path, options.seed) for path in paths}
            posteriors = {name: draws for name, draws in every.items() if draws is not None}
        with watch.part("dampers", "sampling their population, and that of all but one"):
            left_out = list(posteriors)[: options.replicates]
            dampers, results["dampers"] = damper_population(posteriors, left_out, options.seed)
            title = f"Friction damper, {len(posteriors)} tests"
            figures["forest"] = _titled(bp.plot.population(dampers), title)
            for covariate, unit in {"amplitude": "m", "tension": "N"}.items():
                figure = bp.plot.population(dampers, covariate=covariate)
                for axes in figure.axes:
                    axes.set_xlabel(f"{covariate} [{unit}]")
                figures[covariate] = _titled(figure, title)
        print(dampers)
    else:
        print(f"  the tests of the friction damper are not used; they are at {ADDRESS}")
    saved = common.save_figures(options.out, figures)
    common.finish(options.out, results, watch, saved, synthetic=not paths)


def _titled(figure: Figure, title: str) -> Figure:
    """Return a figure with a title before its caveats, if any."""
    figure.suptitle(", ".join(filter(None, [title, figure.get_suptitle()])), fontsize="medium")
    return figure
