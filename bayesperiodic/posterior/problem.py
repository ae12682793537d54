"""Problem: a model, experiments and priors, and the posterior density they define."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._parallel import available_cores
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.recording import Recording
from bayesperiodic.estimation.initial import all_at_once
from bayesperiodic.models.model import Model
from bayesperiodic.periodic.compiled import CONVERGED
from bayesperiodic.periodic.schemes import Scheme
from bayesperiodic.periodic.solution import PeriodicSolution
from bayesperiodic.posterior.density import Linearisation, likelihood_slope
from bayesperiodic.posterior.joint_priors import JointPrior
from bayesperiodic.posterior.likelihood import Likelihood, Residuals, Squares
from bayesperiodic.posterior.noise import Noise, as_noise
from bayesperiodic.posterior.observation import Comparisons, Observation, Response
from bayesperiodic.posterior.parameters import SHIFT, ParameterMap, expand_priors, free_names, local_name
from bayesperiodic.posterior.priors import Uniform
from bayesperiodic.posterior.simulator import Misfits, Responses

METHODS = ("adjoint", "forward")
SMALLEST_SHARED = 10_000


class Problem:
    r"""What the estimator and the samplers work on: the posterior density of a model's parameters.

    The density ([1]_, eq. 5-6) is over (θ, log φ), φ the noise parameters. With independent errors, the paper's model,
    φ is the variance of each channel with Jeffreys' prior 1/v, and the density is

    .. math::

        -\frac{1}{2} \sum_\beta \left[ n_\beta \ln v_\beta + \frac{M_\beta}{v_\beta} \right]
        + \sum_\alpha \ln p(\theta_\alpha),

    where n_β counts the independent values behind the samples of channel β, and M_β weighs each squared residual by
    independent values per sample. It is eq. (6) where every sample is independent. Outputs are projected onto the
    harmonics that the experiment keeps before they are compared, angles are compared modulo 2π.

    Parameters
    ----------
    model : Model
        For an autonomous model the measured frequency, with its standard error, is data too.
    experiments : sequence of Experiment
    priors : mapping of str or tuple of str to prior
        Makes a parameter free; a tuple of names takes a `MultivariateNormal`. A frozen continuous distribution of
        scipy.stats is a prior too. The name "shift" makes the delay [s] of the measured outputs a parameter of each
        experiment; an autonomous model, whose phase is free, always has it.
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
        "independent", "measured" or "circulant", or a model of `bayesperiodic.noise`.
    scheme : str or Scheme
        See `solve_periodic`.

    Raises
    ------
    ValueError
        For a parameter that is not just one of free, fixed and tied, or is in two priors, an expression that is not
        allowed or circular, a value that is no prior or does not fit its tuple of names, an unknown name, an experiment
        without the model's inputs or with outputs that the model lacks or that are constant, no more independent values
        than free parameters behind a variance whose prior is improper, an autonomous model whose measured frequency has
        no standard error.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = {"force": np.cos(2 * np.pi * np.arange(32) / 32)}
    >>> run = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, force, frequency=0.1, duration=400,
    ...                   sampling_rate=4, noise={"displacement": 0.01}, seed=1).fold(32)
    >>> problem = bp.Problem(bp.models.duffing, [run], priors={"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)},
    ...                      fixed={"m": 1, "k3": 0.5}, scheme="fourier")
    >>> problem
    Problem('duffing', 1 experiments, free: c, k, channels: displacement with 11 independent values, independent noise)
    >>> at = {"c": 0.2, "k": 1.0}, {"displacement": 1e-6}
    >>> bool(problem.log_posterior(*at) > problem.log_posterior({"c": 0.2, "k": 1.1}, at[1]))
    True
    >>> problem.gradient(*at).shape, problem.solve(at[0])["synthetic duffing"].status
    ((3,), 'converged')
    """

    def __init__(
        self,
        model: Model,
        experiments: Iterable[Experiment],
        *,
        priors: Mapping[Any, Any],
        fixed: Mapping[str, float | Mapping[str, float]] | None = None,
        tied: Mapping[str, str] | None = None,
        local: Iterable[str] = (),
        noise: str | Noise = "independent",
        scheme: str | Scheme = "central2",
    ):
        self.model, self.scheme, self.noise = model, scheme, as_noise(noise)
        self.experiments = _checked_experiments(model, experiments)
        measured = {channel for experiment in self.experiments for channel in experiment.outputs}
        self.channels = tuple(channel for channel in model.outputs if channel in measured)
        runs = [e.name for e in self.experiments]
        if not isinstance(priors, Mapping):
            raise ValueError(f"priors: {priors!r} is not allowed; it must be a mapping of names to priors.")
        fixed, tied, every = dict(fixed or {}), dict(tied or {}), (*model.parameters, SHIFT)
        self._given_priors, self._given_fixed = dict(priors), fixed
        self.local = _checked_local(local, every, priors, tied)
        self.fixed = {n: _constant(n, fixed[n], runs, n in self.local) for n in every if n in fixed}
        given = expand_priors(priors, self.local, runs, self.fixed) | self._free_phases(priors, fixed, tied)
        self.joint_prior = JointPrior.of(given, free_names(model.parameters, self.local, runs))
        self.names = self.joint_prior.names
        self._check_free(fixed)
        self.parameter_maps = {
            run: ParameterMap.of(
                model.parameters, self.names, run, {n: v[run] for n, v in self.fixed.items() if run in v}, tied
            )
            for run in runs
        }
        self.observations = {
            e.name: Observation(e, model, self.parameter_maps[e.name].delayed) for e in self.experiments
        }
        self.likelihood = self._likelihood(fixed)
        self._check_counts()
        self._responses = Responses(model, self.experiments, self.parameter_maps, scheme)

    def _free_phases(self, priors: Any, fixed: Mapping[str, Any], tied: Mapping[str, Any]) -> dict[str, Uniform]:
        """Return the priors of the delays that an autonomous model needs and that were not given."""
        if not self.model.autonomous or SHIFT in fixed or SHIFT in tied or SHIFT in priors:
            return {}
        return {
            f"{SHIFT}[{e.name}]": Uniform(-0.5 / e.frequency, 0.5 / e.frequency)
            for e in self.experiments
            if f"{SHIFT}[{e.name}]" not in priors
        }

    def _likelihood(self, fixed: Mapping[str, Any]) -> Likelihood:
        blocks = [block for observation in self.observations.values() for block in observation.blocks]
        known = {name: value for name, value in fixed.items() if name not in self.fixed}
        names = tuple(dict.fromkeys(n for block in blocks for n in self.noise.parameter_names(block)))
        for plain in (name.partition("[")[0] for name in names):
            if plain in self.model.parameters:
                raise ValueError(
                    f"model: the parameter name {plain!r} is not allowed; the noise model {self.noise.name!r} has a "
                    "parameter of that name. Call the model's otherwise."
                )
        for name, value in known.items():
            _checks.one_of("fixed", name, (*self.model.parameters, SHIFT, *names))
            _checks.positive(f"fixed[{name!r}]", value)
        return Likelihood(self.noise, blocks, known)

    def _check_free(self, fixed: Mapping[str, Any]) -> None:
        known = {*fixed, *(local_name(name, run) for name, by_run in self.fixed.items() for run in by_run)}
        for name in self.names:
            if name in known:
                raise ValueError(f"fixed: {name!r} has a prior too; give a prior or a value.")
        if not self.names:
            raise ValueError("priors: {} is not allowed; at least one parameter must be free.")

    def _check_counts(self) -> None:
        """Refuse an improper prior of a variance where as many parameters can fit the data exactly."""
        if self.noise.proper:
            return
        for group, members in self.likelihood.groups():
            count = self.likelihood.counts[group[0]]
            runs = {self.likelihood.blocks[b].experiment for b in members}
            acting = sorted({i for run in runs for i in self.parameter_maps[run].columns.values()})
            needed = len(acting) + self.noise.spare
            if group[0] in self.likelihood.free and count <= needed:
                names = ", ".join(self.names[i] for i in acting)
                raise ValueError(
                    f"priors: {len(acting)} free parameters ({names}) are not allowed; {group[0]!r} is unknown, has "
                    f"the {self.noise.prior_text}, and only {count:.0f} independent values, where more than {needed} "
                    f"are needed. Fix parameters or {group[0]!r}, give it a proper prior "
                    "(noise.Independent(prior=…)), keep more harmonics, or add experiments."
                )

    @property
    def noise_names(self) -> tuple[str, ...]:
        """All noise parameters, the last axis of `variances` in what follows."""
        return self.likelihood.names

    @property
    def free_noise(self) -> tuple[str, ...]:
        """Noise parameters without a known value."""
        return self.likelihood.free

    @property
    def counted(self) -> float:
        """Σn, the independent values behind all unknown and known variances."""
        return sum(self.likelihood.counts.values())

    @property
    def responses(self) -> Responses:
        """The periodic solves, anchored at the medians of the priors unless set.

        Where every experiment of a forced model has a guess of its orbit, they are anchored where these orbits and the
        parameters fit together instead: at the medians other orbits may be nearest, or none exist.
        """
        if self._responses._anchors is None:
            together = all_at_once(self, self.median())
            if together is not None and together.states:
                self._responses = self.anchored(together.theta, together.states)._responses
            else:
                self._responses = self._responses.anchored(self.median())
        return self._responses

    def anchored(
        self, theta: Mapping[str, float] | np.ndarray, guesses: Mapping[str, Mapping[str, np.ndarray]] | None = None
    ) -> "Problem":
        """Return the same problem with its anchors at another θ.

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
        if guesses is None:
            return self.with_responses(self.responses.anchored(self.vector(theta)))
        _checks.same_names("guesses", guesses, [e.name for e in self.experiments])
        experiments = tuple(replace(e, guess=guesses[e.name]) for e in self.experiments)
        responses = Responses(self.model, experiments, self.parameter_maps, self.scheme)
        return self.with_responses(responses.anchored(self.vector(theta)))

    def with_responses(self, responses: Responses) -> "Problem":
        """Return the same problem with other anchors.

        Parameters
        ----------
        responses : Responses
            Those of another problem of the same kind.

        Returns
        -------
        Problem
        """
        other = object.__new__(Problem)
        other.__dict__.update(self.__dict__)
        other._responses = responses
        return other

    def with_experiments(self, experiments: Iterable[Experiment]) -> "Problem":
        """Return the same problem with other data, or with some of its experiments.

        Parameters
        ----------
        experiments : iterable of Experiment
            What was said of single experiments, such as values that differ, goes by their names, and is left out with
            them.

        Returns
        -------
        Problem

        Raises
        ------
        ValueError
            As `Problem` does.
        """
        chosen = tuple(experiments)
        gone = {e.name for e in self.experiments} - {getattr(e, "name", None) for e in chosen}
        ends = tuple(local_name("", name) for name in gone)
        priors, fixed = (
            {key: value for key, value in given.items() if not (isinstance(key, str) and key.endswith(ends))}
            for given in (self._given_priors, self._given_fixed)
        )
        for name, value in fixed.items():
            if isinstance(value, Mapping):
                fixed[name] = {run: number for run, number in value.items() if run not in gone}
        return Problem(
            self.model,
            chosen,
            priors=priors,
            fixed=fixed,
            tied=self.tied,
            local=self.local,
            noise=self.noise,
            scheme=self.scheme,
        )

    @property
    def tied(self) -> dict[str, str]:
        """The expressions of the tied parameters."""
        any_map = next(iter(self.parameter_maps.values()))
        return {name: expression.text for name, expression in any_map.tied.items()}

    @property
    def priors(self) -> dict[str | tuple[str, ...], Any]:
        """The priors by name, in the order of the model's parameters."""
        return self.joint_prior.blocks

    def median(self) -> np.ndarray:
        """Return the medians of the priors, (names,)."""
        return self.joint_prior.median()

    def vector(self, theta: Mapping[str, float] | np.ndarray | Sequence[float]) -> np.ndarray:
        """Return θ as an array from a mapping or an array.

        Parameters
        ----------
        theta : mapping of str to float, or array (…, names)
            Natural values, in the parameters' units.

        Returns
        -------
        array (…, names)

        Raises
        ------
        ValueError
            For unknown or missing names, or another last axis.
        """
        if isinstance(theta, Mapping):
            _checks.same_names("theta", theta, self.names)
            theta = np.stack(np.broadcast_arrays(*(np.asarray(theta[name], dtype=float) for name in self.names)), -1)
        values = np.asarray(theta, dtype=float)
        if values.shape[-1:] != (len(self.names),):
            raise ValueError(f"theta: shape {values.shape} is not allowed; the last axis must be {list(self.names)}.")
        return values

    def noise_values(self, variances: Mapping[str, Any] | np.ndarray) -> np.ndarray:
        """Return the noise parameters as an array from a mapping or an array.

        Parameters
        ----------
        variances : mapping of str to float, or array (…, noise_names)
            In a mapping a channel's name stands for its variance [channel's unit squared], and those with a known value
            may be left out.

        Returns
        -------
        array (…, noise_names)

        Raises
        ------
        ValueError
            For unknown or missing names, or another last axis.
        """
        names = self.noise_names
        if isinstance(variances, Mapping):
            longer = {f"variance[{name}]": name for name in variances}
            renamed = {long if long in names else short: variances[short] for long, short in longer.items()}
            given: dict[str, Any] = {**self.likelihood.fixed, **renamed}
            _checks.same_names("variances", given, names)
            variances = np.stack(np.broadcast_arrays(*(np.asarray(given[n], dtype=float) for n in names)), -1)
        values = np.asarray(variances, dtype=float)
        if values.shape[-1:] != (len(names),):
            raise ValueError(f"variances: shape {values.shape} is not allowed; the last axis must be {list(names)}.")
        return values

    def _noise_at(self, theta: np.ndarray, variances: Mapping[str, Any] | np.ndarray) -> np.ndarray:
        """Return the noise parameters (…, noise_names) of θ (…, names), the same for each unless given otherwise."""
        values, shape = self.noise_values(variances), (*theta.shape[:-1], len(self.noise_names))
        return values if values.shape == shape else np.broadcast_to(values, shape)

    def log_prior(self, theta: Mapping[str, float] | np.ndarray) -> np.ndarray:
        """Return Σ ln p(θ_α).

        Parameters
        ----------
        theta : mapping of str to float, or array (…, names)
            Natural values, in the parameters' units.

        Returns
        -------
        array (…)
            −inf outside the support.

        Raises
        ------
        ValueError
            For unknown or missing names, or another last axis.
        """
        return self.joint_prior.log_prob(self.vector(theta))

    def log_likelihood(
        self, theta: Mapping[str, float] | np.ndarray, variances: Any, threads: int | None = None
    ) -> np.ndarray:
        """Return the log-likelihood.

        Parameters
        ----------
        theta : mapping of str to float, or array (…, names)
            Natural values, in the parameters' units.
        variances : mapping of str to float, or array (…, noise_names)
            In a mapping a channel's name stands for its variance [channel's unit squared], and those with a known value
            may be left out.
        threads : int, optional
            By default one a core. The value does not depend on it.

        Returns
        -------
        array (…)
            −inf where a periodic solve fails.

        Raises
        ------
        ValueError
            For unknown or missing names, or another last axis.
        """
        values = self.vector(theta)
        noise = self._noise_at(values, variances)
        return self.likelihood_and_status(values, noise, threads)[0]

    def likelihood_and_status(
        self, theta: np.ndarray, noise: np.ndarray, threads: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the log-likelihood, and how the periodic solves ended.

        Parameters
        ----------
        theta : array (…, names)
        noise : array (…, noise_names)
        threads : int, optional
            By default one a core.

        Returns
        -------
        log_likelihood : array (…)
            −inf where a periodic solve fails.
        status : int array (…)
            The worst status code of the experiments, 0 where all have converged.
        """
        flat = theta.reshape(-1, len(self.names))
        residuals, status = self.misfits(flat, threads)
        good, noise = status == CONVERGED, noise.reshape(len(flat), -1)
        if good.all():
            return self.likelihood(residuals, noise).reshape(theta.shape[:-1]), status.reshape(theta.shape[:-1])
        result = np.full(len(flat), -np.inf)
        if good.any():
            result[good] = self.likelihood(residuals, noise[good])
        return result.reshape(theta.shape[:-1]), status.reshape(theta.shape[:-1])

    def misfits(self, theta: np.ndarray, threads: int | None = None) -> tuple[Residuals | Squares, np.ndarray]:
        """Return as much of `residuals` as the likelihood needs, and how all solves ended.

        Parameters
        ----------
        theta : array (solves, names)
        threads : int, optional
            By default one a core.

        Returns
        -------
        residuals : Residuals, or Squares where these are enough
        status : int array (solves,)
        """
        if not self.flat_misfits:
            return self.residuals(theta, threads)
        squares, status = self.responses.squares(theta, self.flat_misfits, threads)
        own, good = squares[self.flat_places], status == CONVERGED
        return Squares(own if good.all() else own[:, good]), status

    @cached_property
    def flat_misfits(self) -> list[Misfits]:
        """The comparisons of experiments that are solved together, where sums of squares are enough; else none."""
        groups = [[self.observations[e.name] for e in group] for group in self._responses.groups]
        enough = self.likelihood.model.flat and all(map(Misfits.possible, groups))
        return [Misfits(group) for group in groups] if enough else []

    @cached_property
    def flat_places(self) -> np.ndarray | slice:
        """Where the blocks are in the misfits of all groups, one after the other, (blocks,), or all in order."""
        every = [self.observations[e.name] for group in self._responses.groups for e in group]
        order = [(o.experiment.name, channel) for o in every for channel in o.channels]
        places = {key: i for i, key in enumerate(order)}
        result = np.array([places[block.experiment, block.channel] for block in self.likelihood.blocks])
        return slice(None) if np.array_equal(result, np.arange(result.size)) else result

    def residuals(self, theta: np.ndarray, threads: int | None = None) -> tuple[Residuals, np.ndarray]:
        """Return the residual components at those of many θ whose solves converge, and how all solves ended.

        Parameters
        ----------
        theta : array (solves, names)
        threads : int, optional
            By default one a core.

        Returns
        -------
        residuals : Residuals
            An array (converged, size) a block.
        status : int array (solves,)
            The worst of all experiments.
        """
        solved = self.responses.solve(theta, threads, whole=True)
        status = np.max([s.status for s in solved.values()], axis=0)
        good = status == CONVERGED
        responses = {name: s.response for name, s in solved.items()}
        if not good.all():
            responses = {name: Response(*(part[good] for part in r)) for name, r in responses.items()}
        small = max(s.response.outputs.size for s in solved.values()) < SMALLEST_SHARED
        if small:
            return self.comparisons.residuals(responses, 1), status
        return self._each.residuals(responses, threads or available_cores()), status

    @cached_property
    def _each(self) -> Comparisons:
        return Comparisons([o] for o in self.observations.values())

    @cached_property
    def comparisons(self) -> Comparisons:
        """The comparisons with the experiments, those of one layout at once."""
        groups: dict[Any, list[Observation]] = {}
        for name, observation in self.observations.items():
            groups.setdefault(observation.layout or name, []).append(observation)
        return Comparisons(groups.values())

    def log_posterior(self, theta: Mapping[str, float] | np.ndarray, variances: Any) -> np.ndarray:
        """Return log-prior plus log-likelihood, a density over (θ, log φ) (de Kraker et al. 1997, eq. 6).

        Parameters
        ----------
        theta : mapping of str to float, or array (…, names)
            Natural values, in the parameters' units.
        variances : mapping of str to float, or array (…, noise_names)
            In a mapping a channel's name stands for its variance [channel's unit squared], and those with a known value
            may be left out.

        Returns
        -------
        array (…)
            −inf outside the priors' support and where a periodic solve fails.

        Raises
        ------
        ValueError
            For unknown or missing names, or another last axis.
        """
        values = self.vector(theta)
        noise = self._noise_at(values, variances)
        with np.errstate(divide="ignore", invalid="ignore"):
            prior = np.asarray(self.log_prior(values) + self.likelihood.log_prior(noise))
        inside = np.isfinite(prior)
        if inside.all():
            return np.asarray(prior + self.likelihood_and_status(values, noise)[0])
        result = np.full(prior.shape, -np.inf)
        if inside.any():
            result[inside] = prior[inside] + self.likelihood_and_status(values[inside], noise[inside])[0]
        return result

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
        values, noise = self.vector(theta), self.noise_values(variances)
        value, gradient = self._value_and_gradient(values, noise, forward=method == "forward")
        if not np.isfinite(value):
            given = dict(zip(self.names, values.tolist(), strict=True))
            raise ValueError(
                f"theta: {given} is not allowed; the log-posterior is not finite there. A prior excludes it, or a "
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
        return self._value_and_gradient(self.vector(theta), self.noise_values(variances), forward=False)

    def _value_and_gradient(self, values: np.ndarray, noise: np.ndarray, *, forward: bool) -> tuple[float, np.ndarray]:
        nothing = -np.inf, np.zeros(len(self.names) + len(self.free_noise))
        with np.errstate(divide="ignore", invalid="ignore"):
            value = float(self.log_prior(values) + self.likelihood.log_prior(noise))
        if not np.isfinite(value):
            return nothing
        slope = likelihood_slope(self, values, noise, forward=forward)
        if not np.isfinite(value + slope.value) or not np.isfinite(slope.by_theta).all():
            return nothing
        free = [self.noise_names.index(name) for name in self.free_noise]
        by_theta = slope.by_theta + self.joint_prior.gradient(values)
        return value + slope.value, np.concatenate([by_theta, slope.by_noise[free]])

    def pulled(self, here: Linearisation, by_residual: Sequence[np.ndarray], *, forward: bool = False) -> np.ndarray:
        """Return the derivatives by θ from those by the residuals.

        Those of an autonomous model and of multipliers need anchors there.

        Parameters
        ----------
        here : Linearisation
        by_residual : sequence of array (size,)
            One a block.
        forward : bool
            Take one solve a parameter instead of one transposed solve.

        Returns
        -------
        array (names,)
        """
        if forward or self.model.autonomous:
            return self.linearised(here.theta).forward(by_residual)
        if any(e.multipliers is not None for e in self.experiments):
            here = self.linearised(here.theta)
        return here.adjoint(by_residual)

    def linearised(self, theta: Mapping[str, float] | np.ndarray) -> Linearisation:
        """Solve at one θ from the present anchors, and compare with the data (eq. 4-5).

        Parameters
        ----------
        theta : mapping of str to float, or array (names,)

        Returns
        -------
        Linearisation
            Residuals, and their derivatives by θ.
        """
        values = self.vector(theta)
        return Linearisation(values, self.responses.anchored(values), self.comparisons)

    def outputs(self, theta: Mapping[str, float] | np.ndarray) -> tuple[dict[str, dict[str, np.ndarray]], np.ndarray]:
        """Return the outputs ŷ at many θ.

        Parameters
        ----------
        theta : mapping of str to array (draws,), or array (draws, names)

        Returns
        -------
        outputs : dict of str to dict of str to array (draws, points)
            By experiment and channel, in the channel's unit.
        converged : bool array (draws,)
            Where the solves of all experiments have converged.
        """
        values = self.vector(theta)
        solved = self.responses.solve(values)
        converged = np.all([s.status == CONVERGED for s in solved.values()], axis=0)
        return {name: o.predicted(solved[name].response) for name, o in self.observations.items()}, converged

    def solve(self, theta: Mapping[str, float] | np.ndarray) -> dict[str, PeriodicSolution]:
        """Return the periodic solution of every experiment at one θ.

        Parameters
        ----------
        theta : mapping of str to float, or array (names,)

        Returns
        -------
        dict of str to PeriodicSolution
            By experiment; a solve that fails has another status than "converged".
        """
        return self.responses.solutions(self.vector(theta))

    def parameters(self, theta: np.ndarray, experiment: str) -> np.ndarray:
        """Return every parameter of the model in an experiment, free, fixed and tied.

        Parameters
        ----------
        theta : array (draws, names)
        experiment : str

        Returns
        -------
        array (draws, parameters)
            In the order of the model.
        """
        return self._responses.parameters(theta, experiment)

    def sample_prior(self, size: int, seed: int) -> dict[str, np.ndarray]:
        """Return independent draws of every free parameter from its prior.

        Parameters
        ----------
        size : int
        seed : int

        Returns
        -------
        dict of str to array (size,)
            By name.
        """
        draws = self.joint_prior.sample(size, np.random.default_rng(seed))
        return dict(zip(self.names, draws.T.copy(), strict=True))

    def __repr__(self) -> str:
        return (
            f"Problem({self.model.name!r}, {len(self.experiments)} experiments, free: {', '.join(self.names)}, "
            f"channels: {', '.join(self.channels)} with {self.counted:.0f} independent values, {self.noise.name} noise)"
        )


def _checked_local(
    local: Iterable[str], every: tuple[str, ...], priors: Any, tied: Mapping[str, str]
) -> tuple[str, ...]:
    if isinstance(local, str):
        raise ValueError(f"local: {local!r} is not allowed; it must be a sequence of names, such as [{local!r}].")
    names = tuple(local)
    for name in names:
        _checks.one_of("local", name, every)
        if name in tied:
            raise ValueError(f"local: {name!r} is tied; it follows what it is tied to, so leave it out.")
    if isinstance(priors, Mapping):
        for key in priors:
            for name in key if isinstance(key, tuple) else ():
                if name in names:
                    raise ValueError(
                        f"priors[{key!r}]: {name!r} is local; a joint prior needs the names of single experiments, "
                        f"such as '{name}[run]'."
                    )
    return names if SHIFT in names else (*names, SHIFT)


def _constant(name: str, given: Any, runs: list[str], local: bool) -> dict[str, float]:
    """Return the value of a fixed parameter in each experiment; a local one may be fixed in some of them."""
    if not isinstance(given, Mapping):
        return dict.fromkeys(runs, _checks.finite_number(f"fixed[{name!r}]", given))
    for run in given:
        _checks.one_of(f"fixed[{name!r}]", run, runs)
    if not local:
        _checks.same_names(f"fixed[{name!r}]", given, runs)
    return {run: _checks.finite_number(f"fixed[{name!r}][{run!r}]", given[run]) for run in runs if run in given}


def _checked_experiments(model: Model, experiments: Iterable[Experiment]) -> tuple[Experiment, ...]:
    if isinstance(experiments, Experiment):
        raise ValueError(f"experiments: {experiments.name!r} alone is not allowed; give a list of one, [experiment].")
    result = tuple(experiments)
    for e in result:
        if isinstance(e, Recording):
            raise ValueError(f"experiments: the recording {e.name!r} is not allowed; give its mean period, see fold().")
        if not isinstance(e, Experiment):
            raise ValueError(f"experiments: {e!r} is not allowed; each must be an Experiment.")
    if not result:
        raise ValueError("experiments: () is not allowed; at least one experiment is needed.")
    names = [experiment.name for experiment in result]
    if len(set(names)) < len(names):
        raise ValueError(f"experiments: the names {names} are not allowed; they must differ, see fold(name=…).")
    for e in result:
        _checks.same_names(f"inputs of experiment {e.name!r}", e.inputs, model.inputs)
        if not e.outputs:
            raise ValueError(f"outputs of experiment {e.name!r}: {{}} is not allowed; at least one must be measured.")
        for channel, values in e.outputs.items():
            _checks.one_of(f"outputs of experiment {e.name!r}", channel, model.outputs)
            if e.mask is None and e.covariance is None and np.ptp(values) == 0.0:
                raise ValueError(
                    f"outputs of experiment {e.name!r}: {channel!r} is constant ({values[0]:g}); a channel must vary "
                    "over the period, or tells nothing about its variance."
                )
        if e.guess:
            _checks.same_names(f"guess of experiment {e.name!r}", e.guess, model.states)
        if model.autonomous and not e.frequency_se > 0.0:
            raise ValueError(
                f"experiment {e.name!r}: frequency_se = {e.frequency_se:g} is not allowed; {model.name!r} is "
                "autonomous, its measured frequency is data and needs a standard error > 0. Fold without `frequency`, "
                "which then is estimated with its error, or give frequency_se."
            )
    return result
