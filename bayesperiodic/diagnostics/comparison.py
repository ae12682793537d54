"""Laplace against MCMC: parameter by parameter, and jointly."""

import html
from dataclasses import dataclass

import numpy as np
import pandas as pd

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.diagnostics.laplace_check import SAMPLING, Scores, approximation, joint_row, row, scores
from bayesperiodic.diagnostics.verdicts import FINE, LEVELS, MODE, NARROW, SHAPE, UNCONVERGED, WIDE
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.posterior.labels import unit
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.sampling.coordinates import NATURAL
from bayesperiodic.sampling.posterior import Posterior

COORDINATES = (NATURAL, SAMPLING)
PROBABILITIES = np.concatenate([[0.002, 0.005], np.arange(1, 100) / 100, [0.995, 0.998]])
BINS, SHOWN = 40, (0.0005, 0.9995)
BACKGROUND = {FINE: "#d9f0d3", NARROW: "#fdd0a2", WIDE: "#c6dbef", SHAPE: "#fee391", MODE: "#fcbba1"}


@dataclass(frozen=True)
class Comparison(Result):
    """Where the Laplace approximation and the posterior draws disagree.

    Every figure with a Monte Carlo error has it beside it, under its name and "_mcse": the standard deviation between
    batches of the draws, eight of each independent ensemble, over √batches. That of a share is at least the one of as
    many independent draws as the effective sample size.

    Attributes
    ----------
    table : DataFrame
        A row a parameter. coordinate ("k" or "ln k") is what all else is about: map and laplace_sd, mean and sd of the
        draws; shift (mean − map in posterior sds), sd_ratio (Laplace over posterior), skewness; laplace_q05, q05 and
        q05_difference ((draws − Laplace) in posterior sds), likewise for 50 and 95 %; wasserstein, the distance between
        draws and Laplace's normal distribution in posterior sds, whose error includes the upward bias of a distance;
        verdict and recommendation.
    joint : dict
        dimension; share_50, share_90 and share_95, the shares of draws inside Laplace's ellipsoids; pareto_k, the k̂ of
        Laplace as an importance proposal, its error that of fitting the tail; efficiency, the effective share of such
        draws; verdict and recommendation.
    coordinates : str
        "natural" or "sampling".
    probabilities : array (probabilities,)
        Of the quantiles and of the ellipsoids.
    quantiles : dict of str to array (probabilities,)
        Of the draws.
    edges, densities : dict of str to array (bins + 1,) and (bins,)
        Histograms of the draws, over 99.9 % of them.
    shares, shares_mcse : array (probabilities,)
        Shares of draws inside the ellipsoids that hold these probabilities of Laplace.
    units : dict of str to str
        Of the natural values.
    synthetic, converged : bool
        Of the data, and of the draws.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = {"force": np.cos(2 * np.pi * np.arange(32) / 32)}
    >>> run = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, force, frequency=0.1, duration=400,
    ...                   sampling_rate=4, noise={"displacement": 0.01}, seed=1).fold(32)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)},
    ...                      fixed={"m": 1, "k3": 0.5}, scheme="fourier")
    >>> fit = bp.map_estimate(problem, progress=False)
    >>> posterior = bp.sample(problem, fit, seed=1, ensembles=2, walkers=8, max_steps=250, progress=False)
    >>> scorecard = bp.compare(problem, fit, posterior)
    >>> scorecard.converged, scorecard.table["verdict"].to_dict()
    (False, {'c': 'not converged', 'k': 'not converged'})
    >>> scorecard.table.loc["k", ["coordinate", "recommendation"]].tolist(), scorecard.joint["dimension"]
    (['k', 'sample longer'], 2)
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
        joint = f"{self._jointly}: {self.joint['verdict']}; {self.joint['recommendation']}"
        return f"{self._title}\n{self._short.to_string()}\n{joint}"

    def _repr_html_(self) -> str:
        short = self._short
        head = "".join(f"<th>{html.escape(column)}</th>" for column in ("", *short.columns))
        body = "".join(
            f"<tr><th>{html.escape(str(name))}</th>{''.join(_cell(str(line[c]), c) for c in short.columns)}</tr>"
            for name, line in short.iterrows()
        )
        conclusion = f"{_coloured(str(self.joint['verdict']))} {html.escape(str(self.joint['recommendation']))}"
        return (
            f"<table><caption>{html.escape(self._title)}</caption><thead><tr>{head}</tr></thead><tbody>{body}</tbody>"
            f"</table><p>{html.escape(self._jointly)}: {conclusion}</p>"
        )

    @property
    def _title(self) -> str:
        said = ", synthetic data" if self.synthetic else ""
        return f"Laplace against MCMC in {self.coordinates} coordinates{said} (± Monte Carlo error)"

    @property
    def _short(self) -> pd.DataFrame:
        """The table for reading, figures with their errors as text."""
        table = self.table
        columns: dict[str, list[str]] = {c: [f"{v:.5g}" for v in table[c]] for c in ("map", "mean")}
        columns |= {c: [f"{v:.3g}" for v in table[c]] for c in ("laplace_sd", "sd")}
        for column in ("shift", "sd_ratio", "skewness", "wasserstein"):
            pairs = zip(table[column], table[f"{column}_mcse"], strict=True)
            columns[column] = [f"{value:.2f} ± {error:.2f}" for value, error in pairs]
        columns |= {c: table[c].tolist() for c in ("verdict", "recommendation")}
        return pd.DataFrame(columns, index=table["coordinate"].tolist())

    @property
    def _jointly(self) -> str:
        keys = [f"share_{100 * level:.0f}" for level in LEVELS]
        shares = ", ".join(f"{self.joint[key]:.1%} ± {self.joint[f'{key}_mcse']:.1%}" for key in keys)
        k, error = self.joint["pareto_k"], self.joint["pareto_k_mcse"]
        return f"jointly: the 50, 90 and 95% ellipsoids hold {shares} of the draws, Pareto k̂ {k:.2f} ± {error:.2f}"


def _cell(text: str, column: str) -> str:
    return f"<td>{_coloured(text) if column == 'verdict' else html.escape(text)}</td>"


def _coloured(verdict: str) -> str:
    colour = BACKGROUND.get(verdict, "#d9d9d9")
    return f'<span style="background:{colour};color:#000;padding:1px 4px">{html.escape(verdict)}</span>'


@in_one_thread
def compare(problem: Problem, fit: MapEstimate, posterior: Posterior, *, coordinates: str = NATURAL) -> Comparison:
    """Compare the Laplace approximation with the posterior draws, parameter by parameter and jointly.

    Every row gets one verdict. "fine": both ends of the 90 % interval agree with those of the draws within a quarter of
    the posterior sd, and so does the whole distribution. "too narrow" and "too wide": both ends are off in opposite
    directions. "wrong shape": shifted, skewed, or piled up at an end of the prior's support. "wrong mode": more than
    5 % of the draws lie in another mode, or nearly none of them where Laplace is. Whatever is not "fine" is so beyond
    three Monte Carlo errors. "not converged" where the draws cannot be trusted, unless every ensemble by itself shows
    another mode.

    Jointly what counts is the share of draws inside Laplace's ellipsoids, and the Pareto k̂ of the importance weights of
    8000 draws from Laplace ([1]_; above 0.7 it is of no use as a proposal, and it cannot see a mode that Laplace does
    not reach). It is the shape of their tail alone, and does not count where the weights are even (efficiency above
    98 %). Where variances can be integrated out in closed form that is done for k̂ in natural coordinates.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
    posterior : Posterior
    coordinates : "natural" or "sampling"
        "natural" compares `MapEstimate.covariance`, the inverse of H of eq. (8), which is about the parameters alone.
        "sampling" compares `MapEstimate.joint_covariance`, over the logarithms of positive parameters and of noise
        parameters: if Laplace is fine there, only the coordinates were wrong.

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
    >>> import numpy as np, bayesperiodic as bp
    >>> force = np.cos(2 * np.pi * np.arange(50) / 50)
    >>> true = bp.solve_periodic(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, {"force": force},
    ...                          frequency=0.1, samples=50, scheme="central4")
    >>> run = bp.Experiment("run", 0.1, true.outputs, {"force": force}, samples=50)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.Normal(0.2, 0.1), "k": bp.Normal(1, 0.5)},
    ...                      fixed={"m": 1, "k3": 0.5, "variance[displacement]": 1e-4}, scheme="central4")
    >>> fit = bp.map_estimate(problem, progress=False)
    >>> posterior = bp.sample(problem, fit, seed=1, ensembles=2, progress=False)
    >>> scorecard = bp.compare(problem, fit, posterior)
    >>> scorecard.table["verdict"].to_dict(), scorecard.joint["verdict"]
    ({'c': 'fine', 'k': 'fine'}, 'fine')
    """
    _checks.one_of("coordinates", coordinates, COORDINATES)
    every = (*problem.names, *problem.free_noise)
    _checks.holds("posterior", posterior.names, every, "give draws of this problem, sample(problem, fit)")
    both = {kind: approximation(problem, fit, kind) for kind in COORDINATES}
    laplace = both[coordinates]
    if laplace is None:
        raise ValueError(
            "coordinates: 'sampling' is not allowed; this estimate has no joint Laplace approximation, because the "
            f"density has no maximum with finite curvature ({'; '.join(fit.undetermined) or fit.status}). Take "
            "'natural'."
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


def _histogram(draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the density in each bin and the bins' edges."""
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
    """Return what to do; `cure` is whether Laplace is fine in sampling coordinates, where it was asked for."""
    if verdict == FINE:
        return "use Laplace"
    if verdict == UNCONVERGED:
        return "sample longer"
    if verdict == MODE:
        return "report each mode by itself; try map_estimate(starts=…)"
    if cure:
        return ("logarithms cure it: " if logarithm else "") + "use Laplace in sampling coordinates"
    return "report the MCMC quantiles" if determined else "report a combination that the data determine"
