"""Search for terms that a misspecified model lacks: score tests of candidates, and fits with the best ones."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import NOT_STORED, Result, Storable
from bayesperiodic._linalg import in_one_thread
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.candidates import (
    Term,
    coefficient_names,
    coefficient_unit,
    extended,
    generated,
    given,
    lag_names,
    places,
)
from bayesperiodic.diagnostics.optima import (
    SIGNIFICANT_COEFFICIENT,
    Optimum,
    distinct,
    doubt,
    guesses_of,
    held_out_error,
    problem_of,
)
from bayesperiodic.diagnostics.score_tests import ScoreTests, lags_to_try, variable_deviations
from bayesperiodic.estimation.adequacy import ALL, adequacy
from bayesperiodic.estimation.map_estimate import map_estimate, nearest_optimum
from bayesperiodic.estimation.result import MapEstimate, orbit_advice
from bayesperiodic.models.model import Model
from bayesperiodic.problem.arguments import refuse_special_points
from bayesperiodic.problem.fingerprint import check_results

if TYPE_CHECKING:
    import pandas as pd

# Ratio of the errors in experiments that are left out from which on these tell two terms apart.
WORSE_RATIO = 2.0


@dataclass(frozen=True)
class Step(Storable):
    """One term added to the model.

    Parameters
    ----------
    term, place : str
        Text of the term in the model's names, and the output or equation that it is added to.
    alternatives : tuple of str
        Terms of the same effect on the data, or whose fit the data do not tell from this one.
    worse : tuple of str
        Terms whose fit the data do not tell from this one, but which predict experiments left out worse.
    name : str
        Of the coefficient.
    unit : str
        Of the coefficient; empty where the model's units do not tell.
    coefficient, sd, robust_sd : float
        Estimate and standard deviations.
    lag, lag_sd : float
        Estimate and standard deviation [s] of the lag of a term with memory; NaN for the others.
    p : float
        Of the score test before it was added, adjusted for the number of candidates.
    unexplained : dict of str to float
        Fraction of each channel's variance that remains, as `MapEstimate.fvu`.
    p_white : dict of str to float
        Of the test of whiteness of each channel's residual.
    verdict : str
        "adequate", "misspecified" or "not tested" by all tests of `predict` that need no draws.
    evidence_gain : float
        Change of the log evidence in the Laplace approximation.
    held_out : float
        Mean fraction of the variance unexplained in experiments that were left out of the fit, one at a time; NaN for
        fewer than three experiments, or local parameters; infinite where an experiment has no prediction.
    shifts : dict of str to float
        Changes of the other estimates, in standard deviations before the step.
    """

    term: str
    place: str
    alternatives: tuple[str, ...]
    worse: tuple[str, ...]
    name: str
    unit: str
    coefficient: float
    sd: float
    robust_sd: float
    lag: float
    lag_sd: float
    p: float
    unexplained: dict[str, float]
    p_white: dict[str, float]
    verdict: str
    evidence_gain: float
    held_out: float
    shifts: dict[str, float]


@dataclass(frozen=True)
class MissingTerms(Result):
    """What `missing_terms` found.

    A file written by `save` contains the estimates but not the models: what `load` returns prints itself and has
    `table`, `ranking` and `fit`; its `model` and `problem` raise a ValueError.

    Parameters
    ----------
    steps : tuple of Step
        Terms that were added, in this order.
    ranking : DataFrame
        Candidates at the given estimate, the best first: place, term, lag (the best one of those tried [s], NaN without
        memory), same (others of the same effect), explains (fraction of the misfit, linearised), p, and p_adjusted for
        the false discovery rate.
    tested : int
        Number of candidates of different effect that were tested.
    refused : dict of str to str
        Candidates that were left out, and why.
    before : Step
        The model as it was given, as a step without a term.
    dropped : tuple of str
        Terms that were added and removed again, since the later ones made them needless.
    stopped : str
        Why no further term was added.

    Examples
    --------
    >>> found = bp.missing_terms(problem, fit, max_terms=0)
    >>> len(found.table), found.before.verdict
    (1, 'adequate')
    """

    steps: tuple[Step, ...]
    ranking: pd.DataFrame
    tested: int
    refused: dict[str, str]
    before: Step
    dropped: tuple[str, ...]
    stopped: str
    _fits: tuple[MapEstimate, ...]
    _problem: Problem | None = field(default=None, metadata=NOT_STORED)
    _terms: dict[str, tuple[Term, float]] = field(default_factory=dict, metadata=NOT_STORED)

    def model(self, k: int | None = None) -> Model:
        """Return the model with the terms of the first k steps, by default of all.

        Parameters
        ----------
        k : int, optional

        Returns
        -------
        Model

        Raises
        ------
        ValueError
            If there are fewer steps, or the result was loaded from a file.
        """
        problem, terms = self._first(k)
        return extended(problem.settings["model"], {name: term for name, (term, _) in terms.items()})

    def problem(self, k: int | None = None) -> Problem:
        """Return the problem of that model, ready to be fitted and sampled.

        Parameters
        ----------
        k : int, optional

        Returns
        -------
        Problem
            The prior of each coefficient is normal about zero, with an effect as large as the measured outputs at one
            standard deviation; that of a lag is log-normal about the best one of those tried. Its estimate is that of
            `fit`.

        Raises
        ------
        ValueError
            If there are fewer steps, or the result was loaded from a file.
        """
        problem, terms = self._first(k)
        return problem_of(problem, self.model(k), terms, {})

    def fit(self, k: int | None = None) -> MapEstimate:
        """Return the estimate of `problem`.

        Parameters
        ----------
        k : int, optional

        Returns
        -------
        MapEstimate

        Raises
        ------
        ValueError
            If there are fewer steps.
        """
        return self._fits[self._count(k)]

    def _count(self, k: int | None) -> int:
        count = len(self.steps) if k is None else _checks.integer("k", k, 0)
        if count > len(self.steps):
            raise ValueError(f"k: must be at most {len(self.steps)}, the number of steps, got {count}.")
        return count

    def _first(self, k: int | None) -> tuple[Problem, dict[str, tuple[Term, float]]]:
        if self._problem is None:
            raise ValueError("found: must be what missing_terms has returned, got one of a file, which has no models.")
        return self._problem, {step.name: self._terms[step.name] for step in self.steps[: self._count(k)]}

    @property
    def table(self) -> pd.DataFrame:
        """One row per model, the given one first: what is left unexplained, and the tests of it."""
        import pandas as pd

        rows = {}
        for k, step in enumerate((self.before, *self.steps)):
            row: dict[str, Any] = {"term": step.term, "place": step.place}
            row |= {f"unexplained {channel}": value for channel, value in step.unexplained.items()}
            row |= {f"p white {channel}": value for channel, value in step.p_white.items()}
            rows[k] = row | {
                "verdict": step.verdict, "evidence gain": step.evidence_gain, "held out": step.held_out,
                "coefficient": step.coefficient, "robust sd": step.robust_sd,
            }  # fmt: skip
        return pd.DataFrame.from_dict(rows, orient="index")

    def __repr__(self) -> str:
        shown = self.table.astype({"held out": object}).replace({"held out": {np.inf: "no prediction"}})
        lines = [
            f"Missing terms, of {self.tested} candidates; variance unexplained in the fit and in what was left out:",
            shown.to_string(float_format="{:.3g}".format, na_rep="-"),
        ]
        lines += [_sentence(k, step) for k, step in enumerate(self.steps, 1)]
        lines += [f"Removed again: {', '.join(self.dropped)}."] if self.dropped else []
        lines += [f"{text}: left out, {why}." for text, why in self.refused.items() if why != NOT_TOLD]
        return "\n".join([*lines, self.stopped])


def _sentence(k: int, step: Step) -> str:
    """Return what a step has added, in words."""
    size = f"{step.name} = {step.coefficient:.3g} ± {step.robust_sd:.2g} {step.unit}".rstrip()
    others = f"; the data do not tell it from {', '.join(step.alternatives)}" * bool(step.alternatives)
    text = f"{k}. {step.name}·({step.term})" if " - " in step.term else f"{k}. {step.name}·{step.term}"
    text += f" in {step.place}, {size} (p = {step.p:.2g}){others}."
    if np.isfinite(step.lag):
        text += f" Its lag is {step.lag:.3g} ± {step.lag_sd:.2g} s."
        if abs(step.coefficient) < SIGNIFICANT_COEFFICIENT * step.robust_sd:
            text += " The data determine the product of coefficient and lag, but not both."
    if step.worse:
        text += f" As good a fit, but worse in experiments left out: {', '.join(step.worse)}."
    moved = {name: shift for name, shift in step.shifts.items() if abs(shift) > 1.0}
    shifted = ", ".join(f"{name} by {shift:+.1f}" for name, shift in moved.items())
    return text + f" It moves {shifted} of its standard deviations." * bool(moved)


NOT_TOLD = "its effect is that of the parameters"
VANISHED = "with it the fit found no periodic solution, or no optimum"
VAGUE = "its evidence cannot be approximated, for the data hardly determine its parameters"


@in_one_thread
def missing_terms(
    problem: Problem, fit: MapEstimate, candidates: Mapping[str, Iterable[Any]] | None = None, *,
    equations: bool = True, outputs: bool = True, exclude: Iterable[str] = (), keep: int = 4, max_terms: int = 5,
    false_discovery_rate: float = 0.01,
) -> MissingTerms:  # fmt: skip
    """Search for terms that the model lacks.

    Each candidate is a term with an unknown coefficient in an equation or an output. Its score test needs no fit: with
    c its effect on the whitened outputs, less what the parameters can do instead, and r the residual, the statistic is
    c·r over its standard deviation by the measured noise, or by the spectrum of the residual where that was not
    measured. The p-values are adjusted for the false discovery rate (Benjamini and Hochberg [1]_). The best significant
    candidates are fitted, the best of these by evidence is added, and the search is repeated. Where likelihoods do not
    differ significantly (as by Vuong [2]_, for normal errors) and there are at least three experiments, these are left
    out of the fit, one at a time, and only terms are eligible whose predictions of them are off by less than twice the
    smallest error. The search ends if no candidate is significant, if the evidence increases by less than the logarithm
    of the number of candidates, if the coefficient is within two robust standard deviations of zero, if the prediction
    of experiments that are left out gets worse, or if the coefficient changes by more than half on twice as many
    points, so that the grid's error looks like the term. At the end, terms that later ones have made needless are
    removed.

    Candidates are products of states, inputs and their rates up to the third degree, powers up to the fifth, absolute
    values, products with these, signs, a constant, and the highest derivatives, in every equation and output. An
    absolute value is rounded within 2 % of its argument's standard deviation, a sign within 20 %. Terms with memory are
    ``lag(x) - x`` of each variable x, of each summand of the equation or output, and of the whole output. The lag m of
    x is a state of the extended model, τ·ṁ = x − m. Its score test is the best of those with several τ, from 0.3 rad of
    the fastest experiment to 3 rad of the slowest, its p-value multiplied by their number (Bonferroni); in fits τ is
    a free parameter. Where the data determine only the product of coefficient and τ, the coefficient is tested at the
    estimate of τ.

    Of a condensed model (`Model.from_matrices`) the terms are forces of its elements. Those in "force of joint", of the
    element joint, are functions of its displacement ``joint`` and its velocity ``djoint``; terms in outputs and terms
    with memory are not searched. Give the model elements without a force, such as
    ``Element("probe", lambda: 0, (3, 4))``, where a force may be missing.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
    candidates : mapping of str to list, optional
        Further terms by place, an output, "equation of x", or "force of joint" of a condensed model: texts in the
        model's names, or functions of (s, p, u).
        A text may begin with the lag of an expression, ``"lag(x**2)"`` or ``"lag(x**2) - x**2"``.
    equations, outputs : bool
        Whether terms of the model's variables are candidates in the equations, and in the outputs.
    exclude : iterable of str
        Terms, places, or terms at places (``"w**2 in force"``) to be left out.
    keep : int
        Number of the best candidates that are fitted at every step.
    max_terms : int
        Number of terms after which the search ends.
    false_discovery_rate : float
        Expected share of terms that are not missing among those found; of a model that lacks nothing, the probability
        that any is found at the first step.

    Returns
    -------
    MissingTerms

    Raises
    ------
    ValueError
        If the fit is not that of the problem or on other orbits than the measured ones, or for unknown places, names,
        and derivatives.

    References
    ----------
    .. [1] Y. Benjamini, Y. Hochberg, Controlling the false discovery rate, Journal of the Royal Statistical Society B
       57 (1995) 289-300.
    .. [2] Q. H. Vuong, Likelihood ratio tests for model selection and non-nested hypotheses, Econometrica 57 (1989)
       307-333.

    Examples
    --------
    >>> found = bp.missing_terms(problem, fit, {"equation of x": ["x**5"]}, max_terms=1)
    >>> found.steps
    ()
    """
    stated = check_results(problem, fit=fit)
    refuse_special_points(problem.experiments, "a search for terms")
    if advice := orbit_advice(fit):
        raise ValueError(f"fit: must be an estimate on the measured orbits, got one on others; {advice}.")
    _checks.integer("max_terms", max_terms, 0)
    _checks.integer("keep", keep, 1)
    if not 0.0 < _checks.finite_number("false_discovery_rate", false_discovery_rate) < 1.0:
        raise ValueError(f"false_discovery_rate: must be between 0 and 1, got {false_discovery_rate!r}.")
    model = problem.settings["model"]
    terms = given(model, candidates or {})
    wanted = [place for place in places(model) if (outputs if place in model.outputs else equations)]
    terms += generated(model, wanted, variable_deviations(stated, fit))
    left_out = {exclude} if isinstance(exclude, str) else set(_checks.several("exclude", exclude))
    chosen = {str(t): t for t in terms if not {t.text, t.place, str(t)} & left_out}
    return _Search(problem, list(chosen.values()), false_discovery_rate, keep, lags_to_try(fit)).run(fit, max_terms)


class _Search:
    """Candidates of one problem, and the steps."""

    def __init__(self, problem: Problem, terms: list[Term], rate: float, keep: int, lags: list[float]):
        self.problem, self.model, self.rate, self.keep = problem, problem.settings["model"], rate, keep
        self.lags, self.terms = lags, {str(term): term for term in terms}
        self.names = dict(zip(self.terms, coefficient_names(self.model, terms), strict=True))
        self.keys = {name: key for key, name in self.names.items()}
        self.refused: dict[str, str] = {}
        self.widths: dict[str, float] = {}
        self.compiled: tuple[Model, dict[str, Term]] = self.model, {}
        self.fitted: dict[tuple[str, ...], Optimum] = {}

    def run(self, fit: MapEstimate, max_terms: int) -> MissingTerms:
        """Return what was found from the estimate of the model without terms on."""
        state = self.at(fit, ())
        ranking = self.scores(state)
        steps: list[Step] = []
        table, before = ranking, _step(state, fit, fit, None, held_out_error(state))
        stopped = f"The search ended after {max_terms} terms, as asked for by max_terms."
        chosen: dict[str, Term] = {}
        fits = [fit]
        while len(steps) < max_terms:
            addition = self.best(state, table, chosen)
            if isinstance(addition, str):
                stopped = addition
                break
            key, others, worse, p, after = addition
            term, name = self.terms[key], self.names[key]
            fit_after = self.estimate({**chosen, name: term}, after)
            why = doubt(fit_after, name, term) if fit_after else VANISHED
            if fit_after is None or (why and term.force is not None):
                self.refused[key], table = why, table[table["candidate"] != key]
                continue
            if why:
                stopped = f"{key} fits best, but {why}."
                break
            state_after = self.at(fit_after, (*chosen, name))
            held_out, last = held_out_error(state_after), steps[-1].held_out if steps else before.held_out
            if np.isfinite(held_out) and held_out > last:
                stopped = (
                    f"{key} would improve the fit, but not the prediction of experiments that are left out "
                    f"({last:.3%} unexplained without it, {held_out:.3%} with it)."
                )
                break
            gain = after.evidence - state.evidence
            steps.append(_step(state_after, fit_after, fit, (term, name, others, worse, p, gain), held_out))
            chosen[name], state, fit = term, state_after, fit_after
            fits.append(fit)
            table = self.scores(state)
        steps, fits, dropped = self.without_needless(steps, fits, state)
        kept = self.priors(step.name for step in steps)
        return MissingTerms(
            tuple(steps), ranking, len(ranking), self.refused, before, dropped, stopped, tuple(fits), self.problem, kept
        )

    def at(self, fit: MapEstimate, names: tuple[str, ...]) -> Optimum:
        """Return the optimum at an estimate of the model with terms."""
        problem = self.with_terms(names).with_input_errors(fit.input_errors)
        orbits = {name: solution.states for name, solution in fit.solutions.items()}
        nearest = nearest_optimum(problem, problem.vector(fit.theta), guesses_of(self.compiled[0], orbits))
        if nearest is None:
            raise ValueError("fit: must be an estimate with a periodic solution of every experiment, got one without.")
        return Optimum(problem, nearest[0], nearest[1].iterate, names)

    def with_terms(self, names: Iterable[str]) -> Problem:
        """Return the problem with coefficients of the compiled model, the others zero."""
        model, known = self.compiled
        terms = self.priors(names)
        return problem_of(self.problem, model, terms, {n: self.terms[self.keys[n]] for n in known if n not in terms})

    def priors(self, names: Iterable[str]) -> dict[str, tuple[Term, float]]:
        """Return terms and widths of the priors of their coefficients, by these."""
        return {name: (self.terms[self.keys[name]], self.widths[name]) for name in names}

    def estimate(self, terms: Mapping[str, Term], near: Optimum) -> MapEstimate | None:
        """Return the estimate of the model with terms, by name, from a near optimum; None if it cannot start there."""
        model = extended(self.model, terms)
        problem = problem_of(self.problem, model, self.priors(terms), {})
        start = dict(zip(near.problem.names, near.iterate.theta.tolist(), strict=True))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            try:
                return map_estimate(
                    problem.anchored(start, guesses_of(model, near.orbits)), start=start, progress=False
                )
            except ValueError:
                return None

    def scores(self, state: Optimum) -> pd.DataFrame:
        """Return the table of the score tests of candidates that are not yet chosen, the best first."""
        import pandas as pd
        from scipy.stats import false_discovery_control

        left = [key for key in self.terms if self.names[key] not in state.names and key not in self.refused]
        lags = [self.lags if self.terms[key].force is not None else [np.nan] for key in left]
        each = [replace(self.terms[key], lag=lag) for key, choices in zip(left, lags, strict=True) for lag in choices]
        tests, rows, at = ScoreTests(state.problem, state.iterate, each), [], {}
        ends = np.cumsum([len(choices) for choices in lags])
        for key, choices, end in zip(left, lags, ends.tolist(), strict=True):
            tried = range(end - len(choices), end)
            i = max(tried, key=lambda i: tests.explained[i] if tests.identifiable[i] else -1.0)
            at[i], self.terms[key], self.widths[self.names[key]] = key, each[i], float(tests.widths[i])
            tests.p[i] = min(1.0, len(choices) * tests.p[i])
            if not tests.identifiable[i]:
                self.refused[key] = NOT_TOLD
        for group in tests.groups(at):
            key, *same = (at[i] for i in group)
            term, most = self.terms[key], max(group, key=lambda i: tests.explained[i])
            rows.append((key, term.place, term.text, term.lag, same, tests.explained[most], tests.p[most]))
        columns = ["candidate", "place", "term", "lag", "same", "explains", "p"]
        table = pd.DataFrame(rows, [str(i) for i in range(1, len(rows) + 1)], columns)
        table["p_adjusted"] = false_discovery_control(table["p"]) if len(table) else table["p"]
        return table

    def best(
        self, state: Optimum, table: pd.DataFrame, chosen: Mapping[str, Term]
    ) -> tuple[str, tuple[str, ...], tuple[str, ...], float, Optimum] | str:
        """Return the term to be added, alternatives, worse ones, p, and the optimum with it; or why there is none."""
        if not len(table):
            return "No candidate is left."
        significant = table[table["p_adjusted"] < self.rate]
        if not len(significant):
            return (
                f"No further candidate is significant at a false discovery rate of {self.rate:g} (the smallest "
                f"adjusted p is {table['p_adjusted'].min():.2g})."
            )
        tried = list(significant["candidate"][: self.keep])
        self.compile(tried, list(significant["candidate"][: 2 * self.keep]), chosen)
        fitted: dict[str, Optimum] = {}
        curved, vague = state.curved, False
        for key in tried:
            names = (*chosen, self.names[key])
            after = self.fitted.get(names) or state.with_problem(
                self.with_terms(names).with_input_errors(state.problem.input_errors), names
            )
            if after is not None and (after.curved or not curved):
                self.fitted[names] = fitted[key] = after
            else:
                self.refused[key] = VANISHED if after is None else VAGUE
                vague = vague or after is not None
        if vague:  # The next candidates take the places of those without an evidence.
            return self.best(state, table[~table["candidate"].isin(self.refused)], chosen)
        if not fitted:
            return f"With {', '.join(tried)}, the best candidates, no periodic solution was found."
        best = max(fitted, key=lambda key: fitted[key].evidence)
        alike = [key for key in fitted if key == best or not distinct(fitted[best], fitted[key])]
        errors = {key: held_out_error(fitted[key]) for key in alike} if len(alike) > 1 else {best: np.nan}
        # Errors that are nearly equal are in an order by chance: of these, the evidence tells which is best.
        well = [key for key in alike if not errors[key] > WORSE_RATIO * min(errors.values())]
        # Of a term with memory, short and long lags have the effect of one without.
        first = max(well, key=lambda key: (self.terms[key].force is None, fitted[key].evidence))
        # Each of the candidates is as likely to be the missing one.
        needed = np.log(len(self.terms))
        if (gain := fitted[first].evidence - state.evidence) < needed:
            return (
                f"{first} fits best, but the logarithm of the evidence increases only by {gain:.1f}, where "
                f"{len(self.terms)} candidates require {needed:.1f}."
            )
        same, p = (dict(zip(table["candidate"], table[column], strict=True)) for column in ("same", "p_adjusted"))
        others = [[key, *same[key]] for key in alike]
        alternatives = [*same[first], *(o for group in others if group[0] in well and group[0] != first for o in group)]
        worse = tuple(other for group in others if group[0] not in well for other in group)
        return first, tuple(alternatives), worse, float(p[first]), fitted[first]

    def compile(self, wanted: Sequence[str], more: Sequence[str], chosen: Mapping[str, Term]) -> None:
        """Take a model with all wanted terms; where the present one lacks any, one with more terms."""
        if not {self.names[key] for key in wanted} <= set(self.compiled[1]):
            terms = dict(chosen) | {self.names[key]: self.terms[key] for key in dict.fromkeys([*wanted, *more])}
            self.compiled = extended(self.model, terms), terms

    def without_needless(
        self, steps: list[Step], fits: list[MapEstimate], state: Optimum
    ) -> tuple[list[Step], list[MapEstimate], tuple[str, ...]]:
        """Return steps and estimates without terms, but for the last, that the evidence is no longer in favour of."""
        dropped: list[str] = []
        for i, step in reversed([*enumerate(steps[:-1])]):
            names = tuple(n for n in state.names if n != step.name)
            problem = self.with_terms(names).with_input_errors(state.problem.input_errors)
            other = state.with_problem(problem, names)
            if other is None or (state.curved and not other.curved) or other.evidence <= state.evidence:
                continue
            left = steps[:i] + steps[i + 1 :]
            again = self.again(left, fits[: i + 1], other)
            if again is not None:
                steps, fits, state = *again, other
                dropped.append(f"{step.term} in {step.place}")
        return steps, fits, tuple(dropped)

    def again(
        self, steps: list[Step], fits: list[MapEstimate], near: Optimum
    ) -> tuple[list[Step], list[MapEstimate]] | None:
        """Return steps with the estimates of their models, the first ones of which are known; None if one is lost."""
        known, estimates = len(fits) - 1, list(fits)
        for k in range(known, len(steps)):
            names = tuple(step.name for step in steps[: k + 1])
            fit = self.estimate({name: self.terms[self.keys[name]] for name in names}, near)
            if fit is None:
                return None
            state, term, old = self.at(fit, names), self.terms[self.keys[names[-1]]], steps[k]
            added = term, old.name, old.alternatives, old.worse, old.p, old.evidence_gain
            steps = [*steps[:k], _step(state, fit, estimates[-1], added, held_out_error(state)), *steps[k + 1 :]]
            estimates.append(fit)
        return steps, estimates


def _step(
    state: Optimum,
    fit: MapEstimate,
    before: MapEstimate,
    added: tuple[Term, str, tuple[str, ...], tuple[str, ...], float, float] | None,
    held_out: float,
) -> Step:
    table = adequacy(state.problem, state.iterate.here, state.iterate.noise[None], {})
    term, name, others, worse, p, gain = added or (None, "", (), (), np.nan, np.nan)
    lag = lag_names(name)[0] if term and term.force is not None else ""
    unknown: dict[str, float] = {"": np.nan}
    theta, sd, robust = (unknown | estimates for estimates in (fit.theta, fit.sd, fit.robust_sd))
    return Step(
        term.text if term else "", term.place if term else "", others, worse, name,
        coefficient_unit(state.problem.model, term) if term else "",
        theta[name], sd[name], robust[name], theta[lag], sd[lag],
        p, fit.fvu, {channel: white.p for channel, white in fit.whiteness.items()}, str(table.loc[ALL, "verdict"]),
        gain, held_out, {n: (fit.theta[n] - value) / before.sd[n] for n, value in before.theta.items()},
    )  # fmt: skip
