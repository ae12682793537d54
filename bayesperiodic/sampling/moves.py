"""Moves of emcee: within several ensembles at once, and from a mixture. Importing emcee takes a second."""

import emcee
import numpy as np

from bayesperiodic.sampling.proposals import MIXTURE_STEPS, StudentMixture


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
    share = 1.0 if mixture is None else 1.0 - MIXTURE_STEPS
    within = (emcee.moves.DEMove(), 0.7), (emcee.moves.DEMove(gamma0=1.0), 0.1), (emcee.moves.StretchMove(), 0.2)
    weighted = [(WithinEnsembles(move, ensembles), share * fraction) for move, fraction in within]
    return weighted if mixture is None else [*weighted, (mixture, MIXTURE_STEPS)]
