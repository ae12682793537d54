"""Search for terms that a misspecified model lacks: score tests of candidates, and refits of the best ones."""

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from bayesperiodic import _checks
from bayesperiodic._linalg import hessian_scale, in_one_thread
from bayesperiodic.diagnostics.adequacy import ALL, adequacy
from bayesperiodic.diagnostics.candidates import (
    Candidate,
    coefficient_names,
    extended,
    factors,
    generated,
    given,
    places,
    values,
)
from bayesperiodic.estimation.covariance import predicted_changes, residual_variances
from bayesperiodic.estimation.map_estimate import map_estimate
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.models.model import Model
from bayesperiodic.periodic.equations import respond
from bayesperiodic.periodic.solution import periodic_part
from bayesperiodic.posterior.density import Linearisation
from bayesperiodic.posterior.description import check_results
from bayesperiodic.posterior.priors import Normal
from bayesperiodic.posterior.problem import Problem

# Share of a candidate's effect that the parameters do not explain, below which it cannot be told from a change of these.
UNIDENTIFIABLE = 1e-6
# 1 − cos² of the angle between the effects of two candidates that are the same on the measured orbits.
COLLINEAR = 1e-8
# Candidates that are fitted at every step, and that are compiled together.
FITTED, COMPILED = 4, 8
# Standard deviations of the difference of two log-likelihoods from which on the data tell two terms apart.
DISTINCT = 2.0
# Fewest experiments of which one is left out at a time.
FEWEST_EXPERIMENTS = 3


@dataclass(frozen=True)
class Step:
    """One term added to the model.

    Parameters
    ----------
    term, place : str
        Text of the term in the model's names, and the output or equation that it is added to.
    alternatives : tuple of str
        Terms of the same effect on the data, or whose fit the data do not tell from this one.
    name : str
        Of the coefficient.
    coefficient, sd, robust_sd : float
        Estimate and standard deviations, in the place's unit over the term's.
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
        fewer than three experiments, or local parameters.
    shifts : dict of str to float
        Changes of the other estimates, in standard deviations before the step.
    """

    term: str
    place: str
    alternatives: tuple[str, ...]
    name: str
    coefficient: float
    sd: float
    robust_sd: float
    p: float
    unexplained: dict[str, float]
    p_white: dict[str, float]
    verdict: str
    evidence_gain: float
    held_out: float
    shifts: dict[str, float]


