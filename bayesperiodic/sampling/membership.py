"""Whether a unit belongs to a population: tests with a stated false-alarm rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import ndtri, stdtr

from bayesperiodic._io import Result
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.population_density import Parameters
from bayesperiodic.sampling.population_units import UnitDraws

if TYPE_CHECKING:
    import pandas as pd

# Pareto k̂ above which, and effective draws below which, a unit's draws are no importance sample.
USABLE_WEIGHTS, FEWEST_EFFECTIVE = 0.7, 50.0
# Probability to find a deviation that is as large as estimated; most repeats that are considered; simulated units.
REQUIRED_POWER, MOST_REPEATS, SIMULATED_UNITS = 0.9, 1000, 20_000


@dataclass(frozen=True)
class MembershipTest(Result):
    """Whether a unit is a member of a population, by `Population.test`.

    Attributes
    ----------
    unit : str
    member : bool
        False if any p-value is below its level.
    table : DataFrame
        One row per parameter, and "all" if there are several. ``estimate`` and ``sd`` of the unit by its data alone, in
        sampling coordinates (logarithms of positive parameters), ``expected`` and ``spread`` of a new unit without the
        noise of its data; ``p``, the probability that a member deviates at least as much; ``repeats``, how many
        repeats of the unit's experiments would find a deviation of this size in 90 % of the cases, infinite if the
        spread of the population hides it however often they are repeated.
    level : float
        Level of each p-value: the false-alarm rate over their number.
    false_alarm : float
        Probability that a member is called different, at most.

    Examples
    --------
    >>> units, spread = dict.fromkeys(["1", "2", "3"], posterior), {"k": bp.HalfNormal(0.01)}
    >>> verdict = bp.population(units, ["k"], spread=spread, seed=1, progress=False).test(posterior)
    >>> isinstance(verdict, bp.MembershipTest), verdict.differing
    (True, ())
    """

    unit: str
    member: bool
    table: pd.DataFrame
    level: float
    false_alarm: float

    @property
    def differing(self) -> tuple[str, ...]:
        """Parameters in which the unit is no member."""
        return tuple(str(name) for name, p in self.table["p"].items() if p < self.level and name != TOGETHER)

    def __repr__(self) -> str:
        table = self.table.to_string(float_format="{:.4g}".format)
        return f"Membership of {self.unit!r}\n{table}\n{self.verdict}"

    @property
    def verdict(self) -> str:
        """The result in words."""
        rate = f"false-alarm rate {self.false_alarm:.2g}"
        if not self.member:
            where = f" in {', '.join(self.differing)}" if self.differing else " in the combination of the parameters"
            return f"The unit lies outside the population{where}: p = {self.table['p'].min():.2g} ({rate})."
        finite = self.table["repeats"][np.isfinite(self.table["repeats"])]
        needed = [f"{name} {count:.0f}" for name, count in finite.items()]
        tail = f"; repeats that would show deviations of the size seen: {', '.join(needed)}" if needed else ""
        return f"No difference from the population is shown ({rate}){tail}. That does not show that there is none."


TOGETHER = "all"


class UnitEstimate(NamedTuple):
    """What the data of a unit alone say: mean and covariance of its likelihood, and the k̂ of dividing by the prior."""

    mean: np.ndarray
    covariance: np.ndarray
    pareto_k: float


def estimate(unit: UnitDraws) -> UnitEstimate:
    """Return the normal approximation of a unit's likelihood."""
    k = convergence.pareto_k(unit.log_weights)
    weights = np.exp(unit.log_weights - unit.log_weights.max())
    weights /= weights.sum()
    mean = weights @ unit.centres
    offset = unit.centres - mean
    return UnitEstimate(mean, (weights[:, None] * offset).T @ offset + unit.kernel, k)


