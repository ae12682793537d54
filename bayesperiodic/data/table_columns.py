"""Columns of a table of measured responses, in SI."""

import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data import objects
from bayesperiodic.data.formats import recognise
from bayesperiodic.data.formats.contents import Contents, Key, StoredChannel
from bayesperiodic.data.layout import numbers
from bayesperiodic.data.units import Units, from_file, kind_of, unit_of

# Degrees beyond which a phase is none.
LARGEST_PHASE = 720.0
# Phases of an arc tangent of a quotient, in degrees, and what they then jump by.
FOLDED_PHASE, FOLDED_JUMP = 90.5, 120.0
# Degrees within which phases may be radians, least range of these, and how much higher a peak is than both ends.
IN_RADIANS, LEAST_PHASE_RANGE, PEAK_HEIGHT = 3.15, 1.0, 3.0
# Degrees by which phases that rise over a peak are of the other sign.
LEADING_RISE = 90.0
# Names and units of levels.
LEVEL = re.compile(r"(?<![A-Za-z])dB(?![A-Za-z])")


class TableColumns:
    """Columns of a table, in SI."""

    def __init__(self, label: str, contents: Contents, units: Units):
        self.label, self.contents, self.units = label, contents, units

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return [channel.name for channel in self.contents.channels]

    def column(self, key: Key) -> tuple[StoredChannel, np.ndarray]:
        """Return a column and its values."""
        stored = self.contents.find(self.label, key)
        values = np.asarray(stored.values())
        if values.dtype.kind != "c":
            values = numbers(f"{self.contents.word} {stored.label!r} of {self.label}", values)
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise ValueError(
                f"{self.contents.word} {stored.label!r} of {self.label}: must be finite, got {values[bad[0]]} in row "
                f"{bad[0] + 1}; leave out the rows without a value."
            )
        return stored, values

    def frequencies(self, channels: list[StoredChannel], key: Key | None) -> np.ndarray:
        """Return the frequencies [Hz]: a column, or the abscissa of frequency response functions."""
        if key is not None:
            stored, values = self.column(key)
            unit = self.units.get("frequency")
            if stored.unit and unit is None and kind_of(stored.unit) != kind_of("Hz"):
                raise ValueError(
                    f"frequency: must be in Hz, got {stored.unit!r} of {stored.label!r}; give units={{'frequency': "
                    f"({stored.unit!r}, 'Hz')}} if it is a frequency."
                )
            values = from_file("frequency", values, unit, stored.unit)
        else:
            axes = [channel.frequencies() for channel in channels if channel.frequencies is not None]
            if len(axes) < len(channels):
                raise ValueError(f"frequency: must be a {self.contents.word} of {self.label}, got None.")
            values = axes[0]
            if any(not np.array_equal(values, other) for other in axes):
                raise ValueError(
                    f"outputs: must be functions of the same frequencies, got {[one.label for one in channels]} of "
                    f"{self.label}; make a table of each."
                )
        if not np.all(values > 0.0):
            row = int(np.flatnonzero(~(values > 0.0))[0])
            raise ValueError(
                f"frequency: must be > 0 Hz, got {values[row]:g} in row {row + 1} of {self.label}; leave this row out."
            )
        return values

    def drive(self, name: str, value: float | Key, rows: int) -> np.ndarray:
        """Return the amplitudes of an input."""
        if is_number(value):
            return np.full(rows, _checks.positive(f"inputs[{name!r}]", value))
        stored, values = self.column(value)  # type: ignore[arg-type]
        values = from_file(name, self.sized(f"inputs[{name!r}]", values, rows), self.units.get(name), stored.unit)
        return self.amplitudes(f"inputs[{name!r}]", values)

    def unit(self, name: str, value: float | Key) -> str:
        """Return the unit of a channel's amplitudes as they are returned, empty if it is not known."""
        if is_number(value):
            return ""
        return unit_of(self.units.get(name), self.contents.find(self.label, value).unit)  # type: ignore[arg-type]

    def angles(self, key: Key, radian: float) -> np.ndarray:
        """Return phases [rad]; a unit of the file counts."""
        stored, values = self.column(key)
        kind = kind_of(stored.unit)
        if kind not in ("", "rad") or (stored.unit and not kind and stored.unit.strip() != "-"):
            raise ValueError(f"phases: must be in degrees or radians, got {stored.unit!r} of {stored.label!r}.")
        angles = from_file("phase", values, None, stored.unit) if kind else values * radian
        if np.any(np.abs(angles) > np.radians(LARGEST_PHASE)):
            raise ValueError(
                f"phases: must be within {LARGEST_PHASE:g}°, got {np.degrees(np.abs(angles).max()):.4g}° in "
                f"{stored.label!r} of {self.label}; see phase_unit."
            )
        return angles

    def amplitude(self, name: str, key: Key, rows: int, per: str | None) -> np.ndarray:
        """Return the amplitudes of an output, or its complex ones."""
        argument = f"outputs[{name!r}]"
        stored, values = self.column(key)
        values, unit = self.sized(argument, values, rows), self.units.get(name)
        if per is None and unit is None and re.search(r"/ kg|/ \(.*kg|^1 / kg", kind_of(stored.unit)):
            raise ValueError(
                f"per: must be the input per which {name!r} is given, got None and values in {stored.unit!r}."
            )
        if values.dtype.kind == "c":
            parts = (from_file(name, part, unit, stored.unit) for part in (values.real, values.imag))
            return next(parts) + 1j * next(parts)
        if LEVEL.search(stored.name) or LEVEL.search(stored.unit):
            raise ValueError(
                f"{argument}: must be amplitudes, got levels in dB, {stored.label!r} of {self.label}; "
                "reference*10**(level/20) are amplitudes."
            )
        return self.amplitudes(argument, from_file(name, values, unit, stored.unit))

    def deviations(self, name: str, given: Any, key: Key, values: np.ndarray) -> np.ndarray:
        """Return the standard deviations of an output's amplitudes: a share of them, a number or a column."""
        argument = f"sd[{name!r}]"
        unit = self.contents.find(self.label, key).unit
        if isinstance(given, str) and given.strip().endswith("%") and given not in self.names:
            share = _checks.positive(argument, _number(argument, given.strip()[:-1]))
            return 0.01 * share * np.abs(values)
        if is_number(given):
            sd = np.full(values.size, float(given))
        else:
            stored, sd = self.column(given)
            if (stored.unit or stored.name).strip().endswith("%") and unit.strip() != "%":
                shares = self.positive(argument, self.sized(argument, sd, values.size), "standard deviations")
                return 0.01 * shares * np.abs(values)
            if stored.unit and kind_of(stored.unit) != kind_of(unit):
                raise ValueError(
                    f"{argument}: must be in a unit of the amplitudes ({unit or 'none'}) or in %, got {stored.unit!r} "
                    f"of {stored.label!r} of {self.label}."
                )
            unit = stored.unit or unit
        sd = from_file(name, self.sized(argument, sd, values.size), self.units.get(name), unit)
        return self.positive(argument, sd, "standard deviations")

    def phase_deviations(self, name: str, given: Any, radian: float, rows: int) -> np.ndarray:
        """Return the standard deviations of phases [rad]: a number or a column."""
        argument = f"phase_sd[{name!r}]"
        sd = np.full(rows, float(given)) * radian if is_number(given) else self.angles(given, radian)
        return self.positive(argument, self.sized(argument, sd, rows), "standard deviations")

    def sized(self, argument: str, values: np.ndarray, rows: int) -> np.ndarray:
        """Return values; raise a ValueError unless there is one for each frequency."""
        if values.shape != (rows,):
            raise ValueError(f"{argument}: must have {rows} values, one for each frequency, got {values.size}.")
        return values

    def amplitudes(self, argument: str, values: np.ndarray) -> np.ndarray:
        """Return values; raise a ValueError unless they are positive."""
        return self.positive(
            argument, values, "amplitudes", "; levels in dB are converted first, reference*10**(level/20)"
        )

    def positive(self, argument: str, values: np.ndarray, what: str, more: str = "") -> np.ndarray:
        """Return values; raise a ValueError that names the row unless they are positive."""
        if not np.all(values > 0.0):
            row = int(np.flatnonzero(~(values > 0.0))[0])
            raise ValueError(
                f"{argument}: must be {what} > 0, got {values[row]:g} in row {row + 1} of {self.label}{more}."
            )
        return values


