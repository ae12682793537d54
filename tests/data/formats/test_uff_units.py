"""Units of universal files, after the factors and codes of data set 164 and the labels of functions."""

import pytest

from bayesperiodic.data.formats.uff_units import Units164, quotient, seconds_of, unit_of

# Metres and newtons of the units of SDRC's codes.
SI = {
    1: ("m", 1.0, "N", 1.0), 2: ("ft", 0.3048, "lbf", 4.4482216152605), 3: ("m", 1.0, "kgf", 9.80665),
    4: ("ft", 0.3048, "poundal", 0.138254954376), 5: ("mm", 1e-3, "mN", 1e-3), 6: ("cm", 1e-2, "cN", 1e-2),
    7: ("in", 0.0254, "lbf", 4.4482216152605), 8: ("mm", 1e-3, "kgf", 9.80665),
}  # fmt: skip


def stored(code, length, force):
    return Units164.of({"units_code": code, "length": 1.0 / length, "force": 1.0 / force})


@pytest.mark.parametrize("code", SI)
@pytest.mark.parametrize(
    "error, known", [(0.0, True), (0.9e-4, True), (-0.9e-4, True), (1.1e-4, False), (-1.1e-4, False)]
)
def test_units_are_those_of_the_factors_to_four_digits(code, error, known):
    length, metres, force, newtons = SI[code]
    units = stored(code, metres / (1.0 + error), newtons)
    assert units == (Units164(length, force) if known else units) and bool(units.problem) != known
    assert units.in_si == (known and code == 1)
    other = stored(code, metres, newtons / (1.0 + error))
    assert bool(other.problem) != known and (known or other.problem.startswith("data set 164 with factors "))


def test_code_of_other_units_is_a_problem_and_of_the_user_none():
    assert stored(5, 1e-2, 1e-3).problem == "data set 164 with the code of mm and mN, the factors of cm, mN"
    assert stored(9, 1e-2, 1e3) == Units164("cm", "kN") and stored(9, 1e-2, 10.0) == Units164("cm", "daN")


MM, METRES, UNCLEAR = Units164("mm", "mN"), Units164("m", "N"), Units164("mm", "", "data set 164 with factors 1 and 7")


@pytest.mark.parametrize(
    "kind, way, expected",
    [
        (8, 1, "mm"), (8, -3, "mm"), (8, 4, "rad"), (8, -6, "rad"), (9, 2, "mN"), (9, 5, "mN*mm"), (11, 1, "mm/s"),
        (11, 4, "rad/s"), (12, 3, "mm/s**2"), (12, 6, "rad/s**2"), (13, 1, "mN"), (13, 4, "mN*mm"), (2, 1, "mN/mm**2"),
        (15, 0, "mN/mm**2"), (3, 1, ""), (17, 0, "s"), (18, 0, "Hz"), (19, 4, "rpm"),
    ],
)  # fmt: skip
def test_units_of_quantities_by_their_direction(kind, way, expected):
    assert unit_of({"ordinate_spec_data_type": kind, "rsp_dir": way}, "NONE", MM) == expected


@pytest.mark.parametrize(
    "kind, way, label, units, expected",
    [
        (8, 1, "um", None, "um"), (8, 1, "[um]", None, "um"), (8, 1, "none", None, ""), (8, 1, "mm", MM, "mm"),
        (8, 1, "(mm)", MM, "mm"), (8, 1, "millimeter", MM, "millimeter"),
        (8, 1, "m", MM, "m (label) or mm (data set 164)"),
        (8, 1, "g", MM, "g (label) or mm (data set 164)"), (8, 0, "", MM, "mm, mN (unknown)"), (8, 0, "um", MM, "um"),
        (8, 0, "", METRES, "m"), (9, 0, "", METRES, "N"), (1, 1, "", MM, "mm, mN (unknown)"), (1, 1, "V", MM, "V"),
        (1, 1, "", METRES, ""), (3, 1, "", MM, ""), (8, 1, "", UNCLEAR, f"{UNCLEAR.problem} (unknown)"),
        (1, 1, "", UNCLEAR, f"{UNCLEAR.problem} (unknown)"), (8, 1, "mm", UNCLEAR, f"mm (label) or {UNCLEAR.problem}"),
        (2, 5, "", MM, "mm, mN (unknown)"), (18, 0, "Hz", MM, "Hz"),
        (3, 1, "m/m", MM, "m/m"), (3, 1, "%", MM, "% (label) or no unit (data set 164)"),
        (3, 1, "no unit", MM, "no unit (label) or no unit (data set 164)"),
    ],
)  # fmt: skip
def test_units_of_label_and_data_set(kind, way, label, units, expected):
    """Without a direction, a displacement may be an angle, which is open unless both are in SI."""
    assert unit_of({"ordinate_spec_data_type": kind, "rsp_dir": way}, label, units) == expected


@pytest.mark.parametrize(
    "label, denominator, units, expected",
    [
        ("mm", "N", None, "(mm)/(N)"), ("[m/s]", "(N)", METRES, "(m/s)/(N)"), ("NONE", "N", None, "? per N"),
        ("m", "", None, "m per ?"), ("", "NONE", None, ""), ("mm", "N", MM, "(mm)/(N) (and data set 164)"),
        ("", "", MM, "? per ? (and data set 164)"), ("(m)/(s)", "", None, "(m)/(s) per ?"),
    ],
)  # fmt: skip
def test_units_of_frequency_responses(label, denominator, units, expected):
    assert quotient(label, denominator, units) == expected


@pytest.mark.parametrize(
    "label, seconds",
    [
        ("s", 1.0),
        ("", 1.0),
        ("NONE", 1.0),
        ("[ms]", 1e-3),
        ("min", 60.0),
        ("Hz", None),
        ("mm", None),
        ("furlong x", None),
    ],
)
def test_seconds_of_a_unit_of_time(label, seconds):
    assert seconds_of(label) == (pytest.approx(seconds) if seconds else None)
