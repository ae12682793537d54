"""A model, experiments, priors and a noise model, validated: what a posterior density is defined by."""

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, Self

import numpy as np
import sympy as sp

from bayesperiodic import _checks
from bayesperiodic._printing import Printed
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.frequency_error import FrequencyError
from bayesperiodic.likelihood.input_noise import (
    EXACT,
    FROM_CYCLES,
    JOINT,
    InputErrors,
    InputNoise,
    checked,
    error_waves,
    noisy_inputs,
    true_inputs,
    with_errors_as_parameters,
)
from bayesperiodic.likelihood.kinds import blocks_of
from bayesperiodic.likelihood.likelihood import Likelihood
from bayesperiodic.likelihood.noise import PER_EXPERIMENT, Noise, as_noise
from bayesperiodic.likelihood.observation import Observation
from bayesperiodic.models.model import Model
from bayesperiodic.models.sensed import DELAY, sensor_name
from bayesperiodic.periodic.condensed import equations_for
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.schemes import Scheme, default_scheme, find_scheme
from bayesperiodic.priors.joint import JointPrior
from bayesperiodic.priors.single import Uniform
from bayesperiodic.problem import arguments
from bayesperiodic.problem.parameters import (
    SHIFT,
    ParameterMap,
    check_delays,
    expand_priors,
    free_names,
    local_name,
    plain_names,
)
from bayesperiodic.problem.sensors import Sensor, Sensors

# Least width of a prior relative to its median; below it the log-posterior is not smooth in double precision.
LEAST_WIDTH = 1e-12


