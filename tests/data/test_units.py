"""Conversions against the factors of NIST SP 811 (2008), appendix B, and the SI Brochure, 9th edition."""

import re

import numpy as np
import pandas as pd
import pytest

import bayesperiodic as bp
from bayesperiodic.data import units


@pytest.mark.parametrize(
    "text",
    [
        "9**9**9**9 * m",
        "m**9**9",
        "(9**9)**9",
        "9⁹⁹⁹",
        "m**99",
        "(m)**9",
        "__import__('os')",
        "m" * 101,
        "m//s",
        "1e9 m",
        "m(",
    ],
)
def test_units_that_are_no_products_of_names_never_reach_an_evaluator(monkeypatch, text):
    import pint

    monkeypatch.setattr(pint, "UnitRegistry", None)
    with pytest.raises(ValueError, match=r"units\['x'\]: must be units that are multiplied or divided, with exponents"):
        units.convert("x", np.ones(2), (text, "m"))


@pytest.mark.parametrize(
    ("first", "second", "factor"),
    [
        ("µm", "m", 1e-6), ("kg*m/s**2", "kN", 1e-3), ("N/(m/s)", "N s m⁻¹", 1.0), ("m/s²", "mm/s^2", 1e3),
        ("1/s", "Hz", 1.0),        ("°", "rad", np.pi / 180), ("%", "", 0.01), ("kN·s/m", "N*s/m", 1e3),
        ("V*Hz**-0.5", "mV/Hz**0.5", 1e3),
    ],
)  # fmt: skip
def test_usual_units_are_converted(first, second, factor):
    assert units.convert("x", np.ones(2), (first, second)) == pytest.approx(factor)


@pytest.mark.parametrize(
    ("first", "second", "factor"),
    [
        # NIST SP 811, appendix B.8, seven digits
        ("rpm", "rad/s", 1.047198e-1), ("rev", "rad", 6.283185), ("deg", "rad", 1.745329e-2),
        ("arcmin", "rad", 2.908882e-4), ("arcsec", "rad", 4.848137e-6), ("lbf", "N", 4.448222),
        ("psi", "Pa", 6.894757e3), ("inch", "m", 2.54e-2), ("ft*lbf", "J", 1.355818), ("lbf/inch", "N/m", 1.751268e2),
        ("kgf", "N", 9.80665), ("kip", "N", 4.448222e3), ("atm", "Pa", 1.01325e5), ("torr", "Pa", 1.333224e2),
        ("inHg", "Pa", 3.386389e3), ("bar", "Pa", 1e5), ("hp", "W", 7.456999e2), ("knot", "m/s", 5.144444e-1),
        ("mile/hour", "m/s", 4.4704e-1), ("km/h", "m/s", 2.777778e-1), ("slug", "kg", 1.459390e1),
        ("lb", "kg", 4.535924e-1), ("poise", "Pa*s", 0.1), ("ft/s**2", "m/s**2", 3.048e-1), ("Gal", "m/s**2", 1e-2),
        ("g_0", "m/s**2", 9.80665), ("kW*h", "J", 3.6e6), ("delta_degF", "K", 1 / 1.8),
        # hertz for frequencies, rad/s for angular frequencies (SI Brochure, section 2.3.4)
        ("rpm", "Hz", 1 / 60), ("Hz", "rpm", 60.0), ("rev/min", "rev/s", 1 / 60), ("Hz", "rad/s", 2 * np.pi),
        ("rad/s", "Hz", 0.5 / np.pi), ("kHz", "rad/ms", 2 * np.pi), ("deg/s", "Hz", 1 / 360), ("1/min", "Hz", 1 / 60),
        ("rad/s**2", "Hz/s", 0.5 / np.pi), ("Hz**2", "rad**2/s**2", 4 * np.pi**2), ("rad*Hz", "rad/s", 1.0),
        ("V/Hz", "V*s/rad", 0.5 / np.pi), ("N*m/deg", "N*m/rad", 180 / np.pi), ("Hz", "1/s", 1.0),
    ],
)  # fmt: skip
def test_factors_are_those_of_nist_and_the_si(first, second, factor):
    assert units.convert("x", np.ones(2), (first, second)) == pytest.approx(factor, rel=5e-7)


