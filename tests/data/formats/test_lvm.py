"""LabVIEW measurement files, written here after NI's specification."""

import pickle
import warnings

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import lvm
from tests.data.test_damaged_files import Payload, damaged

STEP = "1.0000000000000000E-3"
A, B = 3.0 * np.sin(np.arange(50) / 7), np.cos(np.arange(50) / 5)


def head(columns="One", decimal=".", separator="\t", preference="Relative", headings="Yes"):
    name = {"\t": "Tab", ",": "Comma"}[separator]
    pairs = {
        "LabVIEW Measurement": "", "Writer_Version": "2", "Reader_Version": "2", "Separator": name,
        "Decimal_Separator": decimal, "Multi_Headings": headings, "X_Columns": columns, "Time_Pref": preference,
        "Operator": "someone", "Date": "2026/01/31", "Time": f"12:00:00{decimal}25", "***End_of_Header***": "",
    }  # fmt: skip
    return "".join(f"{key}{separator}{value}\n" for key, value in pairs.items()) + f"{separator}\n"


def segment(
    values=(A, B), columns="One", decimal=".", separator="\t", step=STEP, start="0.0000000000000000E+0",
    units=("mm", "N"), when="12:00:00.2500000000000000000", axis="Time", names=("a", "b"), trailing=True, comment=True,
    places=6, x=None, samples=None,
):  # fmt: skip
    """Return header and rows of a segment, with a comment in its third row."""
    gap = [""] if columns == "Multi" else []
    count, rows = len(values), len(values[0])

    def line(key, cells):
        joined = [part for cell in cells for part in (*gap, str(cell))][len(gap) :]
        return separator.join([key, *joined]) + "\n"

    def number(value):
        return f"{value:.{places}f}".replace(".", decimal)

    each = {
        "Samples": samples or rows, "Date": "2026/01/31", "Time": when.replace(".", decimal),
        "X_Dimension": axis, "X0": start.replace(".", decimal), "Delta_X": step.replace(".", decimal),
    }  # fmt: skip
    text = f"Channels{separator}{count}{separator * (count + 1) if trailing else ''}\n"
    text += "".join(line(key, [value] * count) for key, value in each.items() if value is not None)
    text += line("Y_Unit_Label", units) + f"***End_of_Header***{separator * 3}\n"
    text += separator.join(
        ["X_Value", *([part for name in names for part in (name, "X_Value")][:-1] if gap else names)]
    )
    text += f"{separator}Comment\n" if comment else "\n"
    for k in range(rows):
        at = "" if columns == "No" else number(k * float(step) if x is None else x[k])
        cells = (
            [part for one in values for part in (at, number(one[k]))] if gap else [at, *(number(v[k]) for v in values)]
        )
        text += separator.join([*cells, *(["a remark"] if k == 2 and comment else [])]) + "\n"
    return text


def read(folder, text, encoding="latin-1", **arguments):
    file = folder / "run.lvm"
    file.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
    return bp.Recording.from_file(file, **({"outputs": {"a": "a", "b": "b"}} | arguments))


def refused(folder, text, reason, **arguments):
    with pytest.raises(ValueError, match=reason) as error:
        read(folder, text, **arguments)
    assert "run.lvm" in str(error.value)


def assert_read(run, scale=1e-3):
    np.testing.assert_allclose(run.outputs["a"], A * scale, atol=0.6e-6)
    np.testing.assert_allclose(run.outputs["b"], B, atol=0.6e-6)
    np.testing.assert_allclose(run.time, np.arange(50) / 1000, rtol=1e-12)


@pytest.mark.parametrize("columns", ["No", "One", "Multi"])
@pytest.mark.parametrize("decimal, separator", [(".", "\t"), (",", "\t"), (".", ",")])
@pytest.mark.parametrize("trailing", [True, False])
def test_columns_of_times_and_separators(tmp_path, columns, decimal, separator, trailing):
    """Without tabs at the end of the line Channels, lvm-read drops the last channel of Multi."""
    kind = {"columns": columns, "decimal": decimal, "separator": separator}
    assert_read(read(tmp_path, head(**kind) + segment(**kind, trailing=trailing)))


