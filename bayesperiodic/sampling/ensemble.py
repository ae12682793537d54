"""Ensembles of walkers, advanced by segments; a segment is a pure function of its task, in any process."""

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import emcee
import numpy as np

from bayesperiodic._linalg import covariance_eigh
from bayesperiodic.periodic.compiled import CONVERGED, STATUSES
from bayesperiodic.posterior.density import Evaluation

PIECE, ROOM = 25, 250
Evaluate = Callable[[np.ndarray], Evaluation]


@dataclass(frozen=True)
class AffineTransform:
    """Sampling coordinates x = origin + axes·u, in which the Laplace approximation is a standard normal distribution.

    The columns of `axes` are the eigenvectors of the Laplace covariance times the standard deviations along them.
    emcee's moves are invariant under linear maps, except for the jitter that differential evolution adds to every
    proposal: it would block narrow coordinates if the scales differed by powers of ten.
    """

    origin: np.ndarray
    axes: np.ndarray

    @classmethod
    def of(cls, mean: np.ndarray, covariance: np.ndarray) -> "AffineTransform":
        """Return the transform of a normal distribution."""
        values, vectors, sd = covariance_eigh(covariance)
        return cls(mean, sd[:, None] * vectors * np.sqrt(np.maximum(values, np.finfo(float).eps)))

    def unwhiten(self, u: np.ndarray) -> np.ndarray:
        """Return x (…, dimension)."""
        return self.origin + u @ self.axes.T

    def whiten(self, x: np.ndarray) -> np.ndarray:
        """Return u (…, dimension)."""
        return np.linalg.solve(self.axes, (x - self.origin).reshape(-1, self.origin.size).T).T.reshape(x.shape)


@dataclass
class CallCount:
    """Number of evaluated points, and of failed periodic solves by status."""

    points: int = 0
    failures: Counter[str] = field(default_factory=Counter)

    def add(self, status: np.ndarray) -> None:
        """Count points with these status codes."""
        self.points += len(status)
        self.failures.update(STATUSES[code] for code in status[status != CONVERGED])

    def __add__(self, other: "CallCount") -> "CallCount":
        return CallCount(self.points + other.points, self.failures + other.failures)


class SamplingTarget(NamedTuple):
    """Density of all ensembles, `LogPosterior.evaluate`, and the transform to its coordinates."""

    evaluate: Evaluate
    transform: AffineTransform


class ChainSegment(NamedTuple):
    """Steps of an ensemble, and the number of calls that they took."""

    backend: emcee.backends.Backend
    calls: CallCount


def advance(target: SamplingTarget, task: tuple[emcee.State, int]) -> ChainSegment:
    """Advance an ensemble from a state by a number of steps."""
    (state, steps), calls = task, CallCount()

    def log_prob(u: np.ndarray) -> np.ndarray:
        found = target.evaluate(target.transform.unwhiten(u))
        calls.add(found.status)
        return np.column_stack([found.log_prob, found.moments]) if found.moments.size else found.log_prob

    np.random.RandomState().set_state(state.random_state)  # raises, while emcee would continue with another one
    moves = [(emcee.moves.DEMove(), 0.7), (emcee.moves.DEMove(gamma0=1.0), 0.1), (emcee.moves.StretchMove(), 0.2)]
    sampler = emcee.EnsembleSampler(*state.coords.shape, log_prob, moves=moves, vectorize=True)
    sampler.run_mcmc(state, steps, skip_initial_state_check=True, progress=False)
    return ChainSegment(sampler.backend, calls)


