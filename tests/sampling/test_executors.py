"""Chains do not depend on the executor, and draws survive the death of workers."""

import os
import pickle
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import cache
from importlib.util import find_spec
from multiprocessing import get_context, parent_process
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from tqdm import tqdm

import bayesperiodic as bp
from bayesperiodic import _printing
from bayesperiodic.likelihood import observation
from bayesperiodic.periodic import batch
from bayesperiodic.sampling import sample
from tests.problems import (
    DUFFING,
    DUFFING_PRIORS,
    SAMPLES,
    cycle_run,
    duffing_run,
    pendulum_problem,
    pendulum_run,
    section_run,
)
from tests.sampling.test_checkpoint import content, same

RUN = {"seed": 5, "ensembles": 2, "walkers": 8, "max_steps": 150}


@pytest.fixture(scope="module")
def posed():
    """Return a problem of three experiments and its estimate."""
    runs = [duffing_run(f"run {n}", frequency, seed=n) for n, frequency in enumerate((0.05, 0.1, 0.3))]
    problem = bp.Problem(bp.models.duffing, runs, priors=DUFFING_PRIORS, fixed={"m": 1.0})
    return problem, bp.map_estimate(problem, progress=False)


def sampled(posed, **changes) -> bp.Posterior:
    return bp.sample(*posed, **(RUN | {"progress": False} | changes))


@pytest.fixture(scope="module")
def serial(posed, tmp_path_factory):
    path = tmp_path_factory.mktemp("serial") / "run.h5"
    return sampled(posed, checkpoint=path), path


def alike(one: bp.Posterior, other: bp.Posterior) -> bool:
    """Return whether two posteriors are the same to the last bit."""
    draws = all(np.array_equal(one.draws(name), other.draws(name)) for name in one.names)
    lp = np.array_equal(one.data["sample_stats"]["lp"], other.data["sample_stats"]["lp"])
    counts = ("log_posterior_calls", "failures", "acceptance", "reason", "tau")
    return one.names == other.names and draws and lp and all(getattr(one, c) == getattr(other, c) for c in counts)


@pytest.mark.parametrize("cores", [1, 2, 4])
def test_chains_are_identical_for_any_number_of_threads(posed, serial, cores, monkeypatch):
    for module in (observation, batch):
        monkeypatch.setattr(module, "available_cores", lambda: cores)
    monkeypatch.setattr(observation, "SMALLEST_SHARED", 1)
    assert alike(sampled(posed), serial[0])


def test_chains_do_not_depend_on_the_pieces_of_an_executor(posed, serial, monkeypatch):
    """Pieces of other sizes give the same chain; accepted proposals are those that moved a walker."""
    monkeypatch.setattr(sample, "PIECE", 7)
    with ThreadPoolExecutor(2) as threads:
        assert alike(sampled(posed, executor=threads), serial[0])
    kept = content(serial[1])
    moved = np.any(np.diff(kept["chain"], axis=0) != 0.0, axis=-1).sum(axis=0)
    assert set(kept["accepted"] - moved) <= {0.0, 1.0}, "the first step has no predecessor in the chain"


@pytest.mark.slow
@pytest.mark.parametrize("which", ["processes", "dask", "threads"])
def test_chains_are_identical_for_any_executor(posed, serial, which, request, tmp_path):
    """Chains, log-densities, accepted counts and random states, in the result and in the checkpoint."""
    path = tmp_path / "run.h5"
    with ThreadPoolExecutor(3) as threads:
        executor = threads if which == "threads" else request.getfixturevalue(which)
        assert alike(sampled(posed, executor=executor, checkpoint=path), serial[0])
    assert same(content(path), content(serial[1]))


def test_chains_with_integrated_variances_are_identical_for_a_number_of_processes(posed):
    """Those with sampled variances come from the pool `processes` below, after an interrupt."""
    assert alike(*(sampled(posed, executor=e, variances="collapsed", max_steps=50) for e in (None, 2)))


@pytest.mark.slow
def test_chains_from_the_prior_with_failing_solves_are_identical(processes):
    """A softening spring, measured badly, which has no periodic solution for many draws of its prior."""
    priors = {"k": bp.Normal(1.0, 0.5), "k3": bp.Normal(0.0, 1.0)}
    fixed = {"m": 1.0, "c": DUFFING["c"], "variance[displacement]": 100.0}
    problem = bp.Problem(bp.models.duffing, [duffing_run()], priors=priors, fixed=fixed)
    fit = bp.map_estimate(problem, start={"k": 1.0, "k3": 0.5}, progress=False)
    one, other = (sampled((problem, fit), executor=e, start="prior", max_steps=150) for e in (None, processes))
    assert alike(one, other) and one.failures


