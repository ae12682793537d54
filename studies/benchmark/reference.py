"""The common reference of a problem: log-posteriors at the draws by fully converged, fine shooting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from studies.benchmark.integration import Discretised, discretise, exact
from studies.benchmark.problems import Setting

Way = TypeVar("Way", bound=Callable[[np.ndarray], float])

ALLOWED = 1e-2
# What experiments may be off, of what it were if their errors had either sign.
TRIES = (1.0, 0.5, 0.25, 0.1)
# Steps take a part of what an experiment may be off, the way to the steady state the rest.
SHARE = 0.5


@dataclass(frozen=True)
class Reference:
    """What every contender is held against.

    Attributes
    ----------
    setting : Setting
    parameters : list of array (draws, parameters + 1)
        One an experiment.
    exact : list of array (draws,)
        Log-likelihoods, one an experiment.
    uncertainty : float
        By how much steps twice as long would change a log-posterior.
    """

    setting: Setting
    parameters: list[np.ndarray]
    exact: list[np.ndarray]
    uncertainty: float

    @property
    def each(self) -> float:
        """What an experiment may be off, so that errors of either sign add up to what is allowed."""
        return ALLOWED / np.sqrt(len(self.exact))

    @property
    def log_posteriors(self) -> np.ndarray:
        """At the draws."""
        return self.log_priors + np.sum(self.exact, axis=0)

    @property
    def log_priors(self) -> np.ndarray:
        """At the draws."""
        return np.array([self.setting.log_prior(theta) for theta in self.setting.theta])

    def discretised(self) -> list[Discretised]:
        """Return every experiment with the fewest steps that are right enough."""
        return [
            discretise(case, p, e, SHARE * self.each)
            for case, p, e in zip(self.setting.cases, self.parameters, self.exact, strict=True)
        ]

    def tuned(
        self, choose: Callable[[int, np.ndarray, np.ndarray, float], Way | None], draws: int | None = None
    ) -> tuple[list[Way], float] | None:
        """Return the cheapest way to every experiment's log-likelihood that together are right, and their error.

        Parameters
        ----------
        choose : callable
            From the experiment's number, parameters and log-likelihoods at the draws and what it may be off, to the
            cheapest way, None if there is none.
        draws : int, optional
            The first so many alone, for what takes long.

        Returns
        -------
        tuple or None
            None where an experiment has none.
        """
        at = slice(draws)
        for share in TRIES:
            found = []
            for k, (p, e) in enumerate(zip(self.parameters, self.exact, strict=True)):
                one = choose(k, p[at], e[at], share * self.each)
                if one is None:
                    return None
                found.append(one)
            values = np.array([[one(row) for row in p[at]] for one, p in zip(found, self.parameters, strict=True)])
            error = self.error(self.log_priors[at] + values.sum(axis=0))
            if error <= ALLOWED:
                return found, error
        return found, error

    def error(self, log_posteriors: np.ndarray) -> float:
        """Return the largest error of log-posteriors at the first so many draws, infinite where one is not finite."""
        off = np.abs(log_posteriors - self.log_posteriors[: len(log_posteriors)])
        return float(off.max()) if np.isfinite(off).all() else np.inf


def refer(setting: Setting) -> Reference:
    """Return the reference of a problem."""
    parameters = [setting.parameters(setting.theta, case) for case in setting.cases]
    found = [exact(case, p) for case, p in zip(setting.cases, parameters, strict=True)]
    reference = Reference(setting, parameters, [values for values, _ in found], sum(off for _, off in found))
    if not reference.uncertainty < 0.1 * ALLOWED:
        raise RuntimeError(f"{setting.name}: the reference is uncertain by {reference.uncertainty:.1e}.")
    return reference