@dataclass(frozen=True)
class Ensemble:
    """State of one ensemble: chain in memory, coordinates and random state after the last step, number of calls."""

    backend: emcee.backends.Backend
    start: emcee.State
    calls: CallCount

    @classmethod
    def at(cls, points: np.ndarray, generator: np.random.RandomState, calls: CallCount) -> "Ensemble":
        """Return the ensemble that starts at points (walkers, dimension), which took a number of calls."""
        backend = emcee.backends.Backend()
        backend.reset(*points.shape)
        return cls(backend, emcee.State(points, random_state=generator.get_state()), calls)

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return self.backend.iteration

    def next_task(self, until: int) -> tuple[emcee.State, int] | None:
        """Return the next task for `advance` up to a number of steps; None if they are done."""
        missing = until - self.steps
        return (self.start, min(missing, PIECE)) if missing > 0 else None

    def extended(self, segment: ChainSegment) -> "Ensemble":
        """Return the ensemble with a segment appended, in the same memory."""
        backend, new, first = copy(self.backend), segment.backend, self.steps
        last = first + new.iteration
        if last > len(backend.chain):
            backend.grow(max(new.iteration, ROOM), None if new.blobs is None else new.blobs[0])
        backend.chain[first:last], backend.log_prob[first:last] = new.chain, new.log_prob
        if new.blobs is not None:
            backend.blobs[first:last] = new.blobs
        backend.accepted = backend.accepted + new.accepted
        backend.random_state, backend.iteration = new.random_state, last
        return Ensemble(backend, backend.get_last_sample(), self.calls + segment.calls)


class LockstepPool:
    """Runs tasks like `TaskPool`, in threads whose points are evaluated in one call.

    The overhead dominates small calls, and one large call uses the cores better than several small ones.
    """

    def __init__(self, target: SamplingTarget):
        self._target = target

    def run(
        self, advance: Callable[[SamplingTarget, Any], Any], tasks: Sequence[Any], then: Callable[[int, Any], Any]
    ) -> Iterator[tuple[int, Any]]:
        """Yield number and result advance(target, task) of every task, round by round; raise the exceptions of tasks.

        `tasks` are the first ones of each ensemble; then(number, result) returns its next task, or None.
        """
        waiting = dict(enumerate(tasks))
        with ThreadPoolExecutor(max(1, len(waiting))) as threads:
            while waiting:
                shared = JointEvaluation(self._target.evaluate, len(waiting))
                target = self._target._replace(evaluate=shared.evaluate)
                futures = {n: threads.submit(shared.call, advance, target, task) for n, task in waiting.items()}
                results = {number: future.result() for number, future in futures.items()}
                following = {number: then(number, result) for number, result in results.items()}
                waiting = {number: task for number, task in following.items() if task is not None}
                yield from results.items()


class JointEvaluation:
    """Collects the calls of several threads and evaluates their points (points, dimension) in one call."""

    def __init__(self, evaluate: Evaluate, callers: int):
        self._evaluate, self._callers = evaluate, callers
        self._calls: list[tuple[np.ndarray, Future]] = []
        self._lock = threading.Lock()

    def call(self, advance: Callable[[SamplingTarget, Any], Any], target: SamplingTarget, task: Any) -> Any:
        """Return advance(target, task); then the other threads no longer wait for this one."""
        try:
            return advance(target, task)
        finally:
            with self._lock:
                self._callers -= 1
                calls = self._complete()
            self._answer(calls)

    def evaluate(self, points: np.ndarray) -> Evaluation:
        """Return the evaluation of these points when all other threads have called too."""
        own: Future = Future()
        with self._lock:
            self._calls.append((points, own))
            calls = self._complete()
        self._answer(calls)
        return own.result()

    def _complete(self) -> list[tuple[np.ndarray, Future]]:
        """Return the calls if all threads have called, else none."""
        if len(self._calls) < self._callers:
            return []
        calls, self._calls = self._calls, []
        return calls

    def _answer(self, calls: list[tuple[np.ndarray, Future]]) -> None:
        if not calls:
            return
        try:
            found = self._evaluate(np.concatenate([points for points, _ in calls]))
        except BaseException as error:
            for _, own in calls:
                own.set_exception(error)
            return
        ends = np.cumsum([len(points) for points, _ in calls])[:-1]
        parts = zip(*(np.split(values, ends) for values in found), strict=True)
        for part, (_, own) in zip(parts, calls, strict=True):
            own.set_result(Evaluation(*part))
