"""Tests of the model: discrepancy of every experiment and channel, and the verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import compress
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtrc, fdtrc, stdtr

from bayesperiodic._verdicts import BAD, CAUTION, GOOD, NEUTRAL, with_tone
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.recording_check import HARMLESS
from bayesperiodic.density.log_posterior import Linearisation
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.gauss_newton import Iterate
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.estimation.table_tests import rows_of, serial_correlation
from bayesperiodic.estimation.unexplained import NOT_TESTED, Unexplained, testable, used
from bayesperiodic.likelihood.block import Block

if TYPE_CHECKING:
    import pandas as pd


def excess(variance: float, freedom: float, known: float, known_freedom: float) -> float:
    """Return p of the one-sided test of a variance against a known or independently estimated one."""
    if not freedom > 0.0 or not known > 0.0:
        return NOT_TESTED
    if np.isinf(known_freedom):
        return float(chdtrc(freedom, freedom * variance / known))
    return float(fdtrc(freedom, known_freedom, variance / known))


def consistency(parts: Sequence[tuple[np.ndarray, np.ndarray, str]], known: frozenset[str]) -> float:
    """Return p of the test of common parameters against separate ones by Chow, Econometrica 28 (1960) 591-605.

    Each block has whitened components (size,), their derivatives (parameters, size), and the group of blocks with which
    it has a common variance; the whitened variance of `known` groups is 1.
    """
    apart = [Unexplained(r, j, np.zeros(r.size, dtype=int)) for r, j, _ in parts]
    scale, freedoms = dict.fromkeys(known, 1.0), [np.inf]
    for group in {g for *_, g in parts} - known:
        members = [u for u, (*_, g) in zip(apart, parts, strict=True) if g == group]
        freedom = sum(u.freedom for u in members)
        if freedom and (square := sum(u.square for u in members)) > 0.0:
            scale[group] = square / freedom
            freedoms.append(freedom)
    kept = [(u, r, j, g) for u, (r, j, g) in zip(apart, parts, strict=True) if g in scale]
    if not kept:
        return NOT_TESTED
    r, j = (np.concatenate([part[i] / np.sqrt(scale[part[3]]) for part in kept], axis=-1) for i in (1, 2))
    common = Unexplained(r, j, np.zeros(r.size, dtype=int))
    square = common.square - sum(u.square / scale[g] for u, _, _, g in kept)
    freedom = common.freedom - sum(u.freedom for u, *_ in kept)
    return excess(square / freedom, freedom, 1.0, min(freedoms)) if freedom > 0 else NOT_TESTED


def holm(p: np.ndarray) -> np.ndarray:
    """Return p-values adjusted by the method of Holm, Scand. J. Statist. 6 (1979) 65-70; NaN is not counted."""
    count = np.count_nonzero(~np.isnan(p))
    order = np.argsort(p, kind="stable")[:count]
    adjusted = np.full(p.shape, np.nan)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(p[order] * np.arange(count, 0, -1)))
    return adjusted


# Degrees of freedom of a spectrum, below which it is mostly assumed.
SHAPE_KNOWN = 4.0
ADEQUACY_LEVEL = 0.01
SHAPES = 20
ADEQUACY_TESTS = ("whiteness", "harmonics", "size", "amplitude", "consistency")
ADEQUATE, MISSPECIFIED = with_tone("adequate", GOOD), with_tone("misspecified", BAD)
UNTESTED = with_tone("not tested", NEUTRAL)
# In place of "adequate" where a fault of the recording, such as an amplitude that changes, counts as noise.
UNSOUND = with_tone("recording not sound", CAUTION)
MEASURED_SPECTRUM, ASSUMED_SPECTRUM = "measured", "assumed"
ALL = "all"
SEARCH = "bp.missing_terms(problem, fit) looks for the term that is missing"
ONE_START = "one start was tried, and others may lead to a better fit: give starts=8"


def adequacy(
    problem: Problem, here: Linearisation, noise: np.ndarray, replicates: Mapping[tuple[str, str], np.ndarray]
) -> pd.DataFrame:
    """Return the table of `Prediction`: the p-values of all tests and the verdicts.

    The linearisation is that at a draw near the best fit. Noise parameters are draws (draws, noise_names), replicates
    of the data (draws, points) by experiment and channel, NaN outside the mask and for failed solves.
    """
    import pandas as pd

    shapes = np.median(noise, axis=0)[None] if problem.likelihood.white else noise[:: max(1, len(noise) // SHAPES)]
    rows: dict[str, dict[str, Any]] = {}
    white = [Whitened(problem, here, shape) for shape in shapes]
    for i, block in enumerate(problem.likelihood.blocks):
        if not block.counted or block.channel in problem.quantities:
            continue
        # The spectrum of correlated noise is known from draws only: the p of the realised residual is their mean.
        whiteness, harmonics, harmonic = np.array([w.spectral_tests(i) for w in white]).T
        size, share = _size(problem, here, i, white[0])
        rows[f"{block.experiment} {block.channel}"] = {
            "experiment": block.experiment,
            "channel": block.channel,
            "whiteness": whiteness.mean(),
            "harmonics": harmonics.mean(),
            "harmonic": harmonic[0],
            "size": size,
            "model_error_share": share,
            "spectrum": ASSUMED_SPECTRUM if white[0].spectrum(i) is None else MEASURED_SPECTRUM,
            "amplitude": _amplitude(problem, block, replicates),
        }
    rows |= {quantity: _table_row(problem, quantity, white[0]) for quantity in problem.quantities}
    consistent = np.mean([w.consistency() for w in white])
    rows[ALL] = {"experiment": ALL, "channel": ALL, "spectrum": "", "consistency": consistent}
    columns = ["experiment", "channel", *ADEQUACY_TESTS, "harmonic", "model_error_share", "spectrum"]
    table = pd.DataFrame.from_dict(rows, orient="index", columns=columns)
    adjusted = adjusted_p(table)
    smallest = np.min(np.where(np.isnan(adjusted), np.inf, adjusted), axis=1)
    smallest[-1] = min(smallest)
    table["p"] = np.where(np.isinf(smallest), np.nan, smallest)
    faults = faulty(problem)
    unsound = table["experiment"].isin(faults | {ALL} if faults else set())
    verdicts = [UNTESTED, MISSPECIFIED, UNSOUND]
    table["verdict"] = np.select([np.isinf(smallest), smallest < ADEQUACY_LEVEL, unsound], verdicts, ADEQUATE)
    return table


def _table_row(problem: Problem, quantity: str, white: Whitened) -> dict[str, Any]:
    """Return the tests of a quantity that was measured in several experiments."""
    members = rows_of(problem, quantity)
    r, j, _ = (np.concatenate(parts, axis=-1) for parts in zip(*(white.parts[b] for b in members), strict=True))
    size = NOT_TESTED
    if white.groups[members[0]] in white.known and testable(r, j):
        left = Unexplained(r, j, np.ones(r.size, dtype=int))
        size = excess(left.square / left.freedom, left.freedom, 1.0, np.inf) if left.freedom else NOT_TESTED
    return {
        "experiment": ALL,
        "channel": quantity,
        "whiteness": serial_correlation(r, j),
        "size": size,
        "spectrum": "",
    }


def faulty(problem: Problem) -> set[str]:
    """Return the experiments whose recordings have faults that are not harmless."""
    return {e.name for e in problem.experiments if any(finding.severity != HARMLESS for finding in e.findings)}


REJECTIONS = {
    "whiteness": "the residual is not white",
    "harmonics": "the residual has excess power in some harmonics",
    "size": "the residual is larger than the measured noise",
    "amplitude": "the amplitude differs from the predicted one",
    "consistency": "the experiments and channels are inconsistent with common parameters",
}


def rejections(table: pd.DataFrame) -> dict[str, str]:
    """Return the rejections of a table in words, by row."""
    texts = {}
    for (label, row), small in zip(table.iterrows(), adjusted_p(table) < ADEQUACY_LEVEL, strict=True):
        if reasons := [f"{REJECTIONS[test]} (p = {row[test]:.2g})" for test in compress(ADEQUACY_TESTS, small)]:
            error, harmonic = row["model_error_share"], row["harmonic"]
            text = "" if np.isnan(harmonic) else f"; its strongest harmonic is {harmonic:.0f}"
            if harmonic > 1:
                kind = "odd" if harmonic % 2 else "even"
                text += f", as where a force {kind} in the motion is missing, if the drive is a sine"
            text += "" if np.isnan(error) else f"; {error:.1%} of the residual variance is model error"
            texts[str(label)] = f"{', '.join(reasons)}{text}"
    return texts


def misfit(problem: Problem, fit: MapEstimate) -> str:
    """Return why the model is misspecified at an estimate, in words; "" if it is not, or not fitted to the data."""
    if fit.other_orbits or fit.prior_conflict.members:
        return ""
    if fit.checks is None or (reason := fit.checks.misfit) is None:
        theta = problem.vector(fit.theta)
        guesses = {name: solution.states for name, solution in fit.solutions.items()}
        here = problem.anchored(theta, guesses).density().linearise(theta)
        noise = problem.noise_values({name: fit.noise[name] for name in problem.noise_names})
        reason = misfit_at(problem, Iterate(theta, here, noise, np.nan), len(fit.starts))
    return reason and f"{reason}; the verdicts take the model for right"


def misfit_at(problem: Problem, estimate: Iterate, starts: int) -> str:
    """Return why the model is misspecified at an estimate, in words; "" if no test rejects it, or if there is none.

    The best of few starts can be a local optimum of a right model.
    """
    if not estimate.here.converged:
        return ""
    table = adequacy(problem, estimate.here, estimate.noise[None], {})
    if not (rejected := rejections(table)):
        return ""
    reasons = "; ".join(f"{label}: {text}" for label, text in rejected.items())
    subject, remedy = ("model or the noise model", "") if concerns_noise(table) else ("model", f"; {SEARCH}")
    return f"The {subject} is misspecified ({reasons}){remedy}{f'; {ONE_START}' if starts == 1 else ''}"


def concerns_noise(table: pd.DataFrame) -> bool:
    """Return whether a wrong noise model would explain the rejections as well as a wrong model.

    A measured spectrum of the noise, or a residual larger than the measured noise, tells the two apart.
    """
    import pandas as pd

    rejected = pd.DataFrame(adjusted_p(table) < ADEQUACY_LEVEL, table.index, ADEQUACY_TESTS)
    measured = rejected[["whiteness", "harmonics"]][table["spectrum"] == MEASURED_SPECTRUM]
    return table.loc[ALL, "verdict"] == MISSPECIFIED and not (rejected["size"].any() or measured.any(axis=None))


def adjusted_p(table: pd.DataFrame) -> np.ndarray:
    """Return the p-values (rows, tests) of a table, adjusted for their total number."""
    return holm(table[[*ADEQUACY_TESTS]].to_numpy(dtype=float).ravel()).reshape(len(table), -1)


class Whitened:
    """Residual components and their derivatives in units of the noise for parameters (names,) of the noise model.

    If there are fewer independent values than components, the measured period is a smooth curve, and only the
    components of the lowest harmonics are used, as many as independent values.
    """

    def __init__(self, problem: Problem, here: Any, noise: np.ndarray):
        likelihood = problem.likelihood
        self.blocks = likelihood.blocks
        names = [problem.noise.parameter_names(block) for block in self.blocks]
        self.groups = [variances[0] if variances else "known" for variances in names]
        each = zip(self.groups, names, strict=True)
        self.known = frozenset(group for group, variances in each if set(variances) <= set(likelihood.fixed))
        white = zip(*(likelihood.whitened(part, noise) for part in (here.residuals, here.jacobian)), strict=True)
        self.parts = [used(block, *both) for block, both in zip(self.blocks, white, strict=True)]
        self._plain, self._likelihood, self._noise = (here.residuals, here.jacobian), likelihood, noise
        self._experiments = {e.name: e for e in problem.experiments}

    def spectrum(self, index: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the measured variances of the components of a block, see `measured_spectrum`."""
        block = self.blocks[index]
        return measured_spectrum(self._experiments[block.experiment], block)

    def spectral_tests(self, index: int) -> tuple[float, float, float]:
        """Return p of whiteness and of the harmonic content of a block, and the strongest harmonic.

        Where the spectrum of the noise was measured between the harmonics, the components are in its units. The shape
        of the spectrum of repeated quantisation errors is not known, and whiteness is not tested where they prevail.
        """
        r, j, harmonic = self.parts[index]
        if not self.blocks[index].timed or not testable(r, j):
            return NOT_TESTED, NOT_TESTED, NOT_TESTED
        unexplained = self.in_measured_units(index) or Unexplained(r, j, harmonic)
        spectrum = self.spectrum(index)
        known = spectrum is None or np.median(spectrum[1]) >= SHAPE_KNOWN
        return unexplained.whiteness().p if known else NOT_TESTED, *unexplained.harmonic_content()

    def in_measured_units(self, index: int) -> Unexplained | None:
        """Return what is unexplained of a block in units of the measured spectrum; None if that is not known."""
        spectrum = self.spectrum(index)
        if spectrum is None:
            return None
        r, j, harmonic = self.in_units_of_noise(index)
        return Unexplained.of_measured_noise(r, j, harmonic, spectrum[1])

    def in_units_of_noise(self, index: int) -> list[np.ndarray]:
        """Return components, derivatives and harmonics of a block in units of the measured spectrum, if it is known."""
        return self._in_units_of(index, self._by_spectrum)

    def in_measured_sd(self, index: int) -> Unexplained:
        """Return what is unexplained of a block in units of the measured standard deviation of its values."""
        return Unexplained(*self._in_units_of(index, self._by_scatter))

    def _in_units_of(self, index: int, precision: Callable[[int], np.ndarray]) -> list[np.ndarray]:
        """Return components, derivatives and harmonics of a block in units of noise with precisions (size,) by block.

        The noise of inputs is added; components of all blocks of an experiment that it moves together are decorrelated.
        """
        shared = next((one for one in self._likelihood.shared if index in one.members), None)
        members = shared.members if shared else (index,)
        p, parts = [precision(b) for b in members], []
        for vectors in self._plain:
            scaled = [vectors[b] * np.sqrt(weights) for b, weights in zip(members, p, strict=True)]
            parts.append((shared.whitened(scaled, p) if shared else scaled)[members.index(index)])
        return used(self.blocks[index], *parts)

    def _by_spectrum(self, index: int) -> np.ndarray:
        """Return the inverse of the measured variances of the components, of one value's where these are not known."""
        spectrum = self.spectrum(index)
        return self._by_scatter(index) if spectrum is None else 1.0 / spectrum[0][self.blocks[index].harmonic]

    def _by_scatter(self, index: int) -> np.ndarray:
        """Return the weight over the measured variance of a value, over the estimated one where it is not known."""
        block = self.blocks[index]
        if block.measured > 0.0:
            return np.full(block.size, block.weight / block.measured)
        return np.broadcast_to(self._likelihood.precisions([index], self._noise)[0], (block.size,))

    def consistency(self) -> float:
        """Return p of the test of common parameters."""
        parts = [(r, j, g) for (r, j, _), g in zip(self.parts, self.groups, strict=True) if testable(r, j)]
        return consistency(parts, self.known) if len(parts) == len(self.parts) else NOT_TESTED


