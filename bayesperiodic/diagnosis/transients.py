"""Posterior predictive bands on what is not periodic: drop tests, run-ups, chaotic runs."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from bayesperiodic import checks
from bayesperiodic.data.recording import Recording
from bayesperiodic.diagnosis.bands import PROBABILITY, quantiles
from bayesperiodic.inference.problem import Problem
from bayesperiodic.store import Result

Run = Callable[[dict[str, float]], Recording]


@dataclass(frozen=True)
class Transient(Result):
    """What the posterior expects of a recording that is not periodic.

    Attributes
    ----------
    time : array (samples,)
        [s].
    median, low, high : dict of str to array (samples,)
        By output: the median and the central 90 % band, point by point, of the signals themselves: of the uncertainty
        of the parameters alone, without measurement noise, unless `run` adds some.
    probability : float
        Of the band.
    draws : int
        Runs made, one a draw.
    failures : dict of str to int
        How many of them failed, by reason; they are left out.
    """

    time: np.ndarray
    median: dict[str, np.ndarray]
    low: dict[str, np.ndarray]
    high: dict[str, np.ndarray]
    probability: float
    draws: int
    failures: dict[str, int]

    @property
    def failed(self) -> int:
        """How many runs failed."""
        return sum(self.failures.values())

    def __repr__(self) -> str:
        reasons = "".join(f"\n  {count} times: {reason}" for reason, count in self.failures.items())
        return (
            f"Transient of {', '.join(self.median)} over {self.time[0]:g} to {self.time[-1]:g} s: "
            f"{self.probability:.0%} band of the signal without measurement noise from {self.draws} runs, "
            f"{self.failed} failed{reasons}"
        )


def transient(problem: Problem, theta: np.ndarray, run: Run, experiment: str | None) -> Transient:
    """Return the bands over time of the recordings that `run` makes at draws θ (draws, names).

    Raises
    ------
    ValueError
        If experiments differ in their parameters and none is named, an unknown experiment, anything else than a
        recording, recordings whose times or outputs differ.
    RuntimeError
        If every run fails.
    """
    name = _whose(problem, experiment)
    names, time = problem.model.parameters, np.empty(0)
    signals: dict[str, list[np.ndarray]] = {}
    failures: Counter[str] = Counter()
    for row in problem.parameters(theta, name):
        try:
            recording = run(dict(zip(names, row.tolist(), strict=True)))
        # An integrator that gives up raises one of these, and so does a recording of values that are not finite.
        except (RuntimeError, ArithmeticError, ValueError) as error:
            failures[f"{type(error).__name__}: {error}"] += 1
            last = error
            continue
        if not isinstance(recording, Recording):
            raise ValueError(f"run: it returned a {type(recording).__name__}; it must return a Recording.")
        if not signals:
            time, signals = recording.time, {output: [] for output in recording.outputs}
        _check_same(recording, time, signals)
        for output, values in recording.outputs.items():
            signals[output].append(values)
    if not signals:
        raise RuntimeError(f"run: it failed at all {len(theta)} draws, last with: {last}") from last
    levels = {output: np.quantile(values, quantiles(), axis=0) for output, values in signals.items()}
    median, low, high = ({output: found[i] for output, found in levels.items()} for i in range(3))
    return Transient(time, median, low, high, PROBABILITY, len(theta), dict(failures))


def _whose(problem: Problem, experiment: str | None) -> str:
    """Return the experiment whose parameters the runs get; a ValueError where it matters and is not given."""
    names = [e.name for e in problem.experiments]
    if experiment is not None:
        checks.one_of("experiment", experiment, names)
        return experiment
    maps = [problem.parameter_maps[name] for name in names]
    for parameter in problem.model.parameters:
        sources = {(m.columns.get(parameter), m.fixed.get(parameter)) for m in maps}
        if len(sources) > 1:
            raise ValueError(
                f"experiment: None is not allowed with run; experiments differ in {parameter!r}, so name the one whose "
                f"value the runs take: {', '.join(map(repr, names))}."
            )
    return names[0]


def _check_same(recording: Recording, time: np.ndarray, outputs: Mapping[str, list[np.ndarray]]) -> None:
    checks.same_names("run: outputs of the recordings", recording.outputs, outputs)
    if recording.time.size != time.size or not np.allclose(recording.time, time, rtol=1e-9, atol=0.0):
        raise ValueError(
            f"run: recordings of {time.size} and {recording.time.size} samples, from {time[0]:g} to {time[-1]:g} s and "
            f"from {recording.time[0]:g} to {recording.time[-1]:g} s, are not allowed; all must have the same times."
        )