def test_times_of_multi_columns_are_those_of_each_channel(tmp_path):
    text = head("Multi") + segment((A, B), "Multi")
    lines = text.split("\n")
    start = next(k for k, line in enumerate(lines) if line.startswith("X_Value")) + 1
    for k in range(50):  # the second channel is sampled half as fast
        cells = lines[start + k].split("\t")
        cells[2] = f"{k * 2e-3:.6f}"
        lines[start + k] = "\t".join(cells[:4])
    text = "\n".join(lines).replace(f"{STEP}\t\t{STEP}", f"{STEP}\t\t2.0000000000000000E-3")
    run = read(tmp_path, text)
    np.testing.assert_allclose(run.times["a"], np.arange(50) / 1000, rtol=1e-12)
    np.testing.assert_allclose(run.times["b"], np.arange(50) / 500, rtol=1e-12)


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8"])
def test_micrometres_are_not_metres(tmp_path, encoding):
    """The package lvm-read leaves out bytes that are no UTF-8."""
    run = read(tmp_path, head() + segment(units=("µm", "N")), encoding)
    assert_read(run, 1e-6)


def test_segments_that_restart_are_groups_with_their_instants(tmp_path):
    text = head() + segment() + "\t\n" + segment((2 * A, B), when="12:00:05.7500000000000000000")
    refused(tmp_path, text, r"the name of 2; give the group too: \('segment 1', 'a'\), \('segment 2', 'a'\)")
    run = read(tmp_path, text, outputs={"a": ("segment 1", "a"), "b": ("segment 2", "a")})
    np.testing.assert_allclose(run.outputs["b"], 2e-3 * A, atol=1e-6)
    np.testing.assert_allclose(run.times["a"], np.arange(50) / 1000, rtol=1e-12)
    np.testing.assert_allclose(run.times["b"], 5.5 + np.arange(50) / 1000, rtol=1e-12)


def test_times_with_six_decimals_are_as_exact_as_their_number(tmp_path):
    """51.2 kHz with six decimals: a staircase, whose mean step is known to 1 µs over its length."""
    rate, rows = 51_200.0, 5000
    values = (np.sin(np.arange(rows)), np.cos(np.arange(rows)))
    text = head() + segment(values, step="0.000020", x=np.arange(rows) / rate)
    with pytest.warns(
        UserWarning, match=r"rate is 5\d+\.?\d* Hz with an error of up to \d+ ppm; 51200 Hz has the same"
    ):
        run = read(tmp_path, text)
    assert run.sampling_rate == pytest.approx(rate, rel=1.1e-5)
    assert read(tmp_path, text, sampling_rate=rate).sampling_rate == pytest.approx(rate, rel=1e-12)


def test_step_with_few_digits_is_named_with_its_error(tmp_path):
    text = head("No") + segment(columns="No", step="0.000020")
    with pytest.warns(UserWarning, match=r"50000 Hz with an error of up to 2.5e\+04 ppm"):
        read(tmp_path, text)
    with pytest.warns(UserWarning, match=r"44100\.\d+ Hz with an error of up to 2.2 ppm; 44100 Hz has the same digits"):
        read(tmp_path, head("No") + segment(columns="No", step="2.26757E-5"))
    text = head("No") + segment(columns="No", step="1.953125E-5")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read(tmp_path, text).sampling_rate == pytest.approx(51_200, rel=1e-12)


def test_times_and_step_that_differ_are_refused(tmp_path):
    refused(tmp_path, head() + segment(x=np.arange(50) / 500), "times are 0.002 s apart, while Delta_X is 0.001 s")


def test_uneven_times_are_kept(tmp_path):
    x = (np.arange(50) / 1000) ** 2 + np.arange(50)
    np.testing.assert_allclose(read(tmp_path, head() + segment(x=x)).time, x, atol=0.6e-6)


def test_absolute_times_and_x0(tmp_path):
    run = read(tmp_path, head("No") + segment(columns="No", start="2.5000000000000000E+0"))
    np.testing.assert_allclose(run.time, 2.5 + np.arange(50) / 1000, rtol=1e-12)
    seconds = 3_852_619_200.0 + np.arange(50) / 1000
    run = read(tmp_path, head(preference="Absolute") + segment(x=seconds))
    np.testing.assert_allclose(run.time - run.time[0], np.arange(50) / 1000, atol=1e-6)


def test_spectrum_is_refused_as_times(tmp_path):
    refused(tmp_path, head() + segment(axis="Frequency"), "whose axis is 'Frequency' and not time")


def test_special_blocks_are_left_out(tmp_path):
    special = "***Start_Special***\tWiring\nChannels\t1\nX_Value\tq\n1\t2\n***End_Special***\n\n"
    assert_read(read(tmp_path, head() + special + segment()))
    assert [(one.group, one.name) for one in bp.inspect(tmp_path / "run.lvm").channels] == [("", "a"), ("", "b")]


