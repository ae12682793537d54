"""The paper's Bayesian estimator: staged Gauss-Newton to the MAP point, and its Laplace covariance."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.special import stdtrit
from tqdm import tqdm

from bayesperiodic import checks
from bayesperiodic.expressions import Expression, parse_all
from bayesperiodic.inference.input_noise import input_noise
from bayesperiodic.inference.problem import Evaluation, Problem
from bayesperiodic.inference.whiteness import Whiteness, whiteness
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.store import Result

MAX_ITERATIONS = 100
MAX_HALVINGS = 30
SCALED_STEP = 1e-8
NOISE_SHARE = 0.1


@dataclass(frozen=True)
class MapEstimate(Result):
    """The maximum of the posterior density and the normal approximation around it.

    Attributes
    ----------
    status : str
        "converged", "stalled" (no step raised the objective), "iterations" (their limit was reached) or "singular".
    theta, sd : dict of str to float
        Estimates and their standard deviations, in natural values and the parameters' units.
    variances : dict of str to float
        Variance of the mean period of each channel, eq. (7) or as fixed.
    covariance : DataFrame (names × names)
        Inverse of H of eq. (8) at these variances.
    degrees_of_freedom : float
        Independent values less free parameters; infinite where all variances are fixed.
    independent : dict of str to float
        Independent values behind each channel.
    solutions : dict of str to PeriodicSolution
        By experiment.
    residuals : dict of str to dict of str to array (points,)
        y − ŷ within the kept harmonics, by experiment and channel.
    rms, fvu : dict of str to float
        Root mean square of the residuals of each channel, and their mean square over the variance of the measured
        channel (the fraction of variance unexplained).
    whiteness : dict of str to Whiteness
        By channel; with several experiments p is the smallest, corrected for their number, lag1 the mean.
    input_noise : dict of str to float
        Standard deviation that the noise of the measured inputs brings to each channel.
    history : array (iterations,)
        The objective before each step and at the end.
    tied : dict of str to dict of str to float
        Derivatives of the tied parameters by the free ones at the estimate; NaN where experiments differ.
    """

    status: str
    theta: dict[str, float]
    sd: dict[str, float]
    variances: dict[str, float]
    covariance: pd.DataFrame
    degrees_of_freedom: float
    independent: dict[str, float]
    solutions: dict[str, PeriodicSolution]
    residuals: dict[str, dict[str, np.ndarray]]
    rms: dict[str, float]
    fvu: dict[str, float]
    whiteness: dict[str, Whiteness]
    input_noise: dict[str, float]
    history: np.ndarray
    tied: dict[str, dict[str, float]]

    @property
    def converged(self) -> bool:
        """True if the status is "converged"."""
        return self.status == "converged"

    def interval(self, probability: float = 0.9) -> dict[str, tuple[float, float]]:
        """Return the equal-tailed interval of each parameter, Student's t with `degrees_of_freedom`.

        With few independent values a normal interval is too short, because the variance is estimated too.

        Raises
        ------
        ValueError
            If the probability is not between 0 and 1.
        """
        if not 0.0 < checks.finite_number("probability", probability) < 1.0:
            raise ValueError(f"probability: {probability!r} is not allowed; it must be between 0 and 1.")
        width = float(stdtrit(min(self.degrees_of_freedom, 1e9), 0.5 + 0.5 * probability))
        return {
            name: (value - width * self.sd[name], value + width * self.sd[name]) for name, value in self.theta.items()
        }

    def derive(self, expressions: Mapping[str, str]) -> pd.DataFrame:
        """Return quantities derived from the parameters, with standard deviations by the delta method.

        The standard deviation is √(gᵀ C g) with the exact gradient g by the free parameters and the `covariance` C:
        exact for linear combinations, otherwise good as far as the expression is straight within the uncertainty.

        Parameters
        ----------
        expressions : mapping of str to str
            By new name: numbers, names of parameters (free, fixed or tied), pi, + - * / ** and sqrt, exp, log, sin,
            cos, tan, atan, sinh, cosh, tanh, abs.

        Returns
        -------
        DataFrame
            Columns value and sd, a row a quantity; ``attrs["covariance"]`` holds the covariances between the quantities
            as a dict of dict of floats.

        Raises
        ------
        ValueError
            For an expression that is not allowed or has no finite value at the estimate, a new name that is no
            identifier or that a parameter has.

        Examples
        --------
        >>> import numpy as np, bayesperiodic as bp
        >>> force = np.cos(2 * np.pi * np.arange(50) / 50)
        >>> true = bp.solve_periodic(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, {"force": force},
        ...                          frequency=0.1, samples=50)
        >>> run = bp.Experiment("run", 0.1, true.outputs, {"force": force}, samples=50)
        >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.Normal(0.2, 0.1), "k": bp.Normal(1, 0.5)},
        ...                      fixed={"m": 1, "k3": 0.5, "variance[displacement]": 1e-4})
        >>> fit = bp.map_estimate(problem, progress=False)
        >>> fit.derive({"damping_ratio": "c/(2*sqrt(k*m))"}).round(4)
                       value      sd
        damping_ratio    0.1  0.0016
        """
        values = self._fixed() | self.theta
        quantities = parse_all("expressions", expressions, values)
        at = {name: float(quantity.value(values)) for name, quantity in quantities.items()}
        for name, value in at.items():
            if not np.isfinite(value):
                raise ValueError(
                    f"expressions[{name!r}]: {quantities[name].text!r} is not allowed; it is {value} at the estimate "
                    "and must be finite."
                )
        covariance = _carried(self.covariance, [self._gradient(q, values) for q in quantities.values()])
        with np.errstate(invalid="ignore"):
            sd = np.sqrt(np.diag(covariance))
        table = pd.DataFrame({"value": list(at.values()), "sd": sd}, index=list(at))
        table.attrs["covariance"] = {
            name: dict(zip(at, row, strict=True)) for name, row in zip(at, covariance.tolist(), strict=True)
        }
        return table

    def _gradient(self, quantity: Expression, values: dict[str, float]) -> dict[str, np.ndarray]:
        """Return the derivatives by the free parameters, those through tied ones included."""
        partial = quantity.gradient(values, [*self.theta, *self.tied])
        return {
            name: partial[name] + sum((partial[t] * slopes[name] for t, slopes in self.tied.items()), np.array(0.0))
            for name in self.theta
        }

    def _fixed(self) -> dict[str, float]:
        """Return the parameters that have the same value in all solutions and are not free, tied ones among them."""
        first, *others = (solution.parameters for solution in self.solutions.values())
        return {
            name: value
            for name, value in first.items()
            if name not in self.theta and all(other.get(name) == value for other in others)
        }

    def __repr__(self) -> str:
        lines = [f"MapEstimate ({self.status}), estimate ± Laplace sd:"]
        lines += [f"  {name:12s} {value:12.6g} ± {self.sd[name]:.3g}" for name, value in self.theta.items()]
        lines += [f"  rms of {c}: {self.rms[c]:.4g}, unexplained variance {self.fvu[c]:.2%}" for c in self.rms]
        return "\n".join(lines)


def map_estimate(problem: Problem, *, start: Mapping[str, float] | None = None, progress: bool = True) -> MapEstimate:
    """Find the MAP point by staged Gauss-Newton and the Laplace covariance there ([1]_, eq. 7-8).

    Each iteration solves the channel variances from eq. (7) with its bias correction,
    v_β = M_β / [n_β (1 − l/Σn)], which is s·Σe²/(nNs − l) for equal counts, and then updates θ by eq. (8). Printed
    there, the right-hand side lacks the prior's gradient (θ̄ − θ)/σ², without which the iteration would not end at a
    maximum of eq. (6); it is added. Where convex log-priors outweigh the data, H is not positive definite, and steps
    (not the covariance) take their curvature with the opposite sign. Steps are halved until the objective,
    −½ Σ n_β (1 − l/Σn) ln M_β + Σ ln p(θ), rises.

    Parameters
    ----------
    problem : Problem
    start : mapping of str to float, optional
        A first guess of every free parameter; by default the medians of the priors.
    progress : bool
        Show the iterations, with the objective and the step in standard deviations.

    Returns
    -------
    MapEstimate

    Raises
    ------
    ValueError
        If the log-posterior is not finite at the start, or a name is unknown.

    Warns
    -----
    UserWarning
        If the noise of the measured inputs brings more than a tenth of the residual to an output.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.
    """
    theta = problem.median() if start is None else problem.vector(start)
    evaluation, objective = _objective(problem, theta)
    if not np.isfinite(objective):
        raise ValueError(_not_finite(problem, theta, evaluation))
    history, status = [objective], "iterations"
    bar = tqdm(range(MAX_ITERATIONS), desc="MAP", unit="iteration", leave=False, disable=not progress)
    for _ in bar:
        hessian, gradient = _hessian_and_gradient(problem, theta, evaluation)
        hessian = _uphill(problem, theta, hessian)
        try:
            step = np.linalg.solve(hessian, gradient)
            size = float(np.max(np.abs(step) / np.sqrt(np.abs(np.diag(np.linalg.inv(hessian))))))
        except np.linalg.LinAlgError:
            status = "singular"
            break
        damping, accepted = 1.0, False
        for _ in range(MAX_HALVINGS):
            candidate, value = _objective(problem, theta + damping * step)
            if value > objective or (size < 1e3 * SCALED_STEP and value >= objective - 1e-6):
                accepted = True
                break
            damping *= 0.5
        if not accepted:
            status = "converged" if size < 1e-4 else "stalled"
            break
        theta, evaluation, objective = theta + damping * step, candidate, value
        history.append(objective)
        bar.set_postfix_str(f"objective {objective:.6g}, step {damping * size:.2g} sd")
        if damping == 1.0 and size < SCALED_STEP:
            status = "converged"
            break
    bar.close()
    return _describe(problem, theta, evaluation, status, np.array(history))


def moments(problem: Problem, evaluation: Evaluation) -> np.ndarray:
    """Return M_β = Σ (independent/points) e² of each channel (eq. 6)."""
    total = np.zeros(len(problem.channels))
    for e in problem.experiments:
        for channel, residual in evaluation.residuals[e.name].items():
            total[problem.channels.index(channel)] += e.independent[channel] * np.mean(residual**2)
    return total


def variances(problem: Problem, moment: np.ndarray) -> np.ndarray:
    """Return v_β = M_β / [n_β (1 − l/Σn)] (eq. 7), or the fixed values."""
    share = 1.0 - len(problem.names) / problem.independent.sum()
    v = moment / (problem.independent * share)
    for channel, value in problem.fixed_variances.items():
        v[problem.channels.index(channel)] = value
    return v


def _objective(problem: Problem, theta: np.ndarray) -> tuple[Evaluation | None, float]:
    prior = float(problem.log_prior(theta))
    if not np.isfinite(prior):
        return None, -np.inf
    evaluation = problem.evaluate(theta)
    if not all(solution.converged for solution in evaluation.solutions.values()):
        return evaluation, -np.inf
    moment = moments(problem, evaluation)
    share = 1.0 - len(problem.names) / problem.independent.sum()
    value = prior
    for c, channel in enumerate(problem.channels):
        if channel in problem.fixed_variances:
            value -= 0.5 * moment[c] / problem.fixed_variances[channel]
        else:
            value -= 0.5 * problem.independent[c] * share * np.log(max(moment[c], np.finfo(float).tiny))
    return evaluation, value


def _hessian_and_gradient(
    problem: Problem, theta: np.ndarray, evaluation: Evaluation | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return H of eq. (8) and the gradient of the objective, the prior's part included in both."""
    assert evaluation is not None
    v = variances(problem, moments(problem, evaluation))
    hessian, gradient = problem.joint_prior.curvature(theta), problem.joint_prior.gradient(theta)
    for e in problem.experiments:
        for channel, sensitivity in evaluation.sensitivities[e.name].items():
            residual = evaluation.residuals[e.name][channel]
            weight = e.independent[channel] / residual.size / v[problem.channels.index(channel)]
            hessian += weight * sensitivity @ sensitivity.T
            gradient += weight * sensitivity @ residual
    return hessian, gradient