@dataclass(frozen=True)
class MissingTerms:
    """What `missing_terms` found.

    Parameters
    ----------
    steps : tuple of Step
        Terms that were added, in this order.
    ranking : DataFrame
        Candidates at the given estimate, the best first: place, term, same (others of the same effect), explains
        (fraction of the misfit, linearised), p, and p_adjusted for the false discovery rate.
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
    """

    steps: tuple[Step, ...]
    ranking: pd.DataFrame
    tested: int
    refused: dict[str, str]
    before: Step
    dropped: tuple[str, ...]
    stopped: str
    _problem: Problem
    _terms: dict[str, tuple[Candidate, float]]

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
            If there are fewer steps.
        """
        return extended(self._problem._given["model"], {name: term for name, (term, _) in self._first(k).items()})

    def problem(self, k: int | None = None) -> Problem:
        """Return the problem of that model, ready to be fitted and sampled.

        Parameters
        ----------
        k : int, optional

        Returns
        -------
        Problem
            The prior of each coefficient is normal about zero, with an effect as large as the measured outputs at one
            standard deviation.

        Raises
        ------
        ValueError
            If there are fewer steps.
        """
        return _problem_of(self._problem, self.model(k), {name: width for name, (_, width) in self._first(k).items()})

    def _first(self, k: int | None) -> dict[str, tuple[Candidate, float]]:
        count = len(self.steps) if k is None else _checks.integer("k", k, 0)
        if count > len(self.steps):
            raise ValueError(f"k: must be at most {len(self.steps)}, the number of steps, got {count}.")
        return {step.name: self._terms[step.name] for step in self.steps[:count]}

    @property
    def table(self) -> pd.DataFrame:
        """One row per model, the given one first: what is left unexplained, and the tests of it."""
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
        lines = [f"Missing terms, of {self.tested} candidates (false discovery rate of the score tests, see p):"]
        lines.append(self.table.to_string(float_format="{:.3g}".format, na_rep="-"))
        for k, step in enumerate(self.steps, 1):
            others = f"; the data do not tell it from {', '.join(step.alternatives)}" * bool(step.alternatives)
            moved = {name: shift for name, shift in step.shifts.items() if abs(shift) > 1.0}
            shifted = ", ".join(f"{name} by {shift:+.1f}" for name, shift in moved.items())
            lines.append(
                f"{k}. {step.name}·{step.term} in {step.place} (p = {step.p:.2g}){others}."
                + f" It moves {shifted} of its standard deviations." * bool(moved)
            )
        if not self.steps:
            lines.append("No candidate is significant.")
        lines += [f"Removed again: {', '.join(self.dropped)}."] if self.dropped else []
        lines += [f"{text}: left out, {why}." for text, why in self.refused.items() if why != NOT_TOLD]
        return "\n".join([*lines, self.stopped])


NOT_TOLD = "its effect is that of the parameters"
VANISHED = "with it the fit found no periodic solution"


@in_one_thread
def missing_terms(
    problem: Problem,
    fit: MapEstimate,
    candidates: Mapping[str, Iterable[Any]] | None = None,
    *,
    exclude: Iterable[str] = (),
    generate: bool = True,
    max_terms: int = 5,
    false_discovery_rate: float = 0.01,
) -> MissingTerms:
    """Search for terms that the model lacks.

    Each candidate is a term with an unknown coefficient in an equation or an output. Its score test needs no fit: with
    c its effect on the whitened outputs, less what the parameters can do instead, and r the residual, the statistic is
    c·r over its standard deviation from the spectrum of the residual. The p-values are adjusted for the false discovery
    rate (Benjamini and Hochberg [1]_). The best significant ones are fitted, the best of these by evidence is added,
    and the search is repeated. It ends if none is significant, if the evidence does not increase, or if the prediction
    of experiments that are left out gets worse. At the end, terms that later ones have made needless are removed.

    Candidates are products of states, inputs and their rates up to the third degree, absolute values, products with
    these, signs, a constant, and the highest derivatives, in every equation and output. An absolute value is rounded
    within 2 % of its argument's standard deviation, a sign within 20 %.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
    candidates : mapping of str to list, optional
        Further terms by place, an output or "equation of x": texts in the model's names, or functions of (s, p, u).
    exclude : iterable of str
        Terms, places, or terms at places (``"w**2 in force"``) to be left out.
    generate : bool
        False: only the given candidates.
    max_terms : int
    false_discovery_rate : float
        Expected share of terms that are not missing among those found; of a model that lacks nothing, the probability
        that any is found at the first step.

    Returns
    -------
    MissingTerms

    Raises
    ------
    ValueError
        If the fit is not that of the problem, or for unknown places, names, and derivatives.

    References
    ----------
    .. [1] Y. Benjamini, Y. Hochberg, Controlling the false discovery rate, Journal of the Royal Statistical Society B
       57 (1995) 289-300.

    Examples
    --------
    >>> found = bp.missing_terms(problem, fit, {"equation of x": ["x**5"]}, max_terms=1)
    >>> found.steps
    ()
    """
    stated = check_results(problem, fit=fit)
    _checks.integer("max_terms", max_terms, 0)
    if not 0.0 < _checks.finite_number("false_discovery_rate", false_discovery_rate) < 1.0:
        raise ValueError(f"false_discovery_rate: must be between 0 and 1, got {false_discovery_rate!r}.")
    model = stated._given["model"]
    terms = given(model, candidates or {})
    if generate:
        terms += generated(model, _deviations(model, stated, fit))
    left_out = {exclude} if isinstance(exclude, str) else set(exclude)
    chosen = {str(t): t for t in terms if not {t.text, t.place, str(t)} & left_out}
    search = _Search(problem, model, list(chosen.values()), false_discovery_rate)
    return search.run(_State(stated, fit, ()), max_terms)


def _deviations(model: Model, problem: Problem, fit: MapEstimate) -> dict[str, float]:
    """Return the standard deviations of the model's variables along the orbits of all experiments."""
    variables = {name: e for part in factors(model) for name, e in part.items()}
    each = [_evaluated(problem, fit, name, list(variables.values())) for name in fit.solutions]
    deviations = np.std(np.concatenate(each, axis=1), axis=1)
    return dict(zip(variables, deviations.tolist(), strict=True))


