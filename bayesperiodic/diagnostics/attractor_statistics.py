"""Statistics of free runs and of pieces of a chaotic recording, and their tests."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from bayesperiodic._verdicts import BAD, GOOD, with_tone
from bayesperiodic.diagnostics.free_runs import Recorded
from bayesperiodic.diagnostics.predictive import PROBABILITY
from bayesperiodic.estimation.adequacy import ADEQUACY_LEVEL, ALL, UNTESTED, holm
from bayesperiodic.orbits.coordinates import wrapped
from bayesperiodic.orbits.lyapunov import Growth, growth_of_pieces

if TYPE_CHECKING:
    import pandas as pd

CONSISTENT, DIFFERENT = with_tone("consistent", GOOD), with_tone("different", BAD)
DENSITY, LEFT, SETTLED, LYAPUNOV = "density", "runs that leave", "runs that settle", "Lyapunov exponent"
# Fewest runs or pieces of the recording for a test.
FEWEST_PIECES = 10
# The region of the recording: its quantiles from this one on, and the margin as a fraction of their distance.
OUTERMOST, MARGIN = 1e-3, 0.25
# A run has settled if its last points repeat within this fraction of the section's size, after at most so many returns.
REPEATING, REPEATS_WITHIN, LONGEST_CYCLE = 10, 0.02, 4
# Mean number of the runs' points in a bin, bins along a coordinate, and random divisions of the recording.
POINTS_EACH, COARSEST_BINS, FINEST_BINS, DIVISIONS = 20, 3, 64, 999
# Largest fraction of starts without a fit that does not prevent a verdict.
MOST_UNFITTED = 0.1


class Runs(NamedTuple):
    """Runs whose start was fitted."""

    points: np.ndarray  # in the section, NaN after an overflow, (runs, returns, d)
    growth: np.ndarray  # mean logarithm of growth in a period after the first ones, (runs,)
    left: np.ndarray  # whether they leave the region of the recording, (runs,)
    misfit: np.ndarray  # of the first period, also of starts that were not fitted


def region(recorded: Recorded) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of the region of the recording in each of its outputs, (channels,)."""
    signals = recorded.samples.signals[:, recorded.columns]
    low, high = np.quantile(signals, [OUTERMOST, 1.0 - OUTERMOST], axis=0)
    return low - MARGIN * (high - low), high + MARGIN * (high - low)


