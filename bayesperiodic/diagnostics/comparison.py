"""Comparison of the Laplace approximation with MCMC, per parameter and jointly."""

import html
from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd
from scipy.stats import skew

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.diagnostics.verdicts import (
    FINE,
    LEVELS,
    MODE,
    NARROW,
    SHAPE,
    UNCONVERGED,
    USABLE_K,
    WIDE,
    Sample,
    ellipsoid_radii,
    joint_verdict,
    marginal_verdict,
    normal_draws,
    radii,
    wasserstein_distance,
)
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.posterior.density import COLLAPSED, NATURAL, LogPosterior, SamplingCoordinates
from bayesperiodic.posterior.parameters import unit
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.posterior import Posterior
from bayesperiodic.sampling.starts import laplace_approximation

SAMPLING = "sampling"
COORDINATES = (NATURAL, SAMPLING)
PROPOSALS, SEED = 8000, 1
# Efficiency of the importance weights above which their tail is irrelevant: a probability of 5 % under Laplace is then
# off by at most √((1/0.98 − 1)·0.05·0.95) = 3 % (Cauchy-Schwarz), as far as a quarter of a sd moves it.
EVEN, NO_TAIL = 0.98, (0.0, 0.0)
QUANTILES = {"q05": (0.05, -1.6448536269514722), "q50": (0.5, 0.0), "q95": (0.95, 1.6448536269514722)}
PROBABILITIES = np.concatenate([[0.002, 0.005], np.arange(1, 100) / 100, [0.995, 0.998]])
BINS, SHOWN = 40, (0.0005, 0.9995)
BACKGROUND = {FINE: "#d9f0d3", NARROW: "#fdd0a2", WIDE: "#c6dbef", SHAPE: "#fee391", MODE: "#fcbba1"}


@dataclass(frozen=True)
class Comparison(Result):
    """Comparison of the Laplace approximation with posterior draws.

    The Monte Carlo error of a value has its name and the suffix "_mcse": the standard deviation between batches of the
    draws, eight per independent ensemble, over √batches. That of a fraction is at least the error of as many
    independent draws as the effective sample size.

    Attributes
    ----------
    table : DataFrame
        One row per parameter. The other columns refer to coordinate ("k" or "ln k"): map and laplace_sd, mean and sd of
        the draws; shift (mean − map in posterior sds), sd_ratio (Laplace over posterior), skewness; laplace_q05, q05
        and q05_difference ((draws − Laplace) in posterior sds), likewise for 50 and 95 %; wasserstein, the distance
        between the draws and the Laplace approximation in posterior sds, whose error includes its upward bias; verdict
        and recommendation.
    joint : dict
        dimension; share_50, share_90 and share_95, the fractions of draws inside the Laplace ellipsoids; pareto_k, the
        k̂ of Laplace as an importance proposal, with the error of the tail fit; efficiency, the effective fraction of
        the proposals; verdict and recommendation.
    coordinates : str
        "natural" or "sampling".
    probabilities : array (probabilities,)
        Probabilities of the quantiles and of the ellipsoids.
    quantiles : dict of str to array (probabilities,)
        Quantiles of the draws.
    edges, densities : dict of str to array (bins + 1,) and (bins,)
        Histograms of the central 99.9 % of the draws.
    shares, shares_mcse : array (probabilities,)
        Fractions of draws inside the Laplace ellipsoids of these probabilities.
    units : dict of str to str
        Units of the natural values.
    synthetic, converged : bool
        Whether the data are synthetic, and whether the draws have converged.

    Examples
    --------
    >>> scorecard = bp.compare(problem, fit, posterior)
    >>> scorecard.converged, scorecard.table["verdict"].to_dict()
    (True, {'c': 'fine', 'k': 'fine'})
    >>> scorecard.table.loc["k", ["coordinate", "recommendation"]].tolist(), scorecard.joint["dimension"]
    (['k', 'use Laplace'], 2)
    """

    table: pd.DataFrame
    joint: dict[str, float | str]
    coordinates: str
    probabilities: np.ndarray
    quantiles: dict[str, np.ndarray]
    edges: dict[str, np.ndarray]
    densities: dict[str, np.ndarray]
    shares: np.ndarray
    shares_mcse: np.ndarray
    units: dict[str, str]
    synthetic: bool
    converged: bool

    def __repr__(self) -> str:
        joint = f"{self._ellipsoids} Joint verdict: {self.joint['verdict']}; {self.joint['recommendation']}."
        return f"{self._title}\n{self._short.to_string()}\n{joint}"

    def _repr_html_(self) -> str:
        short = self._short.map(html.escape).assign(verdict=self._short["verdict"].map(_coloured))
        short.index = short.index.map(html.escape)
        with pd.option_context("display.max_colwidth", None):
            table = short.to_html(escape=False, border=0)
        verdict = f"{_coloured(str(self.joint['verdict']))}; {html.escape(str(self.joint['recommendation']))}"
        title, ellipsoids = html.escape(self._title), html.escape(self._ellipsoids)
        return f"<p>{title}</p>{table}<p>{ellipsoids} Joint verdict: {verdict}.</p>"

    @property
    def _title(self) -> str:
        data = ", synthetic data" if self.synthetic else ""
        return f"Laplace against MCMC in {self.coordinates} coordinates{data} (± Monte Carlo error)"

    @property
    def _short(self) -> pd.DataFrame:
        """The main columns of the table as text, values with their errors."""
        table = self.table
        columns: dict[str, list[str]] = {c: [f"{v:.5g}" for v in table[c]] for c in ("map", "mean")}
        columns |= {c: [f"{v:.3g}" for v in table[c]] for c in ("laplace_sd", "sd")}
        for column in ("shift", "sd_ratio", "skewness", "wasserstein"):
            pairs = zip(table[column], table[f"{column}_mcse"], strict=True)
            columns[column] = [f"{value:.2f} ± {error:.2f}" for value, error in pairs]
        columns |= {c: table[c].tolist() for c in ("verdict", "recommendation")}
        return pd.DataFrame(columns, index=table["coordinate"].tolist())

    @property
    def _ellipsoids(self) -> str:
        keys = [f"share_{100 * level:.0f}" for level in LEVELS]
        inside = ", ".join(f"{self.joint[key]:.1%} ± {self.joint[f'{key}_mcse']:.1%}" for key in keys)
        k, error = self.joint["pareto_k"], self.joint["pareto_k_mcse"]
        return (
            f"The 50, 90 and 95% Laplace ellipsoids contain {inside} of the draws; Pareto k̂ is {k:.2f} ± {error:.2f}."
        )


