"""Comparison of models by their evidence and by what they predict of values and experiments left out."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import expit, softmax

from bayesperiodic import _checks, _fourier
from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.predictive import draws_of, predict
from bayesperiodic.diagnostics.verdicts import UNCONVERGED, USABLE_K
from bayesperiodic.estimation.adequacy import MISSPECIFIED
from bayesperiodic.estimation.map_estimate import map_estimate
from bayesperiodic.estimation.modes import default_starts
from bayesperiodic.problem.fingerprint import check_results, digest
from bayesperiodic.problem.parameters import CHAIN, DRAW, EXPERIMENT
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.draws import Posterior, refuse_robust
from bayesperiodic.sampling.evidence import evidence
from bayesperiodic.sampling.groups import OBSERVATION, log_likelihood_terms
from bayesperiodic.sampling.sample import sample

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

# Log evidence ratio of a probability of 95 %. A difference of ELPD below 4 is too small for its standard error to be
# reliable, and so is a standard error from fewer than 5 experiments.
DECISIVE, SMALLEST_GAIN, FEWEST_SCORED = float(np.log(19.0)), 4.0, 5
PREFERRED, WORSE, OPEN, SPLIT = "preferred", "worse", "not distinguished", "contradictory"
EVIDENCE, ELPD, HELD_OUT = "log_evidence", "elpd", "held_out"
CRITERIA = {EVIDENCE: "evidence", ELPD: "leave-one-out prediction", HELD_OUT: "held-out experiments"}
IMPORTANCE, REFIT, NOT_AVAILABLE = "importance", "refit", "not available"
PREDICTION_DRAWS, INPUT_SCALES, NEGLIGIBLE_GAIN = 50, (1.0, 0.5, 2.0), 0.01
PRINTED_COLUMNS = [
    EVIDENCE, "probability", ELPD, "elpd_difference", "elpd_difference_se", "pareto_k", "held_out_difference",
    "held_out_difference_se", "adequacy", "verdict",
]  # fmt: skip
Models = Mapping[str, tuple[Problem, Posterior]]


@dataclass(frozen=True)
class ModelComparison(Result):
    """Comparison of models of the same data.

    Log evidence and ELPD (expected log predictive density) are natural logarithms; constants of the data, such as
    (2π)^(−n/2) of the ELPD, are left out. Only differences have a meaning.

    Attributes
    ----------
    table : DataFrame
        One row per model, the best first. ``log_evidence`` with its Monte Carlo error; ``probability`` of the model at
        equal prior probabilities; ``elpd`` of values left out one by one, with its standard error, the difference from
        the first model, and the largest ``pareto_k``; ``held_out``, the sum of the ELPDs of each experiment predicted
        from the others, likewise, and the number of ``refits``; ``adequacy``, the verdict of `predict`. ``verdict``:
        "preferred", "worse", "not distinguished" from the first, "contradictory" if a criterion decides against the
        first, or "not converged" as the draws. NaN where a value is not available, see `notes`.
    experiments : DataFrame
        One row per model and experiment: ``elpd``, its Monte Carlo ``error``, ``pareto_k`` of the importance weights,
        and ``method``: "importance", "refit" or "not available".
    conclusion : str
        Which model is preferred, on what this rests, and what would distinguish the models.
    notes : tuple of str
        Limitations.
    synthetic : bool
        Whether the data are synthetic.

    Examples
    --------
    >>> found = bp.compare_models(springs)
    >>> found.table["verdict"].to_dict()
    {'cubic': 'preferred', 'linear': 'worse'}
    """

    table: pd.DataFrame
    experiments: pd.DataFrame
    conclusion: str
    notes: tuple[str, ...]
    synthetic: bool

    def __repr__(self) -> str:
        data = ", synthetic data" if self.synthetic else ""
        table = self.table[PRINTED_COLUMNS].to_string(float_format="{:.4g}".format, na_rep="-")
        return "\n".join([f"Comparison of models{data}", table, self.conclusion, *self.notes])


@in_one_thread
def compare_models(models: Mapping[str, tuple[Problem, Posterior]], *, held_out: bool = True) -> ModelComparison:
    """Compare models of the same data by evidence, leave-one-out prediction and held-out experiments.

    The evidence (see `evidence`) decides between two models if the probability of one is above 95 %, beyond twice the
    Monte Carlo error. It depends on the widths of the priors, however many data there are.

    The expected log predictive density (ELPD) of a value left out, by Pareto-smoothed importance sampling [1]_ with
    ArviZ, hardly depends on the priors. It decides if the difference exceeds twice its standard error and 4, below
    which that error is unreliable [2]_, and if no k̂ is above 0.7. The prediction of one experiment from the others is a
    harder test, and decides likewise where there are at least five. The joint likelihood of the experiment gives the
    importance weights; where their k̂ is above 0.7, the model is estimated and sampled again without it, and its ELPD
    is the ratio of two evidences, by Bennett's acceptance ratio [3]_ of the draws with and without it.

    Parameters
    ----------
    models : mapping of str to (Problem, Posterior)
        At least two, by name, with the same experiments and measured outputs.
    held_out : bool
        Whether experiments are held out; refits take as long as sampling did.

    Returns
    -------
    ModelComparison

    Raises
    ------
    ValueError
        For fewer than two models, draws of another problem, or models of different data.

    References
    ----------
    .. [1] A. Vehtari, A. Gelman, J. Gabry, Practical Bayesian model evaluation using leave-one-out cross-validation and
       WAIC, Statistics and Computing 27 (2017) 1413-1432.
    .. [2] T. Sivula, M. Magnusson, A. Matamoros, A. Vehtari, Uncertainty in Bayesian leave-one-out cross-validation
       based model comparison, arXiv:2008.10296.
    .. [3] C. H. Bennett, Efficient estimation of free energy differences from Monte Carlo data, Journal of
       Computational Physics 22 (1976) 245-268.

    Examples
    --------
    >>> bp.compare_models(springs, held_out=False).table["verdict"].to_dict()
    {'cubic': 'preferred', 'linear': 'worse'}
    """
    models = _checked(models)
    notes: list[str] = []
    provisional = {name for name, (_, draws) in models.items() if not draws.converged}
    experiments = _experiments(models, held_out, notes)
    scores = _Scores([*models], provisional, _evidences(models, notes), *_left_out(models, notes), experiments)
    first, verdicts = scores.verdicts()
    table = scores.table(first)
    predictions = {name: predict(*pair, draws=PREDICTION_DRAWS) for name, pair in models.items()}
    table["adequacy"] = [predictions[str(name)].verdict for name in table.index]
    table["verdict"] = [verdicts[str(name)] for name in table.index]
    if predictions[first].verdict == MISSPECIFIED:
        why = "; ".join(f"{label}: {text}" for label, text in predictions[first].findings.items())
        notes.append(
            f"{first!r} is itself misspecified ({why}). The comparison is only relative, and errors and probabilities, "
            "which take one of the models for right, are too small or too extreme."
        )
    notes += [
        f"The draws of {name!r} have not converged ({draws.reason}): its values are provisional. Sample longer."
        for name, (_, draws) in models.items()
        if not draws.converged
    ]
    conclusion = scores.conclusion(first, verdicts, table["probability"].iloc[0])
    if verdicts[first] != PREFERRED:
        rival = next((name for name in map(str, table.index[1:]) if verdicts[name] != WORSE), str(table.index[1]))
        conclusion = f"{conclusion} {_what_would_tell(models, first, rival)}".strip()
    synthetic = any(e.synthetic for e in models[first][0].experiments)
    return ModelComparison(table, experiments, conclusion, tuple(dict.fromkeys(notes)), synthetic)


def _checked(models: Any) -> dict[str, tuple[Problem, Posterior]]:
    """Return models of the same data with their draws; raise a ValueError for anything else."""
    given = {}
    _checks.mapping("models", models, "{'Dahl': (problem, posterior), …}")
    if len(models) < 2:
        raise ValueError(f"models: must be at least two, got {list(models)}.")
    for name, pair in models.items():
        if not (isinstance(pair, tuple | list) and len(pair) == 2 and isinstance(pair[0], Problem)):
            raise ValueError(f"models[{name!r}]: must be (problem, posterior), got {_checks.shortened(pair)}.")
        try:
            given[name] = check_results(pair[0], posterior=pair[1]), pair[1]
            refuse_robust(pair[1])
        except ValueError as error:
            raise ValueError(f"models[{name!r}]: {error}") from None
    first, *others = given
    wanted = _data(given[first][0])
    for other in others:
        data = _data(given[other][0])
        if [*data.items()] != [*wanted.items()]:
            different = [key for key in wanted | data if wanted.get(key) != data.get(key)] or ["order"]
            raise ValueError(
                "models: must have the same experiments, in the same order, with the same measured outputs and "
                f"harmonics, got {first!r} and {other!r} with different {different[0]}. Evidence and prediction of "
                "different data cannot be compared; give both problems the same experiments."
            )
    return given


FIELDS = (
    "outputs",
    "frequency",
    "frequency_se",
    "samples",
    "mask",
    "covariance",
    "multipliers",
    "multiplier_sd",
    "condition",
)


def _data(problem: Problem) -> dict[str, str]:
    """Return digests of what the likelihood is a density of, by name; inputs are not data."""
    digests = {f"{f} of experiment {e.name!r}": digest(getattr(e, f)) for e in problem.experiments for f in FIELDS}
    for block in problem.likelihood.blocks:
        values = type(block).__name__, block.count, block.size, block.channel in problem.model.angles
        digests[f"values of {block.channel!r} of experiment {block.experiment!r}"] = digest(values)
    return digests


def _evidences(models: Models, notes: list[str]) -> np.ndarray:
    """Return log evidence, its error, probability, and whether it is reliable, of each model, (models, 4)."""
    improper, rows = {}, []
    for name, (problem, posterior) in models.items():
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # which the notes repeat
                result = evidence(problem, posterior)
        except ValueError as refusal:
            notes.append(f"The evidence of {name!r} is not available: {refusal}")
            rows.append((np.nan, np.nan, np.nan, False))
            continue
        alarms = [f"Evidence of {name!r}: {note}" for note in result.notes if note.startswith("Unreliable")]
        rows.append((result.log, result.log_error, np.nan, not alarms))
        improper[name] = result.improper
        notes += alarms
    values, first = np.array(rows, dtype=float), next(iter(improper.values()), {})
    if any(other != first for other in improper.values()):
        listed = "; ".join(f"{name!r}: {', '.join(of) or 'none'}" for name, of in improper.items())
        notes.append(
            f"The evidences cannot be compared: the improper priors differ ({listed}), and so do their arbitrary "
            "constants. Give the variances proper priors, such as noise.Independent(prior=bp.LogNormal(…))."
        )
        values[:, :2] = np.nan
    elif first:
        notes.append(
            f"The prior of {', '.join(first)} is improper; its arbitrary constant is the same for all models, and "
            "cancels in their probabilities."
        )
    if np.isfinite(values[:, 0]).all():
        values[:, 2] = softmax(values[:, 0])
    return values


def _leave_one_out(terms: xr.DataArray, efficiency: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ELPD of each term (chain, draw, …) left out by PSIS-LOO, and k̂; `efficiency` see `_terms`."""
    import xarray as xr

    tree, az = xr.DataTree.from_dict({"log_likelihood": xr.Dataset({"data": terms})}), convergence.arviz()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large k̂, which is part of the result
        loo = az.loo(convergence.for_arviz(tree), pointwise=True, reff=efficiency)
    elpd = loo.loo_i if hasattr(loo, "loo_i") else loo.elpd_i
    return np.asarray(elpd).ravel(), np.asarray(loo.pareto_k).ravel()