def _size(problem: Problem, here: Linearisation, index: int, white: Whitened) -> tuple[float, float]:
    """Return p of a residual larger than the measured or known noise, and the fraction of model error."""
    block = white.blocks[index]
    known = block.measured > 0.0 or white.groups[index] in white.known
    if not (known and testable(here.residuals[index], here.jacobian[index])):
        return NOT_TESTED, NOT_TESTED
    if block.measured > 0.0:
        unexplained = white.in_measured_sd(index)
        e = next(e for e in problem.experiments if e.name == block.experiment)
        # Unequal variances reduce the degrees of freedom of a sum of squares.
        evenness, behind = _evenness(e, block), measured_freedom(e, block.channel)
    else:
        unexplained, evenness, behind = Unexplained(*white.parts[index]), 1.0, np.inf
    if not unexplained.freedom:
        return NOT_TESTED, NOT_TESTED
    variance = unexplained.square / unexplained.freedom
    share = max(0.0, 1.0 - 1.0 / variance) if variance > 0.0 else 0.0
    if (relative := white.in_measured_units(index)) is not None:
        return float(chdtrc(relative.freedom, relative.square)) if relative.freedom else NOT_TESTED, share
    return excess(variance, unexplained.freedom * evenness, 1.0, behind), share


def _evenness(experiment: Experiment, block: Block) -> float:
    """Return the effective fraction of degrees of freedom for unequal variances of the harmonics (Satterthwaite)."""
    if block.channel not in experiment.amplitude_variance:
        return 1.0
    variance = experiment.amplitude_variance[block.channel]
    each = np.concatenate([variance[:1], np.repeat(0.25 * variance[1:], 2)])
    return float(each.sum() ** 2 / (each.size * np.sum(each**2)))


