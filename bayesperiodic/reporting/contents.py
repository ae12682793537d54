"""Inputs and tables of the report; the texts around them are in the template."""

import importlib.metadata
import platform
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from bayesperiodic import _checks
from bayesperiodic._verdicts import CAUTION, TONES
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.comparison import Comparison, compare
from bayesperiodic.diagnostics.identifiability import identifiability
from bayesperiodic.diagnostics.missing_terms import MissingTerms
from bayesperiodic.diagnostics.model_error import MODEL_ERROR
from bayesperiodic.diagnostics.predictive import PROBABILITY, Prediction, predict
from bayesperiodic.estimation.adequacy import ADEQUACY_TESTS
from bayesperiodic.estimation.map_estimate import estimation_warnings
from bayesperiodic.estimation.modes import missed_by
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.likelihood.input_noise import FROM_CYCLES, JOINT
from bayesperiodic.models.model import CondensedModel
from bayesperiodic.periodic.schemes import find_scheme
from bayesperiodic.problem.fingerprint import check_results, fingerprint
from bayesperiodic.problem.parameters import SHIFT, local_name, squared
from bayesperiodic.reporting import html
from bayesperiodic.reporting.html import Rows, code, number
from bayesperiodic.sampling.draws import Posterior

# Level of the whiteness test, and the ratio of robust to Laplace sd above which the report warns.
NOT_WHITE, LARGE_RATIO = 0.01, 1.5
LONGEST_PRIOR = 120
PACKAGES = ("bayesperiodic", "numpy", "scipy", "sympy", "numba", "emcee", "arviz", "xarray", "matplotlib")


@dataclass
class ReportInputs:
    """A problem, its estimate, the draws or None, and the diagnostics that the report shows.

    Diagnostics that are None are computed, those that need draws only with draws. `no_prediction` is the reason
    why there is no prediction although there are draws, "" otherwise.
    """

    problem: Problem
    fit: MapEstimate
    posterior: Posterior | None
    identifiability: Any
    comparison: Comparison | None
    prediction: Prediction | None
    missing: MissingTerms | None
    no_prediction: str = ""

    def __post_init__(self) -> None:
        given = {"fit": self.fit} | ({} if self.posterior is None else {"posterior": self.posterior})
        problem = self.problem = check_results(self.problem, **given)
        if self.posterior is not None:
            self.comparison = self.comparison or compare(problem, self.fit, self.posterior)
            try:
                self.prediction = self.prediction or predict(problem, self.posterior)
            except RuntimeError as error:
                self.no_prediction = str(error)
        self.identifiability = self.identifiability or identifiability(problem, self.fit, self.posterior, profile=False)
        _checks.same_names("identifiability", dict.fromkeys(self.identifiability.table.index), problem.names)
        if self.comparison is not None:
            remedy = "give the one of this problem, compare(problem, fit, posterior)"
            _checks.contains("comparison", self.comparison.table.index, problem.names, remedy)
        if self.prediction is not None:
            _checks.same_names("prediction", self.prediction.median, [e.name for e in problem.experiments])
        if self.missing is not None:
            _checks.instance("missing", self.missing, MissingTerms)
            if self.missing.fit(0).fingerprint != fingerprint(problem):
                raise ValueError("missing: must be missing_terms(problem, fit) of this problem, got that of another.")

    @property
    def synthetic(self) -> bool:
        """Whether any of the data were simulated."""
        return any(e.synthetic for e in self.problem.experiments)

    @property
    def condensed(self) -> bool:
        """Whether the model has no symbolic equations."""
        return isinstance(self.problem.model, CondensedModel)

    @property
    def clocks(self) -> set[str]:
        """The time symbols, of "tau" and "frequency", that the model contains."""
        if self.condensed:  # whose elements are functions of their motion alone
            return set()
        model = self.problem.model
        used = set().union(*(e.free_symbols for e in (*model.equations, *model.output_expressions)))
        return {name for name in ("tau", "frequency") if model.time_symbols[name] in used}

    @cached_property
    def summary(self) -> pd.DataFrame:
        """Mean, sd, interval and diagnostics of the draws by name; empty without draws."""
        return pd.DataFrame() if self.posterior is None else self.posterior.summary(robust=False)

    @property
    def misfit(self) -> str:
        """Why the model is misspecified and robust intervals come first, in a sentence; "" if it is not."""
        return f"{self.fit.misfit}." if self.fit.misspecified else ""

    @cached_property
    def headline(self) -> dict[str, tuple[float, float]]:
        """The 90 % interval of each parameter that comes first: robust where the model is misspecified."""
        if self.posterior is None or (self.misfit and self.posterior.headline is self.posterior):
            return self.fit.interval(PROBABILITY)
        low, high = (self.posterior.summary()[end].to_dict() for end in ("q05", "q95"))
        return {name: (low[name], high[name]) for name in self.fit.theta}

    @property
    def coloured(self) -> list[str]:
        """The channels whose residual is not white."""
        return [channel for channel, white in self.fit.whiteness.items() if white.p < NOT_WHITE]

    @property
    def robust_ratios(self) -> dict[str, float]:
        """Robust over Laplace sd where it exceeds 1.5: some residual is not white, though the model is not rejected."""
        ratios = {name: self.fit.robust_sd[name] / sd for name, sd in self.fit.sd.items() if sd > 0.0}
        doubtful = self.coloured and not self.misfit
        return {name: ratio for name, ratio in ratios.items() if doubtful and LARGE_RATIO < ratio < np.inf}

    @property
    def warnings(self) -> Iterator[str]:
        """Warnings of the estimate."""
        return estimation_warnings(self.problem, self.fit)

    def unit(self, name: str) -> str:
        """Return the formatted unit of a parameter, a channel or a noise parameter, by its full name."""
        units = self.problem.units
        if name in self.problem.noise_names:
            plain, _, place = name.partition("[")
            channel = units.get(place.rstrip("]").partition(",")[0], "")
            return html.unit(squared(channel) if plain == "variance" and channel else "")
        return html.unit((self.problem.quantities | units).get(self.problem.plain_names.get(name, name), ""))