def _coloured(verdict: str) -> str:
    colour = BACKGROUND.get(verdict, "#d9d9d9")
    return f'<span style="background:{colour};color:#000;padding:1px 4px">{html.escape(verdict)}</span>'


@in_one_thread
def compare(problem: Problem, fit: MapEstimate, posterior: Posterior, *, coordinates: str = NATURAL) -> Comparison:
    """Compare the Laplace approximation with the posterior draws, per parameter and jointly.

    The verdict on a parameter is "fine" if both ends of the 90 % interval agree with those of the draws within a
    quarter of the posterior sd, and so does the distribution as a whole; "too narrow" or "too wide" if both ends are
    off in opposite directions; "wrong shape" if the posterior is shifted, skewed, or accumulates at an end of the
    prior's support; "wrong mode" if more than 5 % of the draws lie in another mode, or almost none near the
    approximation. All deviations must exceed three Monte Carlo errors. The verdict is "not converged" for draws that
    have not converged, unless every ensemble by itself shows another mode.

    The joint verdict rests on the fraction of draws inside the Laplace ellipsoids and on the Pareto k̂ of the importance
    weights of 8000 draws from Laplace ([1]_; above 0.7 the proposal is unusable; modes that Laplace does not reach
    remain undetected). k̂ describes only the tail of the weights and is ignored if they are even (efficiency above
    98 %). In natural coordinates, k̂ is that of the density with the variances integrated out where that is possible in
    closed form.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
    posterior : Posterior
    coordinates : "natural" or "sampling"
        "natural" compares `MapEstimate.covariance`, the inverse of H of eq. (8), for the parameters alone. "sampling"
        compares `MapEstimate.joint_covariance`, for the logarithms of positive parameters and of noise parameters: if
        Laplace is fine there, a change of coordinates suffices.

    Returns
    -------
    Comparison

    Raises
    ------
    ValueError
        For unknown coordinates, a posterior of another problem, or sampling coordinates without a joint Laplace
        approximation.

    References
    ----------
    .. [1] A. Vehtari, D. Simpson, A. Gelman, Y. Yao, J. Gabry, Pareto smoothed importance sampling, Journal of Machine
       Learning Research 25 (2024) 1-58.

    Examples
    --------
    >>> scorecard = bp.compare(problem, fit, posterior, coordinates="sampling")
    >>> scorecard.table["coordinate"].tolist()
    ['ln c', 'ln k', 'ln variance[displacement]']
    """
    _checks.one_of("coordinates", coordinates, COORDINATES)
    every = (*problem.names, *problem.free_noise)
    _checks.contains("posterior", posterior.names, every, "give draws of this problem, sample(problem, fit)")
    both = {kind: approximation(problem, fit, kind) for kind in COORDINATES}
    laplace = both[coordinates]
    if laplace is None:
        raise ValueError(
            "coordinates: must be 'natural' for an estimate without a joint Laplace approximation, got 'sampling'. The "
            f"density has no maximum with finite curvature ({'; '.join(fit.undetermined) or fit.status})."
        )
    scored = scores(problem, fit, posterior, laplace, coordinates)
    other = both[SAMPLING] if coordinates == NATURAL and posterior.converged and not scored.fine else None
    cured = None if other is None else scores(problem, fit, posterior, other, SAMPLING)
    group, names = posterior.data["posterior"].to_dataset(), laplace.names
    shares, errors = scored.inside(PROBABILITIES)
    histograms = {name: _histogram(scored.samples[name].whole) for name in names}
    return Comparison(
        table=_table(scored, cured),
        joint=_joint(scored, cured),
        coordinates=coordinates,
        probabilities=PROBABILITIES,
        quantiles={name: np.quantile(scored.samples[name].whole, PROBABILITIES) for name in names},
        edges={name: edges for name, (_, edges) in histograms.items()},
        densities={name: density for name, (density, _) in histograms.items()},
        shares=shares,
        shares_mcse=errors,
        units={name: unit(group, name) for name in names},
        synthetic=bool(posterior.data.attrs.get("synthetic")),
        converged=posterior.converged,
    )


