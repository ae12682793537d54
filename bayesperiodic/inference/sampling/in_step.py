"""Ensembles of this process walk in step: what all of them propose is evaluated in one call of the density."""

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from bayesperiodic.inference.sampling.ensemble import Evaluate, Ground


class InStep:
    """Provides for ensembles what `parallel.Team` does, each in a thread that waits for the others at every proposal.

    A small call costs as much for what surrounds its periodic solves as for these; and the cores are better shared by
    the solves of one large call than by several small ones.

    Parameters
    ----------
    ground : Ground
    """

    def __init__(self, ground: Ground):
        self._ground = ground

    def run(
        self, walk: Callable[[Ground, Any], Any], pieces: Sequence[Any], then: Callable[[int, Any], Any]
    ) -> Iterator[tuple[int, Any]]:
        """Yield the number and the result of every piece, those of a round together: walk(ground, piece).

        An exception that is raised on the way comes out here.

        Parameters
        ----------
        walk : callable
        pieces : sequence
            The first of each ensemble.
        then : callable
            Of an ensemble's number and what it walked: its next piece, or None.
        """
        waiting = dict(enumerate(pieces))
        with ThreadPoolExecutor(max(1, len(waiting))) as threads:
            while waiting:
                gate = Gate(self._ground.evaluate, len(waiting))
                ground = self._ground._replace(evaluate=gate.evaluate)
                walking = {number: threads.submit(gate.passed, walk, ground, waiting[number]) for number in waiting}
                walked = {number: future.result() for number, future in walking.items()}
                following = {number: then(number, result) for number, result in walked.items()}
                waiting = {number: piece for number, piece in following.items() if piece is not None}
                yield from walked.items()


class Gate:
    """Holds every call back until all who may call have called; then one evaluates the points of all.

    Parameters
    ----------
    evaluate : callable
        From points (points, dimension) to arrays (points, …), each row of its point alone.
    callers : int
        Threads that may call.
    """

    def __init__(self, evaluate: Evaluate, callers: int):
        self._evaluate, self._callers = evaluate, callers
        self._calls: list[tuple[np.ndarray, Future]] = []
        self._lock = threading.Lock()

    def passed(self, walk: Callable[[Ground, Any], Any], ground: Ground, piece: Any) -> Any:
        """Return walk(ground, piece), whose evaluations pass this gate; afterwards nobody waits for this caller."""
        try:
            return walk(ground, piece)
        finally:
            with self._lock:
                self._callers -= 1
                answering = self._complete()
            self._answer(answering)

    def evaluate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what the function says of these points, once all others have called too."""
        own: Future = Future()
        with self._lock:
            self._calls.append((points, own))
            answering = self._complete()
        self._answer(answering)
        return own.result()

    def _complete(self) -> list[tuple[np.ndarray, Future]]:
        """Return the calls if all who may call have called, else none."""
        calls: list[tuple[np.ndarray, Future]] = []
        if len(self._calls) == self._callers:
            calls, self._calls = self._calls, calls
        return calls

    def _answer(self, calls: list[tuple[np.ndarray, Future]]) -> None:
        if not calls:
            return
        try:
            every = self._evaluate(np.concatenate([points for points, _ in calls]))
        except BaseException as error:
            for _, own in calls:
                own.set_exception(error)
            return
        ends = np.cumsum([len(points) for points, _ in calls])[:-1]
        for part, (_, own) in zip(zip(*(np.split(one, ends) for one in every), strict=True), calls, strict=True):
            own.set_result(part)