@pytest.mark.parametrize(
    ("first", "second", "value", "expected"),
    [
        ("degC", "K", 25.0, 298.15), ("degF", "K", 212.0, (212 + 459.67) / 1.8), ("K", "degC", 0.0, -273.15),
        ("delta_degC", "K", 25.0, 25.0), ("degC/s", "K/s", 2.0, 2.0),
    ],
)  # fmt: skip
def test_temperatures_are_absolute_and_differences_have_their_own_unit(first, second, value, expected):
    assert units.convert("x", np.full(2, value), (first, second)) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("first", "second", "spelling"),
    [
        ("1/min", "rad/s", "write 'rad/min' or 'rev/min'"), ("rpm", "1/s", "write 'rad/s' or 'rev/s'"),
        ("N*m/rad", "N*m", "write 'N*m/rad' or 'N*m/rev'"), ("deg", "", "write 'rad' or 'rev'"),
        ("count", "rad", "or give a factor"), ("cps", "rad/s", "or give a factor"),
    ],
)  # fmt: skip
def test_an_angle_in_one_unit_only_is_refused_with_the_right_spelling(first, second, spelling):
    for pair in ((first, second), (second, first)):
        with pytest.raises(ValueError, match=r"units\['w'\]: must have an angle in both units or in neither") as error:
            units.convert("w", np.ones(2), pair)
        assert spelling in str(error.value)


@pytest.mark.parametrize(
    ("unit", "linear", "formula"),
    [
        ("dB", "", "10**(level/20) for amplitudes"), ("dBm", "W", "10**(level/10) for powers (dBm: 1 mW)"),
        ("dBV", "V", "10**(level/20)"), ("dB/m", "1/m", "10**(level/20)"), ("decibel", "", "10**(level/20)"),
        ("Np", "", "exp(level) for amplitudes"), ("neper", "", "exp(2*level) for powers"), ("pH", "mol/l", "10**-pH"),
        ("octave", "", "2**level"), ("decade", "", "10**level"),
    ],
)  # fmt: skip
def test_logarithmic_units_are_refused_with_the_formula(unit, linear, formula):
    with pytest.raises(ValueError, match=r"units\['w'\]: must be units that are not logarithmic, got") as error:
        units.convert("w", np.ones(2), (unit, linear))
    assert formula in str(error.value)


def test_units_that_look_logarithmic_are_converted():
    assert units.convert("p", np.ones(1), ("dbar", "Pa")) == pytest.approx(1e4)
    assert units.convert("l", np.ones(1), ("pH", "H")) == pytest.approx(1e-12)


@pytest.mark.parametrize(
    "stored, unit, expected",
    [
        ("", None, 2.0), ("  ", None, 2.0), ("", 3.0, 6.0), ("", ("mm", "m"), 0.002), ("mm", None, 0.002),
        ("mm", "um", 2000.0), ("mm", 3.0, 6.0), ("mm", ("millimeter", "m"), 0.002), ("deg", None, np.pi / 90),
        ("C", ("degC", "K"), 275.15), ("C", ("C", "mC"), 2000.0), ("furz", ("m", "mm"), 2000.0), ("furz", 3, 6.0),
        ("m s-2", None, 2.0), ("Nm", "kN*mm", 2.0), ("kN", None, 2000.0),
    ],
)  # fmt: skip
def test_values_of_a_file_are_in_si_or_in_the_unit_that_is_wanted(stored, unit, expected):
    assert units.from_file("x", np.full(2, 2.0), unit, stored) == pytest.approx(expected)


