"""One ensemble of walkers, walked in pieces: a piece is a pure function of what it is given, wherever it is done."""

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import emcee
import numpy as np

from bayesperiodic.sampling.coordinates import RidgeMap, SamplingDensity, counted

PIECE, ROOM = 25, 250
Evaluate = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class Ground(NamedTuple):
    """What all ensembles walk on: the density (`SamplingDensity.evaluate`), and the map to its coordinates."""

    evaluate: Evaluate
    map: RidgeMap


class Walked(NamedTuple):
    """Some steps of an ensemble.

    Attributes
    ----------
    chain : array (steps, walkers, dimension)
    log_prob : array (steps, walkers)
    blobs : array (steps, walkers, …), or None
    accepted : array (walkers,)
        Number of accepted proposals.
    random_state : tuple
        After the last step.
    calls : int
        Points evaluated.
    failures : Counter
        Of their solves, by status.
    """

    chain: np.ndarray
    log_prob: np.ndarray
    blobs: np.ndarray | None
    accepted: np.ndarray
    random_state: tuple
    calls: int
    failures: Counter[str]


def walk(ground: Ground, piece: tuple[emcee.State, int]) -> Walked:
    """Walk a number of steps on from a state."""
    (state, steps), calls, failures = piece, 0, Counter[str]()

    def density(u: np.ndarray) -> np.ndarray:
        nonlocal calls
        values, status = ground.evaluate(ground.map.outwards(u))
        calls += len(u)
        failures.update(counted(status))
        return values

    np.random.RandomState().set_state(state.random_state)  # raises where emcee would go on with another one
    moves = [(emcee.moves.DEMove(), 0.7), (emcee.moves.DEMove(gamma0=1.0), 0.1), (emcee.moves.StretchMove(), 0.2)]
    sampler = emcee.EnsembleSampler(*state.coords.shape, density, moves=moves, vectorize=True)
    sampler.run_mcmc(state, steps, skip_initial_state_check=True, progress=False)
    end = sampler.backend
    return Walked(end.chain, end.log_prob, end.blobs, end.accepted, end.random_state, calls, failures)


@dataclass(frozen=True)
class Ensemble:
    """One ensemble, as far as it has walked.

    Attributes
    ----------
    backend : emcee.backends.Backend
        In memory.
    start : emcee.State
        Where it goes on: coordinates, log-densities and random state.
    calls : int
        Points evaluated so far.
    failures : Counter
        Of their solves, by status.
    """

    backend: emcee.backends.Backend
    start: emcee.State
    calls: int
    failures: Counter[str]

    @classmethod
    def at(cls, points: np.ndarray, generator: np.random.RandomState, density: SamplingDensity) -> "Ensemble":
        """Return the ensemble that starts at points (walkers, dimension); the density has counted what they cost."""
        backend = emcee.backends.Backend()
        backend.reset(*points.shape)
        start = emcee.State(points, random_state=generator.get_state())
        return cls(backend, start, density.calls, density.failures)

    @property
    def steps(self) -> int:
        """How many steps have been walked."""
        return self.backend.iteration

    def piece(self, until: int) -> tuple[emcee.State, int] | None:
        """Return the next task on the way to a number of steps; None if they are done."""
        missing = until - self.steps
        return (self.start, min(missing, PIECE)) if missing > 0 else None

    def after(self, walked: Walked) -> "Ensemble":
        """Return the ensemble with steps more, which take over its memory."""
        backend, first = copy(self.backend), self.steps
        last = first + len(walked.chain)
        blobs = None if walked.blobs is None else walked.blobs[0]
        if last > len(backend.chain):
            backend.grow(max(last - first, ROOM), blobs)
        backend.chain[first:last], backend.log_prob[first:last] = walked.chain, walked.log_prob
        if walked.blobs is not None:
            backend.blobs[first:last] = walked.blobs
        backend.accepted = backend.accepted + walked.accepted
        backend.random_state, backend.iteration = walked.random_state, last
        return Ensemble(backend, backend.get_last_sample(), self.calls + walked.calls, self.failures + walked.failures)


class InStep:
    """Provides for ensembles what `TaskPool` does, each in a thread that waits for the others at every proposal.

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
