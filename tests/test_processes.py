"""Identification where other code has decided about processes, event loops and the locale."""

import asyncio
import os
import shutil
import subprocess
import sys
from functools import cache

import numpy as np
import pytest

import bayesperiodic as bp
from tests import layout
from tests.problems import duffing, duffing_run

SETTINGS = {"seed": 1, "ensembles": 2, "walkers": 12, "max_steps": 50, "progress": False}

HEAD = """
import warnings
import numpy as np
import bayesperiodic as bp
from tests.problems import duffing, duffing_run
warnings.simplefilter("ignore", UserWarning)
problem, noise = duffing(duffing_run()), [1e-3]
fit = bp.map_estimate(problem, progress=False, checks=False)
settings = {"seed": 1, "ensembles": 2, "walkers": 12, "max_steps": 50, "progress": False}
"""

FORKED = """
import multiprocessing, os
big = np.random.default_rng(1).random((400, 400))
def work(_):
    np.linalg.svd(big)
    again = bp.map_estimate(problem, progress=False, checks=False)
    return problem.log_posterior(fit.theta, noise).item(), again.theta
np.linalg.svd(big)
problem.log_likelihood(np.tile(problem.vector(fit.theta), (64, 1)), np.tile(noise, (64, 1)), threads=2)
with multiprocessing.get_context("fork").Pool(2) as pool:
    print(pool.map_async(work, range(4)).get(timeout=300) == [work(0)] * 4)
"""

SENT = """
import __main__
alone = bp.sample(problem, fit, **settings)
shared = bp.sample(problem, fit, executor=2, **settings)
print(hasattr(__main__, "__file__"), np.array_equal(alone.draws("k"), shared.draws("k")))
"""

COMMA = """
import locale, pathlib, tempfile
folder = pathlib.Path(tempfile.mkdtemp())
def everything():
    model = bp.Model("spring", states=["x"], inputs=["force"], parameters=["c", "k"],
                     equations=["ddx + c*dx + 1.25*k*x - force"], outputs={"y": "x"})
    time = np.arange(400) / 8
    force = np.cos(2 * np.pi * 0.12 * time)
    run = bp.simulate(model, {"c": 0.2, "k": 1.5}, {"force": np.cos(2 * np.pi * np.arange(32) / 32)}, frequency=0.12,
                      duration=200, sampling_rate=8, noise={"y": 0.02}, seed=1).between(100, 200)
    (folder / "run.csv").write_text("time,y,force\\n" + "\\n".join(
        f"{t:.6f},{y:.9f},{f:.9f}" for t, y, f in zip(run.time, run.outputs["y"], run.inputs["force"])))
    read = bp.Recording.from_csv(folder / "run.csv", time="time", outputs={"y": "y"}, inputs={"force": "force"})
    one = bp.Problem(model, [read.fold(32, frequency=0.12, harmonics=5)], tied={"k": "0.5*c + 1.4"},
                     priors={"c": bp.LogNormal(0.2, 1.0)}, scheme="fourier")
    best = bp.map_estimate(one, progress=False)
    best.save(folder / "fit.h5")
    return repr(best), repr(bp.load(folder / "fit.h5")), repr(bp.structure(model))
plain = everything()
locale.setlocale(locale.LC_ALL, "de_DE.UTF-8")
print(locale.localeconv()["decimal_point"] == ",", plain == everything())
"""


def output_of(code, *, file=None, **environment):
    """Return the words that a process prints which runs code from a file or, as notebooks do, without one."""
    arguments = ["-c", code] if file is None else [str(file)]
    if file is not None:
        file.write_text(code, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, *arguments], text=True, capture_output=True, check=False,
        env=os.environ | {"PYTHONPATH": str(layout.ROOT)} | environment, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@cache
def posed():
    problem = duffing(duffing_run())
    return problem, bp.map_estimate(problem, progress=False, checks=False)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_forked_processes_compute_after_kernels_and_blas_have_run(tmp_path):
    assert output_of(HEAD + FORKED, file=tmp_path / "forked.py") == ["True"]


def test_processes_sample_for_a_main_module_without_a_file():
    """As that of a notebook; the functions of the model are lambdas."""
    assert output_of(HEAD + SENT) == ["False", "True"]


def test_a_decimal_comma_changes_nothing(tmp_path):
    """The locale is made by localedef where the system lacks it."""
    if shutil.which("localedef") is None:
        pytest.skip("localedef is needed to make a locale")
    made = ["localedef", "-i", "de_DE", "-f", "UTF-8", str(tmp_path / "de_DE.UTF-8")]
    if subprocess.run(made, capture_output=True, check=False).returncode:
        pytest.skip("the sources of the locale are missing")
    assert output_of(HEAD + COMMA, LOCPATH=str(tmp_path)) == ["True", "True"]


def test_estimates_and_draws_inside_a_running_event_loop_are_those_outside():
    """Called in the loop, as in a cell of a notebook, and in two threads of it at once, while the loop goes on."""
    problem, fit = posed()
    outside = bp.sample(problem, fit, **SETTINGS).draws("k")

    async def inside():
        again = bp.map_estimate(problem, progress=False, checks=False)
        draws = [bp.sample(problem, fit, **SETTINGS)]
        running = [asyncio.create_task(asyncio.to_thread(bp.sample, problem, fit, **SETTINGS)) for _ in range(2)]
        ticks = 0
        while not all(task.done() for task in running):
            await asyncio.sleep(0.001)
            ticks += 1
        return again.theta, [one.draws("k") for one in (*draws, *(await asyncio.gather(*running)))], ticks

    theta, draws, ticks = asyncio.run(inside())
    assert theta == fit.theta and ticks > 1
    assert all(np.array_equal(one, outside) for one in draws)
