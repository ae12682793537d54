"""Conversion of units: by the package pint, with angles as a dimension of their own."""

import functools
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesperiodic import _checks

Units = Mapping[str, float | str | Sequence[str]]

LONGEST_UNIT = 100
# Products, quotients and groups of names with an exponent of one digit; the only number is the 1 of "1/s".
SUPERSCRIPT_DIGITS = "¹²³⁰⁴⁵⁶⁷⁸⁹"
UNIT_TOKEN = re.compile(
    rf"(?:[^\W\d{SUPERSCRIPT_DIGITS}]|[°%])[^\W{SUPERSCRIPT_DIGITS}]*"
    rf"(?:\s*(?:\*\*|\^)\s*[+-]?[0-9](?:\.5)?(?![\w.])|⁻?[{SUPERSCRIPT_DIGITS}](?!\w))?"
    r"|1(?![\w.])|[()]|[*/·]|\s+"
)
# Logarithmic units, and the formulas that convert their values.
LOGARITHMIC = {
    r"d[bB](?!ar)\w*|[dD]eci[bB]els?": (
        "reference*10**(level/20) for amplitudes such as those of V, Pa or m/s (dBV: 1 V), "
        "reference*10**(level/10) for powers (dBm: 1 mW)"
    ),
    r"d?Np|[nN]epers?": "reference*exp(level) for amplitudes, reference*exp(2*level) for powers",
    r"pH(?=.*mol)": "10**-pH mol/l",  # else picohenries
    r"oct|octaves?": "reference*2**level",
    r"decades?": "reference*10**level",
}
# Spellings of measurement programs.
SPELLINGS = {
    "sec": "s", "Sec": "s", "Second": "s", "seconds": "s", "Seconds": "s", "msec": "ms", "usec": "us",
    "Volt": "V", "Volts": "V",
    "volts": "V", "Newton": "N", "Newtons": "N", "gn": "g_0", "g_n": "g_0",
    "RPM": "rpm", "HZ": "Hz", "hz": "Hz", "Ampere": "A", "Amps": "A", "Deg": "deg", "Rad": "rad",
    "inch": "in", "C°": "degC", "°C": "degC", "Celsius": "degC", "Ohm": "ohm", "Pascal": "Pa", "PA": "Pa",
    "µe": "um/m", "ue": "um/m", "µε": "um/m", "με": "um/m", "µm/m": "um/m", "ustrain": "um/m", "microstrain": "um/m",
    "-": "", "1": "", "none": "", "None": "", "NONE": "",
}  # fmt: skip
# Units that stand for two things: what to write, and the first units of pairs that decide.
AMBIGUOUS = {
    "g": (
        "('g_0', 'm/s**2') for the acceleration of gravity, ('g', 'kg') for the gram", ("g_0", "gram"),
    ),
    "rpm": ("('rpm', 'Hz') for a frequency, ('rpm', 'rad/s') for an angular velocity", ("rpm",)),
    "C": ("('degC', 'K') for a temperature, ('C', 'C') for the coulomb", ("degC", "delta_degC", "coulomb")),
    "F": ("('degF', 'K') for a temperature, ('F', 'F') for the farad", ("degF", "delta_degF", "farad")),
    "lb": ("('lbf', 'N') for a force, ('lb', 'kg') for a mass", ("lbf", "pound")),
}  # fmt: skip
A_FACTOR = "a pair such as ('mm', 'm'), or a factor, such as 1.0 for values as they are"
# Units of files that are converted without a question, with their prefixes. pint knows many more, of which some are not
# what a measurement program means: "Nm" within a product is its number metric, "mil" an angle, "kn" a knot.
PREFIXED = {
    "m": "n u µ μ m c d k", "s": "n u µ μ m", "rad": "u µ μ m", "Hz": "m k M G", "N": "u µ μ m c d da k M",
    "Pa": "m h k M G", "bar": "m", "J": "m k M", "W": "u µ μ m k M", "V": "n u µ μ m k", "A": "n u µ μ m k",
    "ohm": "m k M", "Ω": "m k M", "F": "p n u µ μ m", "C": "p n u µ μ m", "H": "n u µ μ m", "T": "n u µ μ m", "K": "m",
    "l": "m", "L": "m", "degC": "", "°C": "", "degF": "", "delta_degC": "", "delta_degF": "", "g_0": "", "kg": "",
    "in": "", "ft": "", "lbf": "", "psi": "", "min": "", "h": "", "deg": "", "°": "", "%": "", "ppm": "", "atm": "",
    "rev": "", "turn": "", "dimensionless": "",
}  # fmt: skip
NAMES = (
    "second millisecond microsecond nanosecond minute hour meter metre millimeter millimetre micrometer micrometre "
    "centimeter centimetre kilometer kilometre newton millinewton kilonewton volt millivolt microvolt ampere "
    "milliampere hertz kilohertz megahertz degree radian kelvin pascal kilopascal megapascal bar percent joule watt "
    "kilowatt kilogram ohm tesla foot feet"
).split()
CERTAIN = {prefix + unit for unit, prefixes in PREFIXED.items() for prefix in ("", *prefixes.split())} - {*AMBIGUOUS}
CERTAIN |= {name + plural for name in NAMES for plural in ("", "s")}
WORD = re.compile(rf"[^\W\d_{SUPERSCRIPT_DIGITS}][^\W{SUPERSCRIPT_DIGITS}]*|[°%]\w*")
# Moments, as they are written without a sign between newton and metre.
MOMENT = re.compile(r"(?<!\w)((?:[nuµμmcdkM]|da)?N)([mc]?m)(?!\w)")
# Relative difference of factors below which units are the same.
SAME_UNIT = 1e-6
# Metres per second, or inverse milliseconds.
MS_TO_A_POWER = re.compile(r"(?<!\w)ms\s*(?:(?:\*\*|\^)?\s*-[1-4]|⁻)")
# A unit with an exponent that has no sign of its own, such as m/s2, and those of netCDF, such as m s-2.
BARE_EXPONENT = re.compile(r"(?<=[A-Za-z])([234]|-[1-4])(?![\w.])")


