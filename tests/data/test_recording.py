import csv as table_format
import io

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
import xarray as xr

import bayesperiodic as bp

TIME = np.arange(200) / 50
FORCE, DISPLACEMENT = np.cos(TIME), 3.0 * np.sin(TIME)
CHANNELS = {"outputs": {"force": "F [N]"}, "inputs": {"displacement": "x"}}


@pytest.fixture
def csv(tmp_path):
    path = tmp_path / "run 7.csv"
    pd.DataFrame({"t": TIME, "x": DISPLACEMENT, "F [N]": FORCE, "note": "text"}).to_csv(path, index=False)
    return path


def rewrite(path, row, column, text):
    table = pd.read_csv(path, dtype=str)
    table.loc[row, column] = text
    table.to_csv(path, index=False)


def test_csv_columns_by_name_and_units_by_pair_or_factor(csv):
    recording = bp.Recording.from_csv(
        csv, time="t", **CHANNELS, units={"displacement": ("mm", "m"), "force": 2.0, "time": ("ms", "s")}
    )
    assert recording.inputs["displacement"] == pytest.approx(1e-3 * DISPLACEMENT)
    assert recording.outputs["force"] == pytest.approx(2.0 * FORCE)
    assert recording.time == pytest.approx(1e-3 * TIME)
    assert recording.name == "run 7"
    assert not recording.synthetic


def test_sampling_rate_stands_in_for_a_time_column(csv):
    recording = bp.Recording.from_csv(csv, sampling_rate=50.0, **CHANNELS)
    assert recording.time == pytest.approx(TIME)
    assert recording.sampling_rate == pytest.approx(50.0)


def test_npz_mat5_and_mat73_give_the_same_recording(tmp_path):
    columns = {"t": TIME, "x": DISPLACEMENT, "F": FORCE}
    np.savez(tmp_path / "run.npz", **columns)
    scipy.io.savemat(tmp_path / "v5.mat", columns)
    with h5py.File(tmp_path / "v73.mat", "w") as file:
        for name, values in columns.items():
            file[name] = values[None]
    arguments = {"time": "t", "outputs": {"force": "F"}, "inputs": {"displacement": "x"}}
    for recording in (
        bp.Recording.from_npz(tmp_path / "run.npz", **arguments),
        bp.Recording.from_mat(tmp_path / "v5.mat", **arguments),
        bp.Recording.from_mat(tmp_path / "v73.mat", **arguments),
    ):
        assert np.array_equal(recording.outputs["force"], FORCE)
        assert np.array_equal(recording.inputs["displacement"], DISPLACEMENT)


def test_pickled_npz_is_refused(tmp_path):
    np.savez(tmp_path / "run.npz", t=TIME, F=np.array([{}] * 200, dtype=object))
    with pytest.raises(ValueError, match="pickled"):
        bp.Recording.from_npz(tmp_path / "run.npz", time="t", outputs={"force": "F"})


def test_error_for_other_files_names_the_rightreader(csv, tmp_path):
    with pytest.raises(ValueError, match=r"must be an NPZ file .*, or be read by from_csv or from_mat, got"):
        bp.Recording.from_npz(csv, time="t", **CHANNELS)
    np.save(tmp_path / "force.npy", FORCE)
    with pytest.raises(ValueError, match=r"must be an NPZ file of named arrays .numpy\.savez. without"):
        bp.Recording.from_npz(tmp_path / "force.npy", sampling_rate=50.0, outputs={"force": "force"})


@pytest.mark.parametrize("text", ["0.0,1.5\n0.1,2.5\n", "0.0;1.5\n0.1;2.5\n", "0.0\t1.5\n0.1\t2.5\n"])
def test_columns_of_a_csv_file_without_header_have_numbers(tmp_path, text):
    (tmp_path / "run.csv").write_text(text)
    with pytest.raises(ValueError, match=r"column of run.csv: must be one of 'column 1', 'column 2', got 't'"):
        bp.Recording.from_csv(tmp_path / "run.csv", time="t", outputs={"x": "x"})
    assert bp.Recording.from_csv(tmp_path / "run.csv", time=1, outputs={"x": 2}).outputs["x"].tolist() == [1.5, 2.5]


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_fields_are_separated_by_commas_semicolons_or_tabs(tmp_path, separator):
    """A title with commas above the header, a text with the other separators in it, an empty cell, a surplus column."""
    rows = ["t [s]{}x [mm]{}note", "0.0{}1.5{}'a; b'", "0.1{}{}c", "0.2{}2.5{}d"]
    lines = ["Test 14, J. Doe, 11 March", *(row.format(separator, separator).replace("'", '"') for row in rows)]
    (tmp_path / "run.csv").write_text("\n".join(lines))
    run = bp.Recording.from_csv(
        tmp_path / "run.csv", time="t [s]", outputs={"x": "x [mm]"}, units={"x": ("mm", "m")}, missing="drop"
    )
    assert run.time.tolist() == [0.0, 0.2] and run.outputs["x"] == pytest.approx([0.0015, 0.0025])


