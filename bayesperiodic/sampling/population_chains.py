"""Sampling of a population's parameters: emcee with proposals from a mixture, as for one problem."""

from dataclasses import dataclass
from typing import Any

import emcee
import numpy as np

from bayesperiodic._printing import progress_bar
from bayesperiodic.sampling.convergence import PASSES, autocorrelation_time, unmet_criteria
from bayesperiodic.sampling.moves import from_mixture, moves
from bayesperiodic.sampling.population_coordinates import Decoupled
from bayesperiodic.sampling.population_density import PopulationDensity
from bayesperiodic.sampling.proposals import (
    MIXTURE_STEPS,
    AffineTransform,
    StudentMixture,
    expected_time,
    fit_mixture,
)

CHAINS, LEAST_WALKERS, STEPS_A_ROUND, MOST_ROUNDS = 4, 16, 50, 200
# Rounds before the first mixture, and most rounds in which it is fitted; it is kept at this expected time [steps].
FIRST_ROUNDS, FITTED_ROUNDS, FAST_ENOUGH = 2, 16, 3.0


@dataclass(frozen=True)
class Chains:
    """Draws (ensembles, steps, walkers, coordinates) and how they were made."""

    draws: np.ndarray
    converged: bool
    reason: str
    tau: dict[str, float]
    calls: int


class _Run:
    """State of a run in coordinates u, x = origin + axes·u."""

    def __init__(self, density: Decoupled, seed: int, bar: Any):
        self.density, self._bar, self.calls = density, bar, 0
        dimension, (centre, scale) = density.dimension, density.start
        self.walkers = max(LEAST_WALKERS, 2 * (dimension + dimension % 2))
        self.transform = AffineTransform(centre, np.diag(scale))
        self.random = np.random.RandomState(np.random.default_rng(seed).integers(2**32, size=4))
        self.walk = emcee.State(
            self.random.standard_normal((CHAINS * self.walkers, dimension)), random_state=self.random.get_state()
        )
        self.mixture: StudentMixture | None = None

    def advance(self, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Return chains (ensembles, steps, walkers, coordinates) and log-densities of further steps."""

        def log_prob(u: np.ndarray) -> np.ndarray:
            self.calls += len(u)
            return self.density.evaluate(self.transform.unwhiten(u)).log_prob

        independent = [from_mixture(self.mixture)] if self.mixture else []
        sampler = emcee.EnsembleSampler(
            *self.walk.coords.shape, log_prob, moves=moves(CHAINS, *independent), vectorize=True
        )  # fmt: skip
        for walk in sampler.sample(self.walk, iterations=steps, skip_initial_state_check=True):
            self.walk = walk
            self._bar.update()
        values = sampler.get_chain(), sampler.get_log_prob()
        chains, log_density = (v.reshape(steps, CHAINS, self.walkers, *v.shape[2:]).swapaxes(0, 1) for v in values)
        return chains, log_density

    def whiten(self, chains: np.ndarray) -> None:
        """Take the draws' principal axes as coordinates."""
        points = self.transform.unwhiten(chains).reshape(-1, chains.shape[-1])
        walkers = self.transform.unwhiten(self.walk.coords)
        covariance = np.atleast_2d(np.cov(points, rowvar=False))
        self.transform = AffineTransform.of(points.mean(axis=0), covariance)
        self.walk = emcee.State(self.transform.whiten(walkers), random_state=self.walk.random_state)

    def adapt(self) -> None:
        """Find the coordinates and the mixture."""
        chains, _ = self.advance(FIRST_ROUNDS * STEPS_A_ROUND)
        self.whiten(chains[:, chains.shape[1] // 2 :])
        rounds: list[np.ndarray] = []
        for _ in range(FITTED_ROUNDS):
            chains, log_density = self.advance(STEPS_A_ROUND)
            points = chains.reshape(-1, chains.shape[-1])
            if self.mixture and expected_time(self.mixture, points, log_density.ravel(), MIXTURE_STEPS) <= FAST_ENOUGH:
                return
            rounds.append(chains.reshape(CHAINS, -1, chains.shape[-1]))
            self.mixture = fit_mixture(np.concatenate(rounds[len(rounds) // 2 :], axis=1))


def sample_chains(density: PopulationDensity, seed: int, *, progress: bool) -> Chains:
    """Return draws of the parameters of a population; the stop rule is that of `sample`, but for changes of tau.

    Where nearly all proposals are independent of the walkers, tau needs no further check.
    """
    with progress_bar(unit="step", desc="population", disable=not progress) as bar:
        coordinates = Decoupled(density)
        run = _Run(coordinates, seed, bar)
        run.adapt()
        kept: list[np.ndarray] = []
        passes, following, missing = 0, 2, ["no check yet"]
        while passes < PASSES and len(kept) < MOST_ROUNDS:
            kept.append(run.advance(STEPS_A_ROUND)[0])
            if len(kept) < following:
                continue
            chains = run.transform.unwhiten(np.concatenate(kept, axis=1))
            times = autocorrelation_time(chains)
            missing = unmet_criteria(chains, times, times, density.labels)
            passes = 0 if missing else passes + 1
            following = len(kept) + max(1, len(kept) // 4)
    inside = run.transform.unwhiten(np.concatenate(kept, axis=1))
    chains = coordinates.natural(inside.reshape(-1, density.dimension))[0].reshape(inside.shape)
    converged = passes >= PASSES
    ended = f"stop rule passed after {inside.shape[1]} steps" if converged else f"most steps with {', '.join(missing)}"
    tau = dict(zip(density.labels, autocorrelation_time(chains).tolist(), strict=True))
    return Chains(chains, converged, ended, tau, run.calls)