@dataclass(frozen=True)
class Approximation:
    """A normal approximation of parameters, or of their logarithms where `logarithmic`."""

    names: tuple[str, ...]
    logarithmic: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    supports: tuple[tuple[float, float], ...]

    @property
    def sds(self) -> np.ndarray:
        """Standard deviations (names,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates, such as "ln k"."""
        return tuple(f"ln {n}" if log else n for n, log in zip(self.names, self.logarithmic, strict=True))

    def points(self, posterior: Posterior) -> np.ndarray:
        """Return all draws in these coordinates, (draws, names)."""
        columns = [posterior.draws(name) for name in self.names]
        return np.stack([np.log(x) if log else x for x, log in zip(columns, self.logarithmic, strict=True)], axis=-1)


def approximation(problem: Problem, fit: MapEstimate, coordinates: str) -> Approximation | None:
    """Return the Laplace approximation in "natural" or "sampling" coordinates; None if there is none."""
    every = tuple(problem.joint_prior.supports.values())
    if coordinates == NATURAL:
        names, covariance = [*problem.names], fit.covariance.loc[[*problem.names], [*problem.names]].to_numpy()
        plain = np.zeros(len(names), dtype=bool)
        return Approximation(problem.names, plain, problem.vector(fit.theta), covariance, every)
    density = SamplingCoordinates(problem)
    try:
        mean, covariance = laplace_approximation(density, fit)
    except ValueError:
        return None
    logarithmic = np.concatenate([density.logarithmic, np.ones(len(density.free), dtype=bool)])
    supports = [*every, *[(0.0, np.inf)] * len(density.free)]
    whole = (-np.inf, np.inf)
    own = tuple(whole if log else support for support, log in zip(supports, logarithmic, strict=True))
    return Approximation(density.labels, logarithmic, mean, covariance, own)


