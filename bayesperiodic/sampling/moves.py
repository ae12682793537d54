"""Moves of emcee: within several ensembles at once, and from a mixture. Importing emcee takes a second."""

from dataclasses import dataclass

import emcee
import numpy as np

from bayesperiodic.sampling.proposals import MIXTURE_STEPS, AffineTransform, StudentMixture
from bayesperiodic.sampling.surrogate import Surrogate


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


class CountedMove(emcee.moves.MHMove):
    """Proposals that are independent of the other walkers, with their acceptance."""

    def __init__(self) -> None:
        super().__init__(self.proposal)
        self.proposed = self.accepted = 0

    def proposal(self, points: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """Return proposals for points (walkers, dimension), and the logs of their factors."""
        raise NotImplementedError

    def propose(self, model: emcee.model.Model, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        """Move all walkers, and count."""
        state, accepted = super().propose(model, state)
        self.proposed += accepted.size
        self.accepted += int(accepted.sum())
        return state, accepted


class MixtureMove(CountedMove):
    """Proposals from a mixture."""

    def __init__(self, mixture: StudentMixture):
        super().__init__()
        self._mixture = mixture

    def proposal(self, points: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """Return draws of the mixture, and its density at the points relative to that at the draws."""
        drawn = self._mixture.draw(len(points), random)
        return drawn, self._mixture.log_density(points) - self._mixture.log_density(drawn)


class SurrogateMove(CountedMove):
    """Proposals by moves that leave a surrogate of the density unchanged (J. S. Liu, Monte Carlo strategies, 2001)."""

    def __init__(self, surrogate: Surrogate, transform: AffineTransform):
        super().__init__()
        self._surrogate, self._transform = surrogate, transform

    def proposal(self, points: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """Return moved points, and the surrogate's density over the coordinates at the points relative to theirs."""
        one = self._surrogate
        x = self._transform.unwhiten(points)
        y = one.values(x)
        moved = one.moved(y, random)
        there = one.coordinates(moved)
        volumes = np.sum((x - there)[:, one.logarithmic], axis=1)
        factors = one.log_density(y) - one.log_density(moved) + volumes
        return self._transform.whiten(there), np.where(np.all(moved == y, axis=1), -np.inf, factors)


@dataclass(frozen=True)
class Shares:
    """Fractions of the steps that propose from a mixture, and by a surrogate."""

    mixture: float
    surrogate: float = 0.0


def moves(
    ensembles: int,
    mixture: MixtureMove | None,
    surrogate: SurrogateMove | None = None,
    shares: Shares = Shares(MIXTURE_STEPS),
) -> list[tuple[emcee.moves.Move, float]]:
    """Return the moves with their fractions of the steps.

    Of the steps within ensembles, seven in ten are differential evolution, two are stretch moves, and one is
    differential evolution of full length, which can jump between modes.
    """
    weighted: list[tuple[emcee.moves.Move, float]] = []
    if mixture:
        weighted.append((mixture, shares.mixture))
    if surrogate:
        weighted.append((surrogate, shares.surrogate))
    left = 1.0 - sum(share for _, share in weighted)
    within = (emcee.moves.DEMove(), 0.7), (emcee.moves.DEMove(gamma0=1.0), 0.1), (emcee.moves.StretchMove(), 0.2)
    return [(WithinEnsembles(move, ensembles), left * fraction) for move, fraction in within] + weighted