def test_decimal_commas_are_recognised(tmp_path):
    (tmp_path / "run.csv").write_text("t;x;F\n0,5;1,5;2,5\n1,0;1,0;2,0\n")
    run = bp.Recording.from_csv(tmp_path / "run.csv", time="t", outputs={"x": "x"})
    assert run.time.tolist() == [0.5, 1.0] and run.outputs["x"].tolist() == [1.5, 1.0]


def test_numbers_may_be_names_of_columns(tmp_path):
    pd.DataFrame({0: TIME, 1: FORCE}).to_csv(tmp_path / "run.csv", index=False)
    recording = bp.Recording.from_csv(tmp_path / "run.csv", time="0", outputs={"force": "1"})
    assert recording.outputs["force"] == pytest.approx(FORCE)


def test_error_for_channels_that_are_no_mapping_gives_an_example(csv):
    with pytest.raises(ValueError, match="outputs: must be a mapping, such as .*got 'x'"):
        bp.Recording.from_csv(csv, time="t", outputs="x")
    with pytest.raises(ValueError, match="inputs: must be a mapping, .*"):
        bp.Recording.from_arrays(TIME, {"force": FORCE}, DISPLACEMENT)
    with pytest.raises(ValueError, match="outputs: must be a mapping, .*"):
        bp.Experiment("run", 1.0, DISPLACEMENT, samples=TIME.size)


def test_arrays_may_be_pandas_or_xarray():
    recording = bp.Recording.from_arrays(
        pd.Series(TIME), {"force": xr.DataArray(FORCE, dims="time")}, {"displacement": pd.Series(DISPLACEMENT)}
    )
    table = pd.DataFrame({"force": FORCE})
    assert np.array_equal(bp.Recording.from_arrays(TIME, table).outputs["force"], FORCE)
    assert np.array_equal(recording.outputs["force"], FORCE)


def test_between_cuts_by_time():
    recording = bp.Recording.from_arrays(TIME, {"force": FORCE}).between(1.0, 2.0)
    assert (recording.time[0], recording.time[-1]) == (1.0, 2.0)
    with pytest.raises(ValueError, match="start, stop: must select at least two samples between 1 and 2 s, got 7, 8"):
        recording.between(7, 8)


def test_missing_column_error_suggests_the_nearest_name(csv):
    with pytest.raises(ValueError, match=r"column of run 7\.csv: must be .*got 'F \[M\]'.*Did you mean 'F \[N\]'"):
        bp.Recording.from_csv(csv, time="t", outputs={"force": "F [M]"})


def test_error_locates_the_non_numeric_cell(csv):
    rewrite(csv, 3, "x", "broken")
    with pytest.raises(
        ValueError, match=r"column 'x' of run 7\.csv: must contain numbers, .*got 'broken' in data row 4"
    ):
        bp.Recording.from_csv(csv, time="t", **CHANNELS)


@pytest.mark.parametrize("text", ["nan", "inf", ""])
def test_error_locates_samples_that_are_not_finite(csv, text):
    rewrite(csv, 5, "x", text)
    with pytest.raises(
        ValueError, match=r"displacement \(column 'x' of run 7.csv\): must be finite, got (nan|inf) at index 5"
    ):
        bp.Recording.from_csv(csv, time="t", **CHANNELS)