def badge(verdict: str) -> html.Badge:
    """Return the badge of a verdict; verdicts without a tone of their own get "caution"."""
    return html.Badge(TONES.get(verdict, CAUTION), verdict)


def other_than(good: str, verdicts: Mapping[Any, str]) -> list[str]:
    """Return the verdicts that differ from `good`, with their names."""
    return [f"{name}: {verdict}" for name, verdict in verdicts.items() if verdict != good]


def rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def experiments(given: ReportInputs) -> Rows:
    """Return the table of the experiments."""
    return [
        {
            "Experiment": e.name,
            "Data": "synthetic" if e.synthetic else "measured",
            "Frequency [Hz]": number(e.frequency, 7),
            "Standard error [Hz]": number(e.frequency_se, 2) if e.frequency_se else html.NOTHING,
            "Cycles": html.Number(e.cycles),
            "Forcing periods per response": html.Number(e.periods),
            "Points per period": html.Number(e.samples),
            "Periodicity": number(e.periodicity, 5),
        }
        for e in given.problem.experiments
    ]


def findings(given: ReportInputs) -> Rows:
    """Return the table of what the checks of the recordings found."""
    return [
        {
            "Experiment": e.name,
            "Channel": code(finding.channel) if finding.channel else "all",
            "Finding": finding.kind,
            "Severity": badge(finding.severity),
            "Start [s]": number(float(finding.times[0, 0]), 6),
            "End [s]": number(float(finding.times[-1, 1]), 6),
            "Samples or cycles": html.Number(finding.count),
            "Share": html.percent(finding.share),
            "Bias [standard errors]": number(finding.bias),
        }
        for e in given.problem.experiments
        for finding in e.findings
    ]


def without_findings(given: ReportInputs) -> list[str]:
    """Return sentences on the experiments without findings."""
    plain = [e for e in given.problem.experiments if not e.findings]
    sound = [e.name for e in plain if e.averaged is not None]
    other = [e.name for e in plain if e.averaged is None]
    return [
        *([f"Nothing was found in the recording of {', '.join(sound)}."] if sound else []),
        *([f"Not folded from a recording, so that none was checked: {', '.join(other)}."] if other else []),
    ]


def channels(given: ReportInputs) -> Rows:
    """Return the table of the channels."""
    rows: list[dict[str, str]] = []
    for e in given.problem.experiments:
        at = e.measured_points
        measured = "output" if at.all() else f"output, at {np.sum(at)} points"
        every = [("input", *item) for item in e.inputs.items()]
        every += [(measured, channel, values[at]) for channel, values in e.outputs.items()]
        rows += [
            {
                "Channel": code(channel),
                "Experiment": e.name,
                "Kind": kind,
                "Unit": given.unit(channel),
                "Minimum": number(float(values.min()), 4),
                "Maximum": number(float(values.max()), 4),
                "Harmonics kept": html.Number(e.harmonics.get(channel, "all")),
                "Independent values": html.Number(e.independent.get(channel, html.NOTHING)),
                "Standard deviation of one cycle": number(e.scatter.get(channel, np.nan)),
            }
            for kind, channel, values in every
        ]
    return rows


