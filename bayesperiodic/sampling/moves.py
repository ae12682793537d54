"""Moves of emcee: within several ensembles at once, and from a mixture. Importing emcee takes a second."""

from collections.abc import Callable

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


Proposal = Callable[[np.ndarray, np.random.RandomState], tuple[np.ndarray, np.ndarray]]


class CountedMove(emcee.moves.MHMove):
    """Proposals that are independent of the other walkers, at a `share` of the steps, with their acceptance.

    `proposal` returns those of points (walkers, dimension), and the logs of their factors.
    """

    def __init__(self, proposal: Proposal, share: float):
        super().__init__(proposal)
        self.share = share
        self.proposed = self.accepted = 0

    def propose(self, model: emcee.model.Model, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        """Move all walkers, and count."""
        state, accepted = super().propose(model, state)
        self.proposed += accepted.size
        self.accepted += int(accepted.sum())
        return state, accepted


def from_mixture(mixture: StudentMixture, share: float = MIXTURE_STEPS) -> CountedMove:
    """Return proposals from a mixture."""

    def proposal(points: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        drawn = mixture.draw(len(points), random)
        return drawn, mixture.log_density(points) - mixture.log_density(drawn)

    return CountedMove(proposal, share)


def by_surrogate(surrogate: Surrogate, transform: AffineTransform, share: float) -> CountedMove:
    """Return proposals by moves that leave a surrogate of the density unchanged (surrogate transitions, Liu 2001)."""

    def proposal(points: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        x = transform.unwhiten(points)
        y = surrogate.values(x)
        moved = surrogate.moved(y, random)
        there = surrogate.coordinates(moved)
        volumes = np.sum((x - there)[:, surrogate.logarithmic], axis=1)
        factors = surrogate.log_density(y) - surrogate.log_density(moved) + volumes
        return transform.whiten(there), np.where(np.all(moved == y, axis=1), -np.inf, factors)

    return CountedMove(proposal, share)


def moves(ensembles: int, *independent: CountedMove) -> list[tuple[emcee.moves.Move, float]]:
    """Return the moves with their fractions of the steps.

    Of the steps within ensembles, seven in ten are differential evolution, two are stretch moves, and one is
    differential evolution of full length, which can jump between modes.
    """
    left = 1.0 - sum(move.share for move in independent)
    within = (emcee.moves.DEMove(), 0.7), (emcee.moves.DEMove(gamma0=1.0), 0.1), (emcee.moves.StretchMove(), 0.2)
    weighted = [(WithinEnsembles(move, ensembles), left * fraction) for move, fraction in within]
    return [*weighted, *((move, move.share) for move in independent)]
