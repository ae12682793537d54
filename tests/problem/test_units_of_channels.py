"""Units of measured channels: they stay with the data, and a problem refuses those that are not its model's."""

import numpy as np
import pandas as pd
import pytest

import bayesperiodic as bp

FREQUENCY, STIFFNESS, DAMPING = 0.2, 4.0, 0.3
PRIORS = {"c": bp.LogNormal(DAMPING, 0.5), "k": bp.LogNormal(STIFFNESS, 0.5)}


def oscillator(**units):
    return bp.Model(
        "oscillator", states=["x"], inputs=["F"], parameters=["c", "k"], equations=["ddx + c*dx + k*x - F"],
        outputs={"x": "x", "a": "ddx"}, units=units,
    )  # fmt: skip


def table_of(of="x", factor=1.0):
    """Return times, a force and the exact response of the oscillator of mass 1 kg, or its acceleration."""
    t, w = np.arange(0.0, 100.0, 0.05), 2.0 * np.pi * FREQUENCY
    x = 1.0 / (STIFFNESS - w**2 + 1j * w * DAMPING)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(t.size)
    values = (x if of == "x" else -(w**2) * x) * np.exp(1j * w * t)
    return pd.DataFrame({"t": t, "F": np.cos(w * t), "y": factor * (values.real + noise)})


def recorded(units, *, asked=None, split=None, **given):
    table = table_of(**given)
    table.attrs["units"] = units
    return bp.Recording.from_dataframe(table, time="t", outputs={"x": "y"}, inputs={"F": "F"}, units=asked, split=split)


def problem(recording, model, **more):
    return bp.Problem(model, [recording.fold(32, frequency=FREQUENCY)], priors=PRIORS, scheme="fourier", **more)


def test_units_stay_with_parts_joined_and_folded_recordings():
    run = recorded({"F": "N", "y": "mm"})
    assert run.units == {"x": "m", "F": "N"}
    parts = [run.between(0.0, 50.0), bp.Recording.join(run), run.fold(32, frequency=FREQUENCY)]
    assert all(part.units == run.units for part in parts)


@pytest.mark.parametrize(
    ("asked", "unit"), [(None, "m"), (2.0, None), ("cm", "cm"), (("mm", "um"), "um"), (("mm", "m"), "m")]
)
def test_unit_is_that_of_the_values_and_unknown_after_a_factor(asked, unit):
    assert recorded({"y": "mm"}, asked=asked and {"x": asked}).units.get("x") == unit


def test_saved_experiments_keep_them(tmp_path):
    run = recorded({"y": "mm"}).fold(32, frequency=FREQUENCY)
    run.save(tmp_path / "run.h5")
    assert bp.load(tmp_path / "run.h5").units == {"x": "m"}


def test_an_acceleration_is_refused_for_a_displacement():
    run, model = recorded({"F": "N", "y": "m/s²"}, of="a"), oscillator(x="m", F="N")
    with pytest.raises(ValueError, match=r"outputs\['x'\] of experiment .* must be in 'm', .* of another quantity"):
        problem(run, model)


def test_kilonewtons_of_the_model_are_not_the_newtons_of_the_file():
    run = recorded({"F": "N", "y": "m"})
    with pytest.raises(
        ValueError, match=r"inputs\['F'\] .* must be in 'kN', .* got values in 'N', which is 0\.001 of it"
    ):
        problem(run, oscillator(F="kN"))


def test_celsius_of_the_model_is_not_the_kelvin_of_the_file():
    with pytest.raises(ValueError, match="must be in 'degC', .* which has another zero"):
        problem(recorded({"y": "°C"}), oscillator(x="degC"))


@pytest.mark.parametrize(
    ("unit", "of_model"),
    [("mm", "m"), ("m", "m"), ("cm", "metre"), ("m", ""), ("", "m"), ("m", "g"), ("m", "u s"), ("N", "kg*m/s²")],
)
def test_equal_and_unknown_units_are_taken(unit, of_model):
    values = problem(recorded({"y": unit}), oscillator(x=of_model))
    assert values.names == ("c", "k")


def test_a_gain_of_the_sensor_may_convert_them():
    run, model = recorded({"y": "V"}, factor=0.1), oscillator(x="m")
    with pytest.raises(ValueError, match="of another quantity"):
        problem(run, model)
    with pytest.raises(ValueError, match="of another quantity"):
        problem(run, model, sensors={"x": bp.Sensor(delay=bp.Normal(0.0, 0.01))})
    estimate = bp.map_estimate(problem(run, model, sensors={"x": bp.Sensor(gain=0.1)}), progress=False)
    assert estimate.theta["k"] == pytest.approx(STIFFNESS, rel=0.01)


def test_results_of_data_without_units_are_those_of_the_same_data_with_them():
    with_units, without = (problem(recorded(units), oscillator(x="m")) for units in ({"y": "m"}, {}))
    assert bp.map_estimate(with_units, progress=False).fingerprint == (
        bp.map_estimate(without, progress=False).fingerprint
    )


def response(units, *, derivatives=None, per=None, of_model="m", unit_of_force="N"):
    table = pd.DataFrame({"f": [0.1, 0.2, 0.3], "y": [0.3, 0.4, 0.9]})
    table.attrs["units"] = units | {"f": "Hz"}
    runs = bp.response_table(
        table, frequency="f", outputs={"x": "y"}, inputs={"F": 1.0 if per is None else "y"}, sd={"x": 0.01},
        derivatives=derivatives, per=per,
    )  # fmt: skip
    return bp.Problem(oscillator(x=of_model, F=unit_of_force), runs, priors=PRIORS)


def test_tables_of_other_quantities_are_refused():
    with pytest.raises(ValueError, match=r"outputs\['x'\] of experiment .* must be in 'm', .* of another quantity"):
        response({"y": "m/s**2"})
    assert response({"y": "m/s**2"}, derivatives={"x": 2}).names == ("c", "k")
    with pytest.raises(ValueError, match="of another quantity"):
        response({"y": "m/s**2"}, derivatives={"x": 1})
    with pytest.raises(ValueError, match="is 0.001 of it"):
        response({"y": "m"}, of_model="km")


@pytest.mark.parametrize("units", [{"F": "m"}, {"y": ""}, {"x": 3}, "m"])
def test_units_of_other_channels_and_no_texts_are_refused(units):
    t = np.arange(0.0, 10.0, 0.1)
    with pytest.raises(ValueError, match="^units"):
        bp.Recording(t, {"x": np.sin(t)}, {}, units=units)