def measurements(given: ReportInputs) -> Rows:
    """Return the table of the values that were measured without a time history."""
    return [
        {
            "Quantity": one.label,
            "Experiment": e.name,
            "Unit": given.unit(one.label),
            "Value": number(one.value, 4),
            "Standard deviation": number(np.nan if one.sd is None else one.sd),
        }
        for e in given.problem.experiments
        for one in e.measurements
    ]


def parameters(given: ReportInputs) -> Rows:
    """Return the table of all parameters."""
    return [
        {
            "Parameter": code(name),
            "Symbol": html.symbol(plain),
            "Unit": given.unit(name),
            "Role": role,
            "Prior, value or expression": known,
        }
        for plain in (*given.problem.model.parameters, *given.problem.sensors.names, SHIFT)
        for name, role, known in _roles(given.problem, plain)
    ]


def _roles(problem: Problem, plain: str) -> Iterator[tuple[str, str, str]]:
    """Yield the full names of a parameter with its role and its prior, value or expression."""
    partners = {name: key for key in problem.priors if isinstance(key, tuple) for name in key}
    for name in (n for n, known in problem.plain_names.items() if known == plain):
        prior = repr(problem.joint_prior.marginals[name])
        prior = prior if len(prior) <= LONGEST_PRIOR else f"{prior[:LONGEST_PRIOR]}…"
        others = ", ".join(other for other in partners.get(name, ()) if other != name)
        yield name, "free", prior + (f", jointly with {others}" if others else "")
    if plain in problem.tied:
        yield plain, "tied", problem.tied[plain]
    by_run = problem.fixed.get(plain, {})
    if len(by_run) == len(problem.experiments) and len(set(by_run.values())) == 1:
        by_run = {"": next(iter(by_run.values()))}
    for run, value in by_run.items():
        yield (local_name(plain, run) if run else plain), "fixed", str(number(value, 6))


def summary(given: ReportInputs) -> Rows:
    """Return the summary table of the free parameters."""
    robust = given.fit.interval(PROBABILITY, robust=True) if given.robust_ratios else {}
    laplace = {} if given.comparison is None else dict(given.comparison.table["verdict"])
    return [
        {
            **{title: full[title] for title in ("Parameter", "Unit", "MAP")},
            **_headline_cells(given, name, rounding, full),
            **({"Robust 90 % interval": rounding.interval(*robust[name])} if robust else {}),
            "Identifiability": badge(given.identifiability.verdicts[name]),
            **({"Laplace approximation": badge(laplace[name])} if laplace else {}),
        }
        for full, (name, rounding) in zip(estimates(given), _roundings(given.fit).items(), strict=True)
    ]


def _headline_cells(
    given: ReportInputs, name: str, rounding: html.Rounding, full: Mapping[str, Any]
) -> dict[str, html.Number]:
    """Return the interval that comes first, and beside a robust one that which takes the model for right."""
    usual = full.get("MCMC: 90 % interval", full["Laplace: 90 % interval"])
    if not given.misfit:
        return {"90 % interval": usual}
    return {"Robust 90 % interval": rounding.interval(*given.headline[name]), "If the model were right": usual}


def _roundings(fit: MapEstimate) -> dict[str, html.Rounding]:
    return {name: html.Rounding.of(value, fit.sd[name]) for name, value in fit.theta.items()}


def estimates(given: ReportInputs) -> Rows:
    """Return the table of the estimates of the free parameters."""
    fit, intervals = given.fit, given.fit.interval(PROBABILITY, robust=False)
    return [
        {
            "Parameter": code(name),
            "Unit": given.unit(name),
            "MAP": rounding.text(fit.theta[name]),
            "Laplace: sd": rounding.sd(fit.sd[name]),
            "Laplace: 90 % interval": rounding.interval(*intervals[name]),
            "Degrees of freedom": number(fit.degrees_of_freedom[name], 3),
            "Laplace: robust sd": rounding.sd(fit.robust_sd[name]),
            **_mcmc_cells(given, name, rounding),
        }
        for name, rounding in _roundings(fit).items()
    ]


