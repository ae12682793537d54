"""Posterior density of a population's parameters, with the units integrated out by their draws."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from scipy.special import betaln, gammaln, logsumexp

from bayesperiodic._compile.cache import load
from bayesperiodic.density.log_posterior import Evaluation
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.priors.single import LOG_ROOT_TWO_PI
from bayesperiodic.sampling.population_units import UnitDraws

# Largest artanh of a partial correlation, 1 − |ρ| = 2e-6, beyond which covariances are singular in double precision.
MOST_CORRELATED = 7.0
# Values of a block of units and points that are in memory at once.
BLOCK_VALUES = 300_000


@cache
def _kernels() -> ModuleType:
    return load(Path(__file__).with_name("_kernels").joinpath("mixture.py").read_text(encoding="utf-8"))


class Parameters(NamedTuple):
    """Parameters of the population at several points."""

    means: np.ndarray  # (points, names)
    slopes: np.ndarray  # (points, names, covariates), per standard deviation of the covariate
    covariance: np.ndarray  # (points, names, names)


@dataclass(frozen=True)
class Hierarchy:
    """What a population is: normal, or Student t with `degrees` of freedom, about a mean that is linear in covariates.

    `spread` has the prior of the standard deviation of every name, or its value. `slope_scale` has the standard
    deviation of the normal prior of the slopes of the names that have them, per standard deviation of the covariate.
    """

    names: tuple[str, ...]
    covariates: tuple[str, ...]
    spread: Mapping[str, Any]
    slope_scale: Mapping[str, float]
    correlation: bool
    degrees: float

    @property
    def free(self) -> tuple[str, ...]:
        """Names whose spread is unknown."""
        return tuple(name for name in self.names if not isinstance(self.spread[name], float))

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Pairs of rows of the correlation matrix of `free`, (later, earlier), ordered by the earlier one."""
        pairs = combinations(range(len(self.free)), 2) if self.correlation else ()
        return tuple((later, earlier) for earlier, later in pairs)

    @property
    def sloped(self) -> tuple[tuple[str, str], ...]:
        """Pairs of name and covariate."""
        return tuple(
            (name, covariate) for name in self.names if name in self.slope_scale for covariate in self.covariates
        )

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the parameters of the population."""
        return (
            *(f"mean[{name}]" for name in self.names),
            *(f"slope[{name}, {covariate}]" for name, covariate in self.sloped),
            *(f"spread[{name}]" for name in self.free),
            *(f"correlation[{self.free[j]}, {self.free[i]}]" for i, j in self.pairs),
        )

    def parameters(self, points: np.ndarray) -> Parameters:
        """Return the parameters at points (points, labels): means, slopes, ln spread, artanh of correlations."""
        size, (first, second, third) = len(self.names), np.cumsum([len(self.names), len(self.sloped), len(self.free)])
        slopes = np.zeros((len(points), size, len(self.covariates)))
        for place, (name, covariate) in enumerate(self.sloped):
            slopes[:, self.names.index(name), self.covariates.index(covariate)] = points[:, first + place]
        spread = np.empty((len(points), size))
        spread[:] = [value if isinstance(value := self.spread[name], float) else np.nan for name in self.names]
        at = [self.names.index(name) for name in self.free]
        spread[:, at] = np.exp(points[:, second:third])
        factor = np.broadcast_to(np.eye(size), (len(points), size, size)).copy()
        factor[:, np.array(at, dtype=int)[:, None], at] = self._factor(np.tanh(points[:, third:]))
        factor = spread[:, :, None] * factor
        return Parameters(points[:, :size], slopes, factor @ factor.swapaxes(1, 2))

    def _factor(self, partial: np.ndarray) -> np.ndarray:
        """Return Cholesky factors (points, free, free) of correlations, from partial correlations of a C-vine."""
        count = len(self.free)
        result = np.broadcast_to(np.eye(count), (len(partial), count, count)).copy()
        left = np.ones((len(partial), count))
        for value, (i, j) in zip(partial.T, self.pairs, strict=True):
            result[:, i, j] = value * left[:, i]
            left[:, i] *= np.sqrt(1.0 - value**2)
            result[:, i, i] = left[:, i]
        return result

    def log_prior(self, points: np.ndarray) -> np.ndarray:
        """Return the log-prior over the coordinates: flat in the means, all correlation matrices equally probable."""
        first, second, third = np.cumsum([len(self.names), len(self.sloped), len(self.free)])
        total = np.zeros(len(points))
        for place, (name, _) in enumerate(self.sloped, start=first):
            scale = self.slope_scale[name]
            total -= 0.5 * (points[:, place] / scale) ** 2 + np.log(scale) + LOG_ROOT_TWO_PI
        for place, name in enumerate(self.free, start=second):
            with np.errstate(over="ignore"):
                total += self.spread[name].log_prob(np.exp(points[:, place])) + points[:, place]
        for place, (_, tree) in enumerate(self.pairs, start=third):
            beta = 1.0 + 0.5 * (len(self.free) - 2 - tree)
            log_rest = 2.0 * (np.log(2.0) - np.logaddexp(points[:, place], -points[:, place]))  # ln(1 − tanh²)
            total += beta * log_rest - (2.0 * beta - 1.0) * np.log(2.0) - betaln(beta, beta)
            total[np.abs(points[:, place]) > MOST_CORRELATED] = -np.inf
        return total


class Members(NamedTuple):
    """Units with the same number of members, and their places among all units."""

    places: list[int]
    features: np.ndarray  # (units, features, draws): log-weight, coordinates and their products, standardised
    kernels: np.ndarray  # (units, d, d), standardised
    centre: np.ndarray  # (units, d)
    scale: np.ndarray  # (units, d)
    covariates: np.ndarray  # (units, members, covariates)


class PopulationDensity:
    """Log-density of the parameters of a population, given the draws of all units.

    The likelihood of a unit is the mean over its draws of the population's density there, over the prior under which
    they were drawn (D. W. Hogg, A. D. Myers, J. Bovy, Astrophys. J. 725 (2010) 2166); the kernels of `UnitDraws` are
    convolved with the population, so that it exists for a spread of zero. `covariates` (members, covariates) are
    standardised, in the order of the units' members.
    """

    def __init__(
        self,
        structure: Hierarchy,
        units: Sequence[UnitDraws],
        covariates: np.ndarray,
        groups: list[Members] | None = None,
    ):
        self.structure, self.units = structure, units
        self.covariates = covariates
        self.groups = groups or [self._group(count) for count in sorted({len(unit.members) for unit in units})]

    def with_structure(self, structure: Hierarchy) -> "PopulationDensity":
        """Return the density of another kind of population of the same units, whose arrays are shared."""
        return PopulationDensity(structure, self.units, self.covariates, self.groups)

    def _group(self, count: int) -> Members:
        places = [k for k, unit in enumerate(self.units) if len(unit.members) == count]
        starts = np.cumsum([0, *(len(unit.members) for unit in self.units)])
        chosen = [self.units[k] for k in places]
        centre = np.stack([unit.mean for unit in chosen])
        scale = np.sqrt(np.stack([np.diag(unit.covariance) for unit in chosen]))
        z = (np.stack([unit.centres for unit in chosen]) - centre[:, None]) / scale[:, None]
        first, second = self._products(z.shape[-1])
        weights = np.stack([unit.log_weights for unit in chosen])[..., None]
        features = np.concatenate([weights, z, z[..., first] * z[..., second]], axis=-1).swapaxes(1, 2).copy()
        kernels = np.stack([unit.kernel for unit in chosen]) / (scale[:, :, None] * scale[:, None])
        covariates = np.stack([self.covariates[starts[k] : starts[k] + count] for k in places])
        return Members(places, features, kernels, centre, scale, covariates)

    def covariates_of(self, place: int) -> np.ndarray:
        """Return the standardised covariates (members, covariates) of a unit."""
        first = sum(len(unit.members) for unit in self.units[:place])
        return self.covariates[first : first + len(self.units[place].members)]

    @staticmethod
    def _products(dimension: int) -> tuple[np.ndarray, np.ndarray]:
        return np.triu_indices(dimension)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return self.structure.labels

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return len(self.labels)

    def evaluate(self, points: np.ndarray, threads: int | None = None) -> Evaluation:
        """Return the log-density at points (points, dimension)."""
        del threads
        with np.errstate(over="ignore", invalid="ignore"):
            total = self.structure.log_prior(points)
            inside = np.isfinite(total)
            if inside.any():
                parameters = self.structure.parameters(points[inside])
                total[inside] += np.sum([self._log_likelihood(group, parameters) for group in self.groups], axis=0)
        total = np.where(np.isfinite(total), total, -np.inf)
        return Evaluation(total, np.empty((len(points), 0)), np.full(len(points), CONVERGED))

    def _log_likelihood(self, group: Members, parameters: Parameters) -> np.ndarray:
        """Return the sum of the log-likelihoods of some units (points,), in blocks of points and units."""
        units, _, draws = group.features.shape
        # The terms of all draws are in memory for Student's distribution only.
        values = draws if np.isfinite(self.structure.degrees) else 1
        total, most = np.zeros(len(parameters.means)), max(1, BLOCK_VALUES // draws)
        for first in range(0, len(total), most):
            block = slice(first, first + most)
            chosen = Parameters(*(array[block] for array in parameters))
            step = max(1, BLOCK_VALUES // (values * len(chosen.means)))
            for start in range(0, units, step):
                total[block] += self._log_means(group, chosen, slice(start, start + step)).sum(axis=0)
        return total

    def _log_means(self, group: Members, parameters: Parameters, part: slice) -> np.ndarray:
        """Return the log-likelihoods of some units (units, points), their draws integrated out."""
        if np.isfinite(self.structure.degrees):
            terms, constant = self.log_terms(group, parameters, part)
            return logsumexp(terms, axis=1) - np.log(terms.shape[1]) + constant
        coefficients, constant = self._coefficients(group, parameters, part)
        result = np.empty(constant.shape)
        _kernels().log_means(group.features[part], coefficients, result)
        return result + constant

    def _coefficients(self, group: Members, parameters: Parameters, part: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return what log-weight, coordinates and products are multiplied by in the log-density of a normal population.

        Coefficients (units, points, features), and its constant (units, points).
        """
        mean, covariance = self.moments(group, parameters, part)
        precision, (_, log_det) = np.linalg.inv(covariance), np.linalg.slogdet(covariance)
        linear, dimension = np.einsum("iwab,iwb->iwa", precision, mean), mean.shape[-1]
        first, second = self._products(dimension)
        products = precision[..., first, second] * np.where(first == second, -0.5, -1.0)
        constant = -0.5 * log_det - np.log(group.scale[part]).sum(axis=-1)[:, None] - dimension * LOG_ROOT_TWO_PI
        constant -= 0.5 * np.einsum("iwa,iwa->iw", mean, linear)
        return np.concatenate([np.ones((*linear.shape[:2], 1)), linear, products], axis=-1), constant

    def log_terms(self, group: Members, parameters: Parameters, part: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return log-likelihoods at all draws (units, draws, points) of some units, up to constants (units, points)."""
        coefficients, constant = self._coefficients(group, parameters, part)
        features, degrees = group.features[part].swapaxes(1, 2), self.structure.degrees
        if np.isinf(degrees):
            return features @ coefficients.swapaxes(1, 2), constant
        mean, _ = self.moments(group, parameters, part)
        square = np.einsum("iwa,iwa->iw", mean, coefficients[..., 1 : 1 + mean.shape[-1]])
        distance = square[:, None] - 2.0 * (features[..., 1:] @ coefficients[..., 1:].swapaxes(1, 2))
        dimension = mean.shape[-1]
        half = 0.5 * (degrees + dimension)
        constant = constant + 0.5 * square + dimension * LOG_ROOT_TWO_PI
        total = gammaln(half) - gammaln(0.5 * degrees) - 0.5 * dimension * np.log(degrees * np.pi)
        return features[..., :1] - half * np.log1p(np.maximum(distance, 0.0) / degrees), constant + total

    def moments(self, group: Members, parameters: Parameters, part: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and covariance (units, points, …) of the population with the kernel, in units of the draws."""
        scale, count = group.scale[part], group.covariates.shape[1]
        expected = self.expected(group.covariates[part], parameters)
        mean = (expected - group.centre[part, None]) / scale[:, None]
        spread = np.kron(np.eye(count), parameters.covariance)
        covariance = spread / (scale[:, None, :, None] * scale[:, None, None]) + group.kernels[part, None]
        return mean, covariance

    @staticmethod
    def expected(covariates: np.ndarray, parameters: Parameters) -> np.ndarray:
        """Return the means (units, points, members·names) for covariates (units, members, covariates)."""
        moved = np.einsum("imc,wdc->iwmd", covariates, parameters.slopes)
        return (parameters.means[None, :, None] + moved).reshape(*moved.shape[:2], -1)