def _evaluated(problem: Problem, fit: MapEstimate, run: str, expressions: Sequence[Any]) -> np.ndarray:
    """Return expressions of the model's symbols along the orbit of an experiment (expressions, points)."""
    solution = fit.solutions[run]
    equations = problem.equations[run].at_frequency(solution.frequency)
    z = periodic_part(equations, solution.states)
    parameters = problem.parameters(problem.vector(fit.theta)[None], run)[0]
    return values(
        problem.model, expressions, equations.states(z), equations.inputs, parameters, equations.grid.tau,
        equations.frequency,
    )  # fmt: skip


def _problem_of(problem: Problem, model: Model, widths: Mapping[str, float], zero: Iterable[str] = ()) -> Problem:
    """Return the problem with another model, whose new coefficients have priors of these widths or are zero."""
    settings = dict(problem._given)
    settings["priors"] = settings["priors"] | {name: Normal(0.0, width) for name, width in widths.items()}
    settings["fixed"] = settings["fixed"] | dict.fromkeys(zero, 0.0)
    return Problem(experiments=problem.experiments, **settings | {"model": model})


@dataclass(frozen=True)
class _State:
    """A problem with some of the terms, its estimate, and the coefficients of the terms."""

    problem: Problem
    fit: MapEstimate
    names: tuple[str, ...]

    @property
    def evidence(self) -> float:
        """The logarithm of the evidence by Laplace, but for constants."""
        sd = np.sqrt(np.diag(self.fit.covariance))
        _, size = np.linalg.slogdet(self.fit.covariance / np.outer(sd, sd))
        return float(self.fit.history[-1] + 0.5 * size + np.sum(np.log(sd)) + 0.5 * sd.size * np.log(2.0 * np.pi))

    def here(self) -> Linearisation:
        """Return residuals and derivatives at the estimate."""
        theta = self.problem.vector(self.fit.theta)
        guesses = {name: solution.states for name, solution in self.fit.solutions.items()}
        return self.problem.anchored(theta, guesses).density().linearise(theta)

    @property
    def noise(self) -> np.ndarray:
        return self.problem.noise_values({name: self.fit.noise[name] for name in self.problem.noise_names})


