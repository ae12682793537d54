"""Problem: a model, experiments and priors, and the posterior density they define."""

import math
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.initial_orbits import measured_orbits
from bayesperiodic.density.log_posterior import NATURAL, RIDGE_COORDINATES, SAMPLED, Evaluation, LogPosterior
from bayesperiodic.density.orbit_check import MOST_UNEXPLAINED, other_orbit, unexplained
from bayesperiodic.density.responses import Guesses, ResponseSolver
from bayesperiodic.likelihood.input_noise import EXACT, InputErrors, same
from bayesperiodic.models.model import CondensedModel
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.problem import problem_text
from bayesperiodic.problem.description import Description, written_out
from bayesperiodic.problem.problem_file import ProblemFile

METHODS = ("adjoint", "forward")


class Problem(Description):
    r"""A model, experiments and priors, and the posterior density that they define.

    A problem is immutable; `replace` returns another one.

    The density ([1]_, eq. 5-6) is over (θ, log φ), φ the noise parameters. With independent errors, the paper's model,
    φ is the variance of each channel with Jeffreys' prior 1/v, and the density is

    .. math::

        -\frac{1}{2} \sum_\beta \left[ n_\beta \ln v_\beta + \frac{M_\beta}{v_\beta} \right]
        + \sum_\alpha \ln p(\theta_\alpha),

    where n_β is the number of independent values of channel β, and M_β weighs each squared residual by
    independent values per sample. It is eq. (6) where every sample is independent. Outputs are projected onto the
    harmonics that the experiment keeps before they are compared, angles are compared modulo 2π.

    Parameters
    ----------
    model : Model
        For an autonomous model the measured frequency, with its standard error, is data too.
    experiments : sequence of Experiment
    priors : mapping of str or tuple of str to prior
        Makes a parameter free; a tuple of names takes a `MultivariateNormal`. A frozen continuous distribution of
        scipy.stats is a prior too. The name "shift" makes the delay [s] of all measured outputs a parameter of each
        experiment, beside those of `sensors`; an autonomous model, whose phase is free, always has it.
    fixed : mapping of str to float or to mapping of str to float, optional
        Values of other parameters, for all experiments or by experiment; a name such as ``"variance[force]"`` fixes a
        noise parameter.
    tied : mapping of str to str, optional
        The remaining parameters as expressions of others, such as ``{"theta11": "-1e5*theta4"}``: numbers, names, pi,
        + - * / ** and sqrt, exp, log, sin, cos, tan, atan, sinh, cosh, tanh, abs.
    local : sequence of str
        Free parameters that each experiment has its own of, called ``theta16[run 7]``. Their prior goes by the plain
        name, or by that of one experiment; an experiment may have a fixed value instead.
    noise : str or noise model
        "independent", "measured", "relative" or "circulant", or a model of `bayesperiodic.noise`.
    scheme : str or Scheme, optional
        See `solve_periodic`.
    input_noise : "measured", "exact", "joint" or mapping of str to float or array (amplitudes, amplitudes)
        Errors of the measured inputs. "measured": with the variances that `fold` found, averaged over neighbouring
        harmonics, in experiments of at least two cycles; the inputs of others are exact. A mapping gives the standard
        deviation of one value of the mean period, white noise, or the covariance of mean, cosines and sines of the
        harmonics kept, as many amplitudes as these. The true inputs, with a flat prior, are integrated out, linearised
        about the estimate; see `MapEstimate.input_errors`. "joint": as "measured", but the amplitudes of the errors are
        parameters of each experiment, ``force_mean``, ``force_cos1``, ``force_sin1``, …, in the unit of the input.
    sensors : mapping of str to Sensor, optional
        Gain, offset, delay and filter of measured outputs and inputs, numbers or priors. The model's outputs are
        compared as their sensors show them, and its inputs are the measured ones, corrected. The parameters are called
        ``gain[force]``, those of `local` ones ``gain[force, run 7]``; `priors` and `fixed` may name them.
    input_errors : mapping of str to InputErrors, optional
        Errors of the inputs by experiment, linearised about an estimate, see `with_input_errors`.
    anchors : mapping of str to InitialOrbit, optional
        Orbits from which the periodic solves of each experiment start, see `anchored`; by default near the medians of
        the priors.

    Raises
    ------
    ValueError
        For a parameter that is not just one of free, fixed and tied, or is in two priors, an expression that is not
        allowed or circular, a value that is no prior or does not fit its tuple of names, an unknown name, an experiment
        without the model's inputs or with outputs that the model lacks or that are constant, a sensor of something else
        or one that cannot be corrected, no more independent values
        than free parameters behind a variance whose prior is improper, an autonomous model whose measured frequency has
        no standard error.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.

    Examples
    --------
    >>> problem  # doctest: +NORMALIZE_WHITESPACE
    Problem('duffing', 1 experiments, free: c, k, data: displacement with 11 independent values, independent noise,
    noise of force integrated out)
    >>> at = {"c": 0.2, "k": 1.0}, {"displacement": 1e-6}
    >>> bool(problem.log_posterior(*at) > problem.log_posterior({"c": 0.2, "k": 1.1}, at[1]))
    True
    >>> problem.gradient(*at).shape, problem.solve(at[0])["synthetic duffing"].status
    ((3,), 'converged')
    """

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Build the problem of a problem file; no text in it is executed.

        The format, a table for each argument, is that of the page "Describe a problem in a file".

        Parameters
        ----------
        path : path
            Paths of data files are relative to its folder.

        Returns
        -------
        Problem

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            For whatever the objects in Python refuse, for unknown or missing entries, and for data that have another
            sha256 than the file states. The message begins with the path and the line.

        Examples
        --------
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "spring.toml"
        >>> problem.to_toml(path)
        >>> bp.Problem.from_toml(path).priors == problem.priors
        True
        """
        return ProblemFile(path).build(cls)

    def to_toml(self, path: str | Path) -> None:
        """Write the problem to a problem file, and its experiments beside it, as by `Experiment.save`.

        `from_toml` gives the same problem, bit for bit, and so do estimates and draws with the same version of this
        package on a processor of the same kind. ``python -m bayesperiodic fit`` computes them. Existing files of these
        names are replaced: that of the path, and ``NAME.experiment1.h5``, ``NAME.experiment2.h5``, … for ``NAME.toml``.

        Parameters
        ----------
        path : path
            The folder must exist.

        Raises
        ------
        OSError
            If a file cannot be written.
        TypeError
            If an experiment contains something other than plain data.
        ValueError
            For what texts do not describe: a condensed model, equations of functions that differ from their texts, a
            noise model, a prior or a scheme of your own, and anchors or errors of inputs of an estimate. Nothing is
            written then.
        """
        problem_text.write(self, path)

    @cached_property
    def _densities(self) -> dict[tuple[str, str], LogPosterior]:
        """The densities that were asked for, by coordinates and variances."""
        return {(RIDGE_COORDINATES, SAMPLED): LogPosterior.start(self)}

    def density(self, *, coordinates: str = RIDGE_COORDINATES, variances: str = SAMPLED) -> LogPosterior:
        """Return the log-posterior over the sampling coordinates.

        It is a function of the problem, the anchors of its periodic solves and the errors of the inputs. The anchors
        are at the medians of the priors, see `LogPosterior.start`, or where `anchored` has put them. The first call
        computes the anchors.

        Parameters
        ----------
        coordinates : "ridge" or "natural"
        variances : "sampled" or "collapsed"
            See `LogPosterior`.

        Returns
        -------
        LogPosterior
        """
        settings = coordinates, variances
        if settings not in self._densities:
            first = next(iter(self._densities.values()))
            self._densities[settings] = first.with_settings(coordinates=coordinates, variances=variances)
        return self._densities[settings]

    def anchored(self, theta: Mapping[str, float] | np.ndarray, guesses: Guesses | None = None) -> "Problem":
        """Return the same problem with its periodic solves anchored at another θ.

        Parameters
        ----------
        theta : mapping of str to float, or array (names,)
        guesses : mapping of str to mapping of str to array (points,), optional
            States of every experiment, turns included, from which to solve; by default the present anchors.

        Returns
        -------
        Problem

        Raises
        ------
        ValueError
            For unknown or missing names, or arrays of another length.
        """
        values = self.vector(theta)
        solver = (
            self.density().solver.anchored(values) if guesses is None else ResponseSolver.start(self, values, guesses)
        )
        return self.replace(input_errors=self.input_errors, anchors=solver.anchors)

    def with_input_errors(self, errors: Mapping[str, InputErrors]) -> "Problem":
        """Return the same problem with the errors of its inputs, linearised about an estimate.

        `map_estimate`, `sample` and whatever takes their results do this themselves.

        Parameters
        ----------
        errors : mapping of str to InputErrors
            By experiment, as `MapEstimate.input_errors`; none for exact inputs.

        Returns
        -------
        Problem

        Raises
        ------
        ValueError
            For an unknown experiment, or errors of other data.
        """
        return self if same(self.input_errors, errors) else self.replace(input_errors=errors)

    def planned(self, experiment: Experiment, noise: Mapping[str, float]) -> "Problem":
        """Return the problem of an experiment that may be made, alone, with exact inputs.

        Parameters
        ----------
        experiment : Experiment
            With the name of one of this problem's experiments. The parameters that act there are free.
        noise : mapping of str to float
            The noise parameters by their full names, known.

        Returns
        -------
        Problem
        """
        run = experiment.name
        acting = [self.names[i] for i in self.parameter_maps[run].columns.values()]
        blocks = self.observations[run].blocks
        known = {name: noise[name] for block in blocks for name in self.noise.parameter_names(block)}
        changes = {
            "experiments": [experiment], "priors": {name: self.joint_prior.marginals[name] for name in acting},
            "fixed": {name: {run: v[run]} for name, v in self.fixed.items() if run in v} | known, "input_noise": EXACT,
            "sensors": self.sensors.planned(),
            "input_errors": None, "anchors": None,
        }  # fmt: skip
        return Problem(**written_out(self) | changes)

    def _evaluated(self, evaluate: str, theta: Any, variances: Any, threads: int | None = None) -> np.ndarray:
        values, noise = self.vector(theta), self.noise_values(variances)
        if noise.shape[:-1] != values.shape[:-1]:
            noise = np.broadcast_to(noise, (*values.shape[:-1], noise.shape[-1]))
        flat = tuple(part.reshape(math.prod(part.shape[:-1]), part.shape[-1]) for part in (values, noise))
        evaluation: Evaluation = getattr(self.density(coordinates=NATURAL), evaluate)(*flat, threads)
        return evaluation.log_prob.reshape(values.shape[:-1])

    def log_likelihood(
        self, theta: Mapping[str, float] | np.ndarray, variances: Any, threads: int | None = None
    ) -> np.ndarray:
        """Return the log-likelihood.

        Parameters
        ----------
        theta : mapping of str to float, or array (…, names)
            See `vector`, which raises for unknown or missing names.
        variances : mapping of str to float, or array (…, noise_names)
            See `noise_values`, which does likewise.
        threads : int, optional
            By default one per core. The value does not depend on it.

        Returns
        -------
        array (…)
            −inf where a periodic solve fails.
        """
        return self._evaluated("log_likelihood", theta, variances, threads)

    def log_posterior(self, theta: Mapping[str, float] | np.ndarray, variances: Any) -> np.ndarray:
        """Return log-prior plus log-likelihood, a density over (θ, log φ) (de Kraker et al. 1997, eq. 6).

        Parameters
        ----------
        theta : mapping of str to float, or array (…, names)
        variances : mapping of str to float, or array (…, noise_names)
            See `log_likelihood`.

        Returns
        -------
        array (…)
            −inf outside the priors' support and where a periodic solve fails.
        """
        return self._evaluated("at", theta, variances)

    def gradient(
        self, theta: Mapping[str, float] | np.ndarray, variances: Any, *, method: str = "adjoint"
    ) -> np.ndarray:
        """Return the gradient of `log_posterior` by θ and by the logarithms of the free noise parameters.

        Parameters
        ----------
        theta : mapping of str to float, or array (names,)
        variances : mapping of str to float, or array (noise_names,)
        method : "adjoint" or "forward"
            One transposed solve an experiment, whatever the number of parameters, or one solve a parameter (eq. 4 of
            the paper). An autonomous model always takes the second.

        Returns
        -------
        array (names + free_noise,)

        Raises
        ------
        ValueError
            Where the log-posterior is not finite.
        """
        _checks.one_of("method", method, METHODS)
        value, gradient = self._value_and_gradient(theta, variances, forward=method == "forward")
        if not np.isfinite(value):
            given = dict(zip(self.names, self.vector(theta).tolist(), strict=True))
            raise ValueError(
                f"theta: the log-posterior must be finite, got {value} at {given}. A prior excludes this point, or a "
                "solve fails: see log_prior(theta) and solve(theta)."
            )
        return gradient

    def value_and_gradient(self, theta: Mapping[str, float] | np.ndarray, variances: Any) -> tuple[float, np.ndarray]:
        """Return `log_posterior` at one θ and its `gradient`; −inf and zeros where one of them is not finite.

        One periodic solve and one transposed solve an experiment, shared among the cores.

        Parameters
        ----------
        theta : mapping of str to float, or array (names,)
        variances : mapping of str to float, or array (noise_names,)

        Returns
        -------
        value : float
        gradient : array (names + free_noise,)
        """
        return self._value_and_gradient(theta, variances, forward=False)

    def _value_and_gradient(self, theta: Any, variances: Any, *, forward: bool) -> tuple[float, np.ndarray]:
        density = self.density(coordinates=NATURAL)
        natural = self.vector(theta), self.noise_values(variances)
        value, by_theta, by_noise, _ = density.value_and_gradient_at(*natural, forward=forward)
        return value, np.concatenate([by_theta, by_noise[density.noise_columns]])

    def outputs(self, theta: Mapping[str, float] | np.ndarray) -> tuple[dict[str, dict[str, np.ndarray]], np.ndarray]:
        """Return the predicted outputs at many θ, and whether the solves converged.

        Parameters
        ----------
        theta : mapping of str to array (draws,), or array (draws, names)

        Returns
        -------
        outputs : dict of str to dict of str to array (draws, points)
            By experiment and channel, in the channel's unit.
        converged : bool array (draws,)
        """
        return self.density().outputs(self.vector(theta))

    def solve(self, theta: Mapping[str, float] | np.ndarray) -> dict[str, PeriodicSolution]:
        """Return the periodic solution of every experiment at one θ, the recorded orbit where the model has it.

        The orbits are followed from the anchors, see `anchored`. If that fails, or leaves more than half of the
        variance of a channel unexplained, the experiment's guess and the orbit that the measured outputs show are tried
        too. The log-posterior, which does not try them, may exclude such a θ until the problem is `anchored` there.

        Parameters
        ----------
        theta : mapping of str to float, or array (names,)
            A mapping may leave out parameters that the problem adds by itself, see `completed`.

        Returns
        -------
        dict of str to PeriodicSolution
            By experiment; a solve that fails has another status than "converged".
        """
        return recorded_orbits(self, self.density().solver, self.vector(self.completed(theta)))


def recorded_orbits(problem: Description, solver: ResponseSolver, theta: np.ndarray) -> dict[str, PeriodicSolution]:
    """Return the solution of every experiment at θ (names,) that explains the recording best.

    Solutions followed from the solver's anchors are taken if they are of the recorded kind and explain half of the
    variance of each channel. Otherwise those from the experiments' guesses, or from the measured outputs, are solved
    too: by default the anchors are at the medians of the priors, where the model may have no orbit, or follow another
    branch. Where none converges it is the first.
    """
    first = solver.solutions(theta)
    chosen = {name: (solution, _misfit(problem, solver, theta, name)) for name, solution in first.items()}
    for other in _others(problem, solver, theta, first):
        if all(misfit <= MOST_UNEXPLAINED for _, misfit in chosen.values()):
            break
        solutions = other.solutions(theta)
        for name, (_, least) in chosen.items():
            if least > MOST_UNEXPLAINED and (misfit := _misfit(problem, other, theta, name)) < least:
                chosen[name] = solutions[name], misfit
    return {name: solution for name, (solution, _) in chosen.items()}


def _others(
    problem: Description, solver: ResponseSolver, theta: np.ndarray, first: dict[str, PeriodicSolution]
) -> Iterator[ResponseSolver]:
    yield solver.anchored(theta)
    unable = problem.model.autonomous or isinstance(problem.model, CondensedModel)
    if not unable and all(np.isfinite([*s.states.values()]).all() for s in first.values()):
        near = {name: solution.states for name, solution in first.items()}
        yield ResponseSolver.start(problem, theta, measured_orbits(problem, theta, near, 1).states)


def _misfit(problem: Description, solver: ResponseSolver, theta: np.ndarray, name: str) -> float:
    """Return the largest unexplained fraction of a channel's variance, 1 more for an orbit of another kind.

    Infinite where the solve failed.
    """
    simulation = solver.solve(theta[None], keep=True, polish=True)
    if simulation.statuses(name)[0] != CONVERGED:
        return np.inf
    response, observation = simulation.at(0).response(name), problem.observations[name]
    return max(unexplained(observation, response).values(), default=0.0) + bool(other_orbit(observation, response))