def _uphill(problem: Problem, theta: np.ndarray, hessian: np.ndarray) -> np.ndarray:
    """Return H such that a step goes up: where convex log-priors outweigh the data their curvature changes sign."""
    try:
        np.linalg.cholesky(hessian)
    except np.linalg.LinAlgError:
        curvature = np.diag(problem.joint_prior.curvature(theta))
        return hessian + np.diag(2.0 * np.maximum(-curvature, 0.0))
    return hessian


def _tied_slopes(problem: Problem, theta: np.ndarray) -> dict[str, dict[str, float]]:
    each = np.array([parameter_map.slopes(theta) for parameter_map in problem.parameter_maps.values()])
    common = np.where(np.ptp(each, axis=0) == 0.0, each[0], np.nan)
    slopes = dict(zip(problem.model.parameters, common.tolist(), strict=True))
    return {name: dict(zip(problem.names, slopes[name], strict=True)) for name in problem.tied}


def _describe(
    problem: Problem, theta: np.ndarray, evaluation: Evaluation | None, status: str, history: np.ndarray
) -> MapEstimate:
    assert evaluation is not None
    hessian, _ = _hessian_and_gradient(problem, theta, evaluation)
    try:
        covariance = np.linalg.inv(hessian)
    except np.linalg.LinAlgError:
        covariance = np.full_like(hessian, np.inf)
    with np.errstate(invalid="ignore"):
        sd = np.sqrt(np.diag(covariance))
    names = problem.names
    v = variances(problem, moments(problem, evaluation))
    rms = {c: _pooled(c, evaluation.residuals) for c in problem.channels}
    measured = {e.name: {c: y - y.mean() for c, y in e.outputs.items()} for e in problem.experiments}
    free = len(problem.free_variances) > 0
    result = MapEstimate(
        status=status,
        theta=dict(zip(names, theta.tolist(), strict=True)),
        sd=dict(zip(names, sd.tolist(), strict=True)),
        variances=dict(zip(problem.channels, v.tolist(), strict=True)),
        covariance=pd.DataFrame(covariance, index=list(names), columns=list(names)),
        degrees_of_freedom=float(problem.independent.sum() - len(names)) if free else np.inf,
        independent=dict(zip(problem.channels, problem.independent.tolist(), strict=True)),
        solutions=evaluation.solutions,
        residuals=evaluation.residuals,
        rms=rms,
        fvu={c: rms[c] ** 2 / _pooled(c, measured) ** 2 for c in problem.channels},
        whiteness={c: _whiteness(problem, evaluation, c) for c in problem.channels},
        input_noise=input_noise(problem, theta, evaluation.solutions),
        history=history,
        tied=_tied_slopes(problem, theta),
    )
    for channel, noise in result.input_noise.items():
        if noise > NOISE_SHARE * rms[channel]:
            warnings.warn(
                f"The noise of the measured inputs, differentiated, brings {noise:.3g} to {channel!r}, "
                f"{noise / rms[channel]:.0%} of the residual's {rms[channel]:.3g}; keep fewer input harmonics "
                "(fold(harmonics=…)) or measure the derivative.",
                UserWarning,
                stacklevel=3,
            )
    return result