class _Search:
    """Candidates of one problem, and the steps."""

    def __init__(self, problem: Problem, model: Model, terms: list[Candidate], rate: float):
        self.problem, self.model, self.terms, self.rate = problem, model, terms, rate
        self.refused: dict[str, str] = {}
        self.names = dict(zip(map(str, terms), coefficient_names(model, terms), strict=True))
        self.widths: dict[str, float] = {}
        self.compiled: tuple[Model, dict[str, Candidate]] = model, {}

    def run(self, state: _State, max_terms: int) -> MissingTerms:
        """Return what was found from a state without terms on."""
        first, steps, ranking = state, [], None
        chosen: dict[str, Candidate] = {}
        stopped, count = f"The search ended after {max_terms} terms, as asked.", 0
        while True:
            table = self.scores(state, chosen)
            if ranking is None:
                ranking, count = table, len(table)
            if len(steps) == max_terms:
                break
            found = self.best(state, table, chosen)
            if isinstance(found, str):
                stopped = found
                break
            term, after, others, p = found
            held_out = _held_out(after)
            if held_out > (last := steps[-1].held_out if steps else _held_out(state)):
                stopped = (
                    f"{term} would improve the fit, but not the prediction of experiments that are left out "
                    f"({last:.3%} unexplained without it, {held_out:.3%} with it)."
                )
                break
            chosen[self.names[str(term)]] = term
            steps.append(_step(term, self.names[str(term)], others, p, state, after, held_out))
            state = after
        steps, dropped = self.without_needless(steps, state, chosen)
        kept = {step.name: (chosen[step.name], self.widths[step.name]) for step in steps}
        before = _step(None, "", (), np.nan, first, first, _held_out(first))
        return MissingTerms(tuple(steps), ranking, count, self.refused, before, dropped, stopped, self.problem, kept)

    def scores(self, state: _State, chosen: Mapping[str, Candidate]) -> pd.DataFrame:
        """Return the table of the score tests of candidates that are not yet chosen, the best first."""
        open_terms = [t for t in self.terms if self.names[str(t)] not in chosen and str(t) not in self.refused]
        tests = _ScoreTests(state, open_terms)
        for i in np.flatnonzero(~tests.identifiable):
            self.refused[str(open_terms[i])] = NOT_TOLD
        rows = []
        for members in tests.groups():
            first = open_terms[members[0]]
            same = tuple(str(open_terms[i]) for i in members[1:])
            rows.append((first.place, first.text, same, tests.explained[members[0]], tests.p[members[0]], str(first)))
            self.widths[self.names[str(first)]] = float(tests.widths[members[0]])
        columns = ["place", "term", "same", "explains", "p", "key"]
        table = pd.DataFrame(rows, columns=columns).sort_values("explains", ascending=False, ignore_index=True)
        table["p_adjusted"] = stats.false_discovery_control(table["p"]) if len(table) else []
        return table

    def best(
        self, state: _State, table: pd.DataFrame, chosen: Mapping[str, Candidate]
    ) -> tuple[Candidate, _State, tuple[str, ...], float] | str:
        """Return the term to be added, the estimate with it, its alternatives and p; or why there is none."""
        significant = table[table["p_adjusted"] < self.rate]
        by_key = {str(t): t for t in self.terms}
        fitted: list[tuple[_State, pd.Series]] = []
        for row in significant.itertuples():
            after = self.fitted(state, chosen, by_key[str(row.key)], table)
            if after is None:
                self.refused[str(row.key)] = VANISHED
                continue
            fitted.append((after, row))
            if len(fitted) == FITTED:
                break
        if not fitted:
            return (
                f"No further candidate is significant at a false discovery rate of {self.rate:g}"
                f" (the smallest adjusted p is {table['p_adjusted'].min():.2g})."
            )
        fitted.sort(key=lambda pair: pair[0].evidence, reverse=True)
        after, row = fitted[0]
        if after.evidence <= state.evidence:
            return f"{row.key} is significant, but the evidence does not increase with it."
        here = after.here()
        others = list(row.same)
        for other, own in fitted[1:]:
            if not _distinct(after, here, other):
                others += [str(own.key), *own.same]
        return by_key[str(row.key)], after, tuple(others), float(row.p_adjusted)

    def fitted(
        self, state: _State, chosen: Mapping[str, Candidate], term: Candidate, table: pd.DataFrame
    ) -> _State | None:
        """Return the estimate with one more term, from the present one; None if it has no periodic solution."""
        name = self.names[str(term)]
        model, known = self.compiled
        if not {*chosen, name} <= set(known):
            by_key = {str(t): t for t in self.terms}
            wanted = [str(term), *table["key"][:COMPILED]]
            known = dict(chosen) | {self.names[key]: by_key[key] for key in dict.fromkeys(wanted)}
            model = extended(self.model, known)
            self.compiled = model, known
        names = (*chosen, name)
        return _estimated(
            _problem_of(self.problem, model, {n: self.widths[n] for n in names}, set(known) - {*names}), state, names
        )

    def without_needless(
        self, steps: list[Step], state: _State, chosen: dict[str, Candidate]
    ) -> tuple[list[Step], tuple[str, ...]]:
        """Return the steps without terms, but for the last one, that the evidence is no longer in favour of."""
        dropped: list[str] = []
        for step in steps[:-1]:
            names = tuple(n for n in state.names if n != step.name)
            model, known = self.compiled
            without = _problem_of(self.problem, model, {n: self.widths[n] for n in names}, set(known) - {*names})
            other = _estimated(without, state, names)
            if other is not None and other.evidence > state.evidence:
                state = other
                dropped.append(f"{step.term} in {step.place}")
                steps = [s for s in steps if s.name != step.name]
        return steps, tuple(dropped)