@pytest.mark.slow
def test_run_can_be_resumed_with_another_executor(posed, serial, processes, dask, tmp_path):
    path = tmp_path / "run.h5"
    for steps, executor in ((50, processes), (100, None), (150, dask)):
        last = sampled(posed, executor=executor, checkpoint=path, max_steps=steps)
    assert alike(last, serial[0]) and same(content(path), content(serial[1]))


def hooked(monkeypatch: pytest.MonkeyPatch, steps: int, act) -> None:
    """Call a function between two blocks, once all ensembles have made so many steps."""

    class Bar(tqdm):
        def update(self, n=1):
            super().update(n)
            if self.n >= steps and not getattr(Bar, "done", False):
                Bar.done = True
                act()

    monkeypatch.setattr(_printing, "tqdm", Bar)


def killed(pool: ProcessPoolExecutor) -> None:
    for process in list(pool._processes.values()):
        os.kill(process.pid, signal.SIGKILL)
        process.join()


@pytest.mark.slow
def test_draws_before_the_death_of_a_worker_are_kept(posed, serial, tmp_path, monkeypatch):
    """Interrupted before the first result, then after it, then completed without workers."""
    path = tmp_path / "run.h5"
    for workers, steps in ((1, 0), (2, 75)):
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool, monkeypatch.context() as patch:
            hooked(patch, steps, lambda pool=pool: killed(pool))
            if steps:
                partial = sampled(posed, executor=pool, checkpoint=path, progress=True)
            else:
                with pytest.raises(RuntimeError, match=r"executor: its workers were lost \(BrokenProcessPool: .*too f"):
                    sampled(posed, executor=pool, checkpoint=path, progress=True)
    assert not partial.converged
    assert partial.reason.startswith("stopped after ") and "BrokenProcessPool" in partial.reason
    walked = len(content(path)["chain"])
    assert 75 <= walked < 150
    assert np.array_equal(content(path)["chain"], content(serial[1])["chain"][:walked])
    assert alike(sampled(posed, checkpoint=path), serial[0]) and same(content(path), content(serial[1]))


def test_draws_before_an_interrupt_are_kept(posed, serial, processes, tmp_path, monkeypatch):
    path = tmp_path / "run.h5"
    with monkeypatch.context() as patch:
        hooked(patch, 75, lambda: signal.raise_signal(signal.SIGINT))
        partial = sampled(posed, executor=processes, checkpoint=path, progress=True)
    assert not partial.converged and partial.reason.startswith("interrupted after ")
    assert alike(sampled(posed, executor=processes, checkpoint=path), serial[0])


class Failing(stats.rv_continuous):
    """A standard normal distribution whose density raises in the processes of an executor."""

    def _logpdf(self, x):
        if parent_process() is not None:
            raise ZeroDivisionError("in the prior")
        return -0.5 * x**2 - 0.5 * np.log(2 * np.pi)

    def _pdf(self, x):
        return np.exp(self._logpdf(x))

    def _cdf(self, x):
        return stats.norm.cdf(x)

    def _ppf(self, q):
        return stats.norm.ppf(q)


# That the exception of a task reaches the caller from Dask too is a test of test__parallel.py.
@pytest.mark.parametrize("which", ["processes", pytest.param("dask", marks=pytest.mark.slow)])
def test_exception_in_a_prior_of_the_user_reaches_the_caller(which, posed, request, tmp_path):
    """The checkpoint of the steps before it is intact, and the executor can be used again."""
    priors = DUFFING_PRIORS | {"k3": Failing(name="failing")(0.5, 0.3)}
    problem = bp.Problem(bp.models.duffing, [duffing_run()], priors=priors, fixed={"m": 1.0})
    failing, path = (problem, bp.map_estimate(problem, progress=False)), tmp_path / "run.h5"
    sampled(failing, checkpoint=path, max_steps=50)
    before, executor = path.read_bytes(), request.getfixturevalue(which)
    with pytest.raises(ZeroDivisionError, match="in the prior"):
        sampled(failing, checkpoint=path, executor=executor)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["run.h5"]
    assert sampled(posed, executor=executor, max_steps=50).draws("k").size


