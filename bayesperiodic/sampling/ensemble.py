"""Moves of emcee for several independent ensembles that advance as one, and their coordinates."""

from collections import Counter
from dataclasses import dataclass, field

import emcee
import numpy as np

from bayesperiodic._linalg import covariance_eigh
from bayesperiodic.periodic.compiled import CONVERGED, STATUSES
from bayesperiodic.sampling.proposals import StudentMixture

# Fraction of the steps that propose from the mixture, if there is one; the other steps move within the ensembles.
MIXTURE_STEPS = 0.8


@dataclass(frozen=True)
class AffineTransform:
    """Sampling coordinates x = origin + axes·u, in which the Laplace approximation is a standard normal distribution.

    The columns of `axes` are the eigenvectors of the Laplace covariance times the standard deviations along them.
    emcee's moves are invariant under linear maps, but fits of mixtures are regularised in proportion to the scales.
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


class WithinEnsembles(emcee.moves.RedBlueMove):
    """A move of emcee, made in every ensemble by itself; the points of all are evaluated in one call.

    Rows are ordered by ensemble. Each half of an ensemble, its even and its odd walkers, moves by the other half.
    """

    def __init__(self, move: emcee.moves.RedBlueMove, ensembles: int):
        super().__init__(randomize_split=False)
        self._move, self._ensembles = move, ensembles

    def setup(self, coords: np.ndarray) -> None:
        """Prepare the move for the dimension of the walkers (walkers, dimension)."""
        self._move.setup(coords)

    def get_proposal(
        self, s: np.ndarray, c: list[np.ndarray], random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return proposals for the half s (walkers, dimension) by the other half, and the logs of their factors."""
        halves = zip(np.split(s, self._ensembles), np.split(c[0], self._ensembles), strict=True)
        points, factors = zip(*(self._move.get_proposal(a, [b], random) for a, b in halves), strict=True)
        return np.concatenate(points), np.concatenate(factors)


class MixtureMove(emcee.moves.MHMove):
    """Proposals from a mixture, independent of the walkers, with their acceptance."""

    def __init__(self, mixture: StudentMixture):
        super().__init__(self._proposal)
        self._mixture = mixture
        self.proposed = self.accepted = 0

    def _proposal(self, points: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        drawn = self._mixture.draw(len(points), random)
        return drawn, self._mixture.log_density(points) - self._mixture.log_density(drawn)

    def propose(self, model: emcee.model.Model, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        """Move all walkers, and count."""
        state, accepted = super().propose(model, state)
        self.proposed += accepted.size
        self.accepted += int(accepted.sum())
        return state, accepted


def moves(ensembles: int, mixture: MixtureMove | None) -> list[tuple[emcee.moves.Move, float]]:
    """Return the moves with their fractions of the steps.

    Of the steps within ensembles, seven in ten are differential evolution, two are stretch moves, and one is
    differential evolution of full length, which can jump between modes.
    """
    own = 1.0 if mixture is None else 1.0 - MIXTURE_STEPS
    within = (emcee.moves.DEMove(), 0.7), (emcee.moves.DEMove(gamma0=1.0), 0.1), (emcee.moves.StretchMove(), 0.2)
    found = [(WithinEnsembles(move, ensembles), own * fraction) for move, fraction in within]
    return found if mixture is None else [*found, (mixture, MIXTURE_STEPS)]
