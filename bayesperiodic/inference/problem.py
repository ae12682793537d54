"""Problem: a model, experiments and priors, and the posterior density they define."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesperiodic import checks, fourier
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.inference.joint_prior import JointPrior
from bayesperiodic.inference.parameters import ParameterMap
from bayesperiodic.models.model import Model
from bayesperiodic.periodic.batch import Anchor, Batch
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.equations import PeriodicEquations, Solved
from bayesperiodic.periodic.schemes import Scheme
from bayesperiodic.periodic.solution import PeriodicSolution, describe
from bayesperiodic.periodic.solve import solve_from_rest


@dataclass(frozen=True)
class Evaluation:
    """The model against the data at one θ: residuals e = y − ŷ and ∂ŷ/∂θ, both within the harmonics kept.

    Attributes
    ----------
    solutions : dict of str to PeriodicSolution
    residuals : dict of str to dict of str to array (points,)
        By experiment and channel.
    sensitivities : dict of str to dict of str to array (names, points)
    """

    solutions: dict[str, PeriodicSolution]
    residuals: dict[str, dict[str, np.ndarray]]
    sensitivities: dict[str, dict[str, np.ndarray]]


class Problem:
    """What the estimator and the samplers work on ([1]_, eq. 5-6).

    Errors are taken as independent and normal with an unknown variance per channel, Jeffreys' prior 1/v unless the
    variance is fixed. The density is over (θ, log v),

        −½ Σ_β [ n_β ln v_β + M_β / v_β ] + Σ_α ln p(θ_α),

    where n_β counts the independent values behind the samples of channel β, and M_β weighs each squared residual by
    independent values per sample. It is eq. (6) where every sample is independent. Outputs are projected onto the
    harmonics that the experiment keeps before they are compared.

    Parameters
    ----------
    model : Model
    experiments : sequence of Experiment
    priors : mapping of str or tuple of str to prior
        Makes a parameter free; a tuple of names takes a `MultivariateNormal`. A frozen continuous distribution of
        scipy.stats is a prior too.
    fixed : mapping of str to float or to mapping of str to float, optional
        Values of other parameters, for all experiments or by experiment; ``"variance[force]"`` fixes the variance of a
        channel.
    tied : mapping of str to str, optional
        The remaining parameters as expressions of others, such as ``{"theta11": "-1e5*theta4"}``: numbers, names, pi,
        + - * / ** and sqrt, exp, log, sin, cos, tan, atan, sinh, cosh, tanh, abs.
    scheme : str or Scheme
        See `solve_periodic`.

    Raises
    ------
    ValueError
        For a parameter that is not just one of free, fixed and tied, or is in two priors, an expression that is not
        allowed or circular, a value that is no prior or does not fit its tuple of names, an unknown name, an experiment
        without the model's inputs or with outputs that the model lacks, no more independent values than free parameters
        in a channel whose variance is unknown, an autonomous model.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.
    """

    def __init__(
        self,
        model: Model,
        experiments: Iterable[Experiment],
        *,
        priors: Mapping[Any, Any],
        fixed: Mapping[str, float | Mapping[str, float]] | None = None,
        tied: Mapping[str, str] | None = None,
        scheme: str | Scheme = "central2",
    ):
        if model.autonomous:
            raise ValueError(
                f"model: {model.name!r} is not allowed; it is autonomous (neither inputs nor tau appear in its "
                "equations), and problems take forced models."
            )
        self.model = model
        self.experiments = _checked_experiments(model, experiments)
        measured = {channel for experiment in self.experiments for channel in experiment.outputs}
        self.channels = tuple(channel for channel in model.outputs if channel in measured)
        fixed = dict(fixed or {})
        variance_names = {f"variance[{channel}]": channel for channel in self.channels}
        self.joint_prior = JointPrior.of(priors, model.parameters)
        self.names = self.joint_prior.names
        for name in self.names:
            if name in fixed:
                raise ValueError(f"fixed: {name!r} has a prior too; give a prior or a value.")
        for name in fixed:
            checks.one_of("fixed", name, (*model.parameters, *variance_names))
        if not self.names:
            raise ValueError("priors: {} is not allowed; at least one parameter must be free.")
        self.fixed = {n: _constant(n, fixed[n], self.experiments) for n in model.parameters if n in fixed}
        self.parameter_maps = {
            e.name: ParameterMap.of(
                model.parameters, self.names, {n: v[e.name] for n, v in self.fixed.items()}, tied or {}
            )
            for e in self.experiments
        }
        self.fixed_variances = {
            channel: checks.positive(f"fixed[{name!r}]", fixed[name])
            for name, channel in variance_names.items()
            if name in fixed
        }
        self.free_variances = tuple(c for c in self.channels if c not in self.fixed_variances)
        self.scheme = scheme
        self.independent = np.array(
            [sum(e.independent.get(c, 0) for e in self.experiments) for c in self.channels], dtype=float
        )
        self._check_counts()
        self._anchors: dict[str, Anchor] | None = None

    def _check_counts(self) -> None:
        for channel, count in zip(self.channels, self.independent, strict=True):
            if channel in self.free_variances and count <= len(self.names):
                raise ValueError(
                    f"priors: {len(self.names)} free parameters ({', '.join(self.names)}) are not allowed; the channel "
                    f"{channel!r} has only {count:.0f} independent values and its variance is unknown. Fix parameters "
                    f"or 'variance[{channel}]', keep more harmonics, or add experiments."
                )

    @cached_property
    def equations(self) -> dict[str, PeriodicEquations]:
        """The discretised equations of every experiment."""
        return {
            e.name: PeriodicEquations.build(
                self.model,
                e.inputs,
                frequency=e.frequency,
                samples=e.samples,
                scheme=self.scheme,
                periods=e.periods,
                winding=e.winding,
            )
            for e in self.experiments
        }

    @property
    def anchors(self) -> dict[str, Anchor]:
        """Solved points from which `log_posterior` predicts all others; at the medians of the priors unless set."""
        if self._anchors is None:
            self._anchors = self._anchors_at(self.median())
        return self._anchors

    def anchored(self, theta: Mapping[str, float] | np.ndarray) -> "Problem":
        """Return the same problem with its anchors at another θ, solved from the present ones."""
        other = object.__new__(Problem)
        other.__dict__.update(self.__dict__)
        other.__dict__.pop("_batches", None)
        other._anchors = self._anchors_at(self.vector(theta))
        return other

    def _anchors_at(self, theta: np.ndarray) -> dict[str, Anchor]:
        anchors = {}
        for name, equations in self.equations.items():
            parameters = self.parameters(theta[None], name)[0]
            z, code, _ = self._solve_one(name, parameters, self._anchors)
            anchors[name] = (
                Anchor.at(equations, parameters, z)
                if code == CONVERGED
                else Anchor(parameters, equations.static_guess(parameters))
            )
        return anchors

    def _solve_one(self, name: str, parameters: np.ndarray, anchors: dict[str, Anchor] | None) -> Solved:
        """Solve one experiment from its anchor, if there are any, or else from rest."""
        if anchors:
            solved = self.equations[name].solve(parameters, anchors[name].z)
            if solved.code == CONVERGED:
                return solved
        return solve_from_rest(self.equations[name], parameters)[0]

    @cached_property
    def _batches(self) -> list[tuple[tuple[Experiment, ...], Batch]]:
        """Experiments on the same grid and with the same constants, with what solves them together."""
        groups: dict[tuple[Any, ...], list[Experiment]] = {}
        for e in self.experiments:
            constants = tuple(values[e.name] for values in self.fixed.values())
            groups.setdefault((e.samples, e.periods, constants), []).append(e)
        return [
            (tuple(group), Batch([self.equations[e.name] for e in group], [self.anchors[e.name] for e in group]))
            for group in groups.values()
        ]

    @property
    def tied(self) -> dict[str, str]:
        """The expressions of the tied parameters."""
        any_map = next(iter(self.parameter_maps.values()))
        return {name: expression.text for name, expression in any_map.tied.items()}

    @property
    def priors(self) -> dict[str | tuple[str, ...], Any]:
        """The priors by the keys they were given with, in the order of the model's parameters."""
        return self.joint_prior.blocks

    def median(self) -> np.ndarray:
        """Return the medians of the priors, (names,)."""
        return self.joint_prior.median()

    def vector(self, theta: Mapping[str, float] | np.ndarray | Sequence[float]) -> np.ndarray:
        """Return θ as an array (…, names) from a mapping or an array."""
        if isinstance(theta, Mapping):
            checks.same_names("theta", theta, self.names)
            theta = np.stack(np.broadcast_arrays(*(np.asarray(theta[name], dtype=float) for name in self.names)), -1)
        values = np.asarray(theta, dtype=float)
        if values.shape[-1:] != (len(self.names),):
            raise ValueError(f"theta: shape {values.shape} is not allowed; the last axis must be {list(self.names)}.")
        return values

    def _variances(self, variances: Mapping[str, Any] | np.ndarray) -> np.ndarray:
        if isinstance(variances, Mapping):
            given = {**self.fixed_variances, **variances}
            checks.same_names("variances", given, self.channels)
            variances = np.stack(np.broadcast_arrays(*(np.asarray(given[c], dtype=float) for c in self.channels)), -1)
        values = np.asarray(variances, dtype=float)
        if values.shape[-1:] != (len(self.channels),):
            raise ValueError(
                f"variances: shape {values.shape} is not allowed; the last axis must be {list(self.channels)}."
            )
        return values

    def log_prior(self, theta: Mapping[str, float] | np.ndarray) -> np.ndarray:
        """Return Σ ln p(θ_α), shape (…); −inf outside the support."""
        return self.joint_prior.log_prob(self.vector(theta))

    def log_likelihood(self, theta: Mapping[str, float] | np.ndarray, variances: Any) -> np.ndarray:
        """Return −½ Σ_β [n_β ln v_β + M_β/v_β], shape (…); −inf where a periodic solve fails."""
        return self.likelihood_from_moments(self.moments(theta)[0], self._variances(variances))

    def log_posterior(self, theta: Mapping[str, float] | np.ndarray, variances: Any) -> np.ndarray:
        """Return log-prior plus log-likelihood, shape (…), a density over (θ, log v)."""
        values = self.vector(theta)
        prior = np.asarray(self.log_prior(values))
        result = np.full(prior.shape, -np.inf)
        inside = np.isfinite(prior)
        if inside.any():
            v = np.broadcast_to(self._variances(variances), (*prior.shape, len(self.channels)))
            result[inside] = prior[inside] + self.log_likelihood(values[inside], v[inside])
        return result

    def likelihood_from_moments(self, moments: np.ndarray, variances: np.ndarray) -> np.ndarray:
        """Return −½ Σ_β [n_β ln v_β + M_β/v_β] of moments and variances (…, channels)."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            terms = self.independent * np.log(variances) + moments / variances
            value = -0.5 * terms.sum(axis=-1)
        return np.where(np.isfinite(value), value, -np.inf)

    def moments(
        self, theta: Mapping[str, float] | np.ndarray, threads: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return M (…, channels), the diagonal of the moment matrix (eq. 6), and the worst status code, shape (…).

        M is infinite where a periodic solve fails. The result does not depend on the number of threads.
        """
        values = self.vector(theta)
        flat = values.reshape(-1, len(self.names))
        moments = np.zeros((len(flat), len(self.channels)))
        status = np.full(len(flat), CONVERGED)
        for experiments, batch in self._batches:
            y, codes, _ = batch.solve(self.parameters(flat, experiments[0].name), threads)
            status = np.maximum(status, codes.max(axis=0))
            with np.errstate(over="ignore", invalid="ignore"):
                for experiment, predicted in zip(experiments, y, strict=True):
                    for c, channel in enumerate(self.channels):
                        if channel in experiment.outputs:
                            output = predicted[:, :, self.model.outputs.index(channel)]
                            moments[:, c] += self._moment(experiment, channel, output)
        moments[(status != CONVERGED) | ~np.isfinite(moments).all(axis=1)] = np.inf
        return moments.reshape(*values.shape[:-1], -1), status.reshape(values.shape[:-1])

    def _moment(self, experiment: Experiment, channel: str, predicted: np.ndarray) -> np.ndarray:
        """Return independent · (mean square of y − ŷ within the kept harmonics), one a row of `predicted`."""
        count = experiment.independent[channel]
        target = self._kept_amplitudes.get((experiment.name, channel))
        if target is None:
            return count * np.mean((experiment.outputs[channel] - predicted) ** 2, axis=-1)
        amplitudes = fourier.coefficients(predicted, target.size - 1) - target
        power = amplitudes.real**2 + amplitudes.imag**2
        return count * (power[..., 0] + 0.5 * power[..., 1:].sum(axis=-1))

    @cached_property
    def _kept_amplitudes(self) -> dict[tuple[str, str], np.ndarray]:
        return {
            (e.name, channel): fourier.coefficients(e.outputs[channel], kept)
            for e in self.experiments
            for channel, kept in e.harmonics.items()
            if channel in e.outputs
        }

    def outputs(self, theta: Mapping[str, float] | np.ndarray) -> tuple[dict[str, dict[str, np.ndarray]], np.ndarray]:
        """Return ŷ of many θ (draws, names), by experiment and channel (draws, points), and which solves converged."""
        values = self.vector(theta)
        converged = np.full(len(values), True)
        result = {}
        for experiments, batch in self._batches:
            y, codes, _ = batch.solve(self.parameters(values, experiments[0].name))
            converged &= (codes == CONVERGED).all(axis=0)
            for e, predicted in zip(experiments, y, strict=True):
                result[e.name] = {channel: predicted[:, :, self.model.outputs.index(channel)] for channel in e.outputs}
        return {e.name: result[e.name] for e in self.experiments}, converged

    def solve(self, theta: Mapping[str, float] | np.ndarray) -> dict[str, PeriodicSolution]:
        """Return the periodic solution of every experiment at one θ."""
        values, solutions = self.vector(theta), {}
        for name, equations in self.equations.items():
            parameters = self.parameters(values[None], name)[0]
            solutions[name] = describe(equations, parameters, self._solve_one(name, parameters, self.anchors))
        return solutions

    def evaluate(self, theta: Mapping[str, float] | np.ndarray) -> Evaluation:
        """Solve at one θ and compare with the data (eq. 4-5)."""
        values = self.vector(theta)
        solutions = self.solve(values)
        residuals: dict[str, dict[str, np.ndarray]] = {}
        sensitivities: dict[str, dict[str, np.ndarray]] = {}
        for e in self.experiments:
            solution = solutions[e.name]
            if not solution.converged:
                continue
            residuals[e.name] = {c: y - e.project(c, solution.outputs[c]) for c, y in e.outputs.items()}
            slopes = self.parameter_maps[e.name].slopes(values).T
            sensitivities[e.name] = {
                c: e.project(c, slopes @ np.stack([solution.sensitivities[c][p] for p in self.model.parameters]))
                for c in e.outputs
            }
        return Evaluation(solutions, residuals, sensitivities)

    def sample_prior(self, size: int, seed: int) -> dict[str, np.ndarray]:
        """Return independent draws of every free parameter from its prior, (size,) each."""
        draws = self.joint_prior.sample(size, np.random.default_rng(seed))
        return dict(zip(self.names, draws.T.copy(), strict=True))

    def parameters(self, theta: np.ndarray, experiment: str) -> np.ndarray:
        """Return every parameter of the model (points, parameters) in an experiment from θ (points, names)."""
        return self.parameter_maps[experiment].values(theta)

    def __repr__(self) -> str:
        return (
            f"Problem({self.model.name!r}, {len(self.experiments)} experiments, free: {', '.join(self.names)}, "
            f"channels: {', '.join(self.channels)} with {self.independent.sum():.0f} independent values)"
        )


def _constant(name: str, given: Any, experiments: tuple[Experiment, ...]) -> dict[str, float]:
    """Return the value of a fixed parameter in each experiment."""
    if not isinstance(given, Mapping):
        return dict.fromkeys((e.name for e in experiments), checks.finite_number(f"fixed[{name!r}]", given))
    checks.same_names(f"fixed[{name!r}]", given, [e.name for e in experiments])
    return {e.name: checks.finite_number(f"fixed[{name!r}][{e.name!r}]", given[e.name]) for e in experiments}


def _checked_experiments(model: Model, experiments: Iterable[Experiment]) -> tuple[Experiment, ...]:
    result = tuple(experiments)
    if not result:
        raise ValueError("experiments: () is not allowed; at least one experiment is needed.")
    names = [experiment.name for experiment in result]
    if len(set(names)) < len(names):
        raise ValueError(f"experiments: the names {names} are not allowed; they must differ, see fold(name=…).")
    for experiment in result:
        checks.same_names(f"inputs of experiment {experiment.name!r}", experiment.inputs, model.inputs)
        for channel in experiment.outputs:
            checks.one_of(f"outputs of experiment {experiment.name!r}", channel, model.outputs)
    return result
