"""Estimates from parts of the experiments: which parameters move with what, and by how many standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic._verdicts import BAD, CAUTION, GOOD, NEUTRAL, with_tone
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.adequacy import holm
from bayesperiodic.estimation.map_estimate import map_estimate
from bayesperiodic.estimation.result import MapEstimate

if TYPE_CHECKING:
    import pandas as pd

BY_AMPLITUDE, BY_FREQUENCY = "amplitude", "frequency"
# Relative difference below which amplitudes and frequencies of experiments are the same.
SAME_CONDITION = 1e-3
SPLIT_LEVEL = 0.01
AGREES = with_tone("agrees", GOOD)
WITHIN_ROBUST = with_tone("moves within robust sds", CAUTION)
MOVES = with_tone("moves", BAD)
NOT_COMPARED = with_tone("not compared", NEUTRAL)


@dataclass(frozen=True)
class SplitCheck(Result):
    """Estimates from parts of the experiments.

    Attributes
    ----------
    table : DataFrame
        One row per parameter that all parts share: its estimate in each part; ``laplace`` and ``robust``, the largest
        difference of two parts in its standard deviations; ``p_laplace`` and ``p_robust``, of at least this spread of
        the estimates about their weighted mean if the parameters are the same in all parts; and the verdict. It is
        "moves" if p_robust is below 1 %, adjusted for the number of parameters (Holm), "moves within robust sds" if
        only p_laplace is, "agrees" otherwise, and "not compared" where a standard deviation is not finite.
    parts : dict of str to tuple of str
        Names of the experiments of each part.
    by : str
        "amplitude", "frequency" or "mapping".
    fits : dict of str to MapEstimate
        The estimate of each part.

    Examples
    --------
    >>> runs = [bp.Experiment(f"run {i}", run.frequency, run.outputs, run.inputs, samples=run.samples) for i in (1, 2)]
    >>> both = bp.Problem(bp.models.duffing, runs, priors=problem.priors, fixed={"m": 1, "k3": 0.5}, scheme="fourier")
    >>> bp.split_check(both, by={"run 1": "first", "run 2": "second"}, progress=False).table["verdict"].to_dict()
    {'c': 'agrees', 'k': 'agrees'}
    """

    table: pd.DataFrame
    parts: dict[str, tuple[str, ...]]
    by: str
    fits: dict[str, MapEstimate]

    @property
    def moved(self) -> tuple[str, ...]:
        """Parameters with the verdict "moves"."""
        return tuple(self.table.index[self.table["verdict"] == MOVES])

    def __repr__(self) -> str:
        lines = [f"Estimates from {len(self.parts)} parts of the experiments, by {self.by}"]
        lines += [f"  {label}: {', '.join(runs)}" for label, runs in self.parts.items()]
        lines.append(self.table.to_string(float_format="{:.3g}".format, na_rep="-"))
        with_what = "" if self.by == "mapping" else f" with {self.by}"
        if self.moved:
            lines.append(
                f"Moves{with_what} by more than the robust standard deviations explain: {', '.join(self.moved)}. No "
                "one value is valid for all parts; look for a term that is missing, or give each part its own (local)."
            )
        within = self.table.index[self.table["verdict"] == WITHIN_ROBUST]
        if len(within):
            lines.append(
                f"Moves{with_what} by more than Laplace explains, but within the robust standard deviations: "
                f"{', '.join(within)}. Report the robust ones."
            )
        failed = [label for label, fit in self.fits.items() if not fit.converged]
        lines += [f"The estimate of {label!r} has not converged ({self.fits[label].status})." for label in failed]
        return "\n".join(lines)


def split_check(
    problem: Problem, by: str | Mapping[str, str] = BY_AMPLITUDE, *, start: Mapping[str, float] | None = None,
    progress: bool = True,
) -> SplitCheck:  # fmt: skip
    """Estimate the parameters from parts of the experiments, and compare their spread with the standard deviations.

    If the model is right, estimates from different experiments differ as their standard deviations say. Parameters of
    a wrong model take up part of its error, and move with amplitude or frequency: this shows which ones do, and
    whether the robust standard deviations cover it.

    The prior counts in every part, so that parts agree more closely than p says where it dominates.

    Parameters
    ----------
    problem : Problem
        With at least two experiments.
    by : "amplitude", "frequency" or mapping of str to str
        Halves of the experiments with small and large values, divided where values differ, next to the median: of the
        standard deviation of the first input over the period, or the first output of a model without
        inputs; or of the frequency. Or the part of each experiment, by its name.
    start : mapping of str to float, optional
        Where the searches start, such as ``fit.theta``; by default the medians of the priors.
    progress : bool

    Returns
    -------
    SplitCheck

    Raises
    ------
    ValueError
        For fewer than two experiments or parts, experiments that do not differ in what they are divided by, a mapping
        without one of the experiments, or parts that have no free parameter in common.

    Examples
    --------
    The stiffness of a model without the cubic spring of the data increases with the amplitude:

    >>> truth, runs = {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, []
    >>> for size, name in ((0.1, "weak"), (1.0, "strong")):
    ...     x = bp.simulate(bp.models.duffing, truth, {"force": size * force["force"]}, frequency=0.1, duration=400,
    ...                     sampling_rate=4, noise={"displacement": 0.01 * size}, seed=1)
    ...     runs.append(x.fold(32, name=name))
    >>> linear = bp.Problem(bp.models.duffing, runs, priors=problem.priors, fixed={"m": 1, "k3": 0}, scheme="fourier")
    >>> check = bp.split_check(linear, by="amplitude", progress=False)
    >>> small, large, verdict = check.table.loc["k", ["small amplitude", "large amplitude", "verdict"]]
    >>> print(f"k {verdict}: {small:.1f} and {large:.1f} N/m")
    k moves: 1.0 and 1.4 N/m
    """
    _checks.instance("problem", problem, Problem)
    parts = _parts(problem, by)
    kind = by if isinstance(by, str) else "mapping"
    fits = {}
    for label, runs in parts.items():
        part = problem.with_experiments([e for e in problem.experiments if e.name in runs])
        begin = None if start is None else {name: start[name] for name in part.names}
        fits[label] = map_estimate(part, start=begin, progress=progress)
    names = [name for name in problem.names if all(name in fit.theta for fit in fits.values())]
    if not names:
        raise ValueError(
            "problem: its parts must have a free parameter in common, got local ones only; give shared parameters."
        )
    return SplitCheck(_table(fits, names), parts, kind, fits)


def _parts(problem: Problem, by: str | Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Return the names of the experiments of each part."""
    experiments = problem.experiments
    if len(experiments) < 2:
        raise ValueError(f"problem: must have at least two experiments, got {len(experiments)}; add some.")
    if isinstance(by, str):
        _checks.one_of("by", by, (BY_AMPLITUDE, BY_FREQUENCY))
        values = np.array([e.frequency if by == BY_FREQUENCY else amplitude(e) for e in experiments])
        ordered = np.sort(values)
        cuts = [i for i in range(1, len(values)) if ordered[i] > ordered[i - 1] * (1.0 + SAME_CONDITION)]
        if not cuts:
            raise ValueError(
                f"by: the experiments must differ in their {by}, got {ordered[0]:.6g} in all; give a mapping."
            )
        best = min(cuts, key=lambda i: (abs(i - len(values) / 2), -ordered[i] / ordered[i - 1]))
        small = values < ordered[best]
        labels = {e.name: f"{'small' if s else 'large'} {by}" for e, s in zip(experiments, small, strict=True)}
    else:
        labels = {name: str(label) for name, label in _checks.mapping("by", by, "{'run 1': 'first day'}").items()}
        _checks.same_names("by", labels, [e.name for e in experiments])
    parts: dict[str, tuple[str, ...]] = {}
    for name, label in sorted(labels.items(), key=lambda item: item[1], reverse=isinstance(by, str)):
        parts[label] = (*parts.get(label, ()), name)
    if len(parts) < 2:
        raise ValueError(f"by: must give at least two parts, got {[*parts]}; name them differently.")
    return parts


def amplitude(experiment: Experiment) -> float:
    """Return the standard deviation over the period of the first input, or of the first output without inputs."""
    signals = experiment.inputs or experiment.outputs
    return float(np.nanstd(next(iter(signals.values()))))


def _table(fits: Mapping[str, MapEstimate], names: list[str]) -> pd.DataFrame:
    """Return the table of `SplitCheck`."""
    import pandas as pd

    values = np.array([[fit.theta[name] for name in names] for fit in fits.values()])
    table = pd.DataFrame(values.T, index=names, columns=[*fits])
    for kind, of in (("laplace", "sd"), ("robust", "robust_sd")):
        sd = np.array([[getattr(fit, of)[name] for name in names] for fit in fits.values()])
        known = np.isfinite(sd).all(axis=0) & (sd > 0.0).all(axis=0)
        sd = np.where(known, sd, np.nan)
        difference = np.abs(values[:, None] - values) / np.sqrt(sd[:, None] ** 2 + sd**2)
        mean = np.sum(values / sd**2, axis=0) / np.sum(sd**-2.0, axis=0)
        table[kind] = difference.max(axis=(0, 1))
        table[f"p_{kind}"] = chdtrc(len(fits) - 1, np.sum(((values - mean) / sd) ** 2, axis=0))
    p_laplace, p_robust = (holm(table[f"p_{kind}"].to_numpy()) for kind in ("laplace", "robust"))
    unknown = np.isnan(p_laplace) | np.isnan(p_robust)
    rules = [unknown, p_robust < SPLIT_LEVEL, p_laplace < SPLIT_LEVEL]
    table["verdict"] = np.select(rules, [NOT_COMPARED, MOVES, WITHIN_ROBUST], AGREES)
    return table
