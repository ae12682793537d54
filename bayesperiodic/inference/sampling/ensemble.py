"""One ensemble of walkers, walked in pieces: a piece is a pure function of what it is given, wherever it is done."""

from collections import Counter
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import emcee
import numpy as np

from bayesperiodic.inference.sampling.coordinates import RidgeMap, SamplingDensity, counted

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