class Statistics:
    """Statistics of runs and of the pieces of a recording, and their tests."""

    def __init__(self, recorded: Recorded, runs: Runs, pieces: np.ndarray, generator: np.random.Generator):
        section = recorded.section
        self.recorded, self.runs, self.generator = recorded, runs, generator
        self.turning = np.isin(section.coordinates, section.angles)
        self.size = np.where(self.turning, 2.0 * np.pi, np.ptp(section.points, axis=0))
        self.noise = section.noise
        self.measured = section.points[pieces]
        sd = 0.0 if self.noise is None else self.noise
        self.points = wrapped(runs.points + sd * generator.standard_normal(runs.points.shape), self.turning)
        self.stays = ~runs.left
        self.settled = self._settles(runs.points) & self.stays
        self.measured_settled = self._settles(self.measured)
        self.measured_left = self._measured_left(pieces)

    def _settles(self, points: np.ndarray) -> np.ndarray:
        """Return which of some series (series, points, d) repeat themselves at their ends."""
        repeats = []
        for period in range(1, LONGEST_CYCLE + 1):
            away = wrapped(points[:, period:] - points[:, :-period], self.turning) / self.size
            repeats.append(np.abs(away[:, -REPEATING:]).max(axis=(1, 2)) < REPEATS_WITHIN)
        return np.any(repeats, axis=0)

    def _measured_left(self, pieces: np.ndarray) -> np.ndarray:
        """Return which pieces of the recording leave its region."""
        low, high = region(self.recorded)
        signals = self.recorded.samples.signals[:, self.recorded.columns]
        outside = ~np.all((low <= signals) & (signals <= high) | self.recorded.turning, axis=1)
        counts = np.append(0, np.cumsum(outside))
        ends = self.recorded.instants[pieces[:, [0, -1]]]
        first, last = np.searchsorted(self.recorded.samples.time, ends).T
        return counts[last] > counts[first]

    def table(self) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Return the tests, and the exponents."""
        import pandas as pd

        exponents, difference = self._exponents()
        rows = {DENSITY: self._density()}
        rows[LEFT] = self.share(self.runs.left, self.measured_left)
        rows[SETTLED] = self.share(self.settled, self.measured_settled)
        one, other = exponents["local_maps"]
        spread = ndtri(0.5 + 0.5 * PROBABILITY) * difference.sd
        p = 2.0 * ndtr(-abs(difference.mean) / difference.sd)
        rows[LYAPUNOV] = (one, other, other - spread, other + spread, float(p))
        table = pd.DataFrame.from_dict(rows, "index", columns=["model", "recording", "low", "high", "p"])
        adjusted = holm(table["p"].to_numpy())
        tested = table["p"].notna().to_numpy()
        table["verdict"] = np.select([~tested, adjusted < ADEQUACY_LEVEL], [UNTESTED, DIFFERENT], CONSISTENT)
        few = len(self.runs.points) < (1.0 - MOST_UNFITTED) * len(self.runs.misfit)
        whole = UNTESTED if few or not tested.any() else CONSISTENT
        table.loc[ALL] = [np.nan] * 4 + [
            float(np.nanmin(adjusted)), DIFFERENT if (table["verdict"] == DIFFERENT).any() else whole
        ]  # fmt: skip
        return table, exponents

    @staticmethod
    def share(ours: np.ndarray, theirs: np.ndarray) -> tuple[float, ...]:
        """Return fractions of runs and pieces, the 90 % interval of the latter, and p of Fisher's one-sided test."""
        from scipy.stats import binomtest, fisher_exact

        counts = np.array([[one.sum(), (~one).sum()] for one in (ours, theirs)], dtype=int)
        interval = binomtest(int(counts[1, 0]), theirs.size).proportion_ci(PROBABILITY)
        p = fisher_exact(counts, alternative="greater")[1]
        return float(ours.mean()), float(theirs.mean()), float(interval.low), float(interval.high), float(p)

    def _density(self) -> tuple[float, ...]:
        """Return the distance of the densities, that of the recording from itself, its range, and p."""
        model = self.points[self.stays]
        if len(model) < FEWEST_PIECES:
            return (np.nan,) * 5
        counts = self._counts(np.concatenate([model, self.measured]), len(model))
        ours, theirs = counts[: len(model)], counts[len(model) :]
        distance = 0.5 * np.abs(ours.sum(0) / ours.sum() - theirs.sum(0) / theirs.sum()).sum()
        every, part = len(theirs), min(len(model), len(theirs) // 2)
        scale = np.sqrt((1 / len(model) + 1 / every) / (1 / part + 1 / (every - part)))
        chance = np.empty(DIVISIONS)
        for k in range(DIVISIONS):
            some = self.generator.permutation(every)[:part]
            one = theirs[some].sum(0)
            rest = theirs.sum(0) - one
            chance[k] = scale * 0.5 * np.abs(one / one.sum() - rest / rest.sum()).sum()
        p = (1 + np.sum(chance >= distance)) / (DIVISIONS + 1)
        return float(distance), float(np.median(chance)), *map(float, np.quantile(chance, [0.05, 0.95])), float(p)

    def _counts(self, series: np.ndarray, runs: int) -> np.ndarray:
        """Return the counts (series, bins) of the points of series (series, points, d), the first those of runs."""
        low = np.where(self.turning, -np.pi, self.measured.min(axis=(0, 1)))
        width = np.where(self.turning, 2.0 * np.pi, np.ptp(self.measured, axis=(0, 1)))
        best = np.zeros((len(series), 1))
        for number in range(COARSEST_BINS, FINEST_BINS + 1):
            boxes = np.floor((series - low) / width * number).astype(np.int64)
            _, which = np.unique(boxes.reshape(-1, boxes.shape[-1]), axis=0, return_inverse=True)
            which = which.reshape(boxes.shape[:2])
            occupied = np.unique(which[runs:]).size
            if number > COARSEST_BINS and occupied * POINTS_EACH > min(runs, len(series) - runs) * series.shape[1]:
                break
            best = np.zeros((len(series), which.max() + 1))
            np.add.at(best, (np.arange(len(series))[:, None], which), 1.0)
        return best

    def _exponents(self) -> tuple[pd.DataFrame, Growth]:
        """Return the exponents of model and recording, and the difference of those by local maps, all in 1/s."""
        import pandas as pd

        some, frequency = np.flatnonzero(self.stays & ~self.settled), self.recorded.frequency
        growth, chaotic = self.runs.growth[self.stays], self.runs.growth[some]
        number = min(some.size, len(self.measured))
        columns = ["exponent", "sd", "local_maps", "local_maps_sd"]
        table = pd.DataFrame(np.nan, index=["model", "recording"], columns=columns)
        if growth.size > 1:
            table.loc["model", ["exponent", "sd"]] = growth.mean(), growth.std(ddof=1) / np.sqrt(growth.size)
        if number < FEWEST_PIECES or self.noise is None:
            return frequency * table, Growth(np.nan, np.nan)
        turn = np.where(self.turning, 2.0 * np.pi, np.inf) / self.size
        chosen = self.generator.permutation(some)[:number], self.generator.permutation(len(self.measured))[:number]
        ours, theirs = (
            growth_of_pieces(points / self.size, self.noise / self.size, turn)
            for points in (self.points[chosen[0]], self.measured[chosen[1]])
        )
        bias, difference = ours.mean - chaotic.mean(), float(np.hypot(ours.sd, theirs.sd))
        table.loc["model", ["local_maps", "local_maps_sd"]] = ours.mean, ours.sd
        table.loc["recording"] = [theirs.mean, np.hypot(theirs.sd, bias), theirs.mean, theirs.sd]
        return frequency * table, Growth(frequency * (ours.mean - theirs.mean), frequency * difference)