def noise(given: ReportInputs) -> Rows:
    """Return the table of the estimates of the noise parameters."""
    fit, rows = given.fit, []
    for name, value in fit.noise.items():
        free = name in given.problem.free_noise
        relative = np.sqrt(float(fit.joint_covariance.loc[name, name])) if free else np.nan
        rounding = html.Rounding.of(value, value * relative)
        channel = name.removeprefix("variance[").removesuffix("]")
        independent = fit.independent.get(channel, fit.independent.get(name, np.nan))
        rows.append(
            {
                "Noise parameter": code(name),
                "Unit": given.unit(name),
                "Independent values": number(independent, 6),
                "Estimate (eq. 7)": rounding.text(value) if free else html.Number(f"{number(value, 6)} (known)"),
                "Laplace: relative sd": html.percent(relative),
                **_mcmc_cells(given, name, rounding),
            }
        )
    return rows


def _mcmc_cells(given: ReportInputs, name: str, rounding: html.Rounding) -> dict[str, html.Number]:
    """Return mean, standard deviation and 90 % interval of the draws; no columns without draws."""
    if given.posterior is None:
        return {}
    mean, sd, low, high = given.summary.reindex([name])[["mean", "sd", "q05", "q95"]].to_numpy(dtype=float)[0]
    return {
        "MCMC: mean": rounding.text(mean),
        "MCMC: sd": rounding.sd(sd),
        "MCMC: 90 % interval": rounding.interval(low, high),
    }


def residuals(given: ReportInputs) -> Rows:
    """Return the table of the residuals."""
    fit, rows = given.fit, []
    for channel, value in fit.rms.items():
        split, white = fit.noise_split.get(channel), fit.whiteness.get(channel)
        noise, error = (np.nan, np.nan) if split is None else (split.measurement, split.model)
        rows.append(
            {
                "Channel": code(channel),
                "Unit": given.unit(channel),
                "rms of the residual": number(value),
                "Unexplained variance": html.percent(fit.fvu[channel]),
                "Measurement noise": number(noise),
                "Model error": number(np.nan if np.isnan(noise) else error),
                "Input noise": number(fit.input_noise.get(channel, np.nan)),
                "Whiteness p": html.p_value(white.p if white else np.nan),
                "Autocorrelation": number(white.lag1 if white else np.nan, 2),
            }
        )
    return rows


def input_noise(given: ReportInputs) -> str:
    """Return how the noise of the inputs was treated, what it causes, and how nonlinear that is; "" without inputs."""
    problem, fit = given.problem, given.fit
    noisy, curved = problem.noisy_inputs, fit.input_nonlinearity
    exact = ", ".join(e.name for e in problem.experiments if e.name not in noisy)
    before, after = "causes", "with the estimated inputs"
    if problem.input_noise == JOINT:
        text = "The errors of the inputs are parameters, with priors by the scatter of the cycles."
    elif noisy:
        names = ", ".join(dict.fromkeys(name for wave in noisy.values() for name in wave))
        source = "the scatter of the cycles" if problem.input_noise == FROM_CYCLES else "the problem, which states it"
        text = f"The noise of the inputs ({names}), known from {source}, is " + (
            "integrated out: the covariance of the residual includes it, and so do standard deviations and intervals."
            if fit.noisy_inputs
            else "negligible beside that of the outputs."
        )
        text += f" The inputs of {exact} are taken as exact." if exact else ""
    else:
        text, before, after = "The inputs are taken as exact.", "would cause", "with the measured inputs"
    for channel, caused in fit.input_noise.items():
        sd, rms = number(caused), number(fit.rms[channel])
        unit = "" if (wave := given.unit(channel)) == html.NOTHING else f" {wave}"
        if caused:
            text += f" Their noise {before} a standard deviation of {sd}{unit} in {channel}; "
            text += f"the rms of the residual {after} is {rms}{unit}."
    if fit.noisy_inputs:
        worst = max(curved, key=lambda name: np.nan_to_num(curved[name], nan=np.inf))
        most = "less than 0.01" if curved[worst] < 0.01 else f"up to {number(curved[worst], 2)}"
        text += f" What is not linear in it changes estimates by {most} standard deviations ({worst})."
    return text if problem.model.inputs else ""


def _formatted(table: pd.DataFrame, **columns: tuple[str, Callable[[Any], Any]]) -> Rows:
    """Return columns of a table, each with its title and format; `label` is the index."""
    rows = table.rename_axis("label").reset_index().to_dict("records")
    return [{title: form(row[name]) for name, (title, form) in columns.items()} for row in rows]