def from_file(name: str, values: np.ndarray, unit: float | str | Sequence[str] | None, stored: str) -> np.ndarray:
    """Return the values of a channel with the unit `stored` in its file in that which the user asks for, or in SI.

    `unit` is a factor, a pair of units, whose first must be the one stored, or the unit wanted.
    """
    argument = f"units[{name!r}]"
    if not stored.strip():
        if isinstance(unit, str):
            raise ValueError(
                f"{argument}: must be a factor or a pair such as ('mm', {unit!r}), got {unit!r}, and the file does not "
                "say the unit."
            )
        return values if unit is None else convert(name, values, unit)
    if isinstance(unit, int | float | np.number):
        return convert(name, values, unit)
    text = _spelled(stored)
    if isinstance(unit, str) or unit is None:
        if hint := _doubt(text):
            raise ValueError(f"{argument}: must say what {stored!r} in the file is, got {unit!r}; give {hint}.")
        try:
            return convert(name, values, (text, in_si(text) if unit is None else unit))
        except ValueError as error:
            if unit is None:
                raise ValueError(
                    f"{argument}: must say what {stored!r} in the file is, got None; give {A_FACTOR} ({error})"
                ) from None
            raise
    if len(unit) == 2 and not _decides(unit[0], text):
        raise ValueError(
            f"{argument}: must begin with the unit {stored!r} of the file, got {tuple(unit)!r}; give a factor if the "
            "file is wrong."
        )
    return convert(name, values, unit)


