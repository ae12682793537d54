"""Units of functions in universal files: their labels, and those of data set 164."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesperiodic.data import units

# Units of data set 164 by their factors, "to convert to SI, divide", and those of its codes.
LENGTH_FACTORS = {"m": 1.0, "mm": 1e3, "cm": 1e2, "ft": 1 / 0.3048, "in": 1 / 0.0254}
FORCE_FACTORS = {
    "N": 1.0, "mN": 1e3, "cN": 1e2, "kN": 1e-3, "daN": 0.1, "lbf": 1 / 4.4482216152605, "kgf": 1 / 9.80665,
    "poundal": 1 / 0.138254954376,
}  # fmt: skip
CODES = {
    1: ("m", "N"), 2: ("ft", "lbf"), 3: ("m", "kgf"), 4: ("ft", "poundal"), 5: ("mm", "mN"), 6: ("cm", "cN"),
    7: ("in", "lbf"), 8: ("mm", "kgf"),
}  # fmt: skip
# Relative difference of factors of one unit: they have few digits in some files.
SAME_FACTOR = 1e-4
SCALAR, ROTATIONS = 0, (4, 5, 6)
# Units by specific data type, for translations and rotations; L is the length, F the force.
TRANSLATION = {
    2: "F/L**2", 3: "", 8: "L", 9: "F", 11: "L/s", 12: "L/s**2", 13: "F", 15: "F/L**2", 17: "s", 18: "Hz", 19: "rpm",
}  # fmt: skip
ROTATION = {8: "rad", 9: "F*L", 11: "rad/s", 12: "rad/s**2", 13: "F*L", 17: "s", 18: "Hz", 19: "rpm"}
UNNAMED = ("", "NONE")


@dataclass(frozen=True)
class Units164:
    """Units of length and force of a file; `problem` says why they are not known."""

    length: str
    force: str
    problem: str = ""

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> "Units164":
        """Return the units of a data set 164, by its factors; its code must be theirs."""
        length, force = _nearest(LENGTH_FACTORS, stored["length"]), _nearest(FORCE_FACTORS, stored["force"])
        code = CODES.get(stored["units_code"])
        if not length or not force:
            return cls(length, force, f"data set 164 with factors {stored['length']:g} and {stored['force']:g}")
        if code and code != (length, force):
            return cls(
                length,
                force,
                f"data set 164 with the code of {code[0]} and {code[1]}, the factors of {length}, {force}",
            )
        return cls(length, force)

    @property
    def in_si(self) -> bool:
        """Whether values are in SI, whatever their dimension."""
        return not self.problem and (self.length, self.force) == ("m", "N")


def _nearest(factors: Mapping[str, float], factor: float) -> str:
    """Return the unit of a factor; empty if there is none."""
    return next((name for name, value in factors.items() if abs(factor - value) <= SAME_FACTOR * value), "")


def unit_of(head: Mapping[str, Any], label: str, stored: Units164 | None) -> str:
    """Return the unit of the values of a function.

    It is a text that is no unit, so that the user must give `units`, if label and data set 164 contradict each other.
    """
    label = _plain(label)
    if stored is None:
        return label
    derived = _derived(head, stored)
    if derived is None:  # of a type without a unit, or one that the file does not say
        return label if label or stored.in_si else f"{stored.problem or f'{stored.length}, {stored.force}'} (unknown)"
    if not label:
        return derived if not stored.problem else f"{stored.problem} (unknown)"
    if not stored.problem and (label == derived or _is_same(label, derived)):
        return label
    other = stored.problem or f"{derived or 'no unit'} (data set 164)"
    return f"{label} (label) or {other}"


def quotient(label: str, denominator: str, stored: Units164 | None) -> str:
    """Return the unit of a frequency response function; a text that is no unit if the file leaves it open."""
    above, below = _plain(label), _plain(denominator)
    named = f"({above})/({below})" if above and below else f"{above or '?'} per {below or '?'}"
    if stored is not None and not stored.in_si:
        return f"{named} (and data set 164)"
    return named if above or below else ""


def _plain(label: str) -> str:
    """Return a label of a unit without brackets; empty without."""
    label = label.strip()
    if label[:1] + label[-1:] in ("()", "[]") and label.count(label[0]) == 1:
        label = label[1:-1].strip()
    return "" if label.upper() in UNNAMED else label


def _derived(head: Mapping[str, Any], stored: Units164) -> str | None:
    """Return the unit after data set 164; None if type and direction do not determine it."""
    kind, way = head["ordinate_spec_data_type"], abs(head["rsp_dir"])
    table = ROTATION if way in ROTATIONS else TRANSLATION
    if kind not in table:
        return None
    form = table[kind]
    if way == SCALAR and TRANSLATION.get(kind) != ROTATION.get(kind) and "L" in form + ROTATION.get(kind, ""):
        if not stored.in_si and kind in ROTATION:  # may be an angle, or a moment
            return None
    return form.replace("L", stored.length).replace("F", stored.force)


def _is_same(one: str, other: str) -> bool:
    """Return whether two texts are units of one size."""
    try:
        value = units.from_file("x", np.ones(1), other, one) if other else units.from_file("x", np.ones(1), None, one)
    except ValueError:
        return False
    return abs(float(value[0]) - 1.0) < SAME_FACTOR


def seconds_of(label: str) -> float | None:
    """Return the factor of a unit of time to seconds; None if it is another unit."""
    if not (label := _plain(label)):
        return 1.0
    try:
        return float(units.from_file("time", np.ones(1), "s", label)[0])
    except ValueError:
        return None
