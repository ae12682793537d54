"""The prior of all free parameters of a problem, from what the user gave for each name or tuple of names."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import stats
from scipy.stats.distributions import rv_frozen

from bayesperiodic import checks
from bayesperiodic.inference.priors.from_scipy import FromScipy, as_written
from bayesperiodic.inference.priors.multivariate import MultivariateNormal
from bayesperiodic.inference.priors.univariate import Prior, Univariate

ALLOWED = "a prior such as Normal(mean, sd), or a frozen continuous distribution of scipy.stats"


@dataclass(frozen=True)
class JointPrior:
    """The prior of all free parameters: independent blocks, each of one parameter or of several jointly.

    Attributes
    ----------
    names : tuple of str
        The free parameters, in the order of the last axis of θ.
    blocks : dict of str or tuple of str to prior
        In the order of their first names.
    """

    names: tuple[str, ...]
    blocks: dict[str | tuple[str, ...], Any]

    @classmethod
    def of(cls, priors: Mapping[Any, Any], known: Iterable[str]) -> "JointPrior":
        """Return the checked prior; the names are ordered as in `known`.

        Raises
        ------
        ValueError
            For an unknown name, a name in two keys, an empty key, a value that is no prior or does not fit its key.
        """
        known = list(known)
        keys: dict[str, str | tuple[str, ...]] = {}
        blocks = {}
        for key, value in priors.items():
            members = key if isinstance(key, tuple) else (key,)
            if not members:
                raise ValueError("priors: the key () is not allowed; a joint prior needs names, such as ('k', 'c').")
            for name in members:
                if str(name).startswith("variance["):
                    raise ValueError(
                        f"priors: {name!r} is not allowed; it belongs to the noise, so give its prior there, "
                        "noise=noise.Independent(prior=…), or its value in `fixed`."
                    )
                checks.one_of("priors", name, known)
                if name in keys:
                    both = f"{keys[name]!r} and {key!r}" if keys[name] != key else f"twice in {key!r}"
                    raise ValueError(f"priors: {name!r} is in two keys, {both}; give every parameter one prior.")
                keys[name] = key
            blocks[key] = _joint(key, value) if isinstance(key, tuple) else as_prior(f"priors[{key!r}]", value)
        names = tuple(name for name in known if name in keys)
        ordered = dict.fromkeys(keys[name] for name in names)
        return cls(names, {key: blocks[key] for key in ordered})

    @cached_property
    def _columns(self) -> dict[str | tuple[str, ...], Any]:
        """Where each block is on the last axis of θ."""
        return {
            key: [self.names.index(name) for name in key] if isinstance(key, tuple) else self.names.index(key)
            for key in self.blocks
        }

    @cached_property
    def marginals(self) -> dict[str, Prior]:
        """The distribution of each parameter by itself."""
        by_name: dict[str, Prior] = {}
        for key, prior in self.blocks.items():
            if isinstance(key, tuple):
                by_name |= {name: prior.marginal(i) for i, name in enumerate(key)}
            else:
                by_name[key] = prior
        return {name: by_name[name] for name in self.names}

    @property
    def supports(self) -> dict[str, tuple[float, float]]:
        """The open interval of each parameter outside of which the density is zero."""
        return {name: prior.support for name, prior in self.marginals.items()}

    def median(self) -> np.ndarray:
        """Return the median of each parameter by itself, (names,)."""
        return np.array([float(prior.quantile(np.array(0.5))) for prior in self.marginals.values()])

    def log_prob(self, theta: np.ndarray) -> np.ndarray:
        """Return Σ ln p over the blocks at θ (…, names), shape (…); −inf outside the support."""
        total: Any = 0.0
        for key in self._alone:
            total = total + self._log_prob(key, theta)
        for prior, columns in self._alike:
            total = total + prior.log_prob(theta[..., columns]).sum(axis=-1)
        return total

    @cached_property
    def _alike(self) -> list[tuple[Univariate, list[int]]]:
        """Priors that several parameters have, with where these are on the last axis of θ."""
        columns: dict[Univariate, list[int]] = {}
        for key, prior in self.blocks.items():
            if isinstance(prior, Univariate):
                columns.setdefault(prior, []).append(self._columns[key])
        return [(prior, own) for prior, own in columns.items() if len(own) > 1]

    @cached_property
    def _alone(self) -> list[str | tuple[str, ...]]:
        """The blocks whose prior no other has."""
        shared = {self.names[column] for _, columns in self._alike for column in columns}
        return [key for key in self.blocks if isinstance(key, tuple) or key not in shared]

    def gradient(self, theta: np.ndarray) -> np.ndarray:
        """Return ∂ log p / ∂θ at θ (…, names), shape (…, names)."""
        result = np.empty(theta.shape)
        for key, prior in self.blocks.items():
            result[..., self._columns[key]] = prior.gradient(theta[..., self._columns[key]])
        return result

    def curvature(self, theta: np.ndarray) -> np.ndarray:
        """Return −∂² log p / ∂θ² at θ (…, names), shape (…, names, names)."""
        result = np.zeros((*theta.shape, theta.shape[-1]))
        for key, prior in self.blocks.items():
            columns = self._columns[key]
            rows = np.array(columns)[:, None] if isinstance(key, tuple) else columns
            result[..., rows, columns] = prior.curvature(theta[..., columns])
        return result

    def sample(self, size: int, generator: np.random.Generator) -> np.ndarray:
        """Return independent draws, (size, names)."""
        result = np.empty((size, len(self.names)))
        for key, prior in self.blocks.items():
            result[:, self._columns[key]] = prior.sample(size, generator)
        return result

    def excluding(self, theta: np.ndarray) -> tuple[str, ...]:
        """Return the names of the first block whose density is zero at one θ (names,), or nothing."""
        for key in self.blocks:
            if not np.isfinite(self._log_prob(key, theta)):
                return key if isinstance(key, tuple) else (key,)
        return ()

    def _log_prob(self, key: str | tuple[str, ...], theta: np.ndarray) -> np.ndarray:
        return self.blocks[key].log_prob(theta[..., self._columns[key]])


def as_prior(argument: str, value: Any) -> Prior:
    """Return `value` as a prior of one parameter.

    Parameters
    ----------
    argument : str
        What errors call the value.
    value : prior or frozen scipy.stats distribution
        A prior is one of this module's, or anything else with the functions of `Prior`.

    Raises
    ------
    ValueError
        If it is neither, or a distribution that is discrete, of several variables, or has parameters out of range.

    Examples
    --------
    >>> from scipy import stats
    >>> from bayesperiodic.inference.priors.joint import as_prior
    >>> as_prior("priors['k']", stats.norm(1.0, 2.0)).support
    (-inf, inf)
    """
    if isinstance(value, MultivariateNormal):
        raise ValueError(f"{argument}: {value!r} is not allowed; a joint prior needs a tuple of names as its key.")
    if isinstance(value, rv_frozen):
        text = as_written(value)
        if not isinstance(value.dist, stats.rv_continuous):
            raise ValueError(f"{argument}: {text} is not allowed; it is discrete, and parameters are continuous.")
        if np.shape(value.support()[0]) or np.shape(value.ppf(0.5)):
            raise ValueError(f"{argument}: {text} is not allowed; it must be of one variable, without arrays.")
        if not np.isfinite(value.ppf(0.5)):
            raise ValueError(f"{argument}: {text} is not allowed; its parameters must be in scipy.stats' range.")
        return FromScipy(value)
    if isinstance(value, stats.rv_continuous):
        raise ValueError(
            f"{argument}: scipy.stats.{value.name} is not allowed; it must be frozen, scipy.stats.{value.name}(…)."
        )
    if isinstance(value, type) or not isinstance(value, Prior):
        raise ValueError(f"{argument}: {value!r} is not allowed; it must be {ALLOWED}.")
    return value


def _joint(key: tuple[str, ...], value: Any) -> MultivariateNormal:
    if not isinstance(value, MultivariateNormal):
        text = as_written(value) if isinstance(value, rv_frozen) else repr(value)
        raise ValueError(
            f"priors[{key!r}]: {text} is not allowed; the prior of a tuple of names must be "
            "MultivariateNormal(mean, covariance)."
        )
    if value.dimension != len(key):
        raise ValueError(
            f"priors[{key!r}]: a MultivariateNormal of {value.dimension} parameters is not allowed; the key has "
            f"{len(key)} names."
        )
    return value