def test_one_heading_for_several_packets(tmp_path):
    """The rows of later packets follow after an empty line, or without."""
    text = head(headings="No") + segment((A[:25], B[:25]), comment=False)
    more = "".join(f"{k / 1000:.6f}\t{A[k]:.6f}\t{B[k]:.6f}\n" for k in range(25, 50))
    assert_read(read(tmp_path, text + "\n" + more))


def test_wrong_decimal_sign_is_refused_and_changed_by_its_argument(tmp_path):
    """The package lvm-read returns NaN."""
    text = head(decimal=".") + segment(decimal=",")
    refused(tmp_path, text, "must be .*(Delta_X|no number with the decimal sign|lvm)")
    assert_read(read(tmp_path, text, decimal=","))


@pytest.mark.parametrize("columns", ["No", "One", "Multi"])
@pytest.mark.parametrize("channel", [0, 1])
def test_text_in_place_of_a_number_is_refused(tmp_path, columns, channel):
    lines = (head(columns) + segment(columns=columns)).split("\n")
    cells = lines[-5].split("\t")
    place = 1 + channel * (2 if columns == "Multi" else 1)
    cells[place] = f"x{cells[place]}"
    lines[-5] = "\t".join(cells)
    reason = rf"row 47 after line \d+ has '{cells[place]}', no number with the decimal sign '.', which decimal= changes"
    refused(tmp_path, "\n".join(lines), reason)


def test_empty_cell_is_a_missing_sample(tmp_path):
    lines = (head() + segment()).split("\n")
    cells = lines[-5].split("\t")
    lines[-5] = "\t".join([cells[0], "", cells[2]])
    refused(tmp_path, "\n".join(lines), "must be finite, got nan at index 46")
    assert read(tmp_path, "\n".join(lines), missing="drop").times["a"].size == 49


@pytest.mark.parametrize("lost", [1, 5, 12, 30, 500])
def test_file_that_is_cut_off_is_refused(tmp_path, lost):
    rows = "".join((head() + segment()).splitlines(keepends=True)[:-3])
    refused(tmp_path, rows, "it is cut off: it has 47 rows, and 50 samples by its header")
    refused(tmp_path, (head() + segment(comment=False))[:-lost].rstrip("\n")[:-1], "it (is|seems to be) cut off|fields")


def test_channel_with_fewer_samples_ends_earlier(tmp_path):
    lines = (head("Multi") + segment(columns="Multi")).split("\n")
    lines = [line.replace("Samples\t50\t\t50", "Samples\t50\t\t20") for line in lines]
    for k in range(-31, -1):
        cells = lines[k].split("\t")
        lines[k] = "\t".join([*cells[:2], "", ""])
    run = read(tmp_path, "\n".join(lines))
    assert run.times["b"].size == 20 and run.times["a"].size == 50


def test_no_pickled_file_is_read_or_written(tmp_path):
    """The package lvm-read prefers one beside the file that is newer."""
    trace = tmp_path / "executed"
    read(tmp_path, head() + segment())
    assert [one.name for one in tmp_path.iterdir()] == ["run.lvm"]
    (tmp_path / "run.lvm.pkl").write_bytes(pickle.dumps(Payload(trace)))
    assert_read(bp.Recording.from_file(tmp_path / "run.lvm", outputs={"a": "a", "b": "b"}))
    assert not trace.exists()


def test_names_and_their_number(tmp_path):
    text = head() + segment()
    refused(tmp_path, text.replace("Channels\t2", "Channels\t3"), "3 fields, and 4 have names")
    refused(tmp_path, text.replace("Channels\t2", "Channels\t1"), "1 channels by its header, and the names")
    refused(tmp_path, head() + segment(names=("a", "a")), "several channels 'a'")
    assert_read(read(tmp_path, head() + segment(comment=False)))


def test_last_line_without_an_end_is_read_if_it_is_complete(tmp_path):
    assert_read(read(tmp_path, (head() + segment()).rstrip("\n")))


def test_digits_of_a_step():
    for text, error in (
        ("0.001000", 0.0),
        ("0.000020", 5e-7),
        ("2.26757E-5", 5e-11),
        ("1.953125E-5", 0.0),
        ("0.001", 0.0),
        ("2E-3", 0.0),
    ):
        assert lvm._error(text, ".") == pytest.approx(error, rel=1e-9)


