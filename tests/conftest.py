import gc
import signal
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import matplotlib
import pytest
from hypothesis import configuration, settings
from threadpoolctl import threadpool_limits

import bayesperiodic as bp
from bayesperiodic.periodic import compiled
from tests.known import LINEAR, linear_experiment

matplotlib.use("Agg")

# The same examples in each run, and no files in the repository. More of them: --hypothesis-profile=thorough.
configuration.set_hypothesis_home_dir(tempfile.gettempdir())
settings.register_profile("default", derandomize=True, deadline=None, database=None, max_examples=100)
settings.register_profile("thorough", settings.get_profile("default"), max_examples=2000)
settings.load_profile("default")


# pytest occupies all cores: the process that needs kernels compiles them alone.
compiled.available_cores = lambda: 1
# Number of states and stencil of the kernels that nearly all tests use.
COMMON = ((1, (2, 3, 2)), (1, (3, 4, 6)))


def pytest_collection_finish(session):
    """Compile for one of `COMMON` in each process, before all tests; each would compile for all at the same time."""
    worker = getattr(session.config, "workerinput", {"workerid": "gw0", "workercount": 1})
    if worker["workercount"] > 1 and len(session.items) > 1000:
        for states, stencil in COMMON[int(worker["workerid"][2:]) :: worker["workercount"]]:
            for name in ("adjoint", "autonomous"):
                compiled.kernels(name, states, stencil)
    gc.freeze()  # the tests and all modules, in which the collector would look for garbage again and again


@pytest.fixture(scope="session", autouse=True)
def interrupts():
    """Enable SIGINT, which a shell disables for tests that it runs in the background."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def one_blas_thread():
    """Limit BLAS to one thread: those that wait for others occupy the cores on which the other tests run.

    What the tests compute with NumPy themselves takes several times the processor time otherwise. Tests of the limit
    that the package sets itself ask for two threads.
    """
    import scipy.linalg  # noqa: F401  its library is limited too, once it is loaded

    with threadpool_limits(limits=1, user_api="blas"):
        yield


@pytest.fixture(scope="session")
def solved():
    """Return a well-determined problem, its MAP estimate and a short posterior."""
    priors = {"k": bp.Normal(800.0, 60.0), "c": bp.LogNormal(30.0, 0.5), "coulomb": bp.Normal(20.0, 10.0)}
    problem = bp.Problem(LINEAR, [linear_experiment([900.0, 40.0, 25.0], 3.0, seed=1)], priors=priors)
    fit = bp.map_estimate(problem)
    return problem, fit, bp.sample(problem, fit, seed=1, ensembles=2, progress=False)


@pytest.fixture(scope="session")
def processes():
    """Return a pool of two processes; starting them takes seconds, so all tests share it."""
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        yield pool


@pytest.fixture(scope="session")
def dask():
    """Return a client of a Dask cluster of two processes."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client