def measured_spectrum(experiment: Experiment, block: Block) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the measured variances of a block's components and their degrees of freedom, (harmonics + 1,) each.

    None where the spectrum of the noise was not measured in all harmonics of the block.
    """
    variance = experiment.amplitude_variance.get(block.channel)
    freedom = experiment.amplitude_freedom.get(block.channel)
    if not block.spectral or not block.harmonic.size or variance is None or freedom is None:
        return None
    harmonics = np.unique(block.harmonic)
    nyquist = 2 * harmonics[-1] == block.points
    if nyquist or harmonics[-1] >= variance.size or not np.all(variance[harmonics] > 0.0):
        return None
    return block.size * variance * np.where(np.arange(variance.size) == 0, 1.0, 0.25), freedom


def measured_freedom(experiment: Experiment, channel: str) -> float:
    """Return the degrees of freedom of the measured variance of one value (Satterthwaite); infinite for one cycle."""
    if experiment.cycles < 2:
        return np.inf
    if channel not in experiment.amplitude_variance:
        return (experiment.cycles - 1) * experiment.independent[channel]
    variance = experiment.amplitude_variance[channel]
    values = np.where(np.arange(variance.size) == 0, 1.0, 2.0)
    each = variance / values
    by_cycles = (experiment.cycles - 1) * values
    return float(each.sum() ** 2 / np.sum(each**2 / experiment.amplitude_freedom.get(channel, by_cycles)))


def _amplitude(problem: Problem, block: Block, replicates: Mapping[tuple[str, str], np.ndarray]) -> float:
    """Return the two-sided posterior predictive p of the rms about the mean, assumed normal."""
    if (block.experiment, block.channel) not in replicates:
        return NOT_TESTED
    e = next(e for e in problem.experiments if e.name == block.experiment)
    mask = e.measured_points
    values = e.compared(block.channel, replicates[block.experiment, block.channel])[:, mask]
    rms = values[np.isfinite(values).all(axis=1)].std(axis=1)
    sd = rms.std(ddof=1) if rms.size > 1 else 0.0
    if not sd > 0.0:
        return NOT_TESTED
    score = (e.outputs[block.channel][mask].std() - rms.mean()) / (sd * np.sqrt(1.0 + 1.0 / rms.size))
    return float(2.0 * stdtr(rms.size - 1, -abs(score)))