@pytest.mark.parametrize(
    "stored, unit, reason",
    [
        ("", "m", r"must be a factor or a pair such as \('mm', 'm'\), got 'm', and the file does not say the unit"),
        ("C", None, r"must say what 'C' in the file is, got None; give \('degC', 'K'\) for a temperature"),
        ("C", "K", r"must say what 'C' in the file is, got 'K'; give \('degC', 'K'\)"),
        ("furz", None, "must say what 'furz' in the file is, got None; give a pair such as .* or a factor"),
        ("ms-1", None, "must say what 'ms-1' in the file is"), ("ms⁻¹", None, "must say what 'ms⁻¹' in the file is"),
        ("mm", ("cm", "m"), r"must begin with the unit 'mm' of the file, got \('cm', 'm'\); give a factor"),
        ("C", ("F", "K"), "must begin with the unit 'C' of the file"), ("mm", "s", "must be two units of the same"),
        ("mm", ("mm", "m", "m"), "must be a factor or a pair such as"), ("mm", ("mm",), "must be a factor or"),
        ("mm", 0.0, "must not be zero"),
    ],
)  # fmt: skip
def test_units_that_the_file_and_the_user_leave_open_are_refused(stored, unit, reason):
    with pytest.raises(ValueError, match=rf"^units\['x'\]: {reason}"):
        units.from_file("x", np.ones(2), unit, stored)


def test_units_of_values_from_a_file():
    assert [units.unit_of(None, one) for one in ("mm", "N", " Nm ", "furz", "", "deg")] == [
        "m", "N", "Nm", "furz", "", "rad",
    ]  # fmt: skip
    assert units.unit_of(None, "kN") == units.in_si("N") == "kg * m / s ** 2"
    assert [units.unit_of(one, "mm") for one in (2.0, np.float64(2), "km", ("mm", "cm"))] == ["", "", "km", "cm"]


@pytest.mark.parametrize(
    "one, other, said",
    [
        ("N", "kN", "which is 0.001 of it"), ("kN", "N", "which is 1000 of it"),
        ("m", "s", "a unit of another quantity"),
        ("degC", "K", "which has another zero"), ("N·m", "Nm", ""), ("m s-2", "m/s²", ""), ("C", "K", ""),
        ("m", "furz", ""), ("", "m", ""), ("m", "", ""), ("K", "delta_degC", ""),
    ],
)  # fmt: skip
def test_differences_of_units_are_in_words_if_both_are_certain(one, other, said):
    assert units.difference(one, other) == said


@pytest.mark.parametrize(
    "stored, kind, asked",
    [
        ("mm", "m", ""), ("ms", "s", ""), ("min", "s", ""), ("Hz", "1 / s", ""), ("%", "", ""), ("", "", ""),
        ("C", "", "('degC', 'K') for"), ("furz", "", "a pair such as"), ("ms-1", "", "a pair such as"),
        ("rpm", "", "('rpm', 'Hz') for"),
    ],
)  # fmt: skip
def test_kinds_of_units_and_questions_about_those_that_are_not_certain(stored, kind, asked):
    assert units.kind_of(stored) == kind and units.is_duration(stored) == (kind == "s")
    question = units.question(stored)
    assert question.startswith(asked) and bool(question) == bool(asked)


@pytest.mark.parametrize(
    "text, unit",
    [
        ("m/s", True), ("(m/s)*kg", True), ("m/(s*kg", False), ("m)", False), ("m/*s", False), ("m*s**-2", True),
        ("m**-12", False), ("", True), ("kg m", True), ("m·s", True), ("m;s", False), ("m" * 101, False),
        ("m" * 20, False), ("furz", False),
    ],
)  # fmt: skip
def test_texts_that_are_units(text, unit):
    assert units.is_known(text) == unit
    if not unit:
        with pytest.raises(ValueError, match=f"^'{re.escape(text[:100])}' is no known unit$"):
            units.in_si(text)


def test_channels_of_a_file_are_converted(tmp_path):
    path = tmp_path / "run.csv"
    pd.DataFrame({"t": [0.0, 1.0, 2.0], "speed": [600.0, 1200.0, 60.0]}).to_csv(path, index=False)
    columns = {"time": "t", "outputs": {"speed": "speed"}}
    run = bp.Recording.from_csv(path, **columns, units={"speed": ("rpm", "Hz"), "time": ("min", "s")})
    assert run.outputs["speed"] == pytest.approx([10.0, 20.0, 1.0])
    assert run.time == pytest.approx([0.0, 60.0, 120.0])