def importance_k(problem: Problem, fit: MapEstimate, coordinates: str) -> tuple[float, float, float]:
    """Return the Pareto k̂ of Laplace as an importance proposal, the error of the tail fit, and the efficiency.

    The efficiency is the effective fraction of the draws, (Σw)²/(nΣw²). In natural coordinates unknown variances are
    integrated out where that is possible in closed form. Other noise parameters have the joint Laplace approximation of
    their logarithms, taken as independent of the parameters. Draws outside the support or without a periodic solution
    have zero weight. NaN without a finite covariance.
    """
    anchored = problem.anchored(problem.vector(fit.theta), {run: s.states for run, s in fit.solutions.items()})
    natural = coordinates == NATURAL
    density = anchored.density(coordinates=NATURAL, variances=COLLAPSED) if natural else anchored.density()
    mean, covariance = _proposal(density, fit, natural)
    if not np.isfinite(covariance).all():
        return np.nan, np.nan, np.nan
    points, log_proposal = normal_draws(mean, covariance, PROPOSALS, np.random.default_rng(SEED))
    log_weights = density.evaluate(points, threads=None).log_prob - log_proposal
    k, top = convergence.pareto_k(log_weights), log_weights.max()
    weights = np.exp(log_weights - top) if np.isfinite(top) else np.ones(1)
    efficiency = float(weights.sum() ** 2 / np.sum(weights**2) / PROPOSALS)
    tail = min(0.2 * PROPOSALS, 3.0 * np.sqrt(PROPOSALS))
    return k, float((1.0 + max(k, 0.0)) / np.sqrt(tail)) if np.isfinite(k) else 0.0, efficiency