def unit_of(unit: float | str | Sequence[str] | None, stored: str) -> str:
    """Return the unit of the values that `from_file` returns, empty if it is not known, as after a factor."""
    if isinstance(unit, int | float | np.number):
        return ""
    if unit is None:
        si = in_si(stored) if is_known(stored) else ""
        return si if difference(stored, si) else stored.strip()  # N, not kg·m/s²
    return unit if isinstance(unit, str) else unit[1]


def difference(one: str, other: str) -> str:
    """Return in words how one unit differs from another; empty if it does not, or if one of them is not certain."""
    spelled = [_spelled(text.replace("·", "*")) for text in (one, other)]
    if not all(text and not _doubt(text) and is_known(text) for text in spelled):
        return ""
    registry = _registry()
    first, second = map(registry.Unit, spelled)
    if not first.is_compatible_with(second):
        return "a unit of another quantity"
    zero, step = (registry.Quantity(value, first).to(second).magnitude for value in (0.0, 1.0))
    if abs(zero) > SAME_UNIT:
        return "which has another zero"
    return f"which is {step:.6g} of it" if abs(step - 1.0) > SAME_UNIT else ""


def _doubt(text: str) -> str:
    """Return what to write for a unit that is not certain; empty if it is."""
    if text in AMBIGUOUS:
        return AMBIGUOUS[text][0]
    if MS_TO_A_POWER.search(text) or not {*WORD.findall(text)} <= CERTAIN:
        return A_FACTOR
    return ""


def question(stored: str) -> str:
    """Return what `units` must say for the unit of a file; empty if it is converted without a question."""
    return _doubt(_spelled(stored)) if stored.strip() else ""


def _decides(first: str, text: str) -> bool:
    """Return whether the first unit of a pair can be the unit of a file."""
    if text in AMBIGUOUS:
        return any(_is_same(first, meaning) for meaning in AMBIGUOUS[text][1])
    return bool(_doubt(text)) or not is_known(text) or _is_same(first, text)


def _spelled(text: str) -> str:
    """Return a unit as pint writes it."""
    text = text.strip()
    if text in SPELLINGS:
        return SPELLINGS[text]
    return MOMENT.sub(r"(\1*\2)", BARE_EXPONENT.sub(r"**\1", text))


def is_known(text: str) -> bool:
    """Return whether a text is a unit of pint."""
    try:
        in_si(text)
    except ValueError:
        return False
    return True


def kind_of(text: str) -> str:
    """Return the SI unit of a certain unit of a file, empty for others and for what has no dimension."""
    text = _spelled(text)
    if not text or _doubt(text) or not is_known(text):
        return ""
    return in_si(text).replace("dimensionless", "")


def is_duration(text: str) -> bool:
    """Return whether a text is a unit of time."""
    return kind_of(text) == "s"


def _is_same(one: str, other: str) -> bool:
    """Return whether two texts are one unit."""
    if not (is_known(one) and is_known(other)):
        return False
    registry = _registry()
    return bool(registry.Unit(_spelled(one)) == registry.Unit(_spelled(other)))


def in_si(text: str) -> str:
    """Return the SI unit of a unit of pint; angles in radians."""
    spelled = _spelled(text)
    if len(spelled) > LONGEST_UNIT or not _is_unit(spelled):
        raise ValueError(f"{text[:LONGEST_UNIT]!r} is no known unit")
    registry = _registry()
    try:
        return f"{registry.Quantity(1.0, registry.Unit(spelled)).to_base_units().units:~}" or "dimensionless"
    except Exception:  # pint raises errors of many kinds for what is no unit
        raise ValueError(f"{text!r} is no known unit") from None


