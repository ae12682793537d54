"""A problem at one θ: residuals, their derivatives forward and backward (de Kraker et al. 1997, eq. 4-5)."""

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

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
    observations : mapping of str to Observation
        By experiment.
    """

    def __init__(self, theta: np.ndarray, responses: Responses, observations: Mapping[str, Observation]):
        self.theta, self.responses, self.observations = theta, responses, observations

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
    def residuals(self) -> list[np.ndarray]:
        """Residual components, one array (size,) a block."""
        return [r for name, o in self.observations.items() for r in o.residuals(self._solved[name][0])]

    @cached_property
    def changes(self) -> list[np.ndarray]:
        """Derivatives of the predicted components by θ, one array (names, size) a block; NaN where singular."""
        result = []
        for name, observation in self.observations.items():
            response, z = self._solved[name]
            directions = self.responses.changes(self.theta, name, response, z)
            if directions is None:
                result += [np.full((self.theta.size, block.size), np.nan) for block in observation.blocks]
            else:
                result += observation.changes(response, directions)
        return result

    def compared(self) -> dict[str, dict[str, np.ndarray]]:
        """Return y − ŷ (points,) by experiment and channel, within the harmonics kept."""
        return {name: o.compared(self._solved[name][0]) for name, o in self.observations.items()}

    def forward(self, by_residual: Sequence[np.ndarray]) -> np.ndarray:
        """Return Σ (derivatives by the residuals) · ∂residual/∂θ, (names,), from `changes`."""
        return np.sum(list(self.by_experiment(by_residual, adjoint=False).values()), axis=0)

    def adjoint(self, by_residual: Sequence[np.ndarray]) -> np.ndarray:
        """Return the same by one transposed solve an experiment."""
        return np.sum(list(self.by_experiment(by_residual, adjoint=True).values()), axis=0)

    def by_experiment(self, by_residual: Sequence[np.ndarray], *, adjoint: bool) -> dict[str, np.ndarray]:
        """Return each experiment's part of the sum; NaN where its derivatives do not exist."""
        result, start = {}, 0
        for name, observation in self.observations.items():
            stop = start + len(observation.blocks)
            own = list(by_residual[start:stop])
            if adjoint:
                response, z = self._solved[name]
                pulled = self.responses.pulled(self.theta, name, response, z, observation.pulled(response, own))
                result[name] = np.full(self.theta.size, np.nan) if pulled is None else -pulled
            else:
                result[name] = -np.sum([s @ w for s, w in zip(self.changes[start:stop], own, strict=True)], axis=0)
            start = stop
        return result
