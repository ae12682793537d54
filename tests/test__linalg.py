import os
import threading

import numpy as np
import pytest
import scipy.linalg
from threadpoolctl import threadpool_info, threadpool_limits

import bayesperiodic as bp
from bayesperiodic._linalg import covariance_cholesky, covariance_eigh, factors, hessian_eigh, in_one_thread, one_thread
from bayesperiodic.data import recording
from tests.known import LINEAR

UNITS = np.array([1e-9, 1.0, 1e7, 3e-4])
CORRELATION = 0.8 ** np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
COVARIANCE = CORRELATION * np.outer(UNITS, UNITS)


def test_covariance_of_different_units_is_decomposed_like_its_correlation():
    values, vectors, sd = covariance_eigh(COVARIANCE)
    assert sd == pytest.approx(UNITS, rel=1e-15)
    assert values == pytest.approx(scipy.linalg.eigh(CORRELATION, eigvals_only=True), rel=1e-13)
    assert (vectors * values) @ vectors.T == pytest.approx(CORRELATION, rel=1e-12)
    factor = covariance_cholesky(COVARIANCE)
    assert np.array_equal(factor, np.tril(factor))
    assert factor @ factor.T == pytest.approx(COVARIANCE, rel=1e-13)


def test_hessian_of_different_units_has_the_inverse_of_its_scaled_decomposition():
    hessian = scipy.linalg.toeplitz([4.0, -1.0, 0.5, 0.0]) / np.outer(UNITS, UNITS)
    values, vectors, scale = hessian_eigh(hessian)
    assert np.diag(hessian) * scale**2 == pytest.approx(np.ones(4), rel=1e-14)
    inverse = (vectors / values) @ vectors.T * np.outer(scale, scale)
    expected = scipy.linalg.inv(scipy.linalg.toeplitz([4.0, -1.0, 0.5, 0.0])) * np.outer(UNITS, UNITS)
    assert inverse == pytest.approx(expected, rel=1e-12)


def test_zero_rows_stay_finite_and_indefinite_covariances_raise():
    singular = np.diag([2.0, 0.0])
    for decompose in (hessian_eigh, covariance_eigh):
        assert decompose(singular)[0] == pytest.approx([0.0, 1.0], abs=1e-15)
    for bad in (singular, np.diag([1.0, -1.0]), np.array([[1.0, 2.0], [2.0, 1.0]])):
        with pytest.raises(np.linalg.LinAlgError):
            covariance_cholesky(bad)


def threads():
    return [one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"]


@pytest.fixture
def two_threads():
    scipy.linalg.norm(np.eye(2))
    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        assert set(before) == {2}
        yield
        assert threads() == before


def test_linear_algebra_has_one_thread_inside_and_as_many_as_before_outside(two_threads):
    assert set(in_one_thread(threads)()) == {1}
    with pytest.raises(ZeroDivisionError):
        in_one_thread(lambda: 1 / 0)()


def test_recordings_are_folded_with_one_thread(two_threads, monkeypatch):
    found, fold_signals = [], recording.fold_signals
    monkeypatch.setattr(recording, "fold_signals", lambda *given: found.extend(threads()) or fold_signals(*given))
    time = np.arange(200) / 20.0
    bp.Recording(time, {"x": np.cos(2 * np.pi * time)}, {}).fold(samples=20)
    assert set(found) == {1}


@pytest.mark.slow
def test_estimates_and_draws_are_computed_with_one_thread(two_threads):
    found = set()

    class Watching(bp.Normal):
        def log_prob(self, x):
            found.update(threads())
            return super().log_prob(x)

    tau = 2 * np.pi * np.arange(32) / 32
    force = 2.0 * np.sin(tau) + 0.01 * np.cos(5 * tau)
    e = bp.Experiment("run", 1.0, {"force": force}, inputs={"x": np.sin(tau)}, samples=32)
    priors = {"k": Watching(1.0, 1.0), "c": bp.Normal(0.0, 1.0), "coulomb": bp.Normal(0.0, 1.0)}
    problem = bp.Problem(LINEAR, [e], priors=priors)
    fit = bp.map_estimate(problem, progress=False)
    assert found == {1}
    found.clear()
    bp.sample(problem, fit, seed=1, walkers=8, ensembles=2, max_steps=250, progress=False)
    assert found == {1}


def in_another_thread(entered, leave):
    """Start a thread that holds the limit between two events."""

    def work():
        with one_thread():
            entered.set()
            leave.wait()

    thread = threading.Thread(target=work)
    thread.start()
    entered.wait()
    return thread


@pytest.mark.parametrize("last", ["this thread", "the other"])
def test_overlapping_calls_in_threads_leave_as_many_threads_as_before(two_threads, last):
    """One thread as long as any call holds it, whichever began first and whichever ends last."""
    leave = threading.Event()
    if last == "the other":
        with one_thread():
            other = in_another_thread(threading.Event(), leave)
        assert set(threads()) == {1}
        leave.set()
        other.join()
    else:
        other = in_another_thread(threading.Event(), leave)
        with one_thread():
            leave.set()
            other.join()
            assert set(threads()) == {1}
    assert set(threads()) == {2}


def test_the_limit_may_be_nested_and_held_by_many_threads_whose_ends_are_mixed(two_threads):
    leave = [threading.Event() for _ in range(4)]
    with one_thread(), one_thread():
        others = [in_another_thread(threading.Event(), event) for event in leave]
        for number in (2, 0):
            leave[number].set()
            others[number].join()
        with pytest.raises(ZeroDivisionError):
            in_one_thread(lambda: 1 / 0)()
        assert set(threads()) == {1}
    assert set(threads()) == {1}
    for number in (1, 3):
        leave[number].set()
        others[number].join()
    assert set(threads()) == {2}
    with threadpool_limits(limits=1, user_api="blas"):  # the user may still set the number
        assert set(threads()) == {1}
    assert set(threads()) == {2}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_forked_process_does_not_inherit_the_limit_of_other_threads(two_threads):
    leave = threading.Event()
    other = in_another_thread(threading.Event(), leave)
    child = os.fork()
    if child == 0:
        with one_thread():
            inside = set(threads())
        os._exit(0 if inside == {1} and set(threads()) == {2} else 1)
    assert os.waitpid(child, 0)[1] == 0
    leave.set()
    other.join()


def test_factors_solve_and_a_singular_matrix_has_none():
    matrix = np.random.default_rng(0).standard_normal((5, 5))
    given, right = matrix.copy(), np.arange(5.0)
    np.testing.assert_allclose(scipy.linalg.lu_solve(factors(matrix), right), np.linalg.solve(given, right))
    assert np.array_equal(matrix, given)
    with pytest.raises(np.linalg.LinAlgError, match="singular"):
        factors(np.ones((3, 3)))