def _estimated(problem: Problem, near: _State, names: tuple[str, ...]) -> _State | None:
    """Return the estimate of a problem from that of a similar one; None if there is none."""
    start = {name: near.fit.theta.get(name, 0.0) for name in problem.names}
    guesses = {name: solution.states for name, solution in near.fit.solutions.items()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            fit = map_estimate(problem.anchored(start, guesses), start=start, progress=False)
        except ValueError:
            return None
    if not fit.converged:
        return None
    return _State(problem.with_input_errors(fit.input_errors), fit, names)


def _step(
    term: Candidate | None, name: str, others: tuple[str, ...], p: float, before: _State, after: _State, held_out: float
) -> Step:
    fit, same = after.fit, before is after
    table = adequacy(after.problem, after.here(), after.noise[None], {})
    return Step(
        term.text if term else "",
        term.place if term else "",
        others,
        name,
        fit.theta[name] if term else np.nan,
        fit.sd[name] if term else np.nan,
        fit.robust_sd[name] if term else np.nan,
        p,
        fit.fvu,
        {channel: white.p for channel, white in fit.whiteness.items()},
        str(table.loc[ALL, "verdict"]),
        0.0 if same else after.evidence - before.evidence,
        held_out,
        {n: (fit.theta[n] - value) / before.fit.sd[n] for n, value in before.fit.theta.items()},
    )


def _distinct(one: _State, here: Linearisation, other: _State) -> bool:
    """Return whether the data tell two fits apart, by the test of Q. H. Vuong, Econometrica 57 (1989) 307-333."""
    likelihood = one.problem.likelihood
    own, others = (likelihood.whitened(r, one.noise) for r in (here.residuals, other.here().residuals))
    weight = np.concatenate([np.full(b.size, b.weight) for b in likelihood.blocks])
    change = np.concatenate(others) ** 2 - np.concatenate(own) ** 2
    error = np.sqrt(np.sum((change - change.mean()) ** 2 / np.maximum(weight, 1e-3)))
    return bool(change.sum() > DISTINCT * error)


def _held_out(state: _State) -> float:
    """Return the mean fraction unexplained in experiments that are left out, one at a time; NaN for few experiments."""
    problem = state.problem
    if len(problem.experiments) < FEWEST_EXPERIMENTS or problem.local or problem.model.autonomous:
        return np.nan
    fractions = []
    for e in problem.experiments:
        rest = problem.with_experiments([other for other in problem.experiments if other is not e])
        found = _estimated(rest, state, state.names)
        if found is None:
            return np.inf
        states = {e.name: state.fit.solutions[e.name].states}
        single = problem.with_experiments([e]).anchored(found.fit.theta, states)
        outputs, converged = single.outputs(single.vector(found.fit.theta)[None])
        if not converged.all():
            return np.inf
        for channel, measured in e.outputs.items():
            left = measured - e.project(channel, outputs[e.name][channel][0])
            fractions.append(float(np.mean(left**2) / np.var(measured)))
    return float(np.mean(fractions))


class _ScoreTests:
    """Score tests of the coefficients of several terms at zero.

    `explained` (terms,) is the part of the misfit r·r that each explains, linearised; `widths` are the coefficients
    whose effect is as large as the measured outputs.
    """

    def __init__(self, state: _State, terms: Sequence[Candidate]):
        problem, here, noise = state.problem, state.here(), state.noise
        likelihood = problem.likelihood
        effects = _effects(state, terms)
        s, r, c = (likelihood.whitened(part, noise) for part in (here.changes, here.residuals, effects))
        data = likelihood.whitened(_centred_data(problem), noise)
        self.widths = _widths(data, c)
        prior = problem.joint_prior.curvature(problem.vector(state.fit.theta))
        joined_s, joined_r, joined_c = (np.concatenate(part, axis=-1) for part in (s, r, c))
        information = prior + joined_s @ joined_s.T
        scale = hessian_scale(information)
        inverse = np.linalg.pinv(information * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)
        slopes = inverse @ (joined_s @ joined_c.T)
        self.rest = joined_c - slopes.T @ joined_s
        own = np.sum(self.rest * joined_c, axis=1)
        size = np.sum(joined_c**2, axis=1)
        finite = np.isfinite(size) & (size > 0.0)
        self.identifiable = finite & (own > UNIDENTIFIABLE * np.where(finite, size, 1.0))
        score = joined_c @ joined_r
        total = float(joined_r @ joined_r)
        gain = np.divide(score**2, own, out=np.zeros(len(terms)), where=self.identifiable)
        self.explained = gain / total if total > 0.0 else gain
        cuts = np.cumsum([block.size for block in likelihood.blocks])[:-1]
        freedom = max(problem.counted - len(problem.names) - 1.0, 1.0)
        self.p = np.ones(len(terms))
        for j in np.flatnonzero(self.identifiable):
            coefficient = score[j] / own[j]
            left = np.split(joined_r - coefficient * self.rest[j], cuts)
            further = [np.concatenate([a, b[j][None]]) for a, b in zip(s, c, strict=True)]
            full = np.block(
                [
                    [information, (joined_s @ joined_c[j])[:, None]],
                    [joined_c[j] @ joined_s.T, joined_c[j] @ joined_c[j]],
                ]
            )
            variances = residual_variances(likelihood, further, left, noise, full)
            spread = float(np.sum(self.rest[j] ** 2 * np.concatenate(variances)))
            statistic = score[j] ** 2 / spread if spread > 0.0 else np.inf
            self.p[j] = stats.f.sf(statistic, 1.0, freedom)

    def groups(self) -> Iterator[list[int]]:
        """Yield the indices of identifiable terms with the same effect on the data."""
        size = np.sqrt(np.sum(self.rest**2, axis=1))
        left = list(np.flatnonzero(self.identifiable))
        while left:
            first = left[0]
            cosine = self.rest[left] @ self.rest[first] / (size[left] * size[first])
            same = 1.0 - cosine**2 < COLLINEAR
            yield [int(i) for i, own in zip(left, same, strict=True) if own]
            left = [i for i, own in zip(left, same, strict=True) if not own]


def _effects(state: _State, terms: Sequence[Candidate]) -> list[np.ndarray]:
    """Return the changes of the predicted components by each coefficient, one array (terms, size) a block.

    NaN for terms that are not finite along an orbit.
    """
    problem, fit, found = state.problem, state.fit, []
    theta = problem.vector(fit.theta)
    where = np.array([places(problem.model).index(term.place) for term in terms], dtype=int)
    outputs, states = len(problem.model.outputs), len(problem.model.states)
    for e in problem.experiments:
        equations = problem.equations[e.name].at_frequency(fit.solutions[e.name].frequency)
        z = periodic_part(equations, fit.solutions[e.name].states)
        along = _evaluated(problem, fit, e.name, [term.expression for term in terms])
        finite = np.isfinite(along).all(axis=1)
        added = np.zeros((len(terms), len(z), outputs + states))
        added[np.arange(len(terms)), :, where] = np.where(finite[:, None], along, 0.0)
        parameters = problem.parameters(theta[None], e.name)[0]
        columns, derivatives = equations.residual_jacobian(z, parameters), equations.derivatives(z, parameters)
        f, g = np.ascontiguousarray(added[..., :outputs]), np.ascontiguousarray(added[..., outputs:])
        moved = respond(equations, z, columns, derivatives, g, f)
        sizes = [block.size for block in problem.observations[e.name].blocks]
        if moved is None:
            caused = np.full((len(terms), sum(sizes)), np.nan)
        else:
            caused = predicted_changes(problem, e, equations, theta, z, moved)
            caused[~finite] = np.nan
        found += np.split(caused, np.cumsum(sizes)[:-1], axis=1)
    return found


def _centred_data(problem: Problem) -> list[np.ndarray]:
    """Return the measured components less their means, one array (size,) a block; zero where there are no components."""
    found: list[np.ndarray] = []
    for e in problem.experiments:
        seen = problem.observations[e.name]
        shown = np.stack([e.outputs[c] - e.outputs[c].mean() for c in seen.channels], axis=-1)
        found += seen.errors(shown)
    return found


def _widths(data: Sequence[np.ndarray], effects: Sequence[np.ndarray]) -> np.ndarray:
    """Return the coefficients (terms,) whose effect on one of the blocks is as large as its data."""
    sizes = np.array([np.linalg.norm(c, axis=1) for c in effects])
    wanted = np.array([np.linalg.norm(own) for own in data])[:, None]
    ratio = np.divide(wanted, sizes, out=np.full(sizes.shape, np.inf), where=(sizes > 0.0) & (wanted > 0.0))
    least = ratio.min(axis=0)
    return np.where(np.isfinite(least) & (least > 0.0), least, 1.0)
