"""Concurrent ensembles share one call of the density; results and exceptions reach the right caller."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from bayesperiodic.sampling.ensemble import Gate, Ground, InStep


def squares(points):
    return points**2, np.zeros(len(points), dtype=int)


def three_calls(evaluate, turns):
    """Return the values that three threads get; thread n evaluates n + 1 points per turn."""
    start = threading.Barrier(3)

    def ask(number):
        start.wait()
        return [evaluate(np.full((number + 1, 1), 10.0 * number + turn))[0] for turn in range(turns)]

    with ThreadPoolExecutor(3) as threads:
        return list(threads.map(ask, range(3)))


def test_concurrent_callers_share_one_density_call_and_get_their_own_values():
    sizes = []

    def counted(points):
        sizes.append(len(points))
        return squares(points)

    for number, answers in enumerate(three_calls(Gate(counted, 3).evaluate, turns=20)):
        for turn, answer in enumerate(answers):
            assert np.array_equal(answer, np.full((number + 1, 1), (10.0 * number + turn) ** 2))
    assert sizes == [6] * 20


def walk(ground, steps):
    """Evaluate one point per step."""
    return [float(ground.evaluate(np.full((1, 1), float(k)))[0][0, 0]) for k in range(steps)]


def test_finished_ensembles_do_not_block_the_others():
    pieces = {0: [5, 2], 1: [3], 2: [4, 4, 1]}
    left = {number: list(own) for number, own in pieces.items()}

    def then(number, _):
        return left[number].pop(0) if left[number] else None

    first = [own.pop(0) for own in left.values()]
    found = list(InStep(Ground(squares, None)).run(walk, first, then))
    for number, own in pieces.items():
        assert [len(walked) for n, walked in found if n == number] == own
    assert all(walked == [float(k) ** 2 for k in range(len(walked))] for _, walked in found)


def test_exception_of_the_density_is_raised_and_releases_all_ensembles():
    def broken(points):
        raise ArithmeticError("no density here")

    with pytest.raises(ArithmeticError, match="no density here"):
        list(InStep(Ground(broken, None)).run(walk, [3, 3, 3], lambda *_: None))


def test_exception_of_one_ensemble_is_raised_and_releases_the_others():
    def stumbling(ground, steps):
        if steps == 2:
            raise ArithmeticError("stumbled")
        return walk(ground, steps)

    with pytest.raises(ArithmeticError, match="stumbled"):
        list(InStep(Ground(squares, None)).run(stumbling, [3, 2, 3], lambda *_: None))