def verdicts(given: ReportInputs) -> Rows:
    """Return the table of the identifiability of each parameter."""
    return _formatted(
        given.identifiability.table,
        label=("Parameter", code),
        verdict=("Verdict", badge),
        evidence=("Evidence", str),
        remedy=("Recommendation", lambda text: text or html.NOTHING),
    )


def laplace(compared: Comparison) -> Rows:
    """Return the table of the comparison of Laplace with MCMC."""
    titles = {"shift": "Shift", "sd_ratio": "Ratio of sds", "skewness": "Skewness", "wasserstein": "Distance"}
    columns: dict[str, Any] = {"coordinate": ("Coordinate", code), "verdict": ("Verdict", badge)}
    columns |= {column: (title, html.Number) for column, title in titles.items()}
    two = html.Rounding(0, 2).text
    pairs = {c: compared.table[c].map(two) + " ± " + compared.table[f"{c}_mcse"].map(two) for c in titles}
    return _formatted(compared.table.assign(**pairs), **columns, recommendation=("Recommendation", str))


def adequacy(prediction: Prediction) -> Rows:
    """Return the table of the tests of the model."""
    columns: dict[str, Any] = {"label": ("Experiment and channel", str), "verdict": ("Verdict", badge)}
    columns |= {test: (f"p-values: {test}", html.p_value) for test in ADEQUACY_TESTS}
    columns["model_error_share"] = ("Fraction of model error", html.percent)
    for name, title in zip(MODEL_ERROR, ("estimate", "5 %", "95 %"), strict=True):
        if name in prediction.table:
            columns[name] = (f"Model error over rms: {title}", html.percent)
    return _formatted(prediction.table, **columns)


def missing_terms(search: MissingTerms) -> Rows:
    """Return the table of the models with more and more terms, the given one first."""
    return [
        {
            "Term": code(step.term) if step.term else "given model",
            "Place": step.place or html.NOTHING,
            **{f"Unexplained variance: {channel}": html.percent(left) for channel, left in step.unexplained.items()},
            "Unexplained variance: left out": html.percent(step.held_out),
            **{f"Whiteness p: {channel}": html.p_value(p) for channel, p in step.p_white.items()},
            "Tests of the model": badge(step.verdict),
            "Gain of log evidence": number(step.evidence_gain),
            "Coefficient": number(step.coefficient, 4),
            "Robust sd": number(step.robust_sd),
        }
        for step in (search.before, *search.steps)
    ]


def sampling(given: ReportInputs) -> Rows:
    """Return the table of the convergence of the draws."""
    return _formatted(
        given.summary,
        label=("Quantity", code),
        ess=("Effective sample size", lambda size: html.Number(f"{size:.0f}")),
        tau=("Autocorrelation time [steps]", number),
        rhat=("R-hat between ensembles", lambda rhat: html.Number(f"{rhat:.4f}")),
    )


def settings(given: ReportInputs) -> Rows:
    """Return the table of the settings."""
    problem, fit, posterior = given.problem, given.fit, given.posterior
    shifts = {name: abs(shift) for name, shift in fit.doubling_shift.items() if np.isfinite(shift)}
    worst = max(shifts, key=lambda name: shifts[name], default="")
    steps, starts = html.counted(len(fit.history) - 1, "step"), html.counted(len(fit.starts), "start")
    values = {
        "Problem": fingerprint(problem),
        "Difference scheme": find_scheme(problem.scheme).name,
        "Noise model": repr(problem.noise),
        "Search for the MAP": f"{fit.status}, {steps}, {starts}; of further optima, {missed_by(len(fit.starts))}",
        "Largest shift of an estimate with twice as many points": (
            f"{number(shifts[worst], 2)} sd ({worst})" if worst else "not known"
        ),
    }
    if posterior is not None:
        attributes = posterior.tree.attrs
        count, steps, walkers = posterior.by_step(posterior.draws(posterior.names[0])).shape
        programs = [f"{name} {attributes[name]}" for name in ("bayesperiodic", "emcee", "nutpie") if name in attributes]
        values |= {
            "Seed": str(posterior.seed),
            "Draws": f"{count} ensembles, {html.counted(walkers, 'walker')} each, {steps} draws per walker",
            "Drawn with": ", ".join(programs),
        }
    return [{"Setting": name, "Value": code(value)} for name, value in values.items()]


def versions() -> Rows:
    """Return the table of the versions of Python and of the packages."""
    values = {"Python": platform.python_version()} | {name: importlib.metadata.version(name) for name in PACKAGES}
    return [{"Program": name, "Version": code(value)} for name, value in values.items()]
