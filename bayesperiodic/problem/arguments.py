"""Checked arguments of a problem: experiments, local and fixed parameters, and values by name."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.experiment import DATA, Experiment
from bayesperiodic.data.recording import Recording
from bayesperiodic.data.special_points import Fold, PhaseLag
from bayesperiodic.data.units import difference
from bayesperiodic.models.model import CondensedModel, Model
from bayesperiodic.models.sensed import SHIFT


def values_by_name(argument: str, given: Any, names: tuple[str, ...]) -> np.ndarray:
    """Return the values (…, names) of an argument that is a mapping or such an array; raise a ValueError otherwise."""
    if isinstance(given, Mapping):
        _checks.same_names(argument, given, names)
        each = np.broadcast_arrays(*(_checks.real_array(argument, given[name]) for name in names))
        given = np.stack(each, -1) if names else np.empty(0)
    values = _checks.real_array(argument, given)
    if values.shape[-1:] != (len(names),):
        raise ValueError(f"{argument}: last axis must be {list(names)}, got shape {values.shape}.")
    return values


def check_special_points(
    experiments: Iterable[Experiment],
    sensors: Any,
    noisy: Mapping[str, list[str]],
    parameter_maps: Mapping[str, Any],
) -> None:
    """Refuse sensors, unknown delays and errors of inputs that the solver of special points does not know of.

    The sensors are the `Sensors` of the problem; noisy inputs and parameter maps are by experiment.
    """
    for e in experiments:
        point, late = e.condition, parameter_maps[e.name].delayed or bool(sensors.late_inputs)
        if point is not None and noisy.get(e.name):
            raise ValueError(
                f"input_noise: must not be of {noisy[e.name]} in {e.name!r}, a jump or resonance point, whose inputs "
                "are exact. Give their error in its sd."
            )
        if isinstance(point, PhaseLag) and (late or point.output in sensors.given):
            given = "unknown delays" if late else repr(sensors.given[point.output])
            raise ValueError(
                f"sensors: must be without one of {point.output!r} and without unknown delays for the phase in "
                f"{e.name!r}, got {given}. Correct frequency, amplitude and lag before."
            )


def refuse_special_points(experiments: Iterable[Experiment], purpose: str) -> None:
    """Raise a ValueError if experiments are jumps or resonance points, of which a purpose cannot make use."""
    if special := [e.name for e in experiments if e.condition is not None]:
        raise ValueError(
            f"problem: must be without jumps and resonance points for {purpose}, got {special}; leave them out by "
            "problem.with_experiments."
        )


def check_units(model: Model, experiments: Iterable[Experiment], sensors: Mapping[str, Any]) -> None:
    """Raise a ValueError if values are known to be in other units than the model's; a gain may convert them."""
    for e in experiments:
        for channel, unit in e.units.items():
            needed = model.units.get(channel, "")
            if (channel in sensors and sensors[channel].gain != 1.0) or not (how := difference(unit, needed)):
                continue
            kind = "inputs" if channel in e.inputs else "outputs"
            raise ValueError(
                f"{kind}[{channel!r}] of experiment {e.name!r}: must be in {needed!r}, its unit in {model.name!r}, got "
                f"values in {unit!r}, {how}. Take another channel of the file or units={{{channel!r}: …}} where it is "
                "read, or state another unit of the model."
            )


def checked_local(
    local: Iterable[str], every: tuple[str, ...], priors: Any, tied: Mapping[str, str]
) -> tuple[str, ...]:
    """Return the names of local parameters, the delay of all outputs included; raise a ValueError unless they fit."""
    if isinstance(local, str):
        raise ValueError(f"local: must be a sequence of names, got {local!r}. Give [{local!r}].")
    names = tuple(local)
    for name in names:
        _checks.one_of("local", name, every)
        if name in tied:
            raise ValueError(f"local: {name!r} is tied; it follows what it is tied to, so leave it out.")
    for key in priors:
        for name in key if isinstance(key, tuple) else ():
            if name in names:
                raise ValueError(
                    f"priors[{key!r}]: {name!r} is local; a joint prior needs the names of single experiments, such as "
                    f"'{name}[run]'."
                )
    return names if SHIFT in names else (*names, SHIFT)


def fixed_values(name: str, given: Any, runs: list[str], local: bool) -> dict[str, float]:
    """Return the value of a fixed parameter in each experiment; a local one may be fixed in some of them."""
    if not isinstance(given, Mapping):
        return dict.fromkeys(runs, _checks.finite_number(f"fixed[{name!r}]", given))
    for run in given:
        _checks.one_of(f"fixed[{name!r}]", run, runs)
    if not local:
        _checks.same_names(f"fixed[{name!r}]", given, runs)
    return {run: _checks.finite_number(f"fixed[{name!r}][{run!r}]", given[run]) for run in runs if run in given}