@pytest.mark.slow
def test_dask_repeats_the_tasks_of_a_dead_worker(posed, serial, dask, monkeypatch):
    """Both workers die, one with the only copy of the problem; new ones take their place."""

    def kill() -> None:
        for process in dask.run(os.getpid).values():
            os.kill(process, signal.SIGKILL)

    hooked(monkeypatch, 50, kill)
    assert alike(sampled(posed, executor=dask, progress=True), serial[0])


@pytest.mark.slow
@pytest.mark.parametrize("which", ["processes", "dask"])
def test_profiles_do_not_depend_on_the_executor(posed, which, request):
    here, there = (bp.profile(*posed, ["c", "k3"], executor=e) for e in (None, request.getfixturevalue(which)))
    assert list(there.values) == ["c", "k3"] and here.limits == there.limits and here.best == there.best
    for name in here.names:
        assert np.array_equal(here.values[name], there.values[name])
        assert np.array_equal(here.log_density[name], there.log_density[name])
        assert np.array_equal(here.paths[name], there.paths[name])


def test_error_names_the_bad_executor(posed):
    for call in (bp.sample, bp.profile):
        arguments = {"seed": 1} if call is bp.sample else {}
        with pytest.raises(ValueError, match="executor: must be None, a number of processes .*got 0"):
            call(*posed, executor=0, **arguments)


def correlated_points() -> bp.Experiment:
    """Return the rotation at every fourth sample, all errors correlated."""
    mask = np.arange(SAMPLES) % 4 == 0
    distance = np.abs(np.subtract.outer(np.arange(2 * mask.sum()), np.arange(2 * mask.sum())))
    return pendulum_run(mask=mask, covariance=1e-3 * np.exp(-distance / 5.0))


KINDS = (
    "several experiments", "joint and scipy priors", "tied", "local", "circulant", "measured",
    "variances of each experiment", "angles", "points", "section", "autonomous",
)  # fmt: skip


@cache
def problems() -> dict[str, bp.Problem]:
    """Return the problems of all `KINDS`."""
    two = [duffing_run(), duffing_run("run 2", 0.15, 2)]
    known = {"m": 1.0}
    joint = {
        ("c", "k"): bp.MultivariateNormal([0.2, 1.0], [[0.01, 0.0], [0.0, 0.1]]),
        "k3": stats.gamma(2.0, scale=0.3),
    }
    scatter = duffing_run(scatter={"displacement": 0.01}, cycles=4)

    def duffing(experiments=two, priors=DUFFING_PRIORS, fixed=known, **changes) -> bp.Problem:
        return bp.Problem(bp.models.duffing, experiments, priors=priors, fixed=fixed, **changes)

    tied = {name: prior for name, prior in DUFFING_PRIORS.items() if name != "c"}
    own = DUFFING_PRIORS | {"shift": bp.Normal(0.0, 0.1)}
    cycles = {"mu": bp.LogNormal(1.5, 0.3)}
    return {
        "several experiments": duffing(),
        "joint and scipy priors": duffing(priors=joint),
        "tied": duffing(priors=tied, tied={"c": "0.2*sqrt(k*m)"}),
        "local": duffing(priors=own, local=["c"]),
        "circulant": duffing(noise="circulant"),
        "measured": duffing([scatter], noise="measured"),
        "variances of each experiment": duffing(noise=bp.noise.Independent(per="experiment", prior="flat")),
        "angles": pendulum_problem([pendulum_run()]),
        "points": pendulum_problem([correlated_points()]),
        "section": pendulum_problem([section_run()], noise=bp.noise.Independent(prior=bp.InverseGamma(2.0, 1.0))),
        "autonomous": bp.Problem(
            bp.models.van_der_pol, [cycle_run()], priors=cycles, fixed={"omega": 1.0}, scheme="central4"
        ),
    }


@pytest.mark.parametrize("kind", KINDS)
def test_a_pickled_problem_has_the_same_density_to_the_last_bit(kind):
    assert tuple(problems()) == KINDS
    problem = problems()[kind]
    anchored = problem.anchored(problem.median())
    other = pickle.loads(pickle.dumps(anchored))
    theta = anchored.median() * (1.0 + 0.01 * np.random.default_rng(1).standard_normal((6, len(problem.names))))
    noise = np.full(len(problem.noise_names), 0.01)
    expected = anchored.log_posterior(theta, noise)
    assert np.isfinite(expected).any()
    assert np.array_equal(other.log_posterior(theta, noise), expected)
    assert np.array_equal(pickle.loads(pickle.dumps(problem)).median(), problem.median())
    assert other.names == problem.names and other.tied == problem.tied and repr(other) == repr(problem)


