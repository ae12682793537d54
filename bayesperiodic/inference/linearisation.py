"""A problem at one θ: residuals, their derivatives forward and backward (de Kraker et al. 1997, eq. 4-5)."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from bayesperiodic.inference.comparisons import Comparisons
from bayesperiodic.inference.noise.residuals import Residuals
from bayesperiodic.inference.observation import Observation, Response
from bayesperiodic.inference.responses import Responses
from bayesperiodic.periodic.compiled import CONVERGED, STATUSES


class Linearisation:
    """Everything that one θ says, computed where it is first asked for.

    Parameters
    ----------
    theta : array (names,)
    responses : Responses
        Anchored at θ.
    comparisons : Comparisons
        With the experiments.
    """

    def __init__(self, theta: np.ndarray, responses: Responses, comparisons: Comparisons):
        self.theta, self.responses, self._comparisons = theta, responses, comparisons

    @property
    def _observations(self) -> dict[str, Observation]:
        """Of every experiment, in the order of the problem."""
        return {name: self._comparisons.observations[name] for name in self._solves}

    @cached_property
    def _solved(self) -> dict[str, tuple[Response, np.ndarray]]:
        return {name: solved.one(0) for name, solved in self._solves.items()}

    @cached_property
    def _solves(self) -> dict:
        return self.responses.solve(self.theta[None], keep=True)

    @property
    def statuses(self) -> dict[str, str]:
        """How the solve of each experiment ended."""
        return {name: STATUSES[int(solved.status[0])] for name, solved in self._solves.items()}

    @property
    def converged(self) -> bool:
        """Whether all solves did, with derivatives."""
        return all(solved.status[0] == CONVERGED for solved in self._solves.values())

    @cached_property
    def residuals(self) -> Residuals:
        """Residual components, one array (size,) a block."""
        responses = {name: solved.response for name, solved in self._solves.items()}
        return self._comparisons.residuals(responses, 1).at(0)

    @cached_property
    def changes(self) -> list[np.ndarray]:
        """Derivatives of the predicted components by θ, one array (names, size) a block; NaN where singular."""
        result = []
        for name, observation in self._observations.items():
            response, z = self._solved[name]
            directions = self.responses.changes(self.theta, name, response, z)
            if directions is None:
                result += [np.full((self.theta.size, block.size), np.nan) for block in observation.blocks]
            else:
                result += observation.changes(response, directions)
        return result

    def compared(self) -> dict[str, dict[str, np.ndarray]]:
        """Return y − ŷ (points,) by experiment and channel, within the harmonics kept."""
        return {name: o.compared(self._solved[name][0]) for name, o in self._observations.items()}

    def forward(self, by_residual: Sequence[np.ndarray]) -> np.ndarray:
        """Return Σ (derivatives by the residuals) · ∂residual/∂θ, (names,), from `changes`."""
        return np.sum(list(self.by_experiment(by_residual, adjoint=False).values()), axis=0)

    def adjoint(self, by_residual: Sequence[np.ndarray]) -> np.ndarray:
        """Return the same by one transposed solve an experiment."""
        return np.sum(list(self.by_experiment(by_residual, adjoint=True).values()), axis=0)

    def by_experiment(self, by_residual: Sequence[np.ndarray], *, adjoint: bool) -> dict[str, np.ndarray]:
        """Return each experiment's part of the sum; NaN where its derivatives do not exist."""
        if adjoint:
            responses = {name: response for name, (response, _) in self._solved.items()}
            weights = self._comparisons.pulled(responses, self.residuals.like(by_residual))
            pulled = self.responses.pulled(self.theta, self._solved, weights)
            return {name: -pulled[name] for name in self._solved}
        result, start, blocks = {}, 0, list(by_residual)
        for name, observation in self._observations.items():
            stop = start + len(observation.blocks)
            pairs = zip(self.changes[start:stop], blocks[start:stop], strict=True)
            result[name] = -np.sum([s @ w for s, w in pairs], axis=0)
            start = stop
        return result