class Description(Printed):
    """Model, experiments, parameters, priors and noise of a `Problem`, validated on construction and immutable."""

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
        scheme: str | Scheme | None = None,
        input_noise: InputNoise = FROM_CYCLES,
        sensors: Mapping[str, Sensor] | None = None,
        input_errors: Mapping[str, InputErrors] | None = None,
        anchors: Mapping[str, Any] | None = None,
    ):
        _checks.instance("model", model, Model)
        _checks.mapping("priors", priors, "{'k': bp.LogNormal(1.0, 0.5)}")
        self.noise, self.experiments = as_noise(noise), arguments.checked_experiments(model, experiments)
        local = local if isinstance(local, str) else _checks.several("local", local)
        given = {"fixed": fixed, "tied": tied}
        fixed, tied = (_checks.optional_mapping(argument, one, "{'k2': …}") for argument, one in given.items())
        self.input_noise = checked(input_noise, model.inputs, self.experiments)
        self._settings: dict[str, Any] = {
            "model": model, "experiments": self.experiments, "priors": dict(priors), "fixed": fixed, "tied": tied,
            "local": local, "noise": noise, "scheme": scheme,
            "input_noise": input_noise if isinstance(input_noise, str) else self.input_noise,
            "sensors": dict(sensors) if isinstance(sensors, Mapping) else sensors,
            "input_errors": dict(input_errors or {}), "anchors": dict(anchors or {}),
        }  # fmt: skip
        errors: dict[str, Any] = {}
        if self.input_noise == JOINT:
            model, errors, none = with_errors_as_parameters(model, self.experiments)
            priors, fixed = {**priors, **errors}, {**fixed, **none}
            plain = self._settings["model"].parameters
            local = (*local,) + tuple(name for name in model.parameters if name not in plain)
        self.sensors = Sensors(sensors, model, self.experiments, joint=self.input_noise == JOINT)
        arguments.check_units(self.sensors.plain_model, self.experiments, self.sensors.given)
        self.model = model = self.sensors.model
        self.scheme = scheme or default_scheme(model, tables=all(e.sweep is not None for e in self.experiments))
        find_scheme(self.scheme)
        if any(b.is_dense(self.noise) for e in self.experiments for b in blocks_of(e, model)):
            if isinstance(self.input_noise, Mapping):
                raise ValueError(
                    f"input_noise: must be 'joint' or 'exact' for points of a mask with {self.noise.name!r} noise, got "
                    f"{_checks.shortened(input_noise)}; take noise='independent' or 'measured', or whole periods."
                )
            self.input_noise = EXACT if self.input_noise == FROM_CYCLES else self.input_noise
        self.channels = tuple(c for c in self.sensors.channels if any(c in e.outputs for e in self.experiments))
        runs = [e.name for e in self.experiments]
        every = (*model.parameters, *self.sensors.names, SHIFT)
        priors, fixed = self.sensors.with_entries(priors, fixed)
        self.local = arguments.checked_local(local, every, priors, tied)
        self.fixed = {n: arguments.fixed_values(n, fixed[n], runs, n in self.local) for n in every if n in fixed}
        phases = self._free_phases(priors, fixed, tied)
        given = expand_priors(priors, self.local, runs, self.fixed) | phases
        self.joint_prior = JointPrior.of(given, free_names(every[:-1], self.local, runs))
        self.names = self.joint_prior.names
        self.plain_names = plain_names(self.names, self.local, runs)
        self.automatic = tuple(n for n, plain in self.plain_names.items() if {n, plain} & {*phases, *errors})
        self._check_free(fixed)
        self._check_widths()
        check_delays(self.experiments, (*self.names, *fixed, *tied, *self.sensors.known_delays))
        kinds = model.parameters, self.sensors.names, self.names
        self.parameter_maps = {run: ParameterMap.of(*kinds, run, self.fixed, tied) for run in runs}
        arguments.check_special_points(self.experiments, self.sensors, self.noisy_inputs, self.parameter_maps)
        self.forward = model.autonomous or any(e.condition is not None for e in self.experiments)
        self.ties = self._ties()
        self.frequency_errors = self._known_frequency_errors()
        self.input_errors = self._checked_input_errors(input_errors or {})
        self.anchors = dict(anchors or {})
        if anchors:
            _checks.same_names("anchors", anchors, runs)
        self._noise_values = self._checked_noise_values(fixed)
        self._check_counts()
        self._complete = True

    def __setattr__(self, name: str, value: Any) -> None:
        if "_complete" in vars(self):
            changed = f"replace({name}=…)" if name in self._settings else "replace(…)"
            raise AttributeError(
                f"{name}: must not be assigned or deleted, because a problem is immutable; problem.{changed} returns "
                f"another one. The arguments of replace are {', '.join(self._settings)}."
            )
        super().__setattr__(name, _checks.read_only(value))

    def __delattr__(self, name: str) -> None:
        self.__setattr__(name, None)

    def delay_parameters(self, experiment: str) -> dict[str, tuple[str, ...]]:
        """Return the free parameters that delay each channel; the time between channels of the same ones is known.

        Parameters
        ----------
        experiment : str

        Returns
        -------
        dict of str to tuple of str
            Full names by channel, outputs and inputs.

        Raises
        ------
        ValueError
            For an unknown experiment.

        Examples
        --------
        >>> late = problem.replace(sensors={"displacement": bp.Sensor(delay=bp.Normal(0.0, 0.01))})
        >>> late.delay_parameters("synthetic duffing")
        {'displacement': ('delay[displacement]',), 'force': ()}
        """
        _checks.one_of("experiment", experiment, self.parameter_maps)
        columns, result = self.parameter_maps[experiment].columns, {}
        measured = next(e for e in self.experiments if e.name == experiment)
        for channel in (*measured.outputs, *measured.inputs):
            plain = (SHIFT,) * (channel in measured.outputs) + (sensor_name(DELAY, channel),)
            result[channel] = tuple(self.names[columns[name]] for name in plain if name in columns)
        return result

    def _free_phases(self, priors: Any, fixed: Mapping[str, Any], tied: Mapping[str, Any]) -> dict[str, Uniform]:
        """Return the priors of the delays that an autonomous model needs and that were not given."""
        if not self.model.autonomous or SHIFT in fixed or SHIFT in tied or SHIFT in priors:
            return {}
        return {
            f"{SHIFT}[{e.name}]": Uniform(-0.5 / e.frequency, 0.5 / e.frequency)
            for e in self.experiments
            if f"{SHIFT}[{e.name}]" not in priors
        }

    def _known_frequency_errors(self) -> dict[str, FrequencyError]:
        """Return the errors of frequencies by experiment; raise a ValueError where they cannot be integrated out."""
        errors = {}
        for e in self.experiments:
            if (error := FrequencyError.of(e, self.model)) is None:
                continue
            if any(block.is_dense(self.noise) for block in blocks_of(e, self.model)):
                raise ValueError(
                    f"frequency_se of experiment {e.name!r}: must be 0 for points of a mask with {self.noise.name!r} "
                    f"noise, got {e.frequency_se:g}; take noise='independent' or 'measured', or whole periods."
                )
            errors[e.name] = error
        return errors

    def _checked_input_errors(self, errors: Mapping[str, InputErrors]) -> dict[str, InputErrors]:
        """Return the errors of inputs and frequencies; raise a ValueError unless they are of these experiments."""
        for name, one in errors.items():
            _checks.one_of("input_errors", name, self.parameter_maps)
            experiment = next(e for e in self.experiments if e.name == name)
            size = sum(block.size for block in blocks_of(experiment, self.model))
            count = len(error_waves(experiment, self.input_noise)[0]) + (name in self.frequency_errors)
            if one.caused.shape != (size,) or one.loadings.shape[:1] != (size,) or one.expected.shape != (count,):
                raise ValueError(
                    f"input_errors[{name!r}]: must be {count} errors and {size} components, got {one.expected.size} "
                    f"and {one.caused.size}; give those of an estimate of this problem."
                )
        return dict(errors)

    @cached_property
    def observations(self) -> dict[str, Observation]:
        """Comparison of outputs with the data of every experiment, less what the errors of the inputs caused."""
        result = {}
        for e in self.experiments:
            delayed, errors = self.parameter_maps[e.name].delayed, self.input_errors.get(e.name)
            caused = None if errors is None else errors.parts([block.size for block in blocks_of(e, self.model)])
            result[e.name] = Observation(e, self.model, self.sensors.parameters(delayed), caused)
        return _checks.read_only(result)

    @cached_property
    def likelihood(self) -> Likelihood:
        """Likelihood of the residuals, the errors of the inputs integrated out."""
        blocks = [block for observation in self.observations.values() for block in observation.blocks]
        loadings = {name: errors.loadings for name, errors in self.input_errors.items()}
        return Likelihood(self.noise, blocks, self._noise_values, loadings)

    def _checked_noise_values(self, fixed: Mapping[str, Any]) -> dict[str, float]:
        """Return the known noise parameters."""
        blocks = [block for observation in self.observations.values() for block in observation.blocks]
        known = {name: value for name, value in fixed.items() if name not in self.fixed}
        names = tuple(dict.fromkeys(n for block in blocks for n in self.noise.parameter_names(block)))
        for plain in (name.partition("[")[0] for name in names):
            if plain in self.model.parameters:
                raise ValueError(
                    f"model: parameters must have other names than those of the noise model {self.noise.name!r}, got "
                    f"{plain!r}. Rename the model's parameter."
                )
        for name, value in known.items():
            _checks.one_of("fixed", name, (*self.model.parameters, *self.sensors.names, SHIFT, *names))
            _checks.positive(f"fixed[{name!r}]", value)
        return known

    def _check_free(self, fixed: Mapping[str, Any]) -> None:
        known = {*fixed, *(local_name(name, run) for name, by_run in self.fixed.items() for run in by_run)}
        for name in self.names:
            if name in known:
                raise ValueError(f"fixed: {name!r} has a prior too; give a prior or a value.")
        if not self.names:
            raise ValueError("priors: must have at least one free parameter, got {}.")

    def _check_widths(self) -> None:
        """Refuse priors that are narrower than the rounding of their parameter."""
        sizes = np.spacing(np.abs(self.median())) / np.finfo(float).eps
        for name, width, size in zip(self.names, self.joint_prior.widths, sizes, strict=True):
            if not width > LEAST_WIDTH * size:
                raise ValueError(
                    f"priors[{name!r}]: must be wider than {LEAST_WIDTH:g} of the median, got a width of {width:.3g}; "
                    f"a known value is given by fixed={{{name!r}: …}}."
                )

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
                shared = (
                    "Share it among experiments (per='channel'), fix" if self.noise.per == PER_EXPERIMENT else "Fix"
                )
                raise ValueError(
                    f"priors: an unknown {group[0]!r} with the {self.noise.prior_text} must have more than {needed} "
                    f"independent values for {len(acting)} free parameters ({names}), got only {count:.0f}. {shared} "
                    f"parameters or {group[0]!r}, give it a proper prior (noise.Independent(prior=…)), keep more "
                    "harmonics by fold(…, harmonics={…}), or add experiments."
                )

    @property
    def units(self) -> dict[str, str]:
        """Units by the plain names of parameters and by signals."""
        return self.model.units | self.sensors.units | {SHIFT: "s"}

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
    def quantities(self) -> dict[str, str]:
        """Units of what was measured without a time history, by label."""
        every = (one for e in self.experiments for one in e.measurements)
        return {one.label: "rad" if one.signed else self.model.units.get(one.channel, "") for one in every}

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments of the constructor by name."""
        return dict(self._settings)

    def replace(self, **changes: Any) -> Self:
        """Return the problem with other arguments of the constructor.

        They are validated as the constructor does. Anchors and errors of inputs are kept only if they are given.

        Parameters
        ----------
        **changes
            Arguments of the constructor. For experiments without those that have local parameters see
            `with_experiments`.

        Returns
        -------
        Problem

        Raises
        ------
        ValueError
            For another argument, and as the constructor does.

        Examples
        --------
        >>> coarse = problem.replace(priors={**problem.priors, "k": bp.LogNormal(2.0, 1.0)}, noise="measured")
        >>> coarse.priors["k"], coarse.noise.name, problem.noise.name
        (LogNormal(median=2.0, spread=1.0), 'measured', 'independent')
        """
        for name in changes:
            _checks.one_of("replace", name, self._settings)
        return type(self)(**self._settings | {"input_errors": None, "anchors": None} | changes)

    def with_experiments(self, experiments: Iterable[Experiment]) -> Self:
        """Return the same problem with other data, or with some of its experiments.

        Parameters
        ----------
        experiments : iterable of Experiment
            Priors and fixed values of single experiments go by the experiments' names; those of experiments left out
            are dropped.

        Returns
        -------
        Problem

        Raises
        ------
        ValueError
            As the constructor does.
        """
        chosen = tuple(experiments)
        gone = {e.name for e in self.experiments} - {getattr(e, "name", None) for e in chosen}
        ends = tuple(end for name in gone for end in (f"[{name}]", f", {name}]"))
        priors, fixed = (
            {key: value for key, value in given.items() if not (isinstance(key, str) and key.endswith(ends))}
            for given in (self._settings["priors"], self._settings["fixed"])
        )
        for name, value in fixed.items():
            if isinstance(value, Mapping):
                fixed[name] = {run: number for run, number in value.items() if run not in gone}
        return self.replace(experiments=chosen, priors=priors, fixed=fixed)

    @property
    def tied(self) -> dict[str, str]:
        """The expressions of the tied parameters."""
        any_map = next(iter(self.parameter_maps.values()))
        return {name: expression.text for name, expression in any_map.tied.items()}

    def _ties(self) -> dict[str, sp.Expr]:
        """Return the expressions of the model's tied parameters by its symbols, those of others inserted."""
        others = {name: sp.Symbol(name, real=True) for name in (*self.sensors.names, SHIFT)}
        symbols: dict[str, sp.Expr] = self.model.parameter_symbols | others
        degrees: dict[str, float] = {}
        tied = next(iter(self.parameter_maps.values())).tied  # each only of those before it
        for name, tie in tied.items():
            symbols[name], degrees[name] = tie.symbolic(f"tied[{name!r}]", symbols, degrees)
        return {name: symbols[name] for name in tied if name not in others}

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
        return arguments.values_by_name("theta", theta, self.names)

    def completed(self, theta: Any) -> Any:
        """Return a mapping of θ with the parameters that the problem adds by itself, at their priors' medians.

        They are the delays of an autonomous model and, with ``input_noise="joint"``, the amplitudes of the errors of
        the inputs, unless they are given priors or values.

        Parameters
        ----------
        theta : mapping of str to float, or anything else
            Which is returned as it is.

        Returns
        -------
        dict of str to float
        """
        if not isinstance(theta, Mapping):
            return theta
        medians = dict(zip(self.names, self.median().tolist(), strict=True))
        return {name: medians[name] for name in self.automatic} | dict(theta)

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
            variances = {**self.likelihood.fixed, **renamed}
        return arguments.values_by_name("variances", variances, names)

    def log_prior(self, theta: Mapping[str, float] | np.ndarray) -> np.ndarray:
        """Return Σ ln p(θ_α).

        Parameters
        ----------
        theta : mapping of str to float, or array (…, names)
            See `vector`.

        Returns
        -------
        array (…)
            −inf outside the support.
        """
        return self.joint_prior.log_prob(self.vector(theta))

    @cached_property
    def logarithmic(self) -> np.ndarray:
        """Parameters sampled in their logarithm, those whose prior's support is (0, ∞): bool array (names,)."""
        return np.array([support == (0.0, np.inf) for support in self.joint_prior.supports.values()])

    @property
    def noisy_inputs(self) -> dict[str, list[str]]:
        """Inputs whose errors are integrated out, by experiment; without experiments that have none."""
        every = {e.name: noisy_inputs(e, self.input_noise) for e in self.experiments}
        return {name: inputs for name, inputs in every.items() if inputs}

    def true_inputs(self, experiment: Experiment) -> dict[str, np.ndarray]:
        """Return the inputs of the model in an experiment: the measured ones less their errors, by known sensors.

        Parameters
        ----------
        experiment : Experiment

        Returns
        -------
        dict of str to array (points,)
            In the inputs' units.
        """
        return self.drive(experiment, self.input_errors.get(experiment.name))[0]

    def drive(
        self, experiment: Experiment, errors: InputErrors | None, sensors: Mapping[str, float] | None = None
    ) -> tuple[dict[str, np.ndarray], float]:
        """Return inputs (points,) and frequency [Hz] of an experiment, the measured ones less expected errors.

        Parameters
        ----------
        experiment : Experiment
        errors : InputErrors, optional
        sensors : mapping of str to float, optional
            Values of unknown parameters of sensors; the inputs are corrected by these, too.

        Returns
        -------
        (dict of str to array (points,), float)
        """
        inputs = self.sensors.corrected(experiment, true_inputs(experiment, self.input_noise, errors), sensors)
        of_frequency = self.frequency_errors.get(experiment.name)
        if of_frequency is None or errors is None:
            return inputs, experiment.frequency
        error = float(errors.expected[-1])
        return of_frequency.true_inputs(inputs, error), experiment.frequency - error * of_frequency.se

    @cached_property
    def equations(self) -> dict[str, PeriodicEquations]:
        """The discretised equations of every experiment."""
        result = {}
        for e in self.experiments:
            inputs, frequency = self.drive(e, self.input_errors.get(e.name))
            how = {"samples": e.samples, "scheme": self.scheme, "periods": e.periods, "winding": e.winding}
            result[e.name] = equations_for(self.model, inputs, frequency=frequency, **how)
        return _checks.read_only(result)

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions cannot be pickled; they are loaded again where they are needed.
        return {key: value for key, value in self.__dict__.items() if key != "equations"}

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
        parameter_map = self.parameter_maps[experiment]
        return np.ascontiguousarray(parameter_map.values(theta)[:, : parameter_map.count])

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
        sensors = ", ".join(f"{channel} {sensor!r}" for channel, sensor in self.sensors.given.items())
        noisy = ", ".join(dict.fromkeys(name for inputs in self.noisy_inputs.values() for name in inputs))
        swept = dict.fromkeys(getattr(e.condition, "vary", "") for e in self.experiments)
        return (
            f"Problem({self.model.name!r}, {len(self.experiments)} experiments, free: {', '.join(self.names)}, "
            f"data: {', '.join((*self.channels, *self.quantities, *(f'jumps in {s}' for s in swept if s)))} "
            f"with {self.likelihood.values:.0f} independent values, {self.noise.name} noise"
            f"{f', noise of {noisy} integrated out' if noisy else ''}{f', sensors: {sensors}' if sensors else ''})"
        )


def written_out(problem: Description) -> dict[str, Any]:
    """Return arguments of the constructor with every prior and value by its full name.

    Errors of inputs that are parameters belong to the model.
    """
    model = problem.model if problem.input_noise == JOINT else problem.settings["model"]
    return problem.settings | {
        "model": model, "priors": problem.priors, "fixed": problem.fixed | problem.likelihood.fixed,
        "local": problem.local, "input_noise": EXACT if problem.input_noise == JOINT else problem.input_noise,
    }  # fmt: skip