def _check_condensed(e: Experiment, model: Model) -> None:
    """Refuse what is not known of condensed models."""
    unknown: dict[str, Any] = {
        "multipliers": e.multipliers, "condition": e.condition, "guess": e.guess == DATA and DATA,
    }  # fmt: skip
    for name, value in unknown.items():
        if value is not None and value is not False:
            raise ValueError(
                f"{name} of experiment {e.name!r}: must be absent for {model.name!r}, which is condensed, got "
                f"{_checks.shortened(value)}; make the model with Model.from_matrices(…, condensed=False), of few "
                "degrees of freedom."
            )


def checked_experiments(model: Model, experiments: Iterable[Experiment]) -> tuple[Experiment, ...]:
    """Return the experiments; raise a ValueError unless they are experiments with signals that the model has."""
    if isinstance(experiments, Experiment):
        raise ValueError(
            f"experiments: must be a sequence, got {experiments.name!r}. Give a list of one, [experiment]."
        )
    result = _checks.several("experiments", experiments)
    for e in result:
        if isinstance(e, Recording):
            raise ValueError(f"experiments: must be experiments, got the recording {e.name!r}. Fold it, see fold().")
        if not isinstance(e, Experiment):
            raise ValueError(f"experiments: must each be an Experiment, got {e!r}.")
    if not result:
        raise ValueError("experiments: must have at least one experiment, got ().")
    names = [experiment.name for experiment in result]
    if len(set(names)) < len(names):
        raise ValueError(
            f"experiments: names must differ, got {names}. Name them with fold(name=…), or those of a table with "
            "dataclasses.replace(experiment, name=…)."
        )
    for e in result:
        if model.inputs and not e.inputs:
            raise ValueError(
                f"inputs of experiment {e.name!r}: must be {', '.join(map(repr, model.inputs))}, got none. Give "
                "them to the recording; the orbits of a chaotic one have them by find_orbits(…, waveforms=True)."
            )
        _checks.same_names(f"inputs of experiment {e.name!r}", e.inputs, model.inputs)
        if not e.channels and not isinstance(e.condition, Fold):
            raise ValueError(f"outputs of experiment {e.name!r}: must have at least one channel, got {{}}.")
        for channel in e.channels:
            _checks.one_of(f"outputs of experiment {e.name!r}", channel, model.outputs)
        if e.condition is not None and model.autonomous:
            raise ValueError(
                f"condition of experiment {e.name!r}: must be None for {model.name!r}, which is autonomous, got "
                f"{e.condition!r}."
            )
        if e.guess == DATA and model.autonomous:
            raise ValueError(
                f"guess of experiment {e.name!r}: must be states for {model.name!r}, which is autonomous, got "
                f"{DATA!r}. If an output measures the state x, less its mean if the sensor adds one, take "
                "dataclasses.replace(experiment, guess={'x': experiment.outputs[…]})."
            )
        if isinstance(model, CondensedModel):
            _check_condensed(e, model)
        if e.guess and not isinstance(e.guess, str):
            _checks.same_names(f"guess of experiment {e.name!r}", e.guess, model.states)
        if model.autonomous and not e.frequency_se > 0.0:
            raise ValueError(
                f"experiment {e.name!r}: frequency_se must be > 0, got {e.frequency_se:g}; {model.name!r} is "
                "autonomous, so that its measured frequency is data. Fold without `frequency`, which is then "
                "estimated with its error, or set Experiment(…, frequency_se=…)."
            )
    return tuple(_in_order(e, model) for e in result)


def _in_order(experiment: Experiment, model: Model) -> Experiment:
    """Return an experiment whose outputs, to which its covariance refers, are in the order of the model."""
    given, covariance = [*experiment.outputs], experiment.covariance
    names = [name for name in model.outputs if name in experiment.outputs]
    if covariance is None or names == given:
        return experiment
    values = np.count_nonzero(experiment.measured_points) * len(names)
    rows = np.arange(values).reshape(-1, len(names))[:, [given.index(name) for name in names]].ravel()
    rows = np.append(rows, np.arange(values, len(covariance)))
    outputs = {name: experiment.outputs[name] for name in names}
    return replace(experiment, outputs=outputs, covariance=covariance[np.ix_(rows, rows)])
