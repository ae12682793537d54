"""Coordinates in which the parameters of a population are sampled."""

from collections.abc import Iterator

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from bayesperiodic.density.log_posterior import Evaluation
from bayesperiodic.priors.single import LOG_ROOT_TWO_PI
from bayesperiodic.sampling.population_density import BLOCK_VALUES, Members, PopulationDensity

# Spreads up to this multiple of the units' standard deviations, and down to one over it, and correlations up to tanh 3
# change the scale of the means.
FAR_SPREAD, FAR_CORRELATION = 1e6, 3.0
# First spread, at least, relative to the units' standard deviations; width of the first walkers.
FIRST_SPREAD, START_WIDTH = 0.3, 0.3


class Decoupled:
    """The density of a population over coordinates z, which are nearly normal also if a few units leave much open.

    Means and slopes are centre + factor·z: their mean and a root of their covariance given the spreads and
    correlations, as if the posterior of every unit were normal. Over the means themselves the density has a narrow neck
    at small spreads (O. Papaspiliopoulos, G. O. Roberts, M. Sköld, A general framework for the parametrization of
    hierarchical models, Statistical Science 22 (2007) 59-73). The logarithms of spreads, and twice the artanh of
    correlations, have exponential tails; they are ln Φ(z) − ln Φ(−z) from a middle, Φ being the standard normal
    distribution function, so that the tails over z are normal.
    """

    def __init__(self, density: PopulationDensity):
        self.density, structure = density, density.structure
        self._linear = len(structure.names) + len(structure.sloped)
        self._designs = [self._design(group) for group in density.groups]
        self._covariances = [np.stack([density.units[k].covariance for k in g.places]) for g in density.groups]
        count = len(structure.pairs)
        self._middle = np.concatenate([np.log(self._first_spreads()), np.zeros(count)])
        self._slope = np.concatenate([np.ones(len(structure.free)), np.full(count, 0.5)])
        widths = np.concatenate([np.sqrt(np.diag(unit.covariance)) for unit in density.units])
        self._limits = np.log(widths.min() / FAR_SPREAD), np.log(widths.max() * FAR_SPREAD)
        self._prior = np.diag(
            [0.0] * len(structure.names) + [structure.slope_scale[name] ** -2.0 for name, _ in structure.sloped]
        )

    def _first_spreads(self) -> np.ndarray:
        """Return likely spreads (free,), of the units' means and within the prior."""
        structure, size = self.density.structure, len(self.density.structure.names)
        means = np.concatenate([unit.mean.reshape(-1, size) for unit in self.density.units])
        variances = np.concatenate([np.diag(unit.covariance).reshape(-1, size) for unit in self.density.units])
        spread = np.maximum(means.std(axis=0), FIRST_SPREAD * np.sqrt(variances.mean(axis=0)))
        likely = np.array([0.05, 0.95])
        first = [
            np.clip(spread[structure.names.index(name)], *structure.spread[name].quantile(likely))
            for name in structure.free
        ]
        return np.array(first)

    def _design(self, group: Members) -> np.ndarray:
        """Return what means and slopes are multiplied by in the expected values (units, members·names, linear)."""
        structure, (units, members, _) = self.density.structure, group.covariates.shape
        size = len(structure.names)
        design = np.zeros((units, members, size, self._linear))
        design[..., np.arange(size), np.arange(size)] = 1.0
        for place, (name, covariate) in enumerate(structure.sloped, start=size):
            values = group.covariates[..., structure.covariates.index(covariate)]
            design[..., structure.names.index(name), place] = values
        return design.reshape(units, members * size, self._linear)

    def _between(self, points: np.ndarray) -> np.ndarray:
        """Return the covariances between units (points, names, names), far out those of the nearest limits."""
        structure, limited = self.density.structure, points.copy()
        first, last = self._linear, self._linear + len(structure.free)
        limited[:, first:last] = np.clip(points[:, first:last], *self._limits)
        limited[:, last:] = np.clip(points[:, last:], -FAR_CORRELATION, FAR_CORRELATION)
        return structure.parameters(limited).covariance

    def _conditional(self, points: np.ndarray) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Yield, for parts of the points, the centre (points, linear) and the Cholesky factor of its precision."""
        most = max(1, BLOCK_VALUES // max(d.shape[0] * d.shape[1] ** 2 for d in self._designs))
        for first in range(0, len(points), most):
            part = slice(first, first + most)
            between = self._between(points[part])
            precision = np.broadcast_to(self._prior, (len(between), *self._prior.shape)).copy()
            right = np.zeros((len(between), self._linear))
            of_groups = zip(self.density.groups, self._designs, self._covariances, strict=True)
            for group, design, covariance in of_groups:
                spread = np.kron(np.eye(design.shape[1] // between.shape[1]), between)
                weighted = np.linalg.solve(covariance[:, None] + spread, design[:, None])
                precision += np.einsum("iwdp,idq->wpq", weighted, design)
                right += np.einsum("iwdp,id->wp", weighted, group.centre)
            yield part, np.linalg.solve(precision, right[..., None])[..., 0], np.linalg.cholesky(precision)

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return self.density.dimension

    @property
    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """A point near the posterior, and its uncertainty by coordinate."""
        scale = np.ones(self.dimension)
        scale[self._linear :] = START_WIDTH
        return np.zeros(self.dimension), scale

    def natural(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the coordinates of the population at points z, and the log-determinants of their derivatives."""
        result, linear = points.copy(), self._linear
        log_below, log_above = log_ndtr(points[:, linear:]), log_ndtr(-points[:, linear:])
        result[:, linear:] = self._middle + self._slope * (log_below - log_above)
        log_det = np.sum(np.log(self._slope) - log_below - log_above, axis=1)
        log_det += np.sum(-0.5 * points[:, linear:] ** 2 - LOG_ROOT_TWO_PI, axis=1)
        for part, centre, root in self._conditional(result):
            result[part, :linear] = centre + np.linalg.solve(root.swapaxes(1, 2), points[part, :linear, None])[..., 0]
            log_det[part] -= np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        return result, log_det

    def decoupled(self, points: np.ndarray) -> np.ndarray:
        """Return z at coordinates of the population."""
        result, linear = points.copy(), self._linear
        for part, centre, root in self._conditional(points):
            result[part, :linear] = np.einsum("wqp,wq->wp", root, points[part, :linear] - centre)
        scaled = (points[:, linear:] - self._middle) / self._slope
        result[:, linear:] = -np.sign(scaled) * ndtri_exp(-np.logaddexp(0.0, np.abs(scaled)))
        return result

    def evaluate(self, points: np.ndarray, threads: int | None = None) -> Evaluation:
        """Return the log-density over z at points (points, dimension)."""
        natural, log_det = self.natural(points)
        evaluation = self.density.evaluate(natural, threads)
        return evaluation._replace(log_prob=evaluation.log_prob + log_det)
