"""Proposals of several ensembles are evaluated in one call, with the results of separate calls."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from bayesperiodic.posterior.density import Evaluation
from bayesperiodic.sampling.ensemble import JointEvaluation, LockstepPool, SamplingTarget


def squares(points):
    return Evaluation(points[:, 0] ** 2, np.zeros((len(points), 0)), np.zeros(len(points), dtype=int))


def three_calls(evaluate, turns):
    """Return the results of three threads that call in turns, thread n with n + 1 points."""
    start = threading.Barrier(3)

    def ask(number):
        start.wait()
        return [evaluate(np.full((number + 1, 1), 10.0 * number + turn))[0] for turn in range(turns)]

    with ThreadPoolExecutor(3) as threads:
        return list(threads.map(ask, range(3)))


def test_every_caller_gets_its_own_points_and_one_call_is_made_for_all():
    sizes = []

    def counted(points):
        sizes.append(len(points))
        return squares(points)

    for number, answers in enumerate(three_calls(JointEvaluation(counted, 3).evaluate, turns=20)):
        for turn, answer in enumerate(answers):
            assert np.array_equal(answer, np.full(number + 1, (10.0 * number + turn) ** 2))
    assert sizes == [6] * 20


def advance(target, steps):
    """Evaluate a number of points one by one."""
    return [float(target.evaluate(np.full((1, 1), float(k))).log_prob[0]) for k in range(steps)]


def test_no_thread_waits_for_an_ensemble_that_is_finished():
    tasks = {0: [5, 2], 1: [3], 2: [4, 4, 1]}
    left = {number: list(own) for number, own in tasks.items()}

    def then(number, _):
        return left[number].pop(0) if left[number] else None

    first = [own.pop(0) for own in left.values()]
    found = list(LockstepPool(SamplingTarget(squares, None)).run(advance, first, then))
    for number, own in tasks.items():
        assert [len(values) for n, values in found if n == number] == own
    assert all(values == [float(k) ** 2 for k in range(len(values))] for _, values in found)


def test_an_error_of_the_density_is_raised_and_ends_all_threads():
    def broken(points):
        raise ArithmeticError("no density here")

    with pytest.raises(ArithmeticError, match="no density here"):
        list(LockstepPool(SamplingTarget(broken, None)).run(advance, [3, 3, 3], lambda *_: None))


def test_an_error_of_one_task_is_raised_and_ends_all_threads():
    def stumbling(target, steps):
        if steps == 2:
            raise ArithmeticError("stumbled")
        return advance(target, steps)

    with pytest.raises(ArithmeticError, match="stumbled"):
        list(LockstepPool(SamplingTarget(squares, None)).run(stumbling, [3, 2, 3], lambda *_: None))
