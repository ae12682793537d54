"""A problem at one θ: residuals, their derivatives forward and backward (de Kraker et al. 1997, eq. 4-5)."""

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bayesperiodic.periodic.compiled import CONVERGED, STATUSES
from bayesperiodic.posterior.likelihood import Residuals, Squares
from bayesperiodic.posterior.observation import Comparisons, Observation, Response
from bayesperiodic.posterior.simulator import Responses

if TYPE_CHECKING:
    from bayesperiodic.posterior.problem import Problem


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


class LikelihoodSlope(NamedTuple):
    """A log-likelihood and its derivatives.

    Attributes
    ----------
    status : str
        How the worst of the periodic solves ended.
    value : float
        −inf where one has failed, or the value is not finite; the derivatives are then zero.
    by_theta : array (names,)
        NaN where a derivative does not exist.
    by_noise : array (noise_names,)
        By ln φ, of the log-likelihood plus the log-prior of φ.
    """

    status: str
    value: float
    by_theta: np.ndarray
    by_noise: np.ndarray


def likelihood_slope(
    problem: "Problem", theta: np.ndarray, noise: np.ndarray, *, forward: bool = False
) -> LikelihoodSlope:
    """Return the log-likelihood and its derivatives, by one transposed solve an experiment where that is possible.

    Parameters
    ----------
    problem : Problem
    theta : array (names,)
    noise : array (noise_names,)
    forward : bool
        Take one solve a parameter instead of one transposed solve.
    """
    if problem.flat_misfits and not forward:
        return _from_squares(problem, theta, noise)
    here = Linearisation(theta, problem.responses, problem.comparisons)
    if not here.converged:
        return _failed(problem, max(here.statuses.values(), key=STATUSES.index))
    value = float(problem.likelihood(here.residuals, noise))
    if not np.isfinite(value):
        return _failed(problem, STATUSES[CONVERGED])
    by_residual, by_noise = problem.likelihood.gradients(here.residuals, noise)
    return LikelihoodSlope(STATUSES[CONVERGED], value, problem.pulled(here, by_residual, forward=forward), by_noise)


def _from_squares(problem: "Problem", theta: np.ndarray, noise: np.ndarray) -> LikelihoodSlope:
    """Do it for experiments of which only the sums of squares count, without their components."""
    misfits, places = problem.flat_misfits, problem.flat_places
    orbits, worst = problem.responses.orbits(theta, misfits)
    if worst != CONVERGED:
        return _failed(problem, STATUSES[worst])
    squares = np.concatenate([o.squares for o in orbits])
    value = float(problem.likelihood(Squares(squares[places]), noise))
    if not np.isfinite(value):
        return _failed(problem, STATUSES[CONVERGED])
    by_square, by_noise = problem.likelihood.square_slopes(squares[places], noise)
    own = np.empty_like(by_square)
    own[places] = by_square
    weights, first = [], 0
    for group, orbit in zip(misfits, orbits, strict=True):
        weights.append(group.pulled(orbit.outputs, own[first : first + group.blocks]))
        first += group.blocks
    by_theta = problem.responses.pulled_outputs(orbits, weights)
    return LikelihoodSlope(STATUSES[CONVERGED], value, by_theta, by_noise)


def _failed(problem: "Problem", status: str) -> LikelihoodSlope:
    return LikelihoodSlope(status, -np.inf, np.zeros(len(problem.names)), np.zeros(len(problem.noise_names)))
