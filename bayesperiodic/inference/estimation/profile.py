"""Profiles: the best log-density for every value of one parameter, found by following the ridge from the estimate."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq
from scipy.special import ndtri

from bayesperiodic import checks
from bayesperiodic.blas import in_one_thread
from bayesperiodic.inference.estimation.estimate import MapEstimate
from bayesperiodic.inference.estimation.gauss_newton import Iterate, Objective, bias_correction
from bayesperiodic.inference.estimation.ridge import Point, Ridge
from bayesperiodic.inference.linearisation import Linearisation
from bayesperiodic.inference.parameters import SHIFT
from bayesperiodic.inference.problem import Problem
from bayesperiodic.parallel import checked_executor, team
from bayesperiodic.store import Result

WIDEST = 0.99
BETTER = 1e-4
CLOSED, ONE_SIDED, FLAT = "closed", "one-sided", "flat"


@dataclass(frozen=True)
class Profile(Result):
    """The best log-density for every value of a parameter, all others and the noise parameters being free.

    Attributes
    ----------
    map, sd : dict of str to float
        The estimate and its Laplace standard deviations, of all free parameters. The Laplace approximation of a profile
        is −improvement − ½((values − map)/sd)².
    values : dict of str to array (points,)
        By profiled parameter, ascending, in its unit.
    log_density : dict of str to array (points,)
        The profile there, relative to the best value found at all; NaN where no finite log-posterior was found.
    paths : dict of str to array (points, names)
        All free parameters along the profile, in the order of `map`; NaN where there is no profile.
    limits : dict of str to (float, float)
        The outermost values tried, close to the ends of the prior's support, or infinite.
    best : dict of str to float
        Where the best value was found: the estimate, unless there is a better one.
    improvement : float
        By how much the log-density is higher there than at the estimate.
    units : dict of str to str
        Of all free parameters.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = {"force": np.cos(2 * np.pi * np.arange(32) / 32)}
    >>> run = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, force, frequency=0.1, duration=400,
    ...                   sampling_rate=4, noise={"displacement": 0.01}, seed=1).fold(32)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)},
    ...                      fixed={"m": 1, "k3": 0.5}, scheme="fourier")
    >>> fit = bp.map_estimate(problem, progress=False)
    >>> found = bp.profile(problem, fit, ["k"])
    >>> found.shape, found.failed
    ({'k': 'closed'}, {'k': 0})
    >>> low, high = found.interval(0.95)["k"]
    >>> low < found.map["k"] < high
    True
    """

    map: dict[str, float]
    sd: dict[str, float]
    values: dict[str, np.ndarray]
    log_density: dict[str, np.ndarray]
    paths: dict[str, np.ndarray]
    limits: dict[str, tuple[float, float]]
    best: dict[str, float]
    improvement: float
    units: dict[str, str]

    @property
    def names(self) -> tuple[str, ...]:
        """The profiled parameters."""
        return tuple(self.values)

    @property
    def failed(self) -> dict[str, int]:
        """How many points of each profile have no finite log-posterior."""
        return {name: int(np.isnan(density).sum()) for name, density in self.log_density.items()}

    def interval(self, probability: float = 0.9) -> dict[str, tuple[float, float]]:
        """Return where each profile has dropped by ½χ² with one degree of freedom (likelihood ratio), outermost.

        Between points the root of the drop, a straight line for a parabola, is interpolated monotonically.

        Parameters
        ----------
        probability : float
            Above 0 and at most 0.99, which is as far as profiles are followed.

        Returns
        -------
        dict of str to (float, float)
            An end is −∞ or ∞ where the profile does not come down before the prior's support ends, NaN where solves
            fail before it has come down.

        Raises
        ------
        ValueError
            For any other probability.
        """
        if not 0.0 < checks.finite_number("probability", probability) <= WIDEST:
            raise ValueError(f"probability: {probability!r} is not allowed; it must be above 0 and at most {WIDEST}.")
        level = float(ndtri(0.5 + 0.5 * probability))
        result = {}
        for name, values in self.values.items():
            roots, (low, high) = np.sqrt(np.maximum(-2.0 * self.log_density[name], 0.0)), self.limits[name]
            below = -_crossing(-values[::-1], roots[::-1], level, -low)
            result[name] = below, _crossing(values, roots, level, high)
        return result

    @property
    def shape(self) -> dict[str, str]:
        """How many ends of the 99 % interval are finite: "closed" (both), "one-sided" or "flat" (none).

        An informative prior closes a profile too.
        """
        named = (FLAT, ONE_SIDED, CLOSED)
        return {name: named[int(np.isfinite(ends).sum())] for name, ends in self.interval(WIDEST).items()}

    @property
    def table(self) -> pd.DataFrame:
        """A row a profile: map, sd, the 90 % intervals of Laplace and of the profile, shape, points and failed."""
        half = float(ndtri(0.95))
        rows: dict[str, dict[str, object]] = {}
        for name, (low, high) in self.interval(0.9).items():
            at, sd = self.map[name], self.sd[name]
            rows[name] = {"map": at, "sd": sd, "laplace_low": at - half * sd, "laplace_high": at + half * sd}
            rows[name] |= {"low": low, "high": high, "shape": self.shape[name]}
            rows[name] |= {"points": self.values[name].size, "failed": self.failed[name]}
        return pd.DataFrame.from_dict(rows, orient="index")

    def __repr__(self) -> str:
        text = f"Profile, 90 % intervals:\n{self.table.to_string(float_format='{:.5g}'.format)}"
        if self.improvement > BETTER:
            text += f"\nThe log-density is higher by {self.improvement:.3g} at {_written(self.best)}."
        return text


def _crossing(values: np.ndarray, roots: np.ndarray, level: float, limit: float) -> float:
    """Return where the roots, right of the lowest, cross a level for the last time.

    Infinite if they do not up to the limit; NaN if solves fail before they have, or no root is below the level.
    """
    top = int(np.nanargmin(roots))
    found = top + np.flatnonzero(np.isfinite(roots[top:]))
    values, roots = values[found], roots[found]
    inside = np.flatnonzero(roots <= level)
    if not inside.size:
        return np.nan
    last = int(inside[-1])
    if last == values.size - 1:
        return np.inf if values[last] == limit else np.nan
    curve = PchipInterpolator(values, roots)
    return float(brentq(lambda x: float(curve(x)) - level, values[last], values[last + 1], xtol=1e-300, rtol=1e-14))


@in_one_thread
def profile(problem: Problem, fit: MapEstimate, names: Sequence[str] | None = None, *, executor: Any = None) -> Profile:
    """Follow the best log-density from the estimate along every parameter, outwards and back again.

    What is profiled is what `map_estimate` maximises: eq. (6) of [1]_ with the bias correction of eq. (7), the priors
    included. At every value of a parameter the staged iteration runs over all the others, started from its neighbour.
    Points are spaced by about half a standard deviation of the drop; they go on until the profile has dropped beyond
    what a 99 % interval takes, the prior's support ends, or solves fail. Then every point is started from its outer
    neighbour too, and the better value is kept: where branches cross, the way out stays on the first one for too long.

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
        Of this problem.
    names : sequence of str, optional
        Parameters to profile; by default all that are free.
    executor : None, int, Dask Client, or executor with the interface of concurrent.futures
        Who follows them, one parameter a task, as in `sample`: by default threads of this process. It does not change
        the result.

    Returns
    -------
    Profile

    Raises
    ------
    ValueError
        For an unknown name, an estimate that has no finite log-posterior in this problem, or an executor that takes no
        tasks.
    WorkersLost
        If the executor's workers died (a RuntimeError).

    Warns
    -----
    UserWarning
        If a profile finds a better point than the estimate.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = np.cos(2 * np.pi * np.arange(50) / 50)
    >>> true = bp.solve_periodic(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, {"force": force},
    ...                          frequency=0.1, samples=50)
    >>> run = bp.Experiment("run", 0.1, true.outputs, {"force": force}, samples=50)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.Normal(0.2, 0.1), "k": bp.Normal(1, 0.5)},
    ...                      fixed={"m": 1, "k3": 0.5, "variance[displacement]": 0.01})
    >>> profile = bp.profile(problem, bp.map_estimate(problem, progress=False))
    >>> profile.shape
    {'c': 'closed', 'k': 'closed'}
    >>> profile.table[["laplace_low", "low", "laplace_high", "high"]].round(2)
       laplace_low   low  laplace_high  high
    c         0.15  0.15          0.25  0.25
    k         0.94  0.94          1.06  1.06
    """
    chosen = _checked_names(problem, names)
    executor = checked_executor(executor)
    objective, peak = _at_estimate(problem, fit)
    with team(executor, (objective, peak)) as crew:
        found = dict(crew.run(_followed, [problem.names.index(name) for name in chosen]))
    top, best = peak.objective, peak.theta
    values, density, paths, limits = {}, {}, {}, {}
    for number, name in enumerate(chosen):
        limits[name], values[name], density[name], paths[name] = found[number]
        if np.nanmax(density[name]) > top:
            top, best = np.nanmax(density[name]), paths[name][np.nanargmax(density[name])]
    result = Profile(
        map=dict(fit.theta),
        sd=dict(fit.sd),
        values=values,
        log_density={name: value - top for name, value in density.items()},
        paths=paths,
        limits=limits,
        best=dict(zip(problem.names, best.tolist(), strict=True)),
        improvement=float(top - peak.objective),
        units={name: _unit(problem, name) for name in problem.names},
    )
    if result.improvement > BETTER:
        warnings.warn(
            f"The log-density is higher by {result.improvement:.3g} than at the estimate where "
            f"{_written(result.best)}; start there, map_estimate(problem, start=profile.best), and profile again.",
            UserWarning,
            stacklevel=3,
        )
    return result


def _checked_names(problem: Problem, names: Sequence[str] | None) -> tuple[str, ...]:
    if names is None:
        return problem.names
    if isinstance(names, str) or not len(names):
        raise ValueError(f"names: {names!r} is not allowed; it must be a sequence of names, such as {problem.names!r}.")
    for name in names:
        checks.one_of("names", name, problem.names)
    return tuple(dict.fromkeys(names))


def _at_estimate(problem: Problem, fit: MapEstimate) -> tuple[Objective, Iterate]:
    """Return what is maximised and where the estimate stands, its solves anchored at the estimate's own solutions."""
    checks.same_names("fit.theta", fit.theta, problem.names)
    checks.same_names("fit.noise", fit.noise, problem.noise_names)
    checks.same_names("fit.solutions", fit.solutions, [e.name for e in problem.experiments])
    theta = problem.vector(fit.theta)
    responses = problem.anchored(theta, {name: s.states for name, s in fit.solutions.items()}).responses
    objective = Objective(problem, bias_correction(problem), np.zeros(theta.size, dtype=bool))
    near = Linearisation(theta, responses, problem.comparisons)
    peak = objective.at(theta, near, np.array([fit.noise[name] for name in problem.noise_names]))
    if peak is None:
        raise ValueError(
            f"fit: {_written(fit.theta)} is not allowed; the log-posterior is not finite there. Give "
            "an estimate of this problem."
        )
    return objective, objective.anchored(peak)


def _followed(
    start: tuple[Objective, Iterate], column: int
) -> tuple[tuple[float, float], np.ndarray, np.ndarray, np.ndarray]:
    """Return the limits of the parameter in a column of θ, and the values, the objective and θ along its profile."""
    ridge = Ridge(start[0], column, start[1])
    return ridge.limits(), *_arrays(ridge.followed(), start[1].theta.size)


def _arrays(points: list[Point], size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the values, the objective and θ of points, NaN where there is none."""
    nothing = np.full(size, np.nan)
    return (
        np.array([value for value, _ in points]),
        np.array([np.nan if iterate is None else iterate.objective for _, iterate in points]),
        np.array([nothing if iterate is None else iterate.theta for _, iterate in points]),
    )


def _unit(problem: Problem, name: str) -> str:
    plain = name.partition("[")[0]
    return "s" if plain == SHIFT else problem.model.units.get(plain, "")


def _written(theta: dict[str, float]) -> str:
    return ", ".join(f"{name} = {value:.6g}" for name, value in theta.items())