def _proposal(density: LogPosterior, fit: MapEstimate, natural: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance in the coordinates of a density; NaN if there are none."""
    names = [*density.problem.names]
    try:
        without_noise = natural and not density.free
        mean, covariance = (np.empty(0), np.empty((0, 0))) if without_noise else laplace_approximation(density, fit)
    except ValueError:
        return np.full(density.dimension, np.nan), np.full((density.dimension,) * 2, np.nan)
    if not natural:
        return mean, covariance
    noise, count = slice(len(names), None), len(names)
    whole = np.zeros((density.dimension,) * 2)
    whole[:count, :count] = fit.covariance.loc[names, names]
    whole[count:, count:] = covariance[noise, noise]
    return np.concatenate([density.problem.vector(fit.theta), mean[noise]]), whole


@dataclass(frozen=True)
class Scores:
    """A Laplace approximation, the draws in its coordinates, and the verdicts by name and jointly.

    `distances` are Mahalanobis distances from the mean, NaN without a finite covariance; `pareto_k` has its error with
    it; for `efficiency` see `importance_k`.
    """

    laplace: Approximation
    samples: dict[str, Sample]
    distances: Sample
    verdicts: dict[str, str]
    pareto_k: tuple[float, float]
    efficiency: float
    joint: str

    @property
    def usable_as_proposal(self) -> bool:
        """False if the importance weights have a relevant heavy tail."""
        return self.efficiency > EVEN or not self.pareto_k[0] > USABLE_K

    @property
    def fine(self) -> bool:
        """True if every verdict is "fine"."""
        return {self.joint, *self.verdicts.values()} == {FINE}

    def inside(self, levels: np.ndarray) -> np.ndarray:
        """Return the fractions of draws inside ellipsoids of given probabilities, and their errors, (2, levels)."""
        if not np.isfinite(self.laplace.covariance).all():
            return np.full((2, levels.size), np.nan)
        limits = ellipsoid_radii(levels, self.laplace.mean.size)
        return np.array([self.distances.below(limit, level) for limit, level in zip(limits, levels, strict=True)]).T


def scores(
    problem: Problem, fit: MapEstimate, posterior: Posterior, laplace: Approximation, coordinates: str
) -> Scores:
    """Return the scores of a Laplace approximation."""
    points = laplace.points(posterior)
    ensemble = posterior.data["posterior"]["ensemble"].to_numpy()
    samples = {name: Sample.of(points[:, i], ensemble, posterior.ess[name]) for i, name in enumerate(laplace.names)}
    sampled = partial(Sample.of, ensemble=ensemble, size=min(posterior.ess[name] for name in laplace.names))
    verdicts = {
        name: marginal_verdict(
            samples[name], float(laplace.mean[i]), float(laplace.sds[i]), laplace.supports[i], posterior.converged
        )
        for i, name in enumerate(laplace.names)
    }
    finite = np.isfinite(laplace.covariance).all()
    distances = radii(points, laplace.mean, laplace.covariance) if finite else np.full(len(points), np.nan)
    *k, efficiency = importance_k(problem, fit, coordinates)
    tail = NO_TAIL if efficiency > EVEN else (k[0], k[1])
    joint = joint_verdict(points, laplace.mean, laplace.covariance, sampled, tail, posterior.converged)
    joint = _consistent(joint, set(verdicts.values()))
    return Scores(laplace, samples, sampled(distances), verdicts, (k[0], k[1]), efficiency, joint)


def _consistent(joint: str, rows: set[str]) -> str:
    """Return the joint verdict made consistent with the marginal ones."""
    if MODE in rows:
        return MODE
    if joint in (NARROW, WIDE) and SHAPE in rows:
        return SHAPE
    if joint == FINE and FINE not in rows:
        return rows.pop() if len(rows) == 1 else SHAPE
    return joint


def row(sample: Sample, mean: float, sd: float) -> dict[str, float]:
    """Return the statistics of one quantity and their Monte Carlo errors, see `Comparison.table`."""
    own_mean, mean_error = sample.estimate(lambda x: x.mean(axis=-1))
    own, spread = sample.estimate(lambda x: np.std(x, axis=-1, ddof=1))
    found = {"map": mean, "laplace_sd": sd, "mean": own_mean, "sd": own}
    found |= {"shift": (own_mean - mean) / own, "shift_mcse": mean_error / own}
    found |= {"sd_ratio": sd / own, "sd_ratio_mcse": sd / own * spread / own}
    found["skewness"], found["skewness_mcse"] = sample.estimate(lambda x: skew(x, axis=-1))
    for label, (probability, z) in QUANTILES.items():
        value, error = sample.estimate(lambda x, p=probability: np.quantile(x, p, axis=-1))  # type: ignore[misc]
        end = mean + z * sd if z else mean
        found |= {f"laplace_{label}": end, label: value}
        found |= {f"{label}_difference": (value - end) / own, f"{label}_difference_mcse": error / own}
    found["wasserstein"], found["wasserstein_mcse"] = wasserstein_distance(sample, mean, sd)
    return found


def joint_row(scored: Scores) -> dict[str, float]:
    """Return the joint statistics, see `Comparison.joint`."""
    found: dict[str, float] = {"dimension": scored.laplace.mean.size}
    for level, inside, error in zip(LEVELS, *scored.inside(np.array(LEVELS)), strict=True):
        key = f"share_{100 * level:.0f}"
        found |= {key: float(inside), f"{key}_mcse": float(error)}
    return found | {
        "pareto_k": scored.pareto_k[0],
        "pareto_k_mcse": scored.pareto_k[1],
        "efficiency": scored.efficiency,
    }


def _histogram(draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.quantile(draws, SHOWN)
    counts, edges = np.histogram(draws, BINS, (low, high))
    return counts / (draws.size * np.diff(edges)), edges


def _table(scored: Scores, cured: Scores | None) -> pd.DataFrame:
    laplace, rows = scored.laplace, {}
    for i, name in enumerate(laplace.names):
        verdict, sd = scored.verdicts[name], float(laplace.sds[i])
        cure = cured is not None and cured.verdicts[name] == FINE
        logarithm = cured is not None and bool(cured.laplace.logarithmic[i])
        rows[name] = {
            "coordinate": laplace.coordinates[i],
            **row(scored.samples[name], float(laplace.mean[i]), sd),
            "verdict": verdict,
            "recommendation": _recommendation(verdict, cure, logarithm, bool(np.isfinite(sd))),
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def _joint(scored: Scores, cured: Scores | None) -> dict[str, float | str]:
    logarithm = cured is not None and bool(cured.laplace.logarithmic[: scored.laplace.mean.size].any())
    finite = bool(np.isfinite(scored.laplace.covariance).all())
    advice = _recommendation(scored.joint, cured is not None and cured.fine, logarithm, finite)
    if scored.joint == FINE:
        others = [name for name, verdict in scored.verdicts.items() if verdict != FINE]
        advice += f", except for {', '.join(others)}" if others else ""
        advice += ", not as an importance proposal" if not scored.usable_as_proposal else ""
    return joint_row(scored) | {"verdict": scored.joint, "recommendation": advice}


def _recommendation(verdict: str, cure: bool, logarithm: bool, determined: bool) -> str:
    """Return the recommendation; `cure`: Laplace is fine in sampling coordinates."""
    if verdict == FINE:
        return "use Laplace"
    if verdict == UNCONVERGED:
        return "sample longer"
    if verdict == MODE:
        return "report each mode by itself; try map_estimate(starts=…)"
    if cure:
        return ("logarithms cure it: " if logarithm else "") + "use Laplace in sampling coordinates"
    return "report the MCMC quantiles" if determined else "report a combination that the data determine"