class Expected(NamedTuple):
    """Members as they are expected: draws of mean (draws, d) and covariance (draws, d, d), their weights and tails."""

    means: np.ndarray
    covariances: np.ndarray
    weights: np.ndarray
    degrees: float

    @classmethod
    def of(
        cls, parameters: Parameters, covariates: np.ndarray, degrees: float, weights: np.ndarray | None = None
    ) -> Expected:
        """Return what is expected of a unit with covariates (covariates,)."""
        means = parameters.means + parameters.slopes @ covariates
        count = len(means)
        even = np.full(count, 1.0 / count)
        return cls(means, parameters.covariance, even if weights is None else weights, degrees)

    @property
    def centre(self) -> np.ndarray:
        """Mean (d,)."""
        return self.weights @ self.means

    @property
    def covariance(self) -> np.ndarray:
        """Scale matrix of a new unit (d, d), the uncertainty of the mean included."""
        offset = self.means - self.centre
        return np.einsum("k,kab->ab", self.weights, self.covariances) + (self.weights[:, None] * offset).T @ offset

    def single(self, given: UnitEstimate) -> np.ndarray:
        """Return the p-value of each parameter (d,): that a member's estimate deviates at least as much."""
        sd = np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2) + np.diag(given.covariance))
        size, offset = np.abs(given.mean - self.centre), self.means - self.centre
        # of a normal distribution if `degrees` is infinite
        tails = stdtr(self.degrees, (offset - size) / sd) + stdtr(self.degrees, -(size + offset) / sd)
        return np.minimum(self.weights @ tails, 1.0)

    def joint(self, given: UnitEstimate, generator: np.random.Generator) -> float:
        """Return the p-value of all parameters together, by simulated units; at least 1/SIMULATED_UNITS."""
        inverse = np.linalg.inv(self.covariance + given.covariance)
        row = generator.choice(len(self.weights), SIMULATED_UNITS, p=self.weights)
        factor = np.linalg.cholesky(self.covariances + given.covariance)[row]
        offset = np.einsum("nab,nb->na", factor, generator.standard_normal((SIMULATED_UNITS, len(self.centre))))
        if np.isfinite(self.degrees):
            offset /= np.sqrt(generator.chisquare(self.degrees, SIMULATED_UNITS) / self.degrees)[:, None]
        offset += self.means[row] - self.centre
        difference = given.mean - self.centre
        distances, distance = np.einsum("na,ab,nb->n", offset, inverse, offset), difference @ inverse @ difference
        return float((1 + np.sum(distances >= distance)) / (1 + SIMULATED_UNITS))


def _repeats(difference: float, spread: float, variance: float, level: float) -> float:
    """Return how many repeats find a deviation of this size; infinite if the spread of the population hides it."""
    counts = np.arange(1, MOST_REPEATS + 1)
    limit = -ndtri(0.5 * level) * np.sqrt(spread**2 + variance / counts)
    enough = difference >= limit + ndtri(REQUIRED_POWER) * np.sqrt(variance / counts)
    return float(counts[enough][0]) if enough.any() else np.inf


def membership(
    name: str, unit: UnitDraws, names: Sequence[str], expected: Expected, false_alarm: float, seed: int
) -> MembershipTest:
    """Return the test of one unit."""
    import pandas as pd

    given = estimate(unit)
    if not given.pareto_k <= USABLE_WEIGHTS:
        raise ValueError(
            f"new: must have data that determine {', '.join(names)} better than its prior does, got a Pareto k of "
            f"{given.pareto_k:.2g} for the weights without the prior. Give the unit a wider prior."
        )
    p, several = expected.single(given), len(names) > 1
    level = false_alarm / (len(names) + several)
    spread, variances = np.sqrt(np.diag(expected.covariance)), np.diag(given.covariance)
    repeats = [
        _repeats(abs(given.mean[k] - expected.centre[k]), spread[k], variances[k], level) for k in range(len(names))
    ]
    columns = {
        "estimate": given.mean, "sd": np.sqrt(variances), "expected": expected.centre, "spread": spread, "p": p,
        "repeats": repeats,
    }  # fmt: skip
    table = pd.DataFrame(columns, index=list(names))
    if several:
        row = dict.fromkeys(columns, np.nan) | {"p": expected.joint(given, np.random.default_rng(seed))}
        table.loc[TOGETHER] = row
    return MembershipTest(name, bool((table["p"] >= level).all()), table, level, false_alarm)
