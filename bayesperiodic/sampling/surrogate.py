"""A surrogate of the posterior density that needs no periodic solves: the exact prior times a normal likelihood.

Where the data determine sums of positive parameters rather than each of them, the posterior lies along a surface that
is flat in the parameters and curved in their logarithms, and has the prior's shape there. Mixtures of Student t
distributions do not describe it in more than some ten dimensions; this surrogate does, wherever the outputs are nearly
linear in the parameters over the posterior's width.
"""

from dataclasses import dataclass

import numpy as np

from bayesperiodic._linalg import covariance_eigh
from bayesperiodic.density.log_posterior import SamplingCoordinates
from bayesperiodic.priors.joint import JointPrior
from bayesperiodic.sampling.proposals import LIGHT_TAILS

# Trajectories of a proposal, largest number of leapfrog steps of each, and their length in units of the widths, from a
# quarter of which to 1.6 times as much is drawn: it may be smaller far from the mode, where parameters are near zero.
TRAJECTORIES, MOST_LEAPS, LEAP = 10, 15, 0.1
# Curvature of the likelihood along an axis, in units of the posterior's, that counts as none.
LEAST_CURVATURE = 0.01


@dataclass(frozen=True)
class Surrogate:
    """Density over values y, in which parameters stand themselves and noise parameters by their logarithms.

    Its logarithm is that of the prior plus gᵀy − ν·ln(1 + (y − m)ᵀ·H·(y − m)/ν)/2: the tails are heavier than those of
    a normal likelihood, as those of one with an unknown variance are.
    """

    prior: JointPrior
    logarithmic: np.ndarray  # bool (dimension,), of the sampling coordinates x that are logarithms of parameters
    centre: np.ndarray  # m (dimension,)
    slope: np.ndarray  # g (dimension,), of directions that have no curvature
    information: np.ndarray  # H (dimension, dimension), positive semi-definite
    axes: np.ndarray  # (dimension, dimension), widths of the surrogate about m in its columns

    @classmethod
    def of(cls, coordinates: SamplingCoordinates, mean: np.ndarray, covariance: np.ndarray) -> "Surrogate | None":
        """Return the surrogate with mode and curvature of a Laplace approximation in sampling coordinates.

        None if the prior has no slope or curvature there.
        """
        prior, count = coordinates.problem.joint_prior, len(coordinates.problem.names)
        logarithmic = np.append(coordinates.logarithmic, np.zeros(mean.size - count, dtype=bool))
        mode = np.where(logarithmic, np.exp(np.where(logarithmic, mean, 0.0)), mean)
        scale = np.where(logarithmic, mode, 1.0)
        by_prior = np.zeros(mean.size)
        by_prior[:count] = prior.gradient(mode[:count])
        # Of the log-likelihood, by x: the density's slope is zero at its mode, where ln θ is part of it.
        slope = -(by_prior * scale + logarithmic)
        slope[count:] = 0.0
        values, vectors, sd = covariance_eigh(covariance)
        precision = (vectors / np.maximum(values, np.finfo(float).eps)) @ vectors.T / np.outer(sd, sd)
        of_prior = np.zeros_like(precision)
        of_prior[:count, :count] = prior.curvature(mode[:count]) * np.outer(scale[:count], scale[:count])
        information = precision - of_prior + np.diag(by_prior * scale * logarithmic) + np.diag(slope * logarithmic)
        widths = np.sqrt(np.diag(covariance))
        widths = np.where(logarithmic, np.minimum(widths, 1.0), widths) * scale
        information *= np.outer(widths / scale, widths / scale)
        if not (np.isfinite(slope).all() and np.isfinite(information).all()):
            return None
        relative, directions = np.linalg.eigh(information)
        curved = relative > LEAST_CURVATURE
        relative = np.where(curved, relative, 0.0)
        lengths = np.divide(1.0, relative, out=np.zeros(relative.size), where=curved)
        away = widths * (directions @ (lengths * (directions.T @ (widths * slope / scale))))
        information = (directions * relative) @ directions.T / np.outer(widths, widths)
        axes = widths[:, None] * directions / np.sqrt(1.0 + relative)
        return cls(prior, logarithmic, mode + away, slope / scale - information @ away, information, axes)

    def log_density(self, y: np.ndarray) -> np.ndarray:
        """Return the logarithm of the density at values (points, dimension), −inf outside of the prior's support."""
        by_data = y @ self.slope - 0.5 * LIGHT_TAILS * np.log1p(self._squared(y) / LIGHT_TAILS)
        return np.asarray(self.prior.log_prob(y[:, : len(self.prior.names)]) + by_data)

    def _squared(self, y: np.ndarray) -> np.ndarray:
        away = y - self.centre
        return np.sum(away @ self.information * away, axis=1)

    def gradient(self, y: np.ndarray) -> np.ndarray:
        """Return the gradient of `log_density` at values (points, dimension)."""
        weight = 1.0 + self._squared(y)[:, None] / LIGHT_TAILS
        result = self.slope - (y - self.centre) @ self.information / weight
        result[:, : len(self.prior.names)] += self.prior.gradient(y[:, : len(self.prior.names)])
        return np.asarray(result)

    def moved(self, y: np.ndarray, random: np.random.RandomState) -> np.ndarray:
        """Return values (points, dimension) after Hamiltonian trajectories, which are reversible for the surrogate.

        Several with the same distribution of lengths, one after the other, are reversible too.
        """
        here, slope = self.log_density(y), self.gradient(y)
        for _ in range(TRAJECTORIES):
            y, here, slope = self._trajectory(y, here, slope, random)
        return y

    def _trajectory(
        self, y: np.ndarray, here: np.ndarray, slope: np.ndarray, random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return values, log-densities and gradients after a trajectory; those that leave the support go back."""
        momentum, leap = random.standard_normal(y.shape), LEAP * 10.0 ** random.uniform(-0.6, 0.2, (len(y), 1))
        energy = here - 0.5 * np.sum(momentum**2, axis=1)
        there, inside, leaps = y, np.ones(len(y), dtype=bool), random.randint(MOST_LEAPS // 3, MOST_LEAPS + 1)
        new = slope
        for _ in range(leaps):
            momentum = momentum + 0.5 * leap * (new @ self.axes)
            there = there + leap * (momentum @ self.axes.T)
            value = self.log_density(there)
            inside &= np.isfinite(value)
            there = np.where(inside[:, None], there, y)
            new = self.gradient(there)
            momentum = momentum + 0.5 * leap * (new @ self.axes)
        value = self.log_density(there)
        with np.errstate(invalid="ignore"):
            gain = value - 0.5 * np.sum(momentum**2, axis=1) - energy
        taken = inside & (np.log(random.uniform(size=len(y))) < gain)
        return np.where(taken[:, None], there, y), np.where(taken, value, here), np.where(taken[:, None], new, slope)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return values of sampling coordinates (points, dimension)."""
        return np.where(self.logarithmic, np.exp(np.where(self.logarithmic, x, 0.0)), x)

    def coordinates(self, y: np.ndarray) -> np.ndarray:
        """Return sampling coordinates of values (points, dimension)."""
        return np.where(self.logarithmic, np.log(np.where(self.logarithmic, y, 1.0)), y)
