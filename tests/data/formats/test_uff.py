"""Universal files, written by the lines of their specification: right times, units and lengths, or refused."""

import struct
import subprocess
import sys
import warnings

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import uff
from tests.data.test_damaged_files import damaged

MARK = "    -1\n"
SWING = np.sin(0.3 * np.arange(50))


def field(kind, label, unit, exponents=(0, 0, 0)):
    return f"{kind:10d}{exponents[0]:5d}{exponents[1]:5d}{exponents[2]:5d} {label:<20} {unit:<20}\n"


def texts(numbers, widths, per_line):
    """Return numbers as Fortran writes them."""
    cells = [f"{value:{width}.{5 if width == 13 else 11}E}" for value, width in zip(numbers, widths, strict=True)]
    return "".join("".join(cells[k : k + per_line]) + "\n" for k in range(0, len(cells), per_line))


def function(
    values=SWING, step=0.01, start=0.0, *, x=None, unit="m", kind=8, function=1, title="top", node=3, way=1,
    double=True, binary="", abscissa=17, time_unit="s", step_text=None, count=None, fill=(), form=2, date="NONE",
    denominator=(0, "NONE"),
):  # fmt: skip
    """Return the bytes of a data set 58 after the specification of SDRC."""
    values = np.asarray(values)
    mixed = np.iscomplexobj(values)
    columns = ([] if x is None else [x]) + ([values.real, values.imag] if mixed else [values])
    numbers = [*np.transpose(columns).ravel(), *fill]
    order = {"<": 1, ">": 2}.get(binary, 0)
    size = len(numbers) * (8 if double else 4)
    head = f"{58:6d}" + (f"b{order:6d}{form:6d}{11:12d}{size:12d}{0:6d}{0:6d}{0:12d}{0:12d}" if binary else "")
    ids = "".join(f"{line:<80}\n" for line in (title, "NONE", date, "NONE", "NONE"))
    place = f"{function:5d}{1:10d}{1:5d}{0:10d} {'NONE':<10}{node:10d}{way:4d} {'NONE':<10}{0:10d}{0:4d}\n"
    data_type = (6 if double else 5) if mixed else (4 if double else 2)
    even = x is None
    written = step_text or f"{step * even:13.5E}"
    shape = f"{data_type:10d}{count or len(values):10d}{int(even):10d}{start * even:13.5E}{written:>13}{0.0:13.5E}\n"
    axes = field(abscissa, "Time", time_unit) + field(kind, "x", unit) + field(denominator[0], "NONE", denominator[1])
    whole = MARK + head.ljust(80) + "\n" + ids + place + shape + axes + field(0, "NONE", "NONE")
    if binary:
        body = struct.pack(f"{binary}{len(numbers)}{'d' if double else 'f'}", *numbers)
    elif even or not double:
        body = texts(numbers, [20 if double else 13] * len(numbers), 4 if double else 6).encode()
    elif mixed:
        body = texts(numbers, [13, 20, 20] * len(values), 3).encode()
    else:
        body = texts(numbers, [13, 20] * len(values), 4).encode()
    return whole.encode("utf-8") + body + MARK.encode()


def units164(code=5, length=1000.0, force=1000.0):
    line = "".join(f"{value:25.17E}".replace("E", "D") for value in (length, force, 1.0))
    return f"{MARK}{164:6d}\n{code:10d}{'of the test':<20}{2:10d}\n{line}\n{273.15:25.17E}\n{MARK}".encode()


@pytest.fixture
def saved(tmp_path):
    def save(*sets):
        path = tmp_path / "run.uff"
        path.write_bytes(b"".join(sets))
        return path

    return save


def read(path, key="top", **arguments):
    return bp.Recording.from_file(path, outputs={"x": key}, **arguments)


@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize("binary", ["", "<", ">"])
@pytest.mark.parametrize("even", [True, False])
def test_values_and_times_of_all_forms(saved, double, binary, even):
    x = None if even else 0.01 * np.arange(50)
    run = read(saved(function(double=double, binary=binary, x=x)))
    np.testing.assert_allclose(run.outputs["x"], SWING, atol=1e-10 if double else 6e-6)
    np.testing.assert_allclose(run.time, 0.01 * np.arange(50), atol=1e-7)