def test_encoding_is_given_or_recognised_and_named(tmp_path):
    text = head() + segment(units=("µm", "N"))
    for encoding, used in (("utf-8", "utf-8"), ("utf-8-sig", "utf-8"), ("latin-1", "cp1252")):
        assert_read(read(tmp_path, text, encoding), 1e-6)
        assert f"in {used}" in bp.inspect(tmp_path / "run.lvm").remarks
    path, channels = tmp_path / "run.lvm", {"outputs": {"a": "a", "b": "b"}}
    path.write_bytes(text.encode("cp850"))
    assert_read(bp.Recording.from_file(path, encoding="cp850", **channels), 1e-6)
    with pytest.raises(ValueError, match="encoding: must be Python's name of that of the file, got 'latin-one'; leave"):
        bp.Recording.from_file(path, encoding="latin-one", **channels)
    refused(tmp_path, text.encode("cp850").replace("µ".encode("cp850"), b"\x81"),
            "its encoding is neither UTF-8 nor that of Windows; see encoding, such as encoding='utf-16'")  # fmt: skip


def edited(old, new, text=None, count=1):
    text = text or head() + segment()
    assert old in text
    return text.replace(old, new, count)


@pytest.mark.parametrize(
    "text, reason",
    [
        (edited("X_Columns\tOne", "X_Columns\tTwo"), "its X_Columns is 'Two' and not No, One or Multi"),
        (edited("Samples\t50\t50", "Samples\t50\t50\t50"), "its Samples has 3 values for 2 channels"),
        (edited("Samples\t50\t50", "Samples\t51\t51"), "it is cut off: it has 50 rows, and 51 samples by its header"),
        (edited("Samples\t50\t50", "Samples\t49\t49"), "it has 50 rows, and 49 samples by its header"),
        (edited("Channels\t2", "Channels\t0"), "it has 0 channels by its header, and the names .* from line "),
        (
            edited("\ta\tb\tComment", "\ta\tb\tc"),
            "it has 2 channels by its header, and the names .*'c'. from line 23 on",
        ),
        (edited("X_Value", "Y_Value"), "it is cut off, or has no rows of numbers"),
        (head(), "it is cut off, or has no rows of numbers"),
        (head() + "***Start_Special***\n", "it is cut off, or has no rows of numbers"),
        (
            (head() + segment()).rstrip("\n")[:-3],
            "it seems to be cut off: its last line has no end; add one if its last",
        ),
        ((head() + segment(comment=False)) + "0.05\t1\t2\t3\t4\n", r"row 51 after line 23 has 5 fields, and 3 have"),
        ((head() + segment(comment=False)) + "0.05\t1\n", r"row 51 after line 23 has 2 fields, and 3 have names"),
    ],
)
def test_files_that_contradict_themselves_are_refused_with_the_numbers(tmp_path, text, reason):
    refused(tmp_path, text, f"path: must be a LabVIEW measurement file .*run.lvm.*{reason}")


def test_rows_beyond_the_stated_samples_are_read_with_one_heading(tmp_path):
    """With Multi_Headings No, the header is that of the first packet."""
    assert_read(read(tmp_path, edited("Samples\t50\t50", "Samples\t25\t25", head(headings="No") + segment())))


def test_times_without_a_rate_must_be_given(tmp_path):
    for step in ("0.0000000000000000E+0", "-1.0000000000000000E-3", None):
        text = head("No") + segment(columns="No", step=step or STEP)
        text = text if step else edited("Delta_X", "Other", text)
        refused(tmp_path, text, "time: must be given or sampling_rate")
        assert read(tmp_path, text, sampling_rate=10.0).time[1] == pytest.approx(0.1)


def test_times_that_are_missing_are_refused(tmp_path):
    lines = (head() + segment()).split("\n")
    lines[-5] = "\t".join(["", *lines[-5].split("\t")[1:]])
    refused(
        tmp_path, "\n".join(lines), "channel 'a' of run.lvm, some of whose times are missing; sampling_rate= gives it"
    )


@pytest.mark.parametrize("change, taken", [(0.0, True), (2.1e-8, True), (5e-8, False), (-5e-8, False)])
def test_step_may_differ_from_the_times_by_their_last_digit(tmp_path, change, taken):
    """Over 49 steps of 1 ms, a unit of the sixth decimal is 2.04e-8 s of a step; 1e-9 s of it are rounding."""
    text = head() + segment(step=f"{1e-3 + change:.16E}", x=np.arange(50) / 1000)
    if taken:
        assert read(tmp_path, text).time[-1] == pytest.approx(0.049, rel=2.2e-5)
    else:
        refused(
            tmp_path, text, f"whose times are 0.001 s apart, while Delta_X is {1e-3 + change!r:.8}.* s; sampling_rate="
        )