def test_error_locates_time_that_does_not_increase(csv):
    rewrite(csv, 10, "t", "0.1")
    with pytest.raises(ValueError, match=r"time: must increase, got 0\.1 s after 0\.18 s at index 10"):
        bp.Recording.from_csv(csv, time="t", **CHANNELS)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"path": "nowhere.csv"}, FileNotFoundError, "path: must be an existing file, got 'nowhere.csv'"),
        ({"time": None}, ValueError, "time: must be given or sampling_rate, and not both, got None and None"),
        ({"sampling_rate": 1.0}, ValueError, "must be given or sampling_rate, and not both, got 't' and 1.0"),
        (
            {"units": {"force": ("N", "m")}},
            ValueError,
            r"units\['force'\]: must be two units of the same dimension, got \('N', 'm'\)",
        ),
        ({"units": {"force": ("N", "newtown")}}, ValueError, r"units\['force'\]"),
        ({"units": {"force": 0}}, ValueError, "units\\['force'\\]: must not be zero, got 0"),
        ({"units": {"forc": 1}}, ValueError, "units: must be .*got 'forc'.*Did you mean 'force'"),
        ({"outputs": {}}, ValueError, "outputs: must have at least one channel"),
    ],
)
def test_error_names_the_bad_argument(csv, changes, error, message):
    with pytest.raises(error, match=message):
        bp.Recording.from_csv(**({"path": csv, "time": "t", **CHANNELS} | changes))


def test_file_that_is_not_mat_is_rejected(csv):
    with pytest.raises(ValueError, match="must be a MAT file of version 5 or 7.3, got"):
        bp.Recording.from_mat(csv, time="t", outputs={"force": "F"})


def test_lengths_must_agree():
    with pytest.raises(ValueError, match=r"outputs\['force'\]: must have 200 values .*got 199"):
        bp.Recording.from_arrays(TIME, {"force": FORCE[1:]})


def write(path, text):
    path.write_text(text)
    return path


@pytest.mark.parametrize("more", [",", ",,", ", ,"])
def test_trailing_commas_do_not_shift_columns(tmp_path, more):
    path = write(tmp_path / "run.csv", f"x,F,note\n1,10,0{more}\n2,20,0{more}\n3,30,0{more}\n")
    recording = bp.Recording.from_csv(path, sampling_rate=1.0, outputs={"x": "x"}, inputs={"F": "F"})
    assert recording.outputs["x"].tolist() == [1.0, 2.0, 3.0]
    assert recording.inputs["F"].tolist() == [10.0, 20.0, 30.0]


@pytest.mark.parametrize("row", ["2,20,0,7", "2,20,0,,7", "2,20", "2,,20,0", "2"])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_rows_with_other_numbers_of_fields_are_refused(tmp_path, row, place):
    rows = ["1,10,0", "3,30,0"]
    rows.insert(place, row)
    path = write(tmp_path / "run.csv", "\n".join(["x,F,note", *rows]))
    with pytest.raises(ValueError, match=f"3 fields in each row, .*, got {row.count(',') + 1} in data row {place + 1}"):
        bp.Recording.from_csv(path, sampling_rate=1.0, outputs={"x": "x"}, inputs={"F": "F"})


def test_repeated_column_is_refused_only_where_it_is_used(tmp_path):
    path = write(tmp_path / "run.csv", "x,F,x\n1,10,5\n2,20,6\n")
    assert bp.Recording.from_csv(path, sampling_rate=1.0, outputs={"F": "F"}).outputs["F"].tolist() == [10.0, 20.0]
    with pytest.raises(ValueError, match=r"must be the name of one column, got 'x', the name of 2 \(columns 1, 3\)"):
        bp.Recording.from_csv(path, sampling_rate=1.0, outputs={"x": "x"})


@pytest.mark.parametrize("text", ["x,F\n", "x,F", "x,F\n\n\n", "", "\n"])
def test_file_without_data_is_refused(tmp_path, text):
    path = write(tmp_path / "run.csv", text)
    with pytest.raises(ValueError, match="path: must be a CSV file with (rows of data|a header line), got"):
        bp.Recording.from_csv(path, sampling_rate=1.0, outputs={"x": "x"})


