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


@pytest.fixture(scope="session", autouse=True)
def interrupts():
    """Enable SIGINT, which a shell disables for tests that it runs in the background."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def compilation_in_one_process():
    """Compile in this process alone, because pytest occupies all cores."""
    compiled.available_cores = lambda: 1


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


@pytest.fixture(autouse=True)
def close_figures():
    yield
    import matplotlib.pyplot as plt

    plt.close("all")
