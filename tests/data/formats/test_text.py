"""Texts of columns as programs write them: each trap is cured, or refused with the argument that decides."""

import itertools
import random
import warnings

import numpy as np
import pandas as pd
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import encodings, text, text_cells
from tests.data.test_damaged_files import damaged

X = {"outputs": {"x": "x"}}


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a file."""

    def written(content, encoding="utf-8"):
        path = tmp_path / "run.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode(encoding))
        return path

    return written


def read(path, **arguments):
    """Return times and values of x."""
    run = bp.Recording.from_file(path, **{"time": "t", **X} | arguments)
    return run.time.tolist(), run.outputs["x"].tolist()


GERMAN = "Prüfstand 3;;\nDatum;12.03.2026;\nZeit;Weg;Kraft\ns;µm;kN\n0,0;1,5;-2,5\n0,1;1,6;3,5E+01\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1", "cp1252"])
def test_european_file_is_read_without_any_argument(write, encoding):
    """Decimal commas, a preamble, a row of units and any of the usual encodings; values in SI."""
    path = write(GERMAN, encoding)
    run = bp.Recording.from_file(path, time="Zeit", outputs={"x": "Weg"}, inputs={"force": "Kraft"})
    assert run.time.tolist() == [0.0, 0.1]
    assert run.outputs["x"] == pytest.approx([1.5e-6, 1.6e-6]) and run.inputs["force"] == pytest.approx([-2500, 35000])
    seen = bp.inspect(path)
    assert [channel.unit for channel in seen.channels] == ["s", "µm", "kN"]
    assert "separator ';', names in line 3, units in the row below, decimal comma" in seen.remarks
    assert "time='Zeit'" in seen.code
    assert ("cp1252" in str(seen)) == (encoding in ("latin-1", "cp1252"))


@pytest.mark.parametrize("seed", range(60))
def test_any_combination_of_signs_is_recognised(write, seed):
    """The expected values are those that were written."""
    draw = random.Random(seed)
    separator, decimal = draw.choice([(s, d) for s, d in itertools.product(",;\t |", ".,") if s != d])
    end, quote = draw.choice(["\n", "\r\n", "\r"]), draw.choice(["", '"']) if separator != " " else ""
    blank = "   " if separator == " " else separator
    form = draw.choice(["{:.3f}", "{:.6e}", "{:+.4f}", "{:.12g}"])
    table = [[0.01 * k, draw.uniform(-2e3, 2e3), draw.uniform(-1, 1)] for k in range(draw.randint(3, 40))]
    rows = [[quote + form.format(x).replace(".", decimal) + quote for x in row] for row in table]
    lines = [draw.choice(["Rig 3", "# by hand", ""]) for _ in range(draw.randint(0, 4))]
    titled = draw.random() < 0.7
    if titled:
        lines.append(draw.choice(["", "# "]) + blank.join(["time", "x [mm]", "F [N]"]))
    tail = draw.choice(["", separator]) if separator != " " else draw.choice(["", "  "])
    lines += [(" " * (separator == " ") + blank.join(row) + tail) for row in rows]
    path = write(end.join(lines) + draw.choice(["", end, end + end]))
    names = ["time", "x [mm]", "F [N]"] if titled else [1, 2, 3]
    assert [channel.name for channel in bp.inspect(path).channels] == (
        names if titled else ["column 1", "column 2", "column 3"]
    )
    run = bp.Recording.from_file(path, time=names[0], outputs={"x": names[1], "f": names[2]})
    scale = 1e-3 if titled else 1.0
    written = np.array([[float(form.format(x)) for x in row] for row in table])
    assert run.time == pytest.approx(written[:, 0]) and run.outputs["x"] == pytest.approx(scale * written[:, 1])
    assert run.outputs["f"] == pytest.approx(written[:, 2])


NUMBERS = {
    "thousands after points": ("t;x\n0,5;1.234\n1,5;12.345\n", [1234.0, 12345.0]),
    "both signs": ("t;x\n0;1.234,5\n1;2.345,75\n", [1234.5, 2345.75]),
    "quoted thousands": ('t,x\n0,"1,234.5"\n1,"2,345,678.0"\n', [1234.5, 2345678.0]),
    "apostrophes": ("t;x\n0;1'234.5\n1;999.0\n", [1234.5, 999.0]),
    "blanks": ("t;x\n0;1 234,5\n1;2\u00a0345,5\n".replace("\u00a0", " "), [1234.5, 2345.5]),
    "Fortran": ("   t   x\n 0.0 1.25D-03\n 1.0 -2.50D+00\n", [1.25e-3, -2.5]),
    "bare": ("t,x\n0,.5\n1,+1e3\n", [0.5, 1000.0]),
    "quoted decimals": ('"t","x"\n"0,5","1,5"\n"1,5","2,25"\n', [1.5, 2.25]),
    "points only": ("t,x\n0,1.234\n1,2.345\n", [1.234, 2.345]),
    "one column": ("x\n0,5\n1,5\n", [0.5, 1.5]),
    "names that are numbers": ("0,1\n0.5,1.5\n1.5,2.5\n", [1.5, 2.5]),
}


@pytest.mark.parametrize("case", NUMBERS)
def test_numbers_in_other_notations(write, case):
    content, expected = NUMBERS[case]
    name = "1" if case == "names that are numbers" else "x"
    arguments = {"time": None, "sampling_rate": 1.0, "outputs": {"x": name}}
    assert read(write(content), **arguments)[1] == expected


def test_decimal_comma_of_the_last_row_decides_for_the_whole_file(write):
    path = write("t;x\n" + "".join(f"{k};{k}\n" for k in range(5000)) + "5000;0,5\n")
    assert read(path)[1] == [*map(float, range(5000)), 0.5]


@pytest.mark.parametrize("separator", [";", "\t", " "])
def test_comma_that_may_stand_between_thousands_is_refused_with_the_argument_that_decides(write, separator):
    path = write("t;x\n0;1,234\n1;2,345\n".replace(";", separator))
    with pytest.raises(ValueError, match="column 'x' of run.csv: must be usable, .*'1,234'.*give decimal=',' or dec"):
        read(path)
    assert bp.inspect(path).channels[1].refused
    assert read(path, decimal=",")[1] == [1.234, 2.345] and read(path, decimal=".")[1] == [1234.0, 2345.0]


def test_comma_of_a_late_row_is_refused_like_one_of_the_first(write):
    path = write("t;x\n" + "".join(f"{k};{k}\n" for k in range(2000)) + "2000;1,234\n")
    with pytest.raises(ValueError, match="column 'x' of run.csv: must be usable, .*'1,234'.*give decimal=',' or dec"):
        read(path)


def test_thousands_of_a_file_with_decimal_points_never_turn_1_25_into_125(write):
    """`pandas.read_csv` does it without a word."""
    assert pd.read_csv(write("t;x\n0;1.25\n1;2.5\n"), sep=";", thousands=".")["x"].tolist() == [125, 25]
    with pytest.raises(ValueError, match="column 'x' of run.csv: must be usable, got numbers such as '1.25', which"):
        read(write("t;x\n0;1.25\n1;2.5\n"), thousands=".")


def test_contradicting_decimal_signs_are_refused(write):
    with pytest.raises(ValueError, match="column 't' of run.csv: must be usable, got numbers such as '0,5'.*decimal="):
        read(write("t;x\n0,5;1.5\n1,5;2.5\n"))
    with pytest.raises(ValueError, match="decimal: must be given for 'run.csv', whose numbers have points and commas"):
        read(write('t;x\n1.234;1,234\n"2.345";2,345\n'))


@pytest.mark.parametrize(
    ("header", "units"),
    [
        ("t [ms],x [mm],y (N)", ["ms", "mm", ""]),
        ("time (s),force (N),x / mm", ["s", "N", "mm"]),
        ("t / s,F / kN,T / °C", ["s", "kN", "°C"]),
        ("t,x (t),y (t)", ["", "", ""]),
        ("t,ratio (m),y[0]", ["", "", ""]),
        ("Time (h),Mass (t),u (mm)", ["h", "t", "mm"]),
        ("t,x (raw),y (left)", ["", "", ""]),
        ("t [s],x [raw],y [g]", ["s", "raw", "g"]),
        ("t,x [raw],y [left]", ["", "", ""]),
        ("t,x/m,y m", ["", "", ""]),
    ],
)
def test_units_in_names_are_taken_where_they_are_evident(write, header, units):
    """Names stay as they are."""
    seen = bp.inspect(write(header + "\n0,1,2\n1,2,3\n"))
    assert [channel.name for channel in seen.channels] == header.split(",")
    assert [channel.unit for channel in seen.channels] == units


def test_unit_of_a_time_column_is_converted(write):
    assert read(write("t [ms];x\n0;1,5\n2;2,5\n"), time="t [ms]")[0] == [0.0, 0.002]
    assert read(write("t;x\n[min];[mm]\n0;1,5\n2;2,5\n")) == ([0.0, 120.0], [0.0015, 0.0025])


DATES = {
    "day first": ("12.03.2026 23:59:59,5", "13.03.2026 00:00:00", 0.5),
    "month first": ("03/12/2026 10:00:00.25", "03/13/2026 10:00:01.25", 86401.0),
    "slashes, day first": ("13/03/2026 10:00", "13/03/2026 10:01", 60.0),
    "year first": ("2026/03/12 10:00:00", "2026/03/12 10:00:02", 2.0),
    "ISO": ("2026-03-12T10:00:00.123456789", "2026-03-12T10:00:01.123456789", 1.0),
    "ISO with a comma": ("2026-03-12 10:00:00,5", "2026-03-12 10:00:01,5", 1.0),
    "midnight": ("23:59:59.750", "00:00:00.250", 0.5),
    "minutes": ("59:59.5", "60:00.5", 1.0),
}


@pytest.mark.parametrize("case", DATES)
def test_dates_and_times_of_day_become_seconds(write, case):
    first, second, step = DATES[case]
    path = write(f"t;x\n{first};1,5\n{second};2,5\n")
    assert read(path)[0] == pytest.approx([0.0, step], abs=1e-12)
    assert "time='t'" in bp.inspect(path).code


@pytest.mark.parametrize(
    ("cell", "formats"),
    [
        ("03/12/2026 10:00:0{}", ["%m/%d/%Y %H:%M:%S", "%d/%m/%Y %H:%M:%S"]),
        ("12.03.26 10:00:0{}", ["%d.%m.%y %H:%M:%S"]),
        ("10:0{}", ["%H:%M", "%M:%S"]),
    ],
)
def test_ambiguous_dates_are_refused_with_the_argument_that_decides(write, cell, formats):
    path = write(f"t;x\n{cell.format(1)};1,5\n{cell.format(2)};2,5\n")
    with pytest.raises(ValueError, match=r"column 't' of run.csv: must be usable, got .*give date_format="):
        read(path)
    for form in formats:
        assert read(path, date_format=form)[0] == [0.0, 60.0 if form == "%H:%M" else 1.0]
    with pytest.raises(ValueError, match="date_format: must be that of all cells of a column of 'run.csv', got '%Y'"):
        read(path, date_format="%Y")


def test_comment_lines_are_left_out_and_names_may_stand_in_one(write):
    assert read(write("# rig 3\n# t x\n0 1\n# pause\n1 2\n# end\n")) == ([0.0, 1.0], [1.0, 2.0])


def test_trailing_separators_do_not_shift_columns(write):
    """`pandas.read_csv` takes the first column for an index and shifts the names."""
    content = "t;x\n0;1,5;\n1;2,5;\n"
    assert pd.read_csv(write(content), sep=";", decimal=",")["t"].tolist() == [1.5, 2.5]
    assert read(write(content)) == ([0.0, 1.0], [1.5, 2.5])
    assert read(write(content.replace("t;x\n", "")), time=1, outputs={"x": 2}) == ([0.0, 1.0], [1.5, 2.5])


@pytest.mark.parametrize("row", ["Mean;2,0", "Max.;2,5", "\nMittelwert;2,0"])
def test_summaries_below_the_data_are_no_samples(write, row):
    with pytest.raises(
        ValueError, match="path: must be a CSV file with a sample in each row, .* seems to be a summary"
    ):
        read(write(f"t;x\n0;1,5\n1;2,5\n{row}\n"), time=None, sampling_rate=1.0)


@pytest.mark.parametrize("second", ["t,x\n0,1\n1,2\n", "a,b,c\n0,1,2\n1,2,3\n"])
def test_second_table_is_no_continuation(write, second):
    path = write(f"t,x\n0,1\n1,2\n\n{second}")
    with pytest.raises(ValueError, match="several tables|must be a CSV file with 2 fields in each row"):
        read(path, time=None, sampling_rate=1.0)


def test_repeated_names_get_numbers(write):
    path = write("t,x,x\n0,1,2\n1,2,3\n")
    assert [channel.name for channel in bp.inspect(path).channels] == ["t", "x (1)", "x (2)"]
    assert read(path, outputs={"x": "x (2)"})[1] == read(path, outputs={"x": 3})[1] == [2.0, 3.0]


def test_unit_in_a_code_page_that_is_not_known_is_refused(write):
    path = write("t;x [µm]\n0,5;1,5\n1,5;2\n", "cp850")
    with pytest.raises(
        ValueError, match=r"must be usable, got its unit 'æm' in an encoding that is not known; give enc"
    ):
        read(path, outputs={"x": 2})
    assert read(path, outputs={"x": 2}, encoding="cp850")[1] == pytest.approx([1.5e-6, 2e-6])


@pytest.mark.parametrize(
    "content",
    [
        "<html><body>1,2</body></html>\n", '{"t": [1, 2]}\n', "A letter,\nwithout numbers, but commas.\n",
        bytes(range(1, 256)) * 20, b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "\n\n", "0,5\n1,5\n",
    ],
)  # fmt: skip
def test_what_is_no_table_is_refused(write, content):
    path = write(content)
    with pytest.raises(ValueError, match="(path|separator): must be"):
        bp.inspect(path)
    with pytest.raises(ValueError, match="must be"):
        read(path)


INSTRUMENTS = {
    "oscilloscope": ("Source,CH1\nSecond,Volt\n-1e-3,0.5\n0,0.6\n", "Source", "CH1", "V"),
    "oscilloscope with numbers as names": ("x-axis,1\nsecond,Volt\n-1e-3,0.5\n0,0.6\n", "x-axis", "1", "V"),
    "logger": ("Channel,1,2\nName,U,w\nUnit,V,mm\n-0.001,0.5,1\n0,0.6,2\n", "Name", "U", "V"),
    "preamble beside the data": (
        "Length,2500,,-1e-3,0.5,\nInterval,1e-3,,0,0.6,\n,,,1e-3,0.7,\n,,,2e-3,0.8,\n,,,3e-3,0.9,\n",
        4,
        5,
        "",
    ),
    "excel": ("sep=;\nt;U\n-0,001;0,5\n0;0,6\n", "t", "U", ""),
    "empty last column": ("t\tU\tComment\n-0.001\t0.5\t\n0\t0.6\t\n", "t", "U", ""),
}


@pytest.mark.parametrize("case", INSTRUMENTS)
def test_files_of_instruments(write, case):
    content, time, channel, unit = INSTRUMENTS[case]
    path = write(content)
    run = bp.Recording.from_file(path, time=time, outputs={"x": channel})
    assert run.time[:2] == pytest.approx([-1e-3, 0.0]) and run.outputs["x"][:2] == pytest.approx([0.5, 0.6])
    assert unit in " ".join(one.unit for one in bp.inspect(path).channels)


def test_twelve_hours(write):
    path = write("t,x\n03/13/2026 11:59:59 AM,1\n03/13/2026 12:00:00 PM,2\n")
    assert read(path)[0] == [0.0, 1.0]
    path = write("t,x\n11:59:59 AM,1\n12:00:00 PM,2\n")
    with pytest.raises(ValueError, match="must be usable, got times of twelve hours; give date_format='%I:%M:%S %p'"):
        read(path)
    assert read(path, date_format="%I:%M:%S %p")[0] == [0.0, 1.0]


@pytest.mark.parametrize("header", ["", "t,x,y\n"])
def test_row_with_a_broken_cell_above_numbers_is_not_left_out(write, header):
    path = write(header + "err,1.5,2\n1,2,3\n2,3,4\n3,4,5\n")
    with pytest.raises(ValueError, match="header: must be given, got None, as line . has neither names nor only numb"):
        bp.inspect(path)


def test_header_and_separator_may_be_given(write):
    path = write("a;b\nt;x\n0;1\n1;2\n")
    assert read(path, header=2) == ([0.0, 1.0], [1.0, 2.0])
    assert read(path, header=0, time=1, outputs={"x": 2}) == ([0.0, 1.0], [1.0, 2.0])
    assert read(path, separator=";") == ([0.0, 1.0], [1.0, 2.0])
    for argument, value in (
        ("separator", ";;"),
        ("header", -1),
        ("decimal", ";"),
        ("thousands", "x"),
        ("date_format", "d"),
    ):
        with pytest.raises(ValueError, match=f"{argument}: must be"):
            read(path, **{argument: value})
    with pytest.raises(ValueError, match="thousands: must differ from decimal"):
        read(path, decimal=",", thousands=",")


def test_parts_and_the_whole_are_read_alike(write, monkeypatch):
    """A column whose parts are numbers, texts and truth values is one of texts."""
    rows = [f"{k},{k / 8},{'True' if k < 6 else k}\n" for k in range(12)]
    path = write("t,x,b\n" + "".join(rows))
    whole = bp.inspect(path)
    monkeypatch.setattr(text, "PART_ROWS", 3)
    assert str(bp.inspect(path)) == str(whole) and whole.channels[2].remarks == ("texts, or not only numbers",)
    assert read(path) == ([*map(float, range(12))], [k / 8 for k in range(12)])


def test_suggested_call_reads_the_file(write):
    path = write(GERMAN)
    scope = {"bp": bp}
    exec(bp.inspect(path).code, scope)
    assert scope["recording"].outputs["kraft"] == pytest.approx([-2500.0, 35000.0])


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "cp1252"])
def test_damaged_texts_are_read_as_they_are_or_refused(write, encoding):
    lines = [f"12.03.2026 10:00:{k // 10:02d},{k % 10};{k},5;1.{k:03d},25\n" for k in range(60)]
    whole, generator = (
        ("Prüfstand\nZeit;Weg;Kraft\n;µm;N\n" + "".join(lines)).encode(encoding),
        np.random.default_rng(4),
    )
    for _ in range(200):
        path = write(damaged(whole, generator))
        for call in (bp.inspect, lambda path: read(path, time="Zeit", outputs={"x": "Weg", "F": "Kraft"})):
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                try:
                    call(path)
                except ValueError as error:
                    assert "must" in str(error) and str(error).encode("cp1252", "backslashreplace")


UNIT_ROWS = {
    "half of the units unknown": (
        "Zeit;Kraft;Takt;Status\nms;kN;Impulse;Digits\n{}",
        ["ms", "kN", "Impulse", "Digits"],
    ),
    "with a description": (
        "Zeit;Kraft;Takt;Status\nms;kN;Impulse;Digits\nZeit des Laufs;Lager;Geber;Wort\n{}",
        ["ms", "kN", "Impulse", "Digits"],
    ),
    "above": ("ms;kN;Nm;V\nZeit;Kraft;Takt;Status\n{}", ["ms", "kN", "Nm", "V"]),
    "above, below a preamble": ("Rig 3;;;\nms;kN;Nm;V\nZeit;Kraft;Takt;Status\n{}", ["ms", "kN", "Nm", "V"]),
}
ROWS = "0,5;1,5;1;2\n1,5;2,5;3;4\n2,5;3;5;6\n"


@pytest.mark.parametrize("case", UNIT_ROWS)
@pytest.mark.parametrize("way", ["names", "header", "numbers"])
def test_row_of_units_is_seen_wherever_it_stands(write, case, way):
    """Some of the units are unknown; a description may follow; without names or header= the latter is refused."""
    content, units = UNIT_ROWS[case]
    path = write(content.format(ROWS))
    line = content.split("\n").index("Zeit;Kraft;Takt;Status") + 1
    given = {"header": line} if way == "header" else {}
    keys = {"time": "Zeit", "outputs": {"x": "Kraft"}} if way != "numbers" else {"time": 1, "outputs": {"x": 2}}
    if way == "numbers" and case == "with a description":
        with pytest.raises(ValueError, match="header: must be given, got None, as line 2 may be units"):
            read(path, **keys)
        return
    assert read(path, **keys, **given)[0] == pytest.approx([0.0005, 0.0015, 0.0025])
    assert read(path, **keys, **given)[1] == pytest.approx([1500.0, 2500.0, 3000.0])
    if way == "header":
        assert [channel.unit for channel in bp.inspect(path, **given).channels] == units


def test_text_between_names_and_numbers_that_is_no_unit_is_refused(write):
    path = write("t;x\nTakte;Impulse\n0;1\n1;2\n")
    with pytest.raises(ValueError, match="header: must be the number of the line above the data, .*got 1, and line 2"):
        read(path, header=1)
    with pytest.raises(ValueError, match="must contain numbers, .*got 'Takte' in data row 1"):
        read(path)


def test_units_in_a_code_page_that_is_not_known_are_not_the_names(write):
    path = write("t;x\ns;µm\n0,5;1,5\n1,5;2\n", "cp850")
    assert [channel.name for channel in bp.inspect(path).channels] == ["t", "x"]
    for key in ("x", 2):
        with pytest.raises(ValueError, match="must be usable, got its unit 'æm' in an encoding that is not known"):
            read(path, outputs={"x": key})
    assert read(path, encoding="cp850")[1] == pytest.approx([1.5e-6, 2e-6])


@pytest.mark.parametrize("row", ["-00:00:0{};{}", "OL;{}{}"])
@pytest.mark.parametrize("line", [None, 0, 1])
def test_first_rows_that_are_no_numbers_are_no_preamble(write, row, line):
    first = "".join(row.format(k, k) + "\n" for k in range(5))
    path = write("a;b\n" + first + "".join(f"00:00:0{k};{k}\n" for k in range(9)))
    cell = "OL" if row[0] == "O" else "-00:00:0"
    with pytest.raises(ValueError, match=f"header: must be .*got {line}.*{cell}"):
        read(path, time=1, outputs={"x": 2}, header=line)
    with pytest.raises(ValueError, match="header: must be"):
        bp.inspect(path, header=line)


def test_first_rows_without_any_number_are_no_preamble(write):
    path = write("a;b\n" + "OL;OL\n" * 5 + "1;2\n" * 9)
    with pytest.raises(ValueError, match="header: must be given, got None, as lines 5 and 6 are alike"):
        bp.inspect(path)


@pytest.mark.parametrize(
    "name", ["Time, ms", "Time_ms", "Time in ms", "Time <ms>", "Time {ms}", "[ms] Time", "Zeit/ms", "Time ms", "t.msec"]
)
def test_unit_that_the_name_of_the_time_may_say_is_asked_for(write, name):
    path = write(f"{name};x\n0,5;1,5\n1,5;2,5\n")
    unit = "msec" if "msec" in name else "ms"
    with pytest.raises(ValueError, match=rf"time \(column .*: must be in a unit of time, got '{unit}\?'; give"):
        read(path, time=name)
    assert read(path, time=name, units={"time": ("ms", "s")})[0] == pytest.approx([0.0005, 0.0015])
    assert read(path, time=name, units={"time": 1.0})[0] == [0.5, 1.5]
    assert f"the name may say the unit '{unit}'; units= decides" in str(bp.inspect(path))


@pytest.mark.parametrize(
    ("header", "units"),
    [
        ("t [min];U [in];F [min]", ["min", "in?", "min?"]),
        ("Time [h];Length [in];<mm> x", ["h", "in?", "mm?"]),
        ("t_min;x_min;T [a]", ["min?", "", "a?"]),
        ("Time, s;F {kN};x_h", ["", "kN?", ""]),
        ("time;run <2>;F, kN", ["", "", ""]),
    ],
)
def test_words_that_may_be_units_have_a_question_mark(write, header, units):
    seen = bp.inspect(write(header + "\n0;1;2\n1;2;3\n"))
    assert [channel.unit for channel in seen.channels] == units
    assert ("the name may say the unit 'kN', which is not used; units= converts" in str(seen)) == ("F, kN" in header)


def test_points_that_all_stand_before_three_digits_are_refused(write):
    path = write("n;x\n1;1.100\n2;1.200\n")
    with pytest.raises(ValueError, match="decimal: must be given for 'run.csv', in whose numbers such as '1.100' the"):
        read(path, time="n")
    assert read(path, time="n", decimal=".")[1] == [1.1, 1.2] and read(path, time="n", decimal=",")[1] == [1100, 1200]
    path = write("n;x\n" + "".join(f"{k};1.100\n" for k in range(500)) + "500;0.900\n")
    assert read(path, time="n")[1][-2:] == [1.1, 0.9]


@pytest.mark.parametrize("cell", ["∞", "OL"])
def test_cell_that_is_no_number_is_named_also_among_decimal_commas(write, cell):
    path = write(f"t;x\n0,5;1,5\n1,5;2,5\n2,5;{cell}\n3,5;2,5\n")
    with pytest.raises(ValueError, match=f"column 'x' of run.csv: must be usable, got '{cell}' in data row 3, which"):
        read(path)


def test_columns_of_texts_and_of_one_date_are_not_the_time(write):
    path = write("a,b,Datum,Zeit\n1,2500,12.03.2026,0.5\n5,Volt,12.03.2026,1.5\n3,s,12.03.2026,2.5\n")
    assert "time='Zeit'" in bp.inspect(path).code
    assert "time=" not in bp.inspect(write("a,b\n3,2500\n2,Volt\n1,s\n")).code


@pytest.mark.parametrize(
    "upper, lower", [("CH1;CH2", "t;F"), ("Zeit;Kraft", "Takte;Impulse"), ("CH1;CH2", "Takte;mm Hg")]
)
def test_second_row_of_texts_that_may_be_units_is_refused_without_its_meaning(write, upper, lower):
    path = write(f"{upper};CH3\n{lower};V\n0,5;1;2\n1,5;2;3\n")
    with pytest.raises(ValueError, match="header: must be given, got None, as line 2 may be names or units"):
        bp.inspect(path)
    assert [channel.name for channel in bp.inspect(path, header=2).channels] == [*lower.split(";"), "V"]


def test_row_of_units_in_words_is_one(write):
    path = write("Zeit;Kraft\nMillisekunden;Digits\n0;1\n1;2\n")
    with pytest.raises(ValueError, match=r"time \(column .*: must be in a unit of time, got 'Millisekunden'; give"):
        read(path, time=1, outputs={"x": 2})


def test_first_negative_times_of_the_only_column_are_no_names(write):
    path = write("t\n-00:00:02\n-00:00:01\n" + "".join(f"00:00:0{k}\n" for k in range(9)))
    with pytest.raises(ValueError, match="header: must be given, got None, as line 3 has neither names nor only num"):
        bp.inspect(path)


def test_unit_of_the_time_that_is_none_of_time_is_asked_for(write):
    with pytest.raises(ValueError, match=r"time \(column .*: must be in a unit of time, got 'm'; give"):
        read(write("t;x\nm;mm\n0;1\n1;2\n"))
    assert read(write("t;x\nm;mm\n0;1\n1;2\n"), units={"time": 60.0})[0] == [0.0, 60.0]


def test_row_of_units_behind_a_mark_of_comments_in_a_field_is_seen(write):
    assert read(write("#,t,x\n#,ms,mm\n0,0,1\n1,1,2\n")) == ([0.0, 0.001], [0.001, 0.002])


@pytest.mark.parametrize("place", [0, 119_999])
@pytest.mark.parametrize("cell", [' "2.5"', "  NaN"])
def test_blanks_before_a_field_of_any_row_are_left_out(write, place, cell):
    """The file has more than one of the parts that are searched for blanks; numbers have them in pandas anyway."""
    rows = [f"{k / 100},{k % 7}.5" for k in range(120_000)]
    rows[place] = f"{place / 100},{cell}"
    assert sum(map(len, rows)) > encodings.PART_BYTES
    run = bp.Recording.from_file(write("t,x\n" + "\n".join(rows)), time="t", missing="drop", **X)
    wanted = {k: k % 7 + 0.5 for k in range(len(rows))}
    if "2.5" in cell:
        wanted[place] = 2.5
    else:
        del wanted[place]
    np.testing.assert_array_equal(run.outputs["x"], [*wanted.values()])
    np.testing.assert_array_equal(run.time, np.array([*wanted]) / 100)


@pytest.mark.parametrize("row", [0, 1, 2])
def test_empty_field_at_the_end_of_one_row_is_none(write, row):
    """Of a number there, the row is refused, in the first one too."""
    rows = ["0,1.5", "1,2.5", "2,3.5"]
    rows[row] += ","
    assert read(write("t,x\n" + "\n".join(rows))) == ([0.0, 1.0, 2.0], [1.5, 2.5, 3.5])
    rows[row] += "7"
    with pytest.raises(ValueError, match=r"2 fields in each row|has rows of|has 2 fields for 3"):
        read(write("t,x\n" + "\n".join(rows)))


def test_commas_that_are_no_thousands_are_not_called_so():
    """Of 1,23 and 1,234 only the second has a comma that may stand between thousands."""
    assert "may be the decimal sign" in text_cells.refusal(["1,234", "2,345"], False)
    assert "do not all have one decimal sign" in text_cells.refusal(["1,23", "1,234"], False)
    assert text_cells.refusal(["1,23", "later"], False) == ""


def test_characters_that_decide_an_encoding_are_shown(tmp_path):
    file = tmp_path / "run.csv"
    rows = [f"{0.001 * k:.3f},{np.sin(0.1 * k):.6f}" for k in range(50)]
    file.write_bytes("\n".join(["time,größe", *rows]).encode("cp1252"))
    assert "read as the characters 'ß', 'ö': if they are others, give encoding=" in str(bp.inspect(file))