def _carried(covariance: pd.DataFrame, gradients: list[dict[str, np.ndarray]]) -> np.ndarray:
    """Return the covariance of quantities with these gradients; what a quantity does not depend on has no say."""
    matrix = covariance.to_numpy()
    rows = [np.array([float(gradient[name]) for name in covariance.columns]) for gradient in gradients]
    result = np.zeros((len(rows), len(rows)))
    with np.errstate(invalid="ignore", over="ignore"):
        for i, a in enumerate(rows):
            for j, b in enumerate(rows):
                result[i, j] = a[a != 0.0] @ matrix[np.ix_(a != 0.0, b != 0.0)] @ b[b != 0.0]
    return result


def _pooled(channel: str, signals: Mapping[str, Mapping[str, np.ndarray]]) -> float:
    values = np.concatenate([channels[channel] for channels in signals.values() if channel in channels])
    return float(np.sqrt(np.mean(values**2)))


def _whiteness(problem: Problem, evaluation: Evaluation, channel: str) -> Whiteness:
    tests = [
        whiteness(evaluation.residuals[e.name][channel], e.harmonics.get(channel))
        for e in problem.experiments
        if channel in e.outputs
    ]
    return Whiteness(min(1.0, len(tests) * min(t.p for t in tests)), float(np.mean([t.lag1 for t in tests])))


def _not_finite(problem: Problem, theta: np.ndarray, evaluation: Evaluation | None) -> str:
    given = dict(zip(problem.names, theta, strict=True))
    values = ", ".join(f"{name} = {value:.6g}" for name, value in given.items())
    if names := problem.joint_prior.excluding(theta):
        low, high = problem.joint_prior.supports[names[0]]
        excluded = ", ".join(f"{name} = {given[name]:.6g}" for name in names)
        return (
            f"start: {excluded} is not allowed; the log-posterior is not finite there, the prior's support is "
            f"({low:g}, {high:g})."
        )
    statuses = {} if evaluation is None else {n: s.status for n, s in evaluation.solutions.items() if not s.converged}
    return (
        f"start: {values} is not allowed; the log-posterior is not finite there, the periodic solve ended with "
        f"{statuses}. Start elsewhere."
    )