def test_the_sum_over_many_experiments_does_not_depend_on_how_many_points_to_the_last_bit():
    runs = [duffing_run(f"run {n}") for n in range(20)]
    likelihood = bp.Problem(bp.models.duffing, runs, priors=DUFFING_PRIORS, fixed={"m": 1.0}).likelihood
    generator = np.random.default_rng(1)
    size, values = likelihood.blocks[0].size, generator.uniform(0.1, 1.0, (37, 1))
    residuals = generator.uniform(size=(20, 37, size))
    alone = [likelihood(residuals[:, k], values[k]) for k in range(37)]
    assert np.array_equal(likelihood(residuals, values), alone)


@pytest.mark.parametrize("kind", KINDS)
def test_the_density_of_a_point_does_not_depend_on_the_others_to_the_last_bit(kind):
    problem = problems()[kind]
    density = problem.anchored(problem.median()).density()
    theta = problem.median() * (1.0 + 0.01 * np.random.default_rng(1).standard_normal((37, len(problem.names))))
    points = density.from_natural(theta, np.full((37, len(problem.noise_names)), 0.01))
    whole = density.evaluate(points, threads=2)
    assert np.isfinite(whole.log_prob).sum() > 30
    for size in (1, 4, 16):
        parts = [density.evaluate(points[k : k + size], threads=2) for k in range(0, 37, size)]
        assert np.array_equal(np.concatenate([part.log_prob for part in parts]), whole.log_prob)
        assert np.array_equal(np.concatenate([part.status for part in parts]), whole.status)


SCRIPT = """
import numpy as np
from mpi4py.futures import MPIPoolExecutor
import bayesperiodic as bp

if __name__ == "__main__":
    force = np.cos(2 * np.pi * np.arange(50) / 50)
    fixed = {"m": 1.0, "k3": 0.5}
    values, inputs = fixed | {"c": 0.2, "k": 1.0}, {"force": force}
    truth = bp.solve_periodic(bp.models.duffing, values, inputs, frequency=0.1, samples=50)
    x = truth.outputs["displacement"] + 0.01 * np.random.default_rng(1).standard_normal(50)
    run = bp.Experiment("run", 0.1, {"displacement": x}, inputs, samples=50)
    priors = {"c": bp.LogNormal(0.2, 0.3), "k": bp.Normal(1.0, 0.3)}
    problem = bp.Problem(bp.models.duffing, [run], priors=priors, fixed=fixed)
    fit = bp.map_estimate(problem, progress=False)
    settings = {"seed": 1, "ensembles": 2, "walkers": 8, "max_steps": 250, "progress": False}
    with MPIPoolExecutor() as pool:
        there = bp.sample(problem, fit, executor=pool, **settings)
        profile = bp.profile(problem, fit, executor=pool)
        units = dict.fromkeys(["1", "2", "3"], problem)
        kind = {"names": ["k"], "spread": {"k": 0.1}, "seed": 1, "progress": False}
        groups = [bp.population(units, executor=executor, **kind) for executor in (pool, None)]
    here = bp.sample(problem, fit, **settings)
    same = all(np.array_equal(here.draws(name), there.draws(name)) for name in here.names)
    same = same and np.array_equal(*(group.draws("mean[k]") for group in groups))
    print("workers", pool.num_workers, "same", same, profile.shape)
"""


# Wheels of both put mpiexec beside the interpreter.
PLACES = os.pathsep.join([os.path.dirname(sys.executable), os.environ.get("PATH", "")])
MPIEXEC = shutil.which("mpiexec", path=PLACES)
needs_mpi = pytest.mark.skipif(
    find_spec("mpi4py") is None or MPIEXEC is None, reason="needs mpi4py and mpiexec: pip install mpich mpi4py"
)


@needs_mpi
def test_chains_and_populations_are_identical_with_mpi(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path or str(Path.cwd()) for path in sys.path)}
    command = [MPIEXEC, "-n", "3", sys.executable, "-m", "mpi4py.futures", str(script)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300)
    assert "same True {'c': 'closed', 'k': 'closed'}" in done.stdout, done.stderr
