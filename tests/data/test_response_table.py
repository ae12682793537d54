"""Tables of responses, against the closed form of a linear oscillator."""

import warnings

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
        (TABLE, {"phase_sd": {"x": 1.0}, "phases": None}, "phase_sd: must be of outputs with phases, got one for 'x'"),
        (TABLE, {"sd": {"x": "a%"}}, r"sd\['x'\]: must be a number and a % sign, such as '0.5%', got 'a%'"),
        (TABLE, {"sd": {"x": 0.0}}, r"sd\['x'\]: must be standard deviations > 0, got 0 in row 1"),
        (TABLE, {"size": "rms of signal"}, "phase_sd: must be given for 'x'"),
        (TABLE, {"size": "rms of signal", "derivatives": {"x": 1}}, "size: must be of sines, 'peak', 'rms'"),
        (TABLE, {"outputs": {"x": {0: "A"}}}, "harmonic: must be an integer .* 1"),
        (TABLE, {"phases": {"x": {3: "phi"}}}, r"phases\['x'\]: must have the harmonics of the amplitudes, \[1\]"),
        (TABLE | {"phi": (TABLE["phi"] + 90) % 180 - 90}, {}, r"phases\['x'\]: must be phases over the whole turn"),
        (TABLE | {"A dB": TABLE["A"]}, {"outputs": {"x": "A dB"}}, "must be amplitudes, got levels in dB"),
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
        (TABLE, {"sweep": "both"}, "sweep: must be 'up', 'down' or None, got 'both'; make a table of each sweep"),
        (TABLE | {"A": TABLE["A"].astype(str)}, {}, "column 'A' of the table: must contain numbers, .* got '0.*'"),
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