def contents_of(table: Any, wanted: list[Key]) -> tuple[str, Contents]:
    """Return a name for messages and the columns of a table or a file."""
    import pandas as pd

    if isinstance(table, str | Path):
        return Path(table).name, recognise.contents(table, None, wanted, {})
    if isinstance(table, Mapping):
        columns = {name: np.atleast_1d(np.asarray(values)) for name, values in table.items()}
        sizes = {name: values.size for name, values in columns.items()}
        if len({*sizes.values()}) != 1 or any(values.ndim != 1 for values in columns.values()):
            raise ValueError(f"table: must have columns of one length, got {sizes}.")
        table = pd.DataFrame(columns)
    return "the table", objects.dataframe(table)


def is_number(value: Any) -> bool:
    """Return whether the value of an input is an amplitude; an integer is, not the number of a column."""
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def check_phases(argument: str, label: str, angles: np.ndarray, sizes: np.ndarray) -> None:
    """Raise a ValueError for phases, in the order of frequencies, that are the arc tangent of a quotient.

    Warn of phases in degrees that are radians: of those through a resonance, a peak of the amplitudes `sizes`.
    """
    degrees = np.degrees(angles)
    within, peak = np.abs(degrees).max(initial=0.0) <= IN_RADIANS, sizes.max() > PEAK_HEIGHT * max(sizes[0], sizes[-1])
    if within and peak and np.ptp(degrees) > LEAST_PHASE_RANGE:
        warnings.warn(
            f"{argument}: turns by {np.ptp(degrees):.2g} degrees only at a resonance in {label}; if these are radians, "
            "give phase_unit='rad'.",
            UserWarning,
            stacklevel=2,
        )
    jumps = np.abs(np.diff(degrees))
    if np.abs(degrees).max() <= FOLDED_PHASE and jumps.max(initial=0.0) > FOLDED_JUMP:
        raise ValueError(
            f"{argument}: must be phases over the whole turn, got values within +-90 degrees that jump by "
            f"{jumps.max():.0f} degrees in {label}, as the arc tangent of a quotient does; take the one of two "
            "arguments, arctan2."
        )


def warn_of_leads(name: str, label: str, angles: np.ndarray, sizes: np.ndarray, lag: bool) -> None:
    """Warn of phases [rad], in the order of frequencies, that rise over a peak of the amplitudes `sizes`.

    The phase of a stable system against its force falls through each resonance, and rises between two of them at most
    as much.
    """
    turned = np.degrees(np.unwrap(angles))
    rise = float(turned[-1] - turned[0])
    if rise > LEADING_RISE and sizes.max() > PEAK_HEIGHT * max(sizes[0], sizes[-1]):
        remedy = "leave lag=True out" if lag else "give lag=True"
        warnings.warn(
            f"phases[{name!r}]: rise by {rise:.0f} degrees over the peak of the amplitudes in {label}, whereas a "
            f"response falls behind its force there; if the table's phases have the other sign, {remedy}.",
            UserWarning,
            stacklevel=2,
        )


def _number(argument: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{argument}: must be a number and a % sign, such as '0.5%', got {text + '%'!r}.") from None
