"""Tables of responses, against the closed form of a linear oscillator."""

import numpy as np
import pandas as pd
import pytest

import bayesperiodic as bp

F = np.array([0.05, 0.10, 0.14, 0.16, 0.18, 0.25])
OMEGA = 2 * np.pi * F
H = 1.0 / (1.0 - OMEGA**2 + 0.2j * OMEGA)
FORCE = 0.5 + F
TABLE = {"f": F, "A": abs(FORCE * H), "phi": np.degrees(np.angle(H)), "F": FORCE, "H": H}
COLUMNS = {"frequency": "f", "outputs": {"x": "A"}, "phases": {"x": "phi"}, "inputs": {"force": "F"}}
MODEL = bp.Model(
    "osc", states=["x"], inputs=["force"], parameters=["c", "k"], equations=["ddx + c*dx + k*x - force"],
    outputs={"x": "x"},
)  # fmt: skip


def amplitudes(runs, channel="x", kind="outputs"):
    return np.array([2 / run.samples * np.fft.rfft(getattr(run, kind)[channel])[1] for run in runs])


@pytest.mark.parametrize(
    "table, arguments",
    [
        (TABLE, {}),
        (pd.DataFrame({key: TABLE[key] for key in ("f", "A", "phi", "F")}), {}),
        (TABLE | {"A": 1e3 * TABLE["A"]}, {"units": {"x": ("mm", "m")}}),
        (TABLE | {"A": TABLE["A"] / np.sqrt(2), "F": FORCE / np.sqrt(2)}, {"size": "rms"}),
        (TABLE | {"A": TABLE["A"] * 2, "F": FORCE * 2}, {"size": "peak to peak"}),
        (TABLE | {"phi": np.angle(H)}, {"phase_unit": "rad"}),
        (TABLE | {"phi": TABLE["phi"] - 360.0}, {}),
        (TABLE, {"outputs": {"x": "H"}, "phases": None, "per": "force"}),
        (TABLE | {"f": 60.0 * F}, {"units": {"frequency": ("rpm", "Hz")}}),
    ],
)
def test_amplitudes_and_phases_are_those_of_the_table(table, arguments):
    runs = bp.response_table(table, **(COLUMNS | arguments))
    assert [run.frequency for run in runs] == pytest.approx(F.tolist())
    assert amplitudes(runs) == pytest.approx(FORCE * H) and amplitudes(runs, "force", "inputs") == pytest.approx(FORCE)
    assert all(run.independent == {"x": 2} for run in runs)


def test_table_in_a_file_with_units_and_a_constant_force(tmp_path):
    path = tmp_path / "sweep.csv"
    pd.DataFrame({"f [Hz]": F, "A [mm]": 1e3 * abs(0.5 * H), "phase [deg]": TABLE["phi"]}).to_csv(path, index=False)
    runs = bp.response_table(
        path, frequency="f [Hz]", outputs={"x": "A [mm]"}, phases={"x": "phase [deg]"}, inputs={"force": 0.5}
    )
    assert amplitudes(runs) == pytest.approx(0.5 * H)


def test_an_estimate_from_a_table_has_the_truth_in_its_interval():
    """The seed is one for which the 99 % intervals contain both parameters; 2 % of the seeds would not."""
    noisy = FORCE * H + 0.01 * (np.random.default_rng(1).standard_normal((F.size, 2)) @ [1.0, 1j])
    runs = bp.response_table(TABLE | {"z": noisy}, frequency="f", outputs={"x": "z"}, inputs={"force": "F"})
    priors = {"c": bp.LogNormal(0.3, 1.0), "k": bp.LogNormal(1.5, 0.5)}
    fit = bp.map_estimate(bp.Problem(MODEL, runs, priors=priors, scheme="fourier"), progress=False)
    ends = fit.interval(0.99)
    assert ends["c"][0] < 0.2 < ends["c"][1] and ends["k"][0] < 1.0 < ends["k"][1]


@pytest.mark.parametrize(
    "table, arguments, message",
    [
        (TABLE, {"phases": None}, "phases: must have the phase of 'x', got none"),
        (
            TABLE | {"A": -TABLE["A"]},
            {},
            r"outputs\['x'\]: must be amplitudes > 0, got -0.* in row 1 of",
        ),
        (TABLE, {"outputs": {"x": "H"}}, "phases: must be left out for complex amplitudes, got one for 'x'"),
        (TABLE | {"phi": 100.0 * TABLE["phi"]}, {}, "phases: must be within 720°, got"),
        (TABLE | {"f": F - 0.05}, {}, "frequency: must be > 0 Hz, got 0 in row 1"),
        (TABLE, {"frequency": None}, "frequency: must be a column of the table, got None"),
        (TABLE, {"per": "x"}, "per: must be 'force', got 'x'"),
        (TABLE, {"size": "rsm"}, "size: must be one of .*, got 'rsm'. Did you mean 'rms'"),
        (TABLE, {"inputs": {"force": -1.0}}, r"inputs\['force'\]: must be > 0"),
        (TABLE, {"inputs": {"force": "G"}}, "column of the table: must be one of 'f', 'A', 'phi', 'F', 'H', got 'G'"),
        (TABLE, {"units": {"y": 1.0}}, "units: must be one of"),
        (
            TABLE | {"A": np.where(F > 0.2, np.nan, TABLE["A"])},
            {},
            "must be finite, got nan in row 6; leave",
        ),
    ],
)
def test_tables_that_cannot_be_what_they_say_are_refused(table, arguments, message):
    with pytest.raises(ValueError, match=message):
        bp.response_table(table, **(COLUMNS | arguments))


@pytest.mark.parametrize(
    "units, message",
    [
        ({"phi": "s"}, "phases: must be in degrees or radians, got 's'"),
        ({"f": "ms"}, "frequency: must be in Hz, got 'ms'"),
        ({"A": "mm/N"}, "per: must be the input per which 'x' is given, got None and values in 'mm/N'"),
    ],
)
def test_units_of_another_kind_are_refused(units, message):
    table = pd.DataFrame({key: TABLE[key] for key in ("f", "A", "phi", "F")})
    table.attrs["units"] = units
    with pytest.raises(ValueError, match=message):
        bp.response_table(table, **COLUMNS)


def test_unit_of_phases_counts():
    table = pd.DataFrame({"f": F, "A": TABLE["A"], "phi": np.angle(H), "F": FORCE})
    table.attrs["units"] = {"phi": "rad"}
    assert amplitudes(bp.response_table(table, **COLUMNS)) == pytest.approx(FORCE * H)


def test_columns_of_different_lengths_are_refused():
    with pytest.raises(ValueError, match="table: must have columns of one length, got"):
        bp.response_table({"f": [1.0, 2.0], "A": 1.0}, frequency="f", outputs={"x": "A"}, inputs={"force": 1.0})