@pytest.mark.parametrize("rate", [51_200, 44_100, 48_000, 65_536, 512])
def test_interval_of_six_digits_is_named_with_its_error_and_the_round_rate(saved, rate):
    path = saved(function(step=1.0 / rate))
    with pytest.warns(UserWarning, match=rf"few digits.* ppm; {rate} Hz has the same digits") as raised:
        run = bp.Recording.from_file(path, outputs={"x": "top"})
    assert raised[0].filename == __file__
    assert abs(run.time[-1] * rate / 49 - 1.0) < 3e-6
    exact = read(path, sampling_rate=rate)
    np.testing.assert_allclose(exact.time, np.arange(50) / rate, rtol=1e-14)
    assert "sampling_rate= overrides it" in str(bp.inspect(path))


def test_interval_whose_last_digit_was_cut_off_is_named_too(saved):
    with pytest.warns(UserWarning, match="51200 Hz has the same digits"):
        read(saved(function(step_text="  1.95312E-05")))


@pytest.mark.parametrize(
    "text", ["  1.00000E-03", " 2.50000E-004", "  3.90625E-03", "1.953125E-05", "0.0078125", "  3.00000E-03"]
)
def test_exact_interval_gives_no_warning(saved, text):
    """The second is that of catman, with an exponent of three digits."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read(saved(function(step_text=text))).time[1] == float(text)


def test_exponent_of_fortran_that_the_package_does_not_read_is_refused(saved):
    with pytest.raises(ValueError, match="its data set 1 cannot be read by pyuff"):
        read(saved(function(step_text="  4.00000D-03")))


def test_uneven_times_that_became_a_staircase_are_refused(saved):
    """1 kHz from 1000 s on: six digits are 10 ms."""
    path = saved(function(np.arange(200.0), x=1000.0 + 1e-3 * np.arange(200), double=False))
    with pytest.raises(ValueError, match="time: must be known, .*rounded to 0.01 s, .*sampling_rate="):
        read(path)
    assert read(path, sampling_rate=1000.0).time[-1] == pytest.approx(1000.199, abs=1e-9)
    assert bp.inspect(path).channels[0].refused


def test_uneven_times_that_are_displaced_by_a_part_of_a_step_are_refused(saved):
    """600 Hz from 100 s on: six digits are 1 ms, so that steps of 1.67 ms become 1 or 2 ms."""
    path = saved(function(x=100.0 + np.arange(50) / 600))
    with pytest.raises(ValueError, match="time: must be known, .*rounded to 0.001 s, with a mean step of 0.00167 s"):
        read(path)


def test_uneven_times_with_sufficient_digits_are_taken(saved):
    times = np.cumsum(0.01 + 0.002 * np.sin(np.arange(50)))
    run = read(saved(function(x=times)))
    np.testing.assert_allclose(run.time, times, atol=5e-6)


def test_single_numbers_of_late_times_are_refused_and_doubles_are_taken(saved):
    times = 20_000.0 + 1e-3 * np.arange(50)
    with pytest.raises(ValueError, match="time: must be known"):
        read(saved(function(x=times, binary="<", double=False)))
    np.testing.assert_allclose(read(saved(function(x=times, binary="<"))).time, times, rtol=1e-15)


def test_units_of_data_set_164_are_applied(saved):
    """In mm and mN."""
    parts = [function(unit="NONE", kind=kind, title=f"k{kind}", node=kind) for kind in (8, 11, 12, 13, 15)]
    run = bp.Recording.from_file(
        saved(units164(), *parts), outputs={f"x{kind}": f"k{kind}" for kind in (8, 11, 12, 13, 15)}
    )
    for kind, factor in {8: 1e-3, 11: 1e-3, 12: 1e-3, 13: 1e-3, 15: 1e3}.items():
        np.testing.assert_allclose(run.outputs[f"x{kind}"], factor * SWING, rtol=1e-9)


def test_rotations_of_data_set_164_are_angles_and_moments(saved):
    path = saved(units164(), function(unit="", way=5), function(unit="", kind=13, way=-4, title="moment"))
    run = bp.Recording.from_file(path, outputs={"x": "top", "m": "moment"})
    np.testing.assert_allclose(run.outputs["x"], SWING, rtol=1e-9)
    np.testing.assert_allclose(run.outputs["m"], 1e-6 * SWING, rtol=1e-9)


def test_factors_of_another_unit_system_are_recognised(saved):
    path = saved(
        units164(9, 1 / 0.0254, 1 / 4.4482216152605), function(unit="NONE"), function(kind=13, unit="NONE", title="F")
    )
    run = bp.Recording.from_file(path, outputs={"x": "top", "F": "F"})
    np.testing.assert_allclose(run.outputs["x"], 0.0254 * SWING, rtol=1e-9)
    np.testing.assert_allclose(run.outputs["F"], 4.4482216152605 * SWING, rtol=1e-9)


@pytest.mark.parametrize(
    "parts",
    [
        (units164(), function(unit="m")),  # mm by the data set 164
        (units164(1, 3.28083989501312334, 0.224808943099710480), function(unit="NONE")),  # as in pyuff's example
        (units164(9, 7.0, 1.0), function(unit="NONE")),
        (units164(), function(unit="g", kind=12)),
        (units164(), function(unit="NONE", way=0)),  # a translation or an angle
        (units164(), function(unit="NONE", kind=1)),  # a general function: of unknown dimension
        (function(unit="furlong per fortnight"),),
    ],
)
def test_contradicting_or_unknown_units_are_decided_by_the_user(saved, parts):
    path = saved(*parts)
    with pytest.raises(ValueError, match=r"units\['x'\]: must say what .* in the file is"):
        read(path)
    np.testing.assert_allclose(read(path, units={"x": ("cm", "m")}).outputs["x"], 0.01 * SWING, rtol=1e-9)


@pytest.mark.parametrize("unit, kind", [("mm", 8), ("mm/s2", 12), ("mm/s^2", 12), ("(mm/s²)", 12), ("[mm]", 8)])
def test_label_of_the_unit_that_agrees_is_taken(saved, unit, kind):
    np.testing.assert_allclose(
        read(saved(units164(), function(unit=unit, kind=kind))).outputs["x"], 1e-3 * SWING, rtol=1e-9
    )


def test_label_in_latin_1_is_read(saved):
    """Of "µm", the letter µ is one byte, which is no UTF-8."""
    path = saved(function(unit="um").replace(b"um      ", "µm      ".encode("latin-1")))
    assert bp.inspect(path).channels[0].unit == "µm"
    np.testing.assert_allclose(read(path).outputs["x"], 1e-6 * SWING, rtol=1e-9)


def test_times_in_milliseconds_are_converted_and_other_abscissas_refused(saved):
    assert read(saved(function(time_unit="ms", step=2.0))).time[1] == pytest.approx(2e-3)
    for arguments in ({"abscissa": 18, "time_unit": "Hz"}, {"time_unit": "rev"}):
        with pytest.raises(ValueError, match="time: must be known, .* whose abscissa is no time"):
            read(saved(function(**arguments)))


@pytest.mark.parametrize("which", [2, 4, 7, 9, 12, 24, 0])
def test_functions_that_are_no_time_signals_are_shown_and_refused(saved, which):
    path = saved(function(function=which, abscissa=18, time_unit="Hz", title="H"), function())
    with pytest.raises(
        ValueError, match=r"channel '3:\+X/H' of run.uff: must be usable, .*no time signal.*read_sets\(0\)"
    ):
        read(path, "H")
    shown = bp.inspect(path)
    assert [channel.refused for channel in shown.channels] == [True, False]
    assert np.isnan(shown.channels[0].rate) and "'H'" not in shown.code
    assert read(path).time.size == 50


def test_complex_functions_are_refused(saved):
    for arguments in ({}, {"x": np.arange(50.0)}, {"binary": "<"}):
        with pytest.raises(ValueError, match="must be usable, got a complex time signal"):
            read(saved(function(SWING + 1j, **arguments)))


def test_function_of_unknown_type_over_time_is_taken(saved):
    path = saved(function(function=0))
    assert read(path).time.size == 50 and "taken as a time signal" in str(bp.inspect(path))


def test_several_sets_of_different_lengths_and_rates_keep_their_times(saved):
    path = saved(function(), function(np.arange(20.0), step=0.02, title="slow"), function(np.arange(30.0), title="b"))
    run = bp.Recording.from_file(path, outputs={"x": "top", "slow": "slow"})
    assert run.times["slow"].tolist() == pytest.approx((0.02 * np.arange(20)).tolist())
    assert run.times["x"].size == 50 and run.outputs["slow"].tolist() == [*range(20)]
    assert [channel.samples for channel in bp.inspect(path).channels] == [50, 20, 30]


def test_one_set_and_several_are_read_alike(saved):
    one, two = read(saved(function())), read(saved(function(), function(title="b")))
    assert np.array_equal(one.outputs["x"], two.outputs["x"])


def test_equal_names_are_told_apart_by_places_and_numbers(saved):
    path = saved(function(node=1), function(2 * SWING, node=2, way=-3), function(3 * SWING, title="other"))
    with pytest.raises(ValueError, match=r"must be the name of one channel, got 'top', .*\('2:-Z', 'top'\)"):
        read(path)
    assert np.allclose(read(path, ("2:-Z", "top")).outputs["x"], 2 * SWING)
    assert np.allclose(read(path, 2).outputs["x"], 2 * SWING)
    same = saved(function(), function(2 * SWING), function(3 * SWING, title="other"))
    assert np.allclose(read(same, "top (2)").outputs["x"], 2 * SWING)


def test_places_are_the_names_where_the_first_line_is_that_of_the_model(saved):
    path = saved(function(title="wing", node=1), function(2 * SWING, title="wing", node=2, way=-3))
    assert [channel.name for channel in bp.inspect(path).channels] == ["1:+X", "2:-Z"]
    assert np.allclose(read(path, "2:-Z").outputs["x"], 2 * SWING)


@pytest.mark.parametrize("binary", ["", "<"])
@pytest.mark.parametrize("count", [51, 500, 100_000_000, 20])
def test_set_with_another_number_of_values_than_its_header_says_is_refused(saved, binary, count):
    with pytest.raises(ValueError, match="must be a universal file .* has 50 values, and its header says"):
        read(saved(function(binary=binary, count=count)))


def test_values_that_fill_the_last_line_are_left_out(saved):
    """Fortran writes whole lines, which pyuff returns as samples."""
    run = read(saved(function(fill=(9.0, 9.0), double=True)))
    np.testing.assert_allclose(run.outputs["x"], SWING, atol=1e-10)
    run = read(saved(function(fill=(9.0,) * 4, double=False)))
    assert run.time.size == 50
    whole = function(double=True)  # its last line has two of four values
    blank = saved(whole[: -len(MARK) - 1] + b" " * 40 + b"\n" + MARK.encode())
    with pytest.raises(ValueError, match="path: must be a universal file .*its data set 1 cannot be read by pyuff"):
        read(blank)


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"   \n"])
def test_line_end_after_binary_values_is_left_out(saved, end):
    whole = function(binary="<")
    path = saved(whole[: -len(MARK)] + end + MARK.encode())
    assert np.array_equal(read(path).outputs["x"], SWING)


@pytest.mark.parametrize("form", [1, 3])
def test_binary_numbers_of_other_computers_are_refused(saved, form):
    with pytest.raises(ValueError, match=f"has numbers of format {form} .* not those of IEEE 754"):
        read(saved(function(binary=">", form=form)))


def test_starts_with_too_few_digits_are_refused_if_sets_start_at_different_times(saved):
    path = saved(function(start=1000.123), function(title="b"))
    with pytest.raises(ValueError, match="time: must be known, .*starts at 1000.12 s, rounded to 0.01 s"):
        read(path)
    assert read(path, "b").time[0] == 0.0
    assert read(saved(function(start=1000.123), function(start=1000.123, title="b"))).time[0] == 1000.12
    run = bp.Recording.from_file(saved(function(start=0.25), function(title="b")), outputs={"x": "top", "b": "b"})
    assert run.times["x"][0] == 0.25 and run.times["b"][0] == 0.0


def test_different_dates_are_named(saved):
    path = saved(function(date="01-Jan-26 10:00:00"), function(date="01-Jan-26 11:00:00", title="b"))
    assert "may be different runs" in str(bp.inspect(path))


def test_files_of_other_writers_are_read(saved):
    """Lines that end with CR LF, blanks after marks, data sets of other kinds, a last line filled with blanks."""
    other = f"{MARK}{151:6d}\nmodel\nNONE\nNONE\n{MARK}{MARK}{2411:6d}\n{1:10d}{1:10d}{1:10d}{-1:10d} \n{MARK}".encode()
    whole = other + function(double=False)
    lines = [line.ljust(80) for line in whole.decode().splitlines()]
    for text in ("\r\n".join(lines) + "\r\n", "\n".join(lines) + "\n", whole.decode().replace("\n", "\r\n")):
        np.testing.assert_allclose(read(saved(text.encode())).outputs["x"], SWING, atol=6e-6)


def test_file_whose_marks_are_missed_by_the_package_is_refused(saved):
    """It drops the last set without a word if 80 columns end the file, and all after a line of data that ends in -1."""
    node = f"{MARK}{2411:6d}\n{1:10d}{1:10d}{1:10d}{-1:10d}\n{MARK}".encode()
    for whole in (function() + function(title="b").rstrip() + b" " * 74, node + function()):
        with pytest.raises(ValueError, match="must be a universal file .*(told apart|number is)"):
            read(saved(whole))


def test_file_without_functions_is_refused(saved):
    with pytest.raises(ValueError, match="must be a universal file with data sets 58, got .*no data set 58, but 164"):
        read(saved(units164()))


@pytest.mark.parametrize("arguments", [{}, {"binary": "<"}, {"double": False, "x": 0.01 * np.arange(50)}])
def test_damaged_file_is_refused_or_read_as_a_whole(tmp_path, arguments):
    whole = units164() + function(unit="mm") + function(title="b", unit="mm", **arguments)
    path, generator = tmp_path / "run 7", np.random.default_rng(3)
    for _ in range(200):
        path.write_bytes(damaged(whole, generator))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", "sampling_rate: run 7")
            try:
                bp.inspect(path, format="uff")
                run = bp.Recording.from_file(path, outputs={"x": 1, "b": 2}, format="uff")
            except ValueError as error:
                assert "must" in str(error)
                continue
        assert all(run.times[key].size == run.outputs[key].size >= 2 for key in ("x", "b"))


def test_package_is_imported_by_no_other_format():
    code = "import sys, bayesperiodic as bp; bp.Recording; bp.inspect; assert 'pyuff' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("binary", ["", "<"])
@pytest.mark.parametrize("even", [True, False])
def test_frequency_response_functions_are_a_table_of_responses(saved, binary, even):
    f = 0.05 + 0.05 * np.arange(5)
    omega = 2 * np.pi * f
    h = 1.0 / (1.0 - omega**2 + 0.2j * omega)
    axis = {"step": 0.05, "start": 0.05} if even else {"x": f}
    settings = {"function": 4, "abscissa": 18, "time_unit": "Hz", "unit": "mm", "denominator": (13, "N"), **axis}
    path = saved(function(1e3 * h, title="H", binary=binary, **settings), function(1e3 * h, title="G", **settings))
    runs = bp.response_table(path, outputs={"x": "H"}, inputs={"force": 0.5}, per="force")
    assert [run.frequency for run in runs] == pytest.approx(f.tolist())
    c = [2 / run.samples * np.fft.rfft(run.outputs["x"])[1] for run in runs]
    assert c == pytest.approx((0.5 * h).tolist(), rel=2e-5)
    with pytest.raises(ValueError, match="H.*must be usable, got a frequency response function .type 4., which is no"):
        read(path, "H")


def test_frequency_response_whose_units_are_open_needs_them(saved):
    h = np.exp(-1j * np.arange(1.0, 5.0))
    settings = {"function": 4, "abscissa": 18, "time_unit": "Hz", "start": 1.0, "step": 1.0}
    path = saved(units164(), function(h, unit="mm", denominator=(13, "N"), title="H", **settings))
    arguments = {"outputs": {"x": "H"}, "inputs": {"force": 1.0}, "per": "force"}
    with pytest.raises(ValueError, match=r"units\['x'\]: must say what '\(mm\)/\(N\) \(and data set 164\)'"):
        bp.response_table(path, **arguments)
    first = bp.response_table(path, units={"x": 1e-3}, **arguments)[0]
    assert 2 / first.samples * np.fft.rfft(first.outputs["x"])[1] == pytest.approx(1e-3 * h[0], rel=1e-6)
    path = saved(function(h, time_unit="rad/s", unit="m", denominator=(13, "N"), title="H", function=4, abscissa=18))
    with pytest.raises(ValueError, match="an abscissa that is no frequency in Hz, but 'rad/s'"):
        bp.response_table(path, **arguments)


def with_field(start, text, line=8):
    """Return a function whose line of numbers, that of the form by default, has a text from a column on."""
    lines = function().split(b"\n")
    lines[line] = lines[line][:start] + text.encode() + lines[line][start + len(text) :]
    return b"\n".join(lines)


@pytest.mark.parametrize(
    "content, reason",
    [
        (with_field(0, f"{3:10d}"), "its data set 1 has an unknown form of data"),
        (with_field(0, f"{1:10d}"), "its data set 1 has an unknown form of data"),
        (with_field(10, f"{-1:10d}"), "its data set 1 has an unknown form of data"),
        (with_field(20, f"{2:10d}"), "its data set 1 has an unknown form of data"),
        (with_field(30, f"{'inf':>13}"), "its data set 1 has an abscissa that is not finite"),
        (with_field(43, f"{'nan':>13}"), "its data set 1 has an abscissa that is not finite"),
        (units164() + function(binary="<").replace(f"{11:12d}".encode(), f"{12:12d}".encode(), 1),
         "its data set 2 has 12 lines before its values, not 11"),
        (function(binary="<", form=1),
         "its data set 1 has numbers of format 1 and byte order 1, not those of IEEE 754"),
        (function() + function().replace(f"{58:6d}".encode(), b"  no58", 1),
         "it has a data set whose number is 'no58'"),
        (function()[:-7], "it is cut off"),
        (b"nothing", "it has no data set 58, but none"),
        (units164() + function().replace(f"{58:6d}".encode(), f"{151:6d}".encode(), 1),
         "it has no data set 58, but 151, 164"),
    ],
)  # fmt: skip
def test_files_of_another_form_are_refused_with_the_number_of_the_set(saved, content, reason):
    path = saved(content)
    with pytest.raises(ValueError, match=f"path: must be a universal file with data sets 58, got .*run.uff' .{reason}"):
        bp.inspect(path, format="uff")


@pytest.mark.parametrize(
    "arguments, reason",
    [
        ({"step": 0.0}, "whose interval is 0"), ({"step": -0.01}, "whose interval is -0.01"),
        ({"values": [1.0], "x": [0.5]}, "of fewer than two samples"),
        ({"abscissa": 18, "time_unit": "Hz"}, "whose abscissa is no time, but of type 18 in 'Hz'"),
        ({"abscissa": 1, "time_unit": "mm"}, "whose abscissa is no time, but of type 1 in 'mm'"),
    ],
)  # fmt: skip
def test_abscissas_that_are_no_times_are_refused_with_what_they_are(saved, arguments, reason):
    path = saved(function(**arguments))
    assert reason in str(bp.inspect(path)) or len(arguments) == 2 and "values" in arguments
    with pytest.raises(ValueError, match=f"time: must be known, got channel '3:.X/top' of run.uff, {reason}"):
        read(path)


@pytest.mark.parametrize("abscissa", [0, 1, 17])
@pytest.mark.parametrize("time_unit, size", [("s", 1.0), ("sec", 1.0), ("NONE", 1.0), ("", 1.0), ("ms", 1e-3)])
def test_abscissas_of_the_time_and_of_no_stated_type_are_times(saved, abscissa, time_unit, size):
    run = read(saved(function(abscissa=abscissa, time_unit=time_unit, start=2.0, step=0.5)))
    np.testing.assert_allclose(run.time, size * (2.0 + 0.5 * np.arange(50)), rtol=1e-12)


@pytest.mark.parametrize("end, error", [(0.49, "5e-07"), (4.9, "5e-06"), (99.9, "5e-05"), (100.0, "0.0005")])
def test_error_of_stored_times_is_half_of_their_sixth_digit(saved, end, error):
    times = np.linspace(0.0, end, 50) ** 2 / end
    shown = str(bp.inspect(saved(function(x=times))))
    assert f"times are stored with an error of up to {error} s" in shown
    times = times.astype("f4").astype(float)
    single = float(f"{np.spacing(np.float32(end)) / 2:.2g}")
    assert f"an error of up to {single:.2g} s" in str(bp.inspect(saved(function(x=times, binary="<", double=False))))
    assert "an error of up to 0 s" in str(bp.inspect(saved(function(x=times, binary="<"))))


@pytest.mark.parametrize("step, taken", [(2.1e-3, False), (9.9e-3, False), (1.01e-2, True)])
def test_times_may_be_rounded_to_a_hundredth_of_a_step(saved, step, taken):
    """Around 20 s, six digits are 1e-4 s, and the error is half of that."""
    path = saved(function(x=20.0 + 0.5 * step * np.arange(50)))
    if taken:
        assert read(path).time.size == 50
    else:
        with pytest.raises(ValueError, match="whose times are rounded to 0.0001 s, with a mean step of .* even"):
            read(path)


@pytest.mark.parametrize(
    "start, digits", [("   1.2345E+01", "0.001"), ("  1.23000E+01", None), ("  -1.2345E+01", "0.001")]
)
def test_start_of_one_set_among_others_must_be_known_to_a_hundredth_of_a_step(saved, start, digits):
    lines = function(title="late").split(b"\n")
    lines[8] = lines[8][:30] + start.encode() + lines[8][43:]
    path = saved(b"\n".join(lines), function())
    if digits is None:
        assert read(path, "late").time[0] == 12.3
        return
    assert read(path, "top").time[0] == 0.0
    with pytest.raises(
        ValueError, match=f"which starts at -?12.345 s, rounded to {digits} s with a step of 0.01 s, and"
    ):
        bp.Recording.from_file(path, outputs={"x": "late", "y": "top"})


def sets(*heads):
    """Return functions by number, first line of their names, node, direction and name of the part."""
    kinds = {"id1": "NONE", "rsp_ent_name": "NONE", "rsp_node": 0, "rsp_dir": 0}
    return [uff._Set(k, kinds | head, "", "", ("", "", ""), None) for k, head in enumerate(heads, 1)]


@pytest.mark.parametrize(
    "heads, names, groups",
    [
        ([{}], ["set 1"], [""]), ([{"id1": "a"}], ["a"], [""]), ([{"rsp_node": 3}], ["3"], [""]),
        ([{"rsp_dir": -2}], ["0:-Y"], [""]), ([{"rsp_node": 3, "rsp_dir": 6}], ["3:+RZ"], [""]),
        ([{"rsp_node": 3, "rsp_dir": 9}], ["3"], [""]), ([{"rsp_node": 3, "rsp_dir": -4}], ["3:-RX"], [""]),
        ([{"rsp_ent_name": "wing", "rsp_node": 3, "rsp_dir": 1}], ["wing:3:+X"], [""]),
        ([{"id1": "a", "rsp_node": 1}, {"id1": "b", "rsp_node": 2}], ["a", "b"], ["1", "2"]),
        ([{"id1": "a", "rsp_node": 1}, {"id1": "a", "rsp_node": 2}], ["1", "2"], ["", ""]),
        ([{"id1": "a", "rsp_node": 1}, {"id1": "a", "rsp_node": 1}], ["1", "1 (2)"], ["", ""]),
        ([{"id1": "a", "rsp_node": 1}, {"id1": "a"}], ["a", "a"], ["1", ""]),
        ([{"id1": "a"}, {"id1": "a"}, {"id1": "b"}], ["a", "a (2)", "b"], ["", "", ""]),
        ([{"id1": "a"}, {"rsp_node": 2}, {}], ["a", "2", "set 3"], ["", "", ""]),
        ([{"id1": name, "rsp_node": node} for name, node in (("a", 1), ("b", 2), ("c", 1), ("b", 2), ("a", 1))],
         ["a", "b", "c", "b (2)", "a (2)"], ["1", "2", "1", "2", "1"]),
    ],
)  # fmt: skip
def test_names_are_the_first_lines_and_groups_the_places(heads, names, groups):
    """Where all first lines are the same, as of the model, the places are the names."""
    assert uff._names(sets(*heads)) == (names, groups)


def test_dates_that_differ_are_both_named(saved):
    dates = ("01-Jan-26 10:00:00", "01-Jan-26 11:00:00")
    shown = str(bp.inspect(saved(*(function(date=date, title=date[-8:-6]) for date in dates))))
    assert f"the sets have different dates ({dates[0]!r} to {dates[1]!r}) and may be different runs" in shown
    for parts in ((dates[0],) * 2, (dates[0],)):
        assert "different dates" not in str(bp.inspect(saved(*(function(date=date) for date in parts))))
    # The date of a function that is no time signal does not count.
    other = function(date=dates[1], function=4, abscissa=18, time_unit="Hz", title="H")
    assert "different dates" not in str(bp.inspect(saved(function(date=dates[0]), other)))


@pytest.mark.parametrize("spare, read_", [(0, True), (5, True), (6, False)])
def test_text_may_have_values_up_to_the_end_of_its_line(saved, spare, read_):
    """Of six single numbers in a line, five at most fill it."""
    path = saved(function(fill=(9.0,) * spare, double=False))
    if read_:
        assert read(path).time.size == 50
    else:
        with pytest.raises(ValueError, match="has 56 values, and its header says 50; it is cut off or damaged"):
            read(path)


def test_labels_of_units_have_twenty_characters(saved):
    """Of a record in the format I10, 3I5, 2(1X, A20), they are the last ones."""
    path = saved(function(unit="micrometer/second**2"))
    assert [channel.unit for channel in bp.inspect(path).channels] == ["micrometer/second**2"]


def test_functions_are_channels_with_units_and_clocks(saved):
    path = saved(
        function(title="a", step=0.5), function(title="b", step=0.5, unit="mm", values=SWING[:20]),
        function(title="c", function=2), function(title="a", node=7, step=0.25, kind=13, unit="N"),
    )  # fmt: skip
    whole = uff.contents(path, [])
    assert (whole.kind, whole.word, whole.remarks) == ("universal file", "channel", ())
    assert [(one.name, one.samples) for one in whole.channels] == [("a", 50), ("b", 20), ("c", 50), ("a", 50)]
    assert len({one.label for one in whole.channels if one.name == "a"}) == 2
    assert [one.unit for one in whole.channels if not one.refusal] == ["m", "mm", "N"]
    assert [bool(one.refusal) for one in whole.channels] == [False, False, True, False]
    assert [one.clock.step for one in whole.channels if not one.refusal] == [0.5, 0.5, 0.25]
    np.testing.assert_allclose(whole.channels[1].values(), SWING[:20], atol=1e-10)


def test_lines_are_in_utf_8_or_else_in_the_encoding_of_windows():
    assert [uff._text(line) for line in ("µm".encode(), "µm".encode("cp1252"), b"\x81m")] == ["µm", "µm", "\ufffdm"]