def convert(name: str, values: np.ndarray, unit: float | Sequence[str]) -> np.ndarray:
    """Return the values of a channel, multiplied by a factor or converted by a pair of units such as ("mm", "m")."""
    argument = f"units[{name!r}]"
    if isinstance(unit, int | float | np.number):
        factor = _checks.finite_number(argument, unit)
        if factor == 0.0:
            raise ValueError(f"{argument}: must not be zero, got {unit!r}.")
        return values * factor
    if isinstance(unit, str) or len(unit) != 2 or not all(isinstance(u, str) for u in unit):
        raise ValueError(f"{argument}: must be a factor or a pair such as ('mm', 'm'), got {unit!r}.")
    for text in unit:
        if len(text) > LONGEST_UNIT or not _is_unit(text):
            shown = text if len(text) <= LONGEST_UNIT else f"{text[:LONGEST_UNIT]}…"
            raise ValueError(
                f"{argument}: must be units that are multiplied or divided, with exponents of one digit, such as "
                f"'kg*m/s**2', got {shown!r}."
            )
    for names, formula in LOGARITHMIC.items():
        if re.search(rf"(?<!\w)(?:{names})(?!\w)", " ".join((*unit, unit[0]))):
            raise ValueError(
                f"{argument}: must be units that are not logarithmic, got {tuple(unit)!r}; convert the values first: "
                f"{formula}."
            )
    return _converted(argument, values, *(text.replace("·", "*") for text in unit))


def _converted(argument: str, values: np.ndarray, first: str, second: str) -> np.ndarray:
    """Return values converted by two units, with as many angles in the one as in the other."""
    import pint

    registry = _registry()
    try:
        one, other = registry.Unit(first), registry.Unit(second)
        compatible = one.is_compatible_with(other)
        missing = _angle(registry, one) - _angle(registry, other) if compatible else 0.0
        if missing:
            cycles = [_in_cycles(registry, unit) for unit in (one, other)]
            if _angle(registry, cycles[0]) == _angle(registry, cycles[1]):
                (one, other), missing = cycles, 0.0
        if not missing:
            return np.asarray(registry.Quantity(values, one).to(other).magnitude, dtype=float)
    except (pint.errors.PintError, AssertionError, TypeError, ValueError, ArithmeticError) as error:
        raise ValueError(
            f"{argument}: must be two units of the same dimension, got {(first, second)!r} ({error})."
        ) from None
    plain = first if not _angle(registry, one) else second
    power = missing if plain == second else -missing
    raise ValueError(
        f"{argument}: must have an angle in both units or in neither, got {(first, second)!r}, of which {plain!r} may "
        f"count radians or revolutions; write {_times(plain, 'rad', power)!r} or {_times(plain, 'rev', power)!r}, or "
        "give a factor."
    )


@functools.cache
def _registry() -> Any:
    """Return the units of pint, with the usual abbreviation of a revolution."""
    import pint

    registry: Any = pint.UnitRegistry()
    registry.define("@alias turn = rev")
    return registry


def _angle(registry: Any, unit: Any) -> float:
    """Return the exponent of radians in a unit, which is no dimension in pint."""
    return float(dict(registry.Quantity(1.0, unit).to_root_units().unit_items()).get("radian", 0.0))


def _in_cycles(registry: Any, unit: Any) -> Any:
    """Return a unit with cycles per second in place of hertz."""
    powers = [power for name, power in registry.Quantity(1.0, unit).unit_items() if name.endswith("hertz")]
    return unit * registry.Unit("cycle") ** sum(powers)


def _times(text: str, angle: str, power: float) -> str:
    """Return a unit times a power of an angle, as a text."""
    if power == 1.0:
        return angle + text[1:] if text[:1] in ("", "1") else f"{angle}*{text}"
    return f"{text or '1'}/{angle}" if power == -1.0 else f"{text or '1'}*{angle}**{power:g}"


def _is_unit(text: str) -> bool:
    """Return whether a text consists of the permitted tokens, and no operator follows another one."""
    place, operator, depth = 0, False, 0
    while place < len(text):
        token = UNIT_TOKEN.match(text, place)
        if token is None:
            return False
        place, mark = token.end(), token.group().strip()
        if mark in ("*", "/", "·"):
            if operator:
                return False
            operator = True
        elif mark:
            operator = False
            depth += {"(": 1, ")": -1}.get(mark, 0)
    return depth == 0
