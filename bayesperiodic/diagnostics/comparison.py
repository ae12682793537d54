"""Comparison of the Laplace approximation with MCMC, per parameter and jointly."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.density.log_posterior import COLLAPSED, NATURAL, LogPosterior, SamplingCoordinates
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics import verdicts
from bayesperiodic.diagnostics.verdicts import (
    ELLIPSOID_LEVELS,
    FINE,
    NARROW,
    UNCONVERGED,
    USABLE_K,
    WIDE,
    WRONG_MODE,
    WRONG_SHAPE,
    Sample,
)
from bayesperiodic.estimation.adequacy import misfit
from bayesperiodic.estimation.check import with_joint
from bayesperiodic.estimation.modes import found_from, notable
from bayesperiodic.estimation.result import MapEstimate, orbit_advice
from bayesperiodic.problem.fingerprint import check_results
from bayesperiodic.problem.parameters import unit
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.draws import Posterior, refuse_robust
from bayesperiodic.sampling.starts import laplace_approximation

if TYPE_CHECKING:
    import pandas as pd

SAMPLING = "sampling"
COORDINATES = (NATURAL, SAMPLING)
PROPOSALS, SEED = 8000, 1
# Efficiency of the importance weights above which their tail is irrelevant: a probability of 5 % under Laplace is then
# off by at most √((1/0.98 − 1)·0.05·0.95) = 3 % (Cauchy-Schwarz), as far as a quarter of a sd moves it.
EVEN_WEIGHTS, NO_TAIL = 0.98, (0.0, 0.0)
COMPARED_QUANTILES = {"q05": (0.05, -1.6448536269514722), "q50": (0.5, 0.0), "q95": (0.95, 1.6448536269514722)}
PROBABILITIES = np.concatenate([[0.002, 0.005], np.arange(1, 100) / 100, [0.995, 0.998]])
BINS, HISTOGRAM_RANGE = 40, (0.0005, 0.9995)
BACKGROUND = {FINE: "#d9f0d3", NARROW: "#fdd0a2", WIDE: "#c6dbef", WRONG_SHAPE: "#fee391", WRONG_MODE: "#fcbba1"}


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
        from Laplace in posterior sds, whose error includes its upward bias; verdict and recommendation.
    joint : dict
        dimension; share_50, share_90 and share_95, the fractions of draws inside the Laplace ellipsoids; pareto_k, the
        k̂ of Laplace as an importance proposal, with the error of the tail fit; efficiency, the effective fraction of
        the proposals; verdict and recommendation.
    coordinates : str
        "natural" or "sampling".
    probabilities : array (probabilities,)
    quantiles : dict of str to array (probabilities,)
        Of the draws.
    edges, densities : dict of str to array (bins + 1,) and (bins,)
        Histograms of the central 99.9 % of the draws.
    shares, shares_mcse : array (probabilities,)
        Fractions of draws inside the Laplace ellipsoids of these probabilities.
    units : dict of str to str
        Of the natural values.
    synthetic, converged : bool
        Whether the data are synthetic, and whether the draws have converged.
    limitations : tuple of str
        What the verdicts on Laplace do not show, in words: a conflict of prior and data, a misspecified model, and
        optima that the starts of `map_estimate` may have missed.

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
    limitations: tuple[str, ...]

    def __repr__(self) -> str:
        title, short, joint = self._parts(str, str)
        return f"{title}\n{short.to_string()}\n{joint}"

    def _repr_html_(self) -> str:
        import pandas as pd

        title, short, joint = self._parts(html.escape, _coloured)
        with pd.option_context("display.max_colwidth", None):
            return f"<p>{title}</p>{short.to_html(escape=False, border=0)}<p>{joint}</p>"

    def _parts(self, text: Callable[[str], str], mark: Callable[[str], str]) -> tuple[str, pd.DataFrame, str]:
        """Return the title, the main columns of the table and a sentence, with texts and verdicts formatted."""
        import pandas as pd

        table, joint = self.table, self.joint
        columns: dict[str, Any] = {c: table[c].map("{:.5g}".format) for c in ("map", "mean")}
        columns |= {c: table[c].map("{:.3g}".format) for c in ("laplace_sd", "sd")}
        for c in ("shift", "sd_ratio", "skewness", "wasserstein"):
            columns[c] = table[c].map("{:.2f}".format) + table[f"{c}_mcse"].map(" ± {:.2f}".format)
        columns |= {"verdict": table["verdict"].map(mark), "recommendation": table["recommendation"].map(text)}
        data = ", synthetic data" if self.synthetic else ""
        keys = [f"share_{100 * level:.0f}" for level in ELLIPSOID_LEVELS]
        inside = ", ".join(f"{joint[key]:.1%} ± {joint[f'{key}_mcse']:.1%}" for key in keys)
        return (
            f"Laplace against MCMC in {self.coordinates} coordinates{data} (± Monte Carlo error)",
            pd.DataFrame(columns).set_axis(table["coordinate"].map(text).tolist()),
            f"The 50, 90 and 95% Laplace ellipsoids contain {inside} of the draws; Pareto k is {joint['pareto_k']:.2f} "
            f"± {joint['pareto_k_mcse']:.2f}. Joint verdict: {mark(str(joint['verdict']))}; "
            f"{text(str(joint['recommendation']))}." + "".join(f" {text(one)}." for one in self.limitations),
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
    approximation, if another optimum in `MapEstimate.modes`, further away than a standard deviation, has more than 1 %
    of the mass, or if an orbit of the estimate is not the measured one (`MapEstimate.other_orbits`). All deviations of
    the draws must exceed three Monte Carlo errors. The verdict is "not converged" for draws that have not converged,
    unless every ensemble by itself shows another mode.

    The joint verdict rests on the fraction of draws inside the Laplace ellipsoids and on the Pareto k̂ of the importance
    weights of 8000 draws from Laplace (Vehtari, Simpson, Gelman, Yao, Gabry, Pareto smoothed importance sampling, J.
    Mach. Learn. Res. 25 (2024) 1-58; above 0.7 the proposal is unusable; modes that Laplace does not reach remain
    undetected). k̂ describes only the tail of the weights and is ignored if they are even (efficiency above 98 %). In
    natural coordinates, k̂ is that of the density with the variances integrated out where that is possible in closed
    form.

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

    Examples
    --------
    >>> bp.compare(problem, fit, posterior, coordinates="sampling").table["coordinate"].tolist()
    ['ln c', 'ln k', 'ln variance[displacement]']
    """
    _checks.instance("problem", problem, Problem)
    _checks.one_of("coordinates", coordinates, COORDINATES)
    problem, fit = check_results(problem, fit=fit, posterior=posterior), with_joint(problem, fit)
    refuse_robust(posterior)
    scored = _scores(problem, fit, posterior, coordinates)
    if scored is None:
        raise ValueError(
            "coordinates: must be 'natural' for an estimate without a joint Laplace approximation, got 'sampling'. The "
            f"density has no maximum with finite curvature ({'; '.join(fit.undetermined) or fit.status})."
        )
    doubtful = coordinates == NATURAL and posterior.converged and not scored.fine
    cured = _scores(problem, fit, posterior, SAMPLING) if doubtful else None
    group, draws = posterior.tree["posterior"].to_dataset(), {n: s.whole for n, s in scored.samples.items()}
    shares, errors = scored.inside(PROBABILITIES)
    table, joint = _table(scored, cured), _joint(scored, cured)
    if advice := orbit_advice(fit):
        table[["verdict", "recommendation"]] = WRONG_MODE, advice
        joint |= {"verdict": WRONG_MODE, "recommendation": advice}
    histograms = {name: np.histogram(x, BINS, tuple(np.quantile(x, HISTOGRAM_RANGE))) for name, x in draws.items()}
    return Comparison(
        table=table,
        joint=joint,
        coordinates=coordinates,
        probabilities=PROBABILITIES,
        quantiles={name: np.quantile(x, PROBABILITIES) for name, x in draws.items()},
        edges={name: edges for name, (_, edges) in histograms.items()},
        densities={n: counts / (draws[n].size * np.diff(edges)) for n, (counts, edges) in histograms.items()},
        shares=shares,
        shares_mcse=errors,
        units={name: unit(group, name) for name in draws},
        synthetic=bool(posterior.tree.attrs.get("synthetic")),
        converged=posterior.converged,
        limitations=tuple(filter(None, [fit.prior_conflict.text, misfit(problem, fit), _on_modes(fit)])),
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
    def determined(self) -> bool:
        """True if all covariances are finite."""
        return bool(np.isfinite(self.covariance).all())

    def points(self, posterior: Posterior) -> np.ndarray:
        """Return all draws in these coordinates, (draws, names)."""
        points = np.stack([posterior.draws(name) for name in self.names], axis=-1)
        points[:, self.logarithmic] = np.log(points[:, self.logarithmic])
        return points


def _approximation(problem: Problem, fit: MapEstimate, coordinates: str) -> Approximation | None:
    """Return the Laplace approximation in "natural" or "sampling" coordinates; None if there is none."""
    names, supports = [*problem.names], tuple(problem.joint_prior.supports.values())
    if coordinates == NATURAL:
        plain, covariance = np.zeros(len(names), dtype=bool), fit.covariance.loc[names, names].to_numpy()
        return Approximation(problem.names, plain, problem.vector(fit.theta), covariance, supports)
    density = SamplingCoordinates(problem)
    try:
        mean, covariance = laplace_approximation(density, fit)
    except ValueError:
        return None
    logarithmic = np.concatenate([density.logarithmic, np.ones(len(density.free), dtype=bool)])
    # The logarithms of positive parameters and of noise parameters, which come last, are unbounded.
    whole = (-np.inf, np.inf)
    ends = tuple(whole if log else end for end, log in zip_longest(supports, logarithmic))
    return Approximation(density.labels, logarithmic, mean, covariance, ends)


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
    points, log_proposal = verdicts.normal_draws(mean, covariance, PROPOSALS, np.random.default_rng(SEED))
    log_weights = density.evaluate(points, threads=None).log_prob - log_proposal
    k, top = convergence.pareto_k(log_weights), log_weights.max()
    weights = np.exp(log_weights - top) if np.isfinite(top) else np.ones(1)
    efficiency = float(weights.sum() ** 2 / np.sum(weights**2) / PROPOSALS)
    tail = min(0.2 * PROPOSALS, 3.0 * np.sqrt(PROPOSALS))
    return k, float((1.0 + max(k, 0.0)) / np.sqrt(tail)) if np.isfinite(k) else 0.0, efficiency


def _proposal(density: LogPosterior, fit: MapEstimate, natural: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance in the coordinates of a density; NaN if there are none."""
    names, size = [*density.problem.names], density.dimension
    mean, covariance = np.full(size, np.nan), np.full((size, size), np.nan)
    if density.free or not natural:
        try:
            mean, covariance = laplace_approximation(density, fit)
        except ValueError:
            return mean, covariance
    if natural:
        free, noise = slice(len(names)), slice(len(names), None)
        mean[free], covariance[free, free] = density.problem.vector(fit.theta), fit.covariance.loc[names, names]
        covariance[free, noise], covariance[noise, free] = 0.0, 0.0
    return mean, covariance


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
    def fine(self) -> bool:
        """True if every verdict is "fine"."""
        return {self.joint, *self.verdicts.values()} == {FINE}

    def inside(self, levels: np.ndarray) -> np.ndarray:
        """Return the fractions of draws inside ellipsoids of given probabilities, and their errors, (2, levels)."""
        if not self.laplace.determined:
            return np.full((2, levels.size), np.nan)
        limits = verdicts.ellipsoid_radii(levels, self.laplace.mean.size)
        return np.array([self.distances.below(limit, level) for limit, level in zip(limits, levels, strict=True)]).T


def _scores(problem: Problem, fit: MapEstimate, posterior: Posterior, coordinates: str) -> Scores | None:
    """Return the scores of the Laplace approximation; None if there is none."""
    laplace = _approximation(problem, fit, coordinates)
    if laplace is None:
        return None
    points = laplace.points(posterior)

    def sampled(values: np.ndarray, size: float = min(posterior.ess[name] for name in laplace.names)) -> Sample:
        return Sample.of(posterior.by_step(values), size)

    samples = {name: sampled(points[:, i], posterior.ess[name]) for i, name in enumerate(laplace.names)}
    normals = zip(samples.items(), laplace.mean.tolist(), laplace.sds.tolist(), laplace.supports, strict=True)
    marginal = {
        name: verdicts.marginal_verdict(draws, mean, sd, support, posterior.converged)
        for (name, draws), mean, sd, support in normals
    }
    unknown = np.full(len(points), np.nan)
    distances = verdicts.radii(points, laplace.mean, laplace.covariance) if laplace.determined else unknown
    *k, efficiency = importance_k(problem, fit, coordinates)
    tail = NO_TAIL if efficiency > EVEN_WEIGHTS else (k[0], k[1])
    joint = verdicts.joint_verdict(points, laplace.mean, laplace.covariance, sampled, tail, posterior.converged)
    if posterior.converged and notable(fit.other_modes):
        marginal |= {name: WRONG_MODE for name in problem.names if fit.other_values(name)}
        joint = WRONG_MODE
    joint = _consistent(joint, set(marginal.values()))
    return Scores(laplace, samples, sampled(distances), marginal, (k[0], k[1]), efficiency, joint)


def _on_modes(fit: MapEstimate) -> str:
    return f"The verdicts hold for the optima {found_from(len(fit.starts))}"


def _consistent(joint: str, rows: set[str]) -> str:
    """Return the joint verdict made consistent with the marginal ones."""
    if WRONG_MODE in rows:
        return WRONG_MODE
    if joint in (NARROW, WIDE) and WRONG_SHAPE in rows:
        return WRONG_SHAPE
    if joint == FINE and FINE not in rows:
        return rows.pop() if len(rows) == 1 else WRONG_SHAPE
    return joint


def _row(sample: Sample, mean: float, sd: float) -> dict[str, float]:
    """Return the statistics of one quantity and their Monte Carlo errors, see `Comparison.table`."""
    from scipy.stats import skew

    own_mean, mean_error = sample.estimate(lambda x: x.mean(axis=-1))
    draws_sd, spread = sample.estimate(lambda x: np.std(x, axis=-1, ddof=1))
    row = {"map": mean, "laplace_sd": sd, "mean": own_mean, "sd": draws_sd}
    row |= {"shift": (own_mean - mean) / draws_sd, "shift_mcse": mean_error / draws_sd}
    row |= {"sd_ratio": sd / draws_sd, "sd_ratio_mcse": sd / draws_sd * spread / draws_sd}
    row["skewness"], row["skewness_mcse"] = sample.estimate(lambda x: skew(x, axis=-1))
    for label, (probability, z) in COMPARED_QUANTILES.items():
        value, error = sample.estimate(lambda x, p=probability: np.quantile(x, p, axis=-1))  # type: ignore[misc]
        end = mean + z * sd if z else mean
        row |= {f"laplace_{label}": end, label: value}
        row |= {f"{label}_difference": (value - end) / draws_sd, f"{label}_difference_mcse": error / draws_sd}
    row["wasserstein"], row["wasserstein_mcse"] = verdicts.wasserstein_distance(sample, mean, sd)
    return row


def _table(scored: Scores, cured: Scores | None) -> pd.DataFrame:
    import pandas as pd

    laplace, rows = scored.laplace, {}
    for i, name in enumerate(laplace.names):
        verdict, sd = scored.verdicts[name], float(laplace.sds[i])
        cure = cured is not None and cured.verdicts[name] == FINE
        logarithm = cured is not None and bool(cured.laplace.logarithmic[i])
        rows[name] = {
            "coordinate": f"ln {name}" if laplace.logarithmic[i] else name,
            **_row(scored.samples[name], float(laplace.mean[i]), sd),
            "verdict": verdict,
            "recommendation": _recommendation(verdict, cure, logarithm, bool(np.isfinite(sd))),
        }
    return pd.DataFrame.from_dict(rows, orient="index")


def _joint(scored: Scores, cured: Scores | None) -> dict[str, float | str]:
    row: dict[str, float | str] = {"dimension": scored.laplace.mean.size}
    for level, inside, error in zip(ELLIPSOID_LEVELS, *scored.inside(np.array(ELLIPSOID_LEVELS)), strict=True):
        key = f"share_{100 * level:.0f}"
        row |= {key: float(inside), f"{key}_mcse": float(error)}
    row |= zip(("pareto_k", "pareto_k_mcse", "efficiency"), (*scored.pareto_k, scored.efficiency), strict=True)
    logarithm = cured is not None and bool(cured.laplace.logarithmic[: scored.laplace.mean.size].any())
    advice = _recommendation(scored.joint, cured is not None and cured.fine, logarithm, scored.laplace.determined)
    if scored.joint == FINE:
        others = [name for name, verdict in scored.verdicts.items() if verdict != FINE]
        advice += f", except for {', '.join(others)}" if others else ""
        heavy_tail = not scored.efficiency > EVEN_WEIGHTS and scored.pareto_k[0] > USABLE_K
        advice += ", not as an importance proposal" if heavy_tail else ""
    return row | {"verdict": scored.joint, "recommendation": advice}


def _recommendation(verdict: str, cure: bool, logarithm: bool, determined: bool) -> str:
    """Return the recommendation; `cure`: Laplace is fine in sampling coordinates."""
    if verdict == FINE:
        return "use Laplace"
    if verdict == UNCONVERGED:
        return "sample longer"
    if verdict == WRONG_MODE:
        return "report each mode by itself; see fit.modes, map_estimate(starts=…)"
    if cure:
        return ("logarithms cure it: " if logarithm else "") + "use Laplace in sampling coordinates"
    return "report the MCMC quantiles" if determined else "report a combination that the data determine"
