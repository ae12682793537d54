"""Units of a population: what each unit's own posterior says of the chosen parameters, in sampling coordinates."""

import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import load_groups
from bayesperiodic._linalg import covariance_cholesky
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.map_estimate import map_estimate
from bayesperiodic.priors.joint import MultivariateNormal
from bayesperiodic.priors.stored import PRIORS, from_text
from bayesperiodic.problem.fingerprint import check_fingerprint, fingerprint
from bayesperiodic.problem.parameters import column, support, unit
from bayesperiodic.sampling.convergence import QUANTILE_LEVELS
from bayesperiodic.sampling.draws import Posterior
from bayesperiodic.sampling.robust import ROBUST
from bayesperiodic.sampling.sample import sample

# Draws of each unit that are kept.
KEPT_DRAWS = 2000
# Curvature of a prior, relative to that of the kernel, up to which it is taken into account.
MOST_CURVATURE = 0.5
# Of a saved posterior.
READ_GROUPS = "posterior", ROBUST
UNIT = "a Problem, a Posterior, (problem, posterior), or the path of a saved Posterior"


class Coordinate(NamedTuple):
    """What is the same for a parameter in all units."""

    logarithmic: bool
    unit: str
    support: tuple[float, float]


@dataclass(frozen=True)
class UnitDraws:
    """Draws of one posterior, which has one member of the population or several.

    A posterior has several members where the parameters are local to its experiments; the coordinates are those of the
    first member, then those of the next. A normal kernel of covariance `kernel` about every one of the `centres`
    (draws, members·names), which are moved towards the mean so that mean and covariance remain those of the draws
    (M. West, J. R. Statist. Soc. B 55 (1993) 409-422), is the estimated density; divided by the prior, it is that of
    the likelihood, with `log_weights` (draws,). `mean`, `covariance` and `quantiles` (5, 50 and 95 %,
    one row each) are those of the draws.
    """

    members: tuple[str, ...]
    coordinates: tuple[Coordinate, ...]
    centres: np.ndarray
    log_weights: np.ndarray
    kernel: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    quantiles: np.ndarray
    calls: int = 0
    misfit: str = ""

    @classmethod
    def of(
        cls, members: Sequence[str], coordinates: Sequence[Coordinate], points: np.ndarray, log_prior: Any, size: float
    ) -> "UnitDraws":
        """Return the unit of draws (draws, members·names), `size` of them effective; log_prior(points) is (draws,).

        The kernel has Silverman's width for normally distributed draws (B. W. Silverman, Density estimation, 1986).
        """
        mean, covariance = points.mean(axis=0), np.atleast_2d(np.cov(points, rowvar=False))
        dimension = mean.size
        squared = (4.0 / ((dimension + 2.0) * size)) ** (2.0 / (dimension + 4.0))
        centres = mean + np.sqrt(1.0 - squared) * (points - mean)
        parts = _without_prior(centres, squared * covariance, log_prior)
        quantiles = np.quantile(points, QUANTILE_LEVELS, axis=0)
        return cls(tuple(members), tuple(coordinates), *parts, mean, covariance, quantiles)