@pytest.mark.parametrize("shift, even", [(0.0, True), (-1e-6, True), (1e-6, False), (-2e-6, False)])
def test_times_are_even_to_a_unit_of_their_last_digit(tmp_path, shift, even):
    """Of 20 steps of 1/3000 s, six decimals are 0.33e-6 s too late, and with the shift -0.67e-6 s or 1.33e-6 s."""
    x = np.round(np.arange(50) / 3000, 6)
    x[20] += shift
    time = read(tmp_path, head() + segment(x=x, step=f"{1 / 3000:.16E}")).time
    assert (time[20] == pytest.approx(20 / 3000, rel=1e-9)) == even


def test_segments_have_their_numbers_and_a_remark(tmp_path):
    read(tmp_path, head() + segment() + "\t\n" + segment(), outputs={"a": ("segment 1", "a")})
    seen = bp.inspect(tmp_path / "run.lvm")
    assert "2 segments, with times of their own" in seen.remarks
    assert [(one.group, one.name) for one in seen.channels] == [(f"segment {k}", n) for k in (1, 2) for n in "ab"]
    read(tmp_path, head() + segment())
    assert bp.inspect(tmp_path / "run.lvm").remarks == ("in utf-8",)


def test_arguments_are_in_the_suggested_code(tmp_path):
    read(tmp_path, head() + segment())
    path = tmp_path / "run.lvm"
    assert "decimal" not in bp.inspect(path).code and "encoding" not in bp.inspect(path).code
    code = bp.inspect(path, decimal=".", encoding="cp1252").code
    assert "decimal='.'" in code and "encoding='cp1252'" in code


@pytest.mark.parametrize(
    "texts, digit", [(["0.5"], 0.1), (["1", "2.25", "3.5"], 0.01), ([" 7 "], 1.0), (["1E-3", "5.0E-1"], 1e-3)]
)
def test_last_digit_is_that_of_the_longest_number(texts, digit):
    assert lvm._digit(texts, ".") == pytest.approx(digit)
    assert lvm._digit([text.replace(".", ",") for text in texts], ",") == pytest.approx(digit)


@pytest.mark.parametrize(
    "text, error",
    [
        ("", 0.0), ("0", 0.0), ("-0.001", 0.0), ("0.0010000", 0.0), ("0.000977", 5e-7), ("0.0009765625", 0.0),
        ("1.9531E-5", 5e-10), ("0.0000195", 5e-8), ("0.00002", 0.0), ("0.010000", 0.0), ("1,5", 0.05),
    ],
)  # fmt: skip
def test_error_of_a_step_is_half_of_its_last_digit_unless_its_rate_is_round(text, error):
    """Rates of four digits are round: 51.2 kHz, 1024 Hz, 100 Hz; of 1.5 s it is 0.6667."""
    assert lvm._error(text, ",") == lvm._error(text.replace(",", "."), ".") == pytest.approx(error, rel=1e-9)


@pytest.mark.parametrize(
    "date, time, instant",
    [
        ("2026/01/31", "12:00:00.25", "2026-01-31T12:00:00.25"), ("2026/1/3", "1:02:03", "2026-01-03T01:02:03"),
        ("2026/01/31", "12:00:00,5000000000000000000", "2026-01-31T12:00:00.5"),
        (" 2026/01/31 ", " 23:59:59.9999999999",
        "2026-01-31T23:59:59.999999999"), ("31.01.2026", "12:00:00", None), ("2026/01/31", "12 o'clock", None),
        ("2026/01/31x", "12:00:00", None), (None, "12:00:00", None), ("2026/01/31", None, None),
    ],
)  # fmt: skip
def test_instants_of_segments(date, time, instant):
    origin = lvm._origin(date, time)
    assert origin is None if instant is None else origin == np.datetime64(instant, "ns")


def test_damaged_file_is_read_or_refused_by_one_error(tmp_path, capfd):
    generator, file = np.random.default_rng(2), tmp_path / "run.lvm"
    whole = (head() + segment(units=("µm", "N")) + "\t\n" + segment()).encode("latin-1")
    for _ in range(200):
        file.write_bytes(damaged(whole, generator))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                bp.inspect(file, format="lvm")
            except ValueError as error:
                assert "run.lvm" in str(error)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("date, origin", [("2261/12/31", "2261-12-31"), ("2300/01/31", None), ("1601/01/01", None)])
