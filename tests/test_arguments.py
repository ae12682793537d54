"""Arguments of another kind than a mapping or a sequence: one ValueError that begins with the argument's name."""

import numpy as np
import pytest

import bayesperiodic as bp

FORCE = np.sin(2 * np.pi * np.arange(16) / 16)
MODEL = {
    "name": "oscillator", "states": ["x"], "inputs": ["force"], "parameters": ["k"], "outputs": {"x": "x"},
    "equations": ["ddx + 0.1*dx + k*x - force"],
}  # fmt: skip
EXPERIMENT = {"name": "run", "frequency": 1.0, "outputs": {"x": FORCE}, "inputs": {"force": FORCE}, "samples": 16}
MAPPINGS = {
    "model": ["units", "outputs"],
    "experiment": [
        "outputs", "inputs", "scatter", "independent", "harmonics", "unmeasured", "amplitude_variance",
        "amplitude_freedom", "left_out", "error_slopes", "drift", "middle", "clocks", "guess", "units",
    ],
    "problem": ["priors", "fixed", "tied"],
    "simulate": ["parameters", "inputs", "start", "noise"],
    "solve_periodic": ["parameters", "inputs"],
    "recording": ["outputs", "inputs", "units"],
    "response_table": ["outputs", "inputs", "phases", "sd", "phase_sd", "against", "derivatives", "units"],
    "from_matrices": ["forces", "base", "outputs", "units"], "from_harmonics": ["outputs", "inputs"],
    "element": ["constants"],
}  # fmt: skip
SEQUENCES = {
    "model": ["states", "inputs", "parameters", "angles"], "problem": ["experiments", "local"],
    "from_matrices": ["elements"], "section": ["coordinates", "angles"],
}  # fmt: skip
NUMBERS = {
    "experiment": ["frequency", "frequency_se"], "simulate": ["frequency", "duration", "sampling_rate", "seed"],
    "continue_periodic": ["until", "step"], "section": ["frequency", "origin"],
}  # fmt: skip
TIME = 0.05 * np.arange(400)
RECORDING = {"time": TIME, "outputs": {"x": np.sin(6.0 * TIME), "y": np.cos(6.0 * TIME)}, "inputs": {}}
OTHERS = {
    "recording": (bp.Recording, RECORDING),
    "section": (
        bp.PoincareSection.from_recording,
        {"recording": bp.Recording(**RECORDING), "coordinates": ["x", "y"], "frequency": 1.0},
    ),
    "response_table": (
        bp.response_table,
        {"table": {"f": [0.5, 0.6], "a": [1.0, 1.1]}, "outputs": {"x": "a"}, "inputs": {"F": 1.0}, "frequency": "f"},
    ),
    "from_harmonics": (
        bp.Experiment.from_harmonics, {"name": "run", "frequency": 1.0, "outputs": {"x": [0, 1]}, "samples": 16},
    ),
    "element": (bp.elements.Element, {"name": "stop", "force": bp.elements.gap, "place": 0}),
    "from_matrices": (
        bp.Model.from_matrices,
        {"name": "m", "mass": [[1.0]], "stiffness": [[1.0]], "outputs": {"x": (0, "displacement")}},
    ),
}  # fmt: skip


def call(what, **changed):
    if what in OTHERS:
        function, given = OTHERS[what]
        return function(**given | changed)
    model = bp.Model(**MODEL | (changed if what == "model" else {}))
    experiment = bp.Experiment(**EXPERIMENT | (changed if what == "experiment" else {}))
    if what == "problem":
        given = {"model": model, "experiments": [experiment], "priors": {"k": bp.Normal(1.0, 0.1)}}
        return bp.Problem(**given | changed)
    periodic = {"model": model, "parameters": {"k": 1.0}, "inputs": {"force": FORCE}, "frequency": 1.0}
    if what == "simulate":
        return bp.simulate(**periodic | {"duration": 3.0, "sampling_rate": 10.0} | changed)
    if what == "solve_periodic":
        return bp.solve_periodic(**periodic | {"samples": 16} | changed)
    if what == "continue_periodic":
        solution = bp.solve_periodic(**periodic, samples=16)
        return bp.continue_periodic(model, solution, **{"vary": "k", "until": 1.1} | changed)
    return experiment


@pytest.mark.parametrize("wrong", [3, -1.5, "text", ["x"], True, len], ids=str)
@pytest.mark.parametrize("what, argument", [(what, name) for what, names in MAPPINGS.items() for name in names])
def test_what_is_no_mapping_is_refused_by_name(what, argument, wrong):
    with pytest.raises(ValueError, match=rf"^{argument}\b.*: must"):
        call(what, **{argument: wrong})


@pytest.mark.parametrize("wrong", [3, -1.5, True, len], ids=str)
@pytest.mark.parametrize("what, argument", [(what, name) for what, names in SEQUENCES.items() for name in names])
def test_what_is_no_sequence_is_refused_by_name(what, argument, wrong):
    with pytest.raises(ValueError, match=f"^{argument}: must"):
        call(what, **{argument: wrong})


@pytest.mark.parametrize("wrong", ["text", ["x"], {"x": 1.0}, len, 1j, float("nan")], ids=str)
@pytest.mark.parametrize("what, argument", [(what, name) for what, names in NUMBERS.items() for name in names])
def test_what_is_no_number_is_refused_by_name(what, argument, wrong):
    with pytest.raises(ValueError, match=f"^{argument}: must"):
        call(what, **{argument: wrong})


@pytest.mark.parametrize("wrong", [3, True, None, len], ids=str)
def test_channels_of_a_clock_that_are_no_sequence_are_refused(wrong):
    with pytest.raises(ValueError, match=r"^clocks\['second'\]: must be a sequence"):
        bp.Recording(**RECORDING).fold(64, frequency=1.0, clocks={"second": wrong})


def test_what_predict_runs_must_be_a_function():
    with pytest.raises(ValueError, match="^run: must be a function, got 3"):
        bp.predict(call("problem"), None, run=3)


def test_a_problem_without_priors_is_refused():
    with pytest.raises(ValueError, match="^priors: must have at least one free parameter"):
        call("problem", priors={}, fixed={"k": 1.0})