def random_csv(seed):
    """Return a table with its text: preamble, quoted texts, trailing commas, blank lines, any end of line."""
    generator = np.random.default_rng(seed)
    names = [*generator.permutation(["t", "x", "F [N]", "a, b", "note"])]
    rows = int(generator.integers(2, 30))
    table = {name: np.round(generator.standard_normal(rows) * 10.0 ** generator.integers(-9, 9), 12) for name in names}
    table["t"] = np.arange(rows) / 7.0
    table["note"] = generator.choice(["", "ok", "a, b", 'say "x"', "x,t"], rows)
    text, end = io.StringIO(newline=""), str(generator.choice(["\n", "\r\n", "\r"]))
    writer = table_format.writer(text, lineterminator=end)
    for _ in range(int(generator.integers(0, 5))):
        text.write(str(generator.choice(["# rig 3", "Date, 2026", "x", "", "a,b,c,d,e,f,g,h"])) + end)
    more = [""] * int(generator.integers(0, 3))
    writer.writerow([*names, *more * int(generator.integers(0, 2))])
    for row in zip(*table.values(), strict=True):
        writer.writerow([*(repr(float(v)) if not isinstance(v, str) else v for v in row), *more])
        text.write(end * int(generator.uniform() < 0.1))
    return table, text.getvalue(), end


@pytest.mark.parametrize("seed", range(40))
def test_columns_of_any_csv_file_are_read_exactly(tmp_path, seed):
    table, text, _ = random_csv(seed)
    path = tmp_path / "run.csv"
    path.write_bytes((b"\xef\xbb\xbf" if seed % 2 else b"") + text.encode())
    channels = {"outputs": {"x": "x", "b": "a, b"}, "inputs": {"force": "F [N]"}}
    recording = bp.Recording.from_csv(path, time="t", **channels)
    assert recording.time.tolist() == table["t"].tolist()
    assert [*recording.outputs["x"]] == [*table["x"]] and [*recording.outputs["b"]] == [*table["a, b"]]
    assert [*recording.inputs["force"]] == [*table["F [N]"]]


@pytest.mark.parametrize("seed", range(40))
def test_missing_or_additional_field_of_any_csv_file_is_refused(tmp_path, seed):
    table, text, end = random_csv(seed)
    lines, generator = text.split(end), np.random.default_rng(seed)
    head = next(i for i, line in enumerate(lines) if "F [N]" in line)
    row = generator.choice([i for i, line in enumerate(lines) if i > head and line])
    fields = next(table_format.reader([lines[row]]))
    place = int(generator.integers(0, 5))
    changed = fields[:place] + fields[place + 1 :] if seed % 2 else [*fields[:place], "1.5", *fields[place:]]
    buffer = io.StringIO(newline="")
    table_format.writer(buffer, lineterminator="").writerow(changed)
    lines[row] = buffer.getvalue()
    path = tmp_path / "run.csv"
    path.write_bytes(end.join(lines).encode())
    with pytest.raises(ValueError):
        bp.Recording.from_csv(path, time="t", outputs={"x": "x", "b": "a, b"}, inputs={"force": "F [N]"})


def test_preamble_is_skipped(tmp_path):
    path = write(tmp_path / "run.csv", 'Rig 3\nDate,2026-11-24\n\n"a, b"\nt,x\n0,1\n1,2\n')
    assert bp.Recording.from_csv(path, time="t", outputs={"x": "x"}).outputs["x"].tolist() == [1.0, 2.0]


def test_rows_with_nan_are_dropped_or_interpolated_by_request(csv, tmp_path):
    for row, text in ((5, "nan"), (20, ""), (21, "NaN"), (0, "")):
        rewrite(csv, row, "x", text)
    with pytest.raises(
        ValueError,
        match=r"got nan at index 0 \(4 of 200 values are NaN or masked\); missing='drop' leaves such samples out",
    ):
        bp.Recording.from_csv(csv, time="t", **CHANNELS)
    rest = np.delete(np.arange(200), [0, 5, 20, 21])
    for arguments in ({"time": "t"}, {"sampling_rate": 50.0}):
        dropped = bp.Recording.from_csv(csv, **arguments, **CHANNELS, missing="drop")
        assert dropped.time["displacement"] == pytest.approx(TIME[rest])
        assert np.array_equal(dropped.inputs["displacement"], DISPLACEMENT[rest])
        assert dropped.time["force"] == pytest.approx(TIME) and np.array_equal(dropped.outputs["force"], FORCE)
        filled = bp.Recording.from_csv(csv, **arguments, **CHANNELS, missing="interpolate")
        assert filled.time == pytest.approx(TIME[1:])
        middle = DISPLACEMENT[19] + (DISPLACEMENT[22] - DISPLACEMENT[19]) / 3
        assert filled.inputs["displacement"][19] == pytest.approx(middle)
    rewrite(csv, slice(30, 33), "x", "nan")
    with pytest.raises(
        ValueError, match=r"missing: must be 'drop' for displacement \(column 'x' .* at most 3 successive values, and 4"
    ):
        bp.Recording.from_csv(csv, time="t", **CHANNELS, missing="interpolate")
    with pytest.raises(ValueError, match="missing: must be one of 'drop', 'interpolate', got 'fill'"):
        bp.Recording.from_csv(csv, time="t", **CHANNELS, missing="fill")
    np.savez(tmp_path / "run.npz", t=TIME, x=np.where(TIME > 3.9, np.nan, TIME))
    assert bp.Recording.from_npz(tmp_path / "run.npz", time="t", outputs={"x": "x"}, missing="drop").time[-1] <= 3.9