def test_dates_beyond_nanoseconds_are_no_origin(date, origin):
    """In nanoseconds NumPy reads the year 2300 as 1715."""
    assert lvm._origin(date, "00:00:00") == (origin and np.datetime64(origin, "ns"))


@pytest.mark.parametrize("separator", [",", "\t", ";"])
def test_the_last_row_is_shorter_by_its_last_number_only(separator):
    """Files that end within a number; other columns may have fewer or more digits."""
    rows = [separator.join(["0.1", "0.25"]), separator.join(["0.12345", "0.3"])]
    assert lvm._is_shorter(rows, separator) and not lvm._is_shorter(rows[::-1], separator)
    assert not lvm._is_shorter([rows[0], rows[0]], separator)


def test_entries_of_the_header_may_be_missing(tmp_path):
    """Without them there is one column of times, the decimal sign is a point, and rows are counted."""
    whole = (head() + segment()).splitlines(keepends=True)
    for entry in ("X_Columns", "Decimal_Separator", "Multi_Headings", "Time_Pref", "Samples", "X_Dimension", "X0"):
        fewer = [line for line in whole if not line.startswith(f"{entry}\t")]
        assert len(fewer) < len(whole)
        assert_read(read(tmp_path, "".join(fewer)))
    for separator in ("\t", ","):
        rest = (head(separator=separator) + segment(separator=separator)).splitlines(keepends=True)
        assert_read(read(tmp_path, "".join(line for line in rest if not line.startswith("Separator"))))
    unnamed = [line for line in whole if not line.startswith("Y_Unit_Label\t")]
    np.testing.assert_allclose(read(tmp_path, "".join(unnamed)).outputs["a"], A, atol=0.6e-6)


def test_each_channel_has_its_own_step(tmp_path):
    text = head("No") + segment(columns="No")
    for steps, channel, rates in (
        (f"0.000020\t{STEP}", "a", (50_000, 1000)),
        (f"{STEP}\t0.000020", "b", (1000, 50_000)),
    ):
        other = edited(f"Delta_X\t{STEP}\t{STEP}", f"Delta_X\t{steps}", text)
        with pytest.warns(UserWarning, match=f"gives the interval of channel '{channel}' with few digits") as seen:
            run = read(tmp_path, other)
        assert len(seen) == 1
        assert [1.0 / run.times[c][1] for c in "ab"] == pytest.approx(rates)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
@pytest.mark.parametrize("mark, name", [(";", "Semicolon"), ("\t", "Tab"), (",", "Comma")])
def test_channels_of_any_separator_have_units_and_one_clock(tmp_path, mark, name, encoding):
    text = (head() + segment(units=("µm", "N"))).replace("Separator\tTab", f"Separator\t{name}").replace("\t", mark)
    (tmp_path / "run").write_text(text, encoding)
    whole = lvm.contents(tmp_path / "run", [])
    assert (whole.kind, whole.word) == ("LabVIEW measurement file", "channel")
    assert whole.remarks == (f"in {encoding.removesuffix('-sig')}",)
    a, b = whole.channels
    assert (a.group, a.name, a.unit, a.samples, b.group, b.name, b.unit, b.samples) == (
        "", "a", "µm", 50, "", "b", "N", 50
    )  # fmt: skip
    assert a.clock is b.clock and a.clock.step == pytest.approx(1e-3, rel=1e-12)
    np.testing.assert_allclose(a.values(), A, atol=0.6e-6)
    np.testing.assert_allclose(b.values(), B, atol=0.6e-6)


@pytest.mark.parametrize("columns", ["No", "One", "Multi"])
def test_one_step_may_be_that_of_all_channels(tmp_path, columns):
    gap = "\t" if columns == "Multi" else ""
    text = edited(f"Delta_X\t{STEP}\t{gap}{STEP}", f"Delta_X\t{STEP}", head(columns) + segment(columns=columns))
    assert_read(read(tmp_path, text))


@pytest.mark.parametrize("separator", [",", "\t"])
@pytest.mark.parametrize("count", [1, 3])
def test_lines_of_separators_between_segments_are_no_rows(tmp_path, separator, count):
    text = head(separator=separator) + segment(separator=separator) + separator * count + "\n"
    run = read(tmp_path, text + segment(separator=separator), outputs={c: ("segment 1", c) for c in "ab"})
    assert_read(run)