def _without_prior(
    centres: np.ndarray, kernel: np.ndarray, log_prior: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres (draws, d), log-weights (draws,) and covariance of the kernels divided by the prior.

    The slope of the log-prior at every centre moves the kernel, its mean curvature widens all; exact for normal priors.
    """
    steps = np.diag(np.sqrt(np.diag(kernel)))
    slopes = np.stack([(log_prior(centres - s) - log_prior(centres + s)) / (2.0 * s.max()) for s in steps], axis=-1)
    slopes = np.where(np.isfinite(slopes), slopes, 0.0)  # beside the ends of a prior's support
    offset = centres - centres.mean(axis=0)
    curvature = np.linalg.lstsq(offset, slopes - slopes.mean(axis=0), rcond=None)[0]
    curvature = 0.5 * (curvature + curvature.T)
    root = covariance_cholesky(kernel)
    values, vectors = np.linalg.eigh(root.T @ curvature @ root)
    turned = root @ vectors
    wider = (turned / (1.0 - np.clip(values, -MOST_CURVATURE, MOST_CURVATURE))) @ turned.T
    gain = 0.5 * np.einsum("na,ab,nb->n", slopes, wider, slopes)
    return centres + slopes @ wider, gain - log_prior(centres), wider


def unit_draws(name: str, given: Any, names: Sequence[str], alone: bool = False) -> UnitDraws:
    """Return the draws of a unit that was sampled; `alone`, its runs are the members under their own names."""
    problem, posterior = given if isinstance(given, tuple) and len(given) == 2 else (None, given)
    if isinstance(posterior, str | Path):
        posterior = load_groups(posterior, READ_GROUPS)
    if not isinstance(posterior, Posterior) or not (problem is None or isinstance(problem, Problem)):
        raise ValueError(f"units[{name!r}]: must be {UNIT}, got {type(given).__name__}.")
    if not posterior.converged:
        raise ValueError(
            f"units[{name!r}]: must have converged, got draws that have not ({posterior.reason}). Sample longer, see "
            "max_steps."
        )
    if problem is not None:
        check_fingerprint("posterior", posterior, fingerprint(problem))
    priors = dict(problem.priors) if problem is not None else from_text(str(posterior.tree.attrs.get(PRIORS, "")))
    shown = posterior.headline
    group = shown.tree["posterior"].to_dataset()
    members, columns = _members(name, shown.names, names, alone)
    supports = [support(group, full) for full in columns]
    logs = np.array([ends == (0.0, np.inf) for ends in supports])
    values = np.stack([column(group, full).ravel() for full in columns], axis=-1)
    points = np.log(values, out=np.array(values), where=logs)
    if not np.isfinite(points).all() or (np.ptp(points, axis=0) <= 0.0).any():
        raise ValueError(f"units[{name!r}]: draws of {', '.join(names)} must be finite and vary.")
    size = min(len(points), *(shown.ess[full] for full in columns))
    kept = points[np.linspace(0, len(points) - 1, KEPT_DRAWS).round().astype(int)]
    coordinates = [Coordinate(bool(logs[k]), unit(group, columns[k]), supports[k]) for k in range(len(names))]
    result = UnitDraws.of(members, coordinates, kept, _LogPrior(name, priors, columns, logs), size)
    return replace(result, calls=posterior.log_posterior_calls, misfit=posterior.misfit)


def _members(
    name: str, free: Sequence[str], names: Sequence[str], alone: bool
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the labels of the members, and the full names of their parameters, member by member."""
    if all(plain in free for plain in names):
        return (name,), tuple(names)
    runs = [[full[len(plain) + 1 : -1] for full in free if full.startswith(f"{plain}[")] for plain in names]
    if not runs[0] or any(other != runs[0] for other in runs):
        raise ValueError(
            f"names: must be sampled parameters of units[{name!r}], all shared by its experiments or all local to the "
            f"same ones, got {list(names)}; sampled are {', '.join(free)}."
        )
    labels = tuple(run if alone else f"{name}: {run}" for run in runs[0])
    return labels, tuple(f"{plain}[{run}]" for run in runs[0] for plain in names)


class _LogPrior:
    """Log-prior density over the sampling coordinates of some parameters, the others integrated out."""

    def __init__(self, name: str, priors: Mapping[Any, Any], columns: Sequence[str], logs: np.ndarray):
        self._logs, self._terms = logs, []
        left = set(columns)
        for key, prior in priors.items():
            members = key if isinstance(key, tuple) else (key,)
            places = [k for k, member in enumerate(members) if member in columns]
            if not places:
                continue
            left -= set(members)
            at = [columns.index(members[k]) for k in places]
            if isinstance(key, tuple):
                prior = MultivariateNormal(prior.mean[places], prior.covariance[np.ix_(places, places)])
            self._terms.append((prior, at if isinstance(key, tuple) else at[0]))
        if left:
            raise ValueError(
                f"units[{name!r}]: must be (problem, posterior), got draws without the prior of "
                f"{', '.join(sorted(left))}, which has to be divided out: older files, and priors of SciPy or of "
                "classes of your own, are not stored with the draws."
            )

    def __call__(self, points: np.ndarray) -> np.ndarray:
        values = np.exp(points, out=np.array(points), where=self._logs)
        total = points[:, self._logs].sum(axis=-1)
        return total + np.sum([prior.log_prob(values[:, at]) for prior, at in self._terms], axis=0)


class UnitTask(NamedTuple):
    """A unit to sample, or to read from its file, for a worker."""

    name: str
    pickled: bytes  # the problem or the path, by cloudpickle
    alone: bool
    seed: int


def carried_out(names: Sequence[str], task: UnitTask) -> UnitDraws | str:
    """Return the draws of a unit's problem, or why there are none, or those in its file."""
    given = pickle.loads(task.pickled)
    if isinstance(given, Problem):
        try:
            fit = map_estimate(given, progress=False)
            posterior = sample(given, fit, seed=task.seed, progress=False)
        except RuntimeError as error:
            return str(error)
        if not posterior.converged:
            return f"the draws have not converged ({posterior.reason})"
        given = given, posterior
    return unit_draws(task.name, given, names, task.alone)


def task_of(name: str, given: Problem | str | Path, alone: bool, seed: int) -> UnitTask:
    """Return the task of sampling or reading a unit."""
    import cloudpickle

    given = given if isinstance(given, Problem) else Path(given).absolute()
    return UnitTask(name, cloudpickle.dumps(given), alone, seed)


def checked_names(names: Any) -> tuple[str, ...]:
    """Return the names of the parameters of the population."""
    if isinstance(names, str) or not isinstance(names, Sequence) or not names or len(set(names)) < len(names):
        raise ValueError(f"names: must be a sequence of different parameters, such as ['k'], got {names!r}.")
    return tuple(_checks.text("names", name) for name in names)