def test_phases_in_radians_without_their_unit_are_warned_of():
    """Through a resonance phases turn by more than degrees; a table below it may have small ones."""
    table = TABLE | {"phi": np.radians(TABLE["phi"])}
    with pytest.warns(UserWarning, match=r"phases\['x'\]: turns by 2.* degrees only .* phase_unit='rad'"):
        bp.response_table(table, **COLUMNS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bp.response_table(table, **COLUMNS, phase_unit="rad")
        below = slice(np.argmax(TABLE["A"]))
        bp.response_table({name: values[below] for name, values in table.items()}, **COLUMNS)


@pytest.mark.parametrize(
    "name, values, expected",
    [
        ("s [%]", 2.0, 0.02 * np.abs(H)),
        ("s %", 3.0, 0.03 * np.abs(H)),
        ("s [µm]", 50.0, 5e-5),
        ("s", 0.2, 2e-4),
    ],
)
def test_columns_of_standard_deviations_have_their_unit(name, values, expected):
    """Amplitudes in mm; a column in percent is a share, one without a unit has that of the amplitudes."""
    table = {"f": F, "x [mm]": 1e3 * abs(H), name: np.full(F.size, values)}
    runs = bp.response_table(table, frequency="f", outputs={"x": "x [mm]"}, inputs={"force": 1.0}, sd={"x": name})
    assert [run.measurements[0].sd for run in runs] == pytest.approx(np.broadcast_to(expected, F.shape))


@pytest.mark.parametrize("unit", ["kg", "N", "dB"])
def test_standard_deviations_of_another_kind_are_refused(unit):
    table = {"f": F, "x [mm]": 1e3 * abs(H), f"s [{unit}]": np.ones(F.size)}
    with pytest.raises(ValueError, match=r"sd\['x'\]: must be in a unit of the amplitudes \(mm\) or in %"):
        bp.response_table(table, frequency="f", outputs={"x": "x [mm]"}, inputs={"force": 1.0}, sd={"x": f"s [{unit}]"})


def test_phases_of_the_other_sign_are_warned_of():
    """Through a resonance a response falls behind its force; complex amplitudes may be of exp(-i omega t)."""
    lags = TABLE | {"phi": -TABLE["phi"], "H": np.conj(H)}
    of_complex = COLUMNS | {"outputs": {"x": "H"}, "phases": None, "per": "force"}
    below = {name: values[: np.argmax(TABLE["A"])] for name, values in lags.items()}
    for arguments in (COLUMNS, of_complex):
        with pytest.warns(UserWarning, match=r"phases\['x'\]: rise by 1\d\d degrees .* give lag=True"):
            bp.response_table(lags, **arguments)
        with pytest.warns(UserWarning, match="leave lag=True out"):
            bp.response_table(TABLE, **arguments, lag=True)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            bp.response_table(TABLE, **arguments)
            bp.response_table(lags, **arguments, lag=True)
            bp.response_table(below, **arguments)


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


@pytest.mark.parametrize(
    "table, arguments",
    [
        (TABLE, {}),
        (TABLE, {"sd": {"x": 0.02}}),
        (
            TABLE | {"s": 0.04 * np.ones(6), "A": 2 * TABLE["A"], "F": 2 * FORCE},
            {"sd": {"x": "s"}, "size": "peak to peak"},
        ),
        (TABLE | {"A": 1e3 * TABLE["A"]}, {"sd": {"x": 20.0}, "units": {"x": ("mm", "m")}}),
        (TABLE | {"A": TABLE["A"] * OMEGA**2}, {"sd": {"x": "2%"}, "derivatives": {"x": 2}}),
        (TABLE | {"A": abs(H) * OMEGA}, {"sd": {"x": "2%"}, "derivatives": {"x": 1}, "per": "force"}),
    ],
)
def test_amplitudes_alone_are_those_of_the_table(table, arguments):
    runs = bp.response_table(table, **(COLUMNS | {"phases": None} | arguments))
    measured = [run.measurements[0] for run in runs]
    assert all(run.outputs == {} and len(run.measurements) == 1 for run in runs)
    assert [one.value for one in measured] == pytest.approx(abs(FORCE * H))
    given = arguments.get("sd", {}).get("x")
    expected = [None] * 6 if given is None else 0.02 * (abs(FORCE * H) if given == "2%" else np.ones(6))
    assert [one.sd for one in measured] == (expected if given is None else pytest.approx(expected))


@pytest.mark.parametrize(
    "table, arguments, sd",
    [
        (TABLE, {"phase_sd": {"x": 1.0}}, np.radians(1.0)),
        (TABLE | {"phi": -TABLE["phi"]}, {"lag": True}, 0.01),
        (TABLE | {"H": np.conj(H)}, {"outputs": {"x": "H"}, "phases": None, "per": "force", "lag": True}, 0.01),
        (TABLE | {"A": OMEGA * TABLE["A"], "phi": TABLE["phi"] + 90.0}, {"derivatives": {"x": 1}}, 0.01),
    ],
)
def test_phases_with_known_standard_deviations_are_those_of_the_table(table, arguments, sd):
    runs = bp.response_table(table, **(COLUMNS | {"sd": {"x": "1%"}} | arguments))
    phases = [run.measurements[1] for run in runs]
    assert [(one.to, one.value) for one in phases] == [("force", pytest.approx(np.angle(h))) for h in H]
    assert [one.sd for one in phases] == pytest.approx(np.full(6, sd))


def test_harmonics_of_a_table_are_data_of_their_own():
    table = TABLE | {"A3": 0.1 * TABLE["A"], "phi3": np.linspace(-170.0, 170.0, 6)}
    outputs, phases = {"x": {1: "A", 3: "A3"}}, {"x": {1: "phi", 3: "phi3"}}
    arguments = COLUMNS | {"outputs": outputs, "phases": phases}
    c = np.array([2 / run.samples * np.fft.rfft(run.outputs["x"])[3] for run in bp.response_table(table, **arguments)])
    assert c == pytest.approx(0.1 * abs(FORCE * H) * np.exp(1j * np.radians(table["phi3"])))
    (first, third) = bp.response_table(table, **(arguments | {"phases": None}))[0].measurements
    assert (first.harmonic, third.harmonic) == (1, 3) and third.value == pytest.approx(0.1 * first.value)


@pytest.mark.parametrize(
    "size, kind, of_sine", [("rms", "RootMeanSquare", np.sqrt(0.5)), ("peak to peak", "PeakToPeak", 2.0)]
)
def test_values_of_meters_are_of_the_whole_signal(size, kind, of_sine):
    runs = bp.response_table(
        TABLE, **(COLUMNS | {"phases": None, "size": f"{size} of signal", "sd": {"x": "1%"}})
    )  # fmt: skip
    meters = [run.measurements[0] for run in runs]
    assert [type(one).__name__ for one in meters] == [kind] * 6
    assert [one.value for one in meters] == pytest.approx(TABLE["A"])
    assert [one.sd for one in meters] == pytest.approx(0.01 * TABLE["A"])
    assert amplitudes(runs, "force", "inputs") == pytest.approx(FORCE / of_sine)


def test_tables_of_the_same_columns_are_tables_of_their_own():
    tables = TABLE, TABLE | {"F": 2.0 * FORCE}, TABLE | {"A": 1.01 * TABLE["A"]}
    sweeps = [{run.sweep for run in bp.response_table(table, **COLUMNS, sweep="up")} for table in (*tables, TABLE)]
    assert [len(one) for one in sweeps] == [1] * 4 and len(set.union(*sweeps)) == 3


@pytest.mark.parametrize("orders, turn", [({}, 0.0), ({"x": 1}, 90.0), ({"v": 2}, -180.0), ({"x": 2, "v": 2}, 0.0)])
def test_phase_against_another_output_is_compared_with_that(orders, turn):
    """A derivative in the table is a quarter of a turn ahead of its output."""
    table = TABLE | {"phi": np.full(6, 30.0 + turn)}
    given = {"outputs": {"x": "A", "v": "A"}, "against": {"x": "v"}, "phase_sd": {"x": 1.0}, "derivatives": orders}
    phase = bp.response_table(table, **(COLUMNS | given))[0].measurements[1]
    assert phase.to == "v" and phase.value == pytest.approx(np.radians(30.0))