def _terms(posterior: Posterior) -> tuple[xr.DataArray, float]:
    """Return the terms of the log-likelihood (chain, draw, observation), and the independent draws per draw."""
    terms = posterior.tree["log_likelihood"]["data"].transpose(CHAIN, DRAW, OBSERVATION)
    count = terms.sizes[CHAIN] * terms.sizes[DRAW]
    return terms, float(min(1.0, np.nanmin([*posterior.ess.values()]) / count))


def _left_out(models: Models, notes: list[str]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return ELPD, its error and the largest k̂ of each model (models, 3), and the ELPDs of its values.

    The latter are over the square roots of the weights: the sum of n values of weight w has the variance of n·w
    independent ones of weight 1.
    """
    rows, values = [], []
    for name, (problem, posterior) in models.items():
        (elpd, pareto_k), weight = _leave_one_out(*_terms(posterior)), problem.likelihood.labels["weight"]
        values.append(elpd / np.sqrt(weight))
        rows.append((elpd.sum(), _sum_error(values[-1]), pareto_k.max()))
        if bad := int((pareto_k > USABLE_K).sum()):
            notes.append(
                f"Leave-one-out of {name!r} is unreliable: Pareto k > {USABLE_K} for {bad} of {elpd.size} values."
            )
        if weight.min() < 1.0:
            notes.append(
                "There are fewer independent values than samples: leave-one-out is too optimistic, as the neighbours "
                "of a sample tell the same. Evidence and held-out experiments are not affected."
            )
    if len({problem.likelihood.observations for problem, _ in models.values()}) > 1:
        notes.append(
            "Leave-one-out cannot be compared: the noise models have other independent values (see Posterior)."
        )
        return np.full((len(rows), 3), np.nan), [np.full(1, np.nan)] * len(rows)
    return np.array(rows), values


def _sum_error(values: np.ndarray) -> float:
    """Return the standard error of the sum of independent values."""
    return float(np.sqrt(values.size) * values.std(ddof=1)) if values.size > 1 else np.nan


def _experiments(models: Models, held_out: bool, notes: list[str]) -> pd.DataFrame:
    """Return the table of held-out experiments."""
    import pandas as pd

    rows: list[dict[str, Any]] = []
    runs = [e.name for e in next(iter(models.values()))[0].experiments] if held_out else []
    if len(runs) == 1:
        notes.append("No experiment can be held out: there is only one.")
    for name, (problem, posterior) in models.items() if len(runs) > 1 else ():
        terms, efficiency = _terms(posterior)
        joint = _joint(problem, terms)
        elpd, pareto_k = _leave_one_out(joint, efficiency)
        for i, run in enumerate(runs):
            left_out, rest = joint.to_numpy()[..., i].ravel(), _without(problem, run)
            row = {"model": name, "experiment": run, "elpd": elpd[i], "pareto_k": pareto_k[i]}
            if isinstance(rest, str):
                notes.append(f"{name!r} cannot predict experiment {run!r} from the others: {rest}")
                row |= {"elpd": np.nan, "pareto_k": np.nan, "error": np.nan, "method": NOT_AVAILABLE}
            elif pareto_k[i] > USABLE_K:
                value, error, reason = _refitted(problem, rest, posterior, i, left_out, efficiency)
                row |= {"elpd": value, "error": error, "method": REFIT}
                if reason:
                    notes.append(f"The draws of {name!r} without experiment {run!r} have not converged ({reason}).")
            else:
                weights = np.exp(left_out.min() - left_out)
                error = weights.std() / weights.mean() / np.sqrt(efficiency * weights.size)
                row |= {"error": float(error), "method": IMPORTANCE}
            rows.append(row)
    columns = ["model", "experiment", "elpd", "error", "pareto_k", "method"]
    return pd.DataFrame(rows, columns=columns, index=[f"{row['model']}: {row['experiment']}" for row in rows])


def _joint(problem: Problem, terms: xr.DataArray) -> xr.DataArray:
    """Return the log-likelihood (chain, draw, experiment) of each experiment from terms (chain, draw, observation)."""
    import xarray as xr

    members = [problem.likelihood.labels[EXPERIMENT] == e.name for e in problem.experiments]
    return xr.DataArray(terms.to_numpy() @ np.array(members, dtype=float).T, dims=(CHAIN, DRAW, EXPERIMENT))


def _without(problem: Problem, run: str) -> Problem | str:
    """Return the problem without an experiment, or why it does not predict it."""
    try:
        rest = problem.with_experiments(e for e in problem.experiments if e.name != run)
    except ValueError as refusal:
        return str(refusal)
    every = (*problem.names, *problem.noise_names)
    if alone := [name for name in every if name not in (*rest.names, *rest.noise_names)]:
        return f"{', '.join(alone)} {'belongs' if len(alone) == 1 else 'belong'} to it alone."
    return rest


def _refitted(
    problem: Problem, rest: Problem, posterior: Posterior, index: int, log_likelihood: np.ndarray, efficiency: float
) -> tuple[float, float, str]:
    """Return the ELPD of an experiment from new draws without it, its error, and why these have not converged."""
    lp = posterior.tree["sample_stats"]["lp"].transpose(CHAIN, DRAW).to_numpy()
    peak = draws_of(problem, posterior, [int(np.argmax(lp))])[0][0]
    guesses = posterior.guesses([*problem.observations], problem.model.states)
    density, start = problem.anchored(peak, guesses).density(), dict(zip(problem.names, peak.tolist(), strict=True))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of the fit with all experiments, which has been made before
        fit = map_estimate(rest, start=start, starts=default_starts(rest)[0], checks=False, progress=False)
        draws = sample(rest, fit, seed=posterior.seed, progress=False)
    terms = log_likelihood_terms(density, draws.tree["posterior"].to_dataset())["data"]
    other = _joint(problem, terms).to_numpy()[..., index].ravel()
    value, error = bennett(np.nan_to_num(other, nan=-np.inf), log_likelihood, (_terms(draws)[1], efficiency))
    return value, error, "" if draws.converged else draws.reason


def bennett(without: np.ndarray, given: np.ndarray, efficiencies: tuple[float, float]) -> tuple[float, float]:
    """Return ln p(y | rest) and its Monte Carlo error from ln p(y | θ) at draws without y and at draws with y.

    `efficiencies` are the numbers of independent draws per draw of the two sets.
    """
    from scipy.optimize import brentq

    sizes = [efficiency * draws.size for efficiency, draws in zip(efficiencies, (without, given), strict=True)]
    ratio, finite = np.log(sizes[1] / sizes[0]), np.concatenate([without, given])
    finite = finite[np.isfinite(finite)]

    def weights(log: float) -> tuple[np.ndarray, np.ndarray]:
        return expit(without - log + ratio), expit(log - given - ratio)

    def balance(log: float) -> float:
        first, second = weights(log)
        return float(sizes[0] * first.mean() - sizes[1] * second.mean())

    reach = 50.0 + abs(ratio)
    solution = float(brentq(balance, finite.min() - reach, finite.max() + reach))
    means, spreads = zip(*((max(w.mean(), np.finfo(float).tiny), w.std()) for w in weights(solution)), strict=True)
    return solution, float(np.sqrt(np.sum(np.divide(spreads, means) ** 2 / sizes)))


class _Scores:
    """Evidence, ELPD and held-out experiments of the models, and what they decide.

    `evidence` has the columns log, error, probability, reliable; `loo` elpd, se, pareto_k; one row per model. `values`
    are the ELPDs of single values over the square roots of their weights; `provisional` models have not converged.
    """

    def __init__(
        self, names: list[str], provisional: set[str], evidence: Any, loo: Any, values: Any, experiments: pd.DataFrame
    ):
        self.names, self.provisional = names, provisional
        self._evidence, self._loo, self._values = (dict(zip(names, x, strict=True)) for x in (evidence, loo, values))
        self._held_out = {name: experiments[experiments["model"] == name] for name in names}
        self._total = {n: x["elpd"].sum(skipna=False) if len(x) else np.nan for n, x in self._held_out.items()}

    def differences(self, one: str, other: str) -> dict[str, tuple[float, float]]:
        """Return by how much each criterion is in favour of one of two models, with its standard error."""
        evidence, loo, values = ([rows[one], rows[other]] for rows in (self._evidence, self._loo, self._values))
        runs = self._held_out[one], self._held_out[other]
        elpd, errors = ([run[column].to_numpy(float) for run in runs] for column in ("elpd", "error"))
        noise = 0.0 if one == other else np.sqrt(np.square(errors).sum())
        return {
            EVIDENCE: (float(evidence[0][0] - evidence[1][0]), float(np.hypot(evidence[0][1], evidence[1][1]))),
            ELPD: (float(loo[0][0] - loo[1][0]), _sum_error(values[0] - values[1])),
            HELD_OUT: (self._total[one] - self._total[other], float(np.hypot(_sum_error(elpd[0] - elpd[1]), noise))),
        }

    def decisions(self, one: str, other: str) -> dict[str, int]:
        """Return for each usable criterion 1 if it decides for the first of two models, −1 for the other, or 0."""
        usable = {
            EVIDENCE: self._evidence[one][3] and self._evidence[other][3],
            ELPD: max(self._loo[one][2], self._loo[other][2]) <= USABLE_K,
            HELD_OUT: len(self._held_out[one]) >= FEWEST_SCORED,
        }
        decisions = {}
        for name, (change, error) in self.differences(one, other).items():
            if usable[name] and np.isfinite(change) and not {one, other} & self.provisional:
                needed = DECISIVE + 2.0 * error if name == EVIDENCE else max(SMALLEST_GAIN, 2.0 * error)
                decisions[name] = int(np.sign(change)) if abs(change) > needed else 0
        return decisions

    def verdicts(self) -> tuple[str, dict[str, str]]:
        """Return the model that most decisions are in favour of, of equal ones the likeliest, and all verdicts."""

        def rank(name: str) -> tuple[float, ...]:
            favour = sum(sum(self.decisions(name, other).values()) for other in self.names)
            return favour, *np.nan_to_num((self._evidence[name][0], self._loo[name][0]), nan=-np.inf)

        self.names = sorted(self.names, key=rank, reverse=True)
        first, verdicts = self.names[0], {}
        for name in self.names:
            signs = tuple({*self.decisions(first, name).values()} - {0})
            verdict = {(): OPEN, (1,): WORSE}.get(signs, SPLIT)
            verdicts[name] = UNCONVERGED if {name, first} & self.provisional else verdict
        others = [verdicts[name] for name in self.names[1:]]
        verdicts[first] = next((verdict for verdict in (SPLIT, OPEN, UNCONVERGED) if verdict in others), PREFERRED)
        return first, verdicts

    def table(self, first: str) -> pd.DataFrame:
        """Return the numbers of `ModelComparison.table`."""
        import pandas as pd

        rows = {}
        for name in self.names:
            change, loo = self.differences(name, first), self._loo[name]
            row = dict(zip((EVIDENCE, "log_evidence_error", "probability"), self._evidence[name], strict=False))
            row |= {ELPD: loo[0], "elpd_se": loo[1], "pareto_k": loo[2], HELD_OUT: self._total[name]}
            for kind in (ELPD, HELD_OUT):
                row |= dict(zip((f"{kind}_difference", f"{kind}_difference_se"), change[kind], strict=True))
            rows[name] = row | {"refits": int((self._held_out[name]["method"] == REFIT).sum())}
        return pd.DataFrame.from_dict(rows, orient="index")

    def conclusion(self, first: str, verdicts: dict[str, str], probability: float) -> str:
        """Return which model is preferred, and on what that rests, in words."""
        texts, deciding = [], set(CRITERIA)
        for other in self.names[1:]:
            changes, signs = self.differences(first, other), self.decisions(first, other)
            shown = [f"{CRITERIA[n]} {c:+.1f} ± {e:.2g}" for n, (c, e) in changes.items() if np.isfinite(c)]
            texts.append(f"against {other!r}, in the logarithm: {', '.join(shown) or 'nothing that can be compared'}")
            deciding &= {name for name, sign in signs.items() if sign > 0}
        rivals = " and ".join(repr(name) for name in self.names if verdicts[name] == OPEN)
        rests = " and ".join(text for name, text in CRITERIA.items() if name in deciding) or "different criteria"
        text = {
            PREFERRED: f"{first!r} is preferred by {rests}",
            OPEN: f"The data do not distinguish {rivals}",
            SPLIT: "The criteria contradict each other, so that no model is preferred",
            UNCONVERGED: "No model is preferred, as draws have not converged",
        }[verdicts[first]]
        text += f" ({first!r} {'; '.join(texts)})."
        if np.isfinite(probability):
            text += f" The probability of {first!r} is {probability:.3g}, at equal prior probabilities."
        if verdicts[first] == SPLIT or deciding == {EVIDENCE}:
            text += " Evidence depends on the widths of the priors, prediction hardly."
        return text


def _what_would_tell(models: Models, one: str, other: str) -> str:
    """Return which experiment would distinguish two models, in words.

    Expected log-likelihood ratio of an experiment: ½ Σ (difference of the mean predictions)² over the variances of the
    noise and of both predictions, with the independent values that the present one has.
    """
    gains, problem = {}, models[one][0]
    for e in problem.experiments:
        for scale in INPUT_SCALES if problem.model.inputs else INPUT_SCALES[:1]:
            predictions, total = [_predicted(*models[name], e.name, scale) for name in (one, other)], 0.0
            for channel in e.outputs:
                means, variances, noises = zip(*(predicted[channel] for predicted in predictions), strict=True)
                gap = means[0] - means[1]
                gap = _fourier.within_half_turn(gap) if channel in problem.model.angles else gap
                total += 0.5 * e.independent[channel] * np.mean(gap**2 / (max(noises) + sum(variances)))
            if np.isfinite(total):
                gains[e.name, scale] = total
    if not gains:
        return ""
    (run, scale), gain = max(gains.items(), key=lambda item: item[1])
    if gain < NEGLIGIBLE_GAIN:
        return "Neither repetitions of the experiments nor half or twice their drive would distinguish them."
    kind = "a repetition of" if scale == 1.0 else f"{scale:g} times the drive of"
    present = sum(value for (_, s), value in gains.items() if s == 1.0)
    times = (
        f", so {DECISIVE / present:.0f} repetitions or times the cycles are needed" if 0 < present < DECISIVE else ""
    )
    return (
        f"Of repetitions and of half and twice the drive, {kind} {run!r} would tell most: about {gain:.2g} in the "
        f"log-likelihood ratio, where {DECISIVE:.1f} make 95 %. Repeating all experiments would tell "
        f"{present:.2g}{times}."
    )


def _predicted(
    problem: Problem, posterior: Posterior, run: str, scale: float
) -> dict[str, tuple[np.ndarray, np.ndarray, float]]:
    """Return mean and variance (points,) of each output of an experiment with scaled drive, and its noise variance.

    NaN where most draws have no periodic solution.
    """
    e = next(e for e in problem.experiments if e.name == run)
    inputs = {name: u.mean() + scale * (u - u.mean()) for name, u in problem.true_inputs(e).items()}
    places = np.linspace(0, posterior.draws(problem.names[0]).size - 1, PREDICTION_DRAWS).astype(int)
    theta, noise = draws_of(problem, posterior, places)
    level, guesses = np.median(noise, axis=0), posterior.guesses([run], problem.model.states)
    variances = problem.likelihood.value_variances(level)
    planned = problem.planned(replace(e, inputs=inputs), dict(zip(problem.noise_names, level.tolist(), strict=True)))
    theta = theta[:, [problem.names.index(name) for name in planned.names]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a coarse grid, which the estimate has given
        outputs, converged = planned.anchored(np.median(theta, axis=0), guesses).outputs(theta)
    result = {}
    for channel, values in outputs[run].items():
        kept = e.project(channel, values)[:, e.measured_points]
        kept = kept[converged] if converged.mean() > 0.5 else np.full_like(kept, np.nan)
        result[channel] = kept.mean(axis=0), kept.var(axis=0), float(variances.get((run, channel), np.nan))
    return result