STEPS = (1.5, 1.52, 1.8)


def stepped(gap=0.0, restart=False):
    time = np.arange(4000) / 100.0
    parts, phase = [], 0.0
    for i, frequency in enumerate(STEPS):
        angle = 2 * np.pi * frequency * time + phase
        phase = angle[-1] + 2 * np.pi * frequency / 100.0
        start = 0.0 if restart else i * (40.0 + gap)
        parts.append(pd.DataFrame({"t": start + time, "F": np.sin(angle), "x": np.cos(angle), "run": f"step {i}"}))
    table = pd.concat(parts)
    table[["F", "x"]] += 0.01 * np.random.default_rng(0).standard_normal((12_000, 2))
    return table


@pytest.mark.parametrize("gap", [0.0, 3.0])
def test_split_at_steps_of_the_drive_and_at_gaps(gap):
    table = stepped(gap)
    whole = bp.Recording.from_arrays(table["t"], {"x": table["x"]}, {"F": table["F"]}, name="sweep")
    runs = whole.split()
    assert [run.name for run in runs] == ["sweep 1", "sweep 2", "sweep 3"]
    assert [run.fold(64).frequency for run in runs] == pytest.approx(STEPS, rel=1e-4)
    assert sum(run.time.size for run in runs) > 0.98 * 12_000
    (same,) = runs[0].split()
    assert same.name == "sweep 1" and same.time.size == runs[0].time.size


@pytest.mark.parametrize("restart", [False, True])
def test_file_is_divided_by_a_column(tmp_path, restart):
    path = tmp_path / "all.csv"
    stepped(restart=restart).to_csv(path, index=False)
    arguments = {"time": "t", "outputs": {"x": "x"}, "inputs": {"F": "F"}}
    runs = bp.Recording.from_csv(path, **arguments, split="run")
    assert [run.name for run in runs] == [f"all {i + 1}: run step {i}" for i in range(3)]
    assert [run.fold(64).frequency for run in runs] == pytest.approx(STEPS, rel=1e-4)
    assert [run.time.size for run in runs] == [4000] * 3
    if restart:
        with pytest.raises(ValueError, match=r"must increase, got 0 s after 39\.99 s .*from_csv.split=…."):
            bp.Recording.from_csv(path, **arguments)
    rewrite(path, 3, "run", "")
    with pytest.raises(ValueError, match="split: must be a column without empty cells, got 'run', empty in data row 4"):
        bp.Recording.from_csv(path, **arguments, split="run")


def test_arrays_of_a_file_are_split_like_columns(tmp_path):
    time, label = np.tile(np.arange(10) / 10, 2), np.repeat(["up", "down"], 10)
    np.savez(tmp_path / "runs.npz", t=time, x=np.arange(20.0), sweep=label, short=label[:5])
    runs = bp.Recording.from_npz(tmp_path / "runs.npz", time="t", outputs={"x": "x"}, split="sweep")
    assert [run.name for run in runs] == ["runs 1: sweep up", "runs 2: sweep down"]
    assert runs[1].outputs["x"].tolist() == list(range(10, 20))
    with pytest.raises(
        ValueError, match="split: must be a column with one value per sample, got 'short' with 5 values"
    ):
        bp.Recording.from_npz(tmp_path / "runs.npz", time="t", outputs={"x": "x"}, split="short")
