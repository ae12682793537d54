"""Full disks and killed processes under every executor: one error, no process left, the same chain."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import bayesperiodic as bp
from tests.known import LINEAR, linear_experiment
from tests.sampling.test_executors import MPIEXEC, needs_mpi

TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.LogNormal(30.0, 0.5), "coulomb": bp.Normal(20.0, 10.0)}
RUN = {"seed": 5, "ensembles": 2, "walkers": 8, "max_steps": 150, "progress": False}


def posed():
    problem = bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=1)], priors=PRIORS)
    return problem, bp.map_estimate(problem, progress=False)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs the limits of Unix")
@pytest.mark.parametrize("which", ["processes", "dask"])
def test_full_disk_is_an_error_after_which_the_run_goes_on(which, request, tmp_path):
    import resource

    problem, path, executor = posed(), tmp_path / "run.h5", request.getfixturevalue(which)
    expected = bp.sample(*problem, **RUN)
    bp.sample(*problem, checkpoint=path, executor=executor, **(RUN | {"max_steps": 50}))
    before, (soft, hard) = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before), hard))
    try:
        with pytest.raises(OSError, match=r"checkpoint: cannot be written .*the same call goes on from it"):
            bp.sample(*problem, checkpoint=path, executor=executor, **RUN)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["run.h5"]
    resumed = bp.sample(*problem, checkpoint=path, executor=executor, **RUN)
    assert all(np.array_equal(resumed.draws(name), expected.draws(name)) for name in expected.names)


JOB = """
import os, sys
import numpy as np
import bayesperiodic as bp
from tests.sampling.test_faults import posed

def run(executor):
    settings = {"seed": 1, "ensembles": 2, "walkers": 8, "max_steps": 400, "progress": False}
    posterior = bp.sample(*posed(), checkpoint="run.h5", executor=executor, **settings)
    np.save(os.environ["DRAWS"], [posterior.draws(name) for name in posterior.names])

if __name__ == "__main__":
    kind = os.environ["EXECUTOR"]
    if kind == "dask":
        from distributed import Client, LocalCluster
        with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
            with Client(cluster) as client:
                run(client)
    elif kind == "mpi":
        from mpi4py.futures import MPIPoolExecutor
        with MPIPoolExecutor() as pool:
            run(pool)
    else:
        run(2 if kind == "processes" else None)
"""


class Job:
    """A run in a session of its own, whose processes are found by the session or, where they leave it, by a variable.

    Workers of Dask overwrite their environment if setproctitle is installed.
    """

    def __init__(self, folder, kind, draws):
        (folder / "job.py").write_text(JOB)
        command = [sys.executable, "job.py"]
        if kind == "mpi":
            command = [MPIEXEC, "-n", "3", sys.executable, "-m", "mpi4py.futures", "job.py"]
        places = os.pathsep.join(os.path.abspath(path or ".") for path in sys.path)
        given = {"PYTHONPATH": places, "EXECUTOR": kind, "DRAWS": draws, "OF_TEST": str(folder)}
        with (folder / "log").open("w") as log:
            self.process = subprocess.Popen(
                command, cwd=folder, env=os.environ | given, stdout=log, stderr=log, start_new_session=True
            )
        self.mark = f"OF_TEST={folder}".encode()

    def alive(self):
        """Return the numbers of the processes of this run that have not ended."""
        found = []
        for number in filter(str.isdigit, os.listdir("/proc")):
            try:
                state, _, _, session = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[:4]
                own = int(session) == self.process.pid or self.mark in Path(f"/proc/{number}/environ").read_bytes()
                if own and state != "Z":
                    found.append(int(number))
            except OSError:
                continue
        return found


def wait(condition):
    """Wait until a condition holds; the limit is for slow machines."""
    limit = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < limit
        time.sleep(0.05)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("serial")
    assert Job(folder, "serial", "draws.npy").process.wait() == 0
    return np.load(folder / "draws.npy")


SIGNALS = [signal.SIGKILL, signal.SIGINT, signal.SIGTERM]
# Starting Dask takes a third of a minute; SIGTERM ends the process there as SIGKILL does.
KINDS = [("processes", SIGNALS), ("dask", SIGNALS[:2]), ("mpi", SIGNALS)]
ENDS = [
    pytest.param(kind, how, marks=[needs_mpi] if kind == "mpi" else []) for kind, signals in KINDS for how in signals
]


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for processes in /proc")
@pytest.mark.parametrize(("kind", "how"), ENDS)
def test_killed_run_leaves_no_process_and_resumes_identically(tmp_path, uninterrupted, kind, how):
    job = Job(tmp_path, kind, "partial.npy")
    wait(lambda: (tmp_path / "run.h5").exists() or job.process.poll() is not None)
    workers = len(job.alive())
    os.kill(job.process.pid, how)
    job.process.wait()
    wait(lambda: not job.alive())
    assert workers >= 3
    assert Job(tmp_path, kind, "draws.npy").process.wait() == 0
    assert np.array_equal(np.load(tmp_path / "draws.npy"), uninterrupted)


@pytest.mark.slow
@needs_mpi
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for processes in /proc")
def test_run_whose_mpi_worker_is_killed_ends_and_resumes_identically(tmp_path, uninterrupted):
    """MPI ends all ranks when one has died; another executor resumes the run."""
    job = Job(tmp_path, "mpi", "partial.npy")
    wait(lambda: (tmp_path / "run.h5").exists() or job.process.poll() is not None)
    os.kill(max(job.alive()), signal.SIGKILL)
    assert job.process.wait() != 0
    wait(lambda: not job.alive())
    assert Job(tmp_path, "processes", "draws.npy").process.wait() == 0
    assert np.array_equal(np.load(tmp_path / "draws.npy"), uninterrupted)
