"""Attributes of arrays in HDF5 files: units, scales and missing values of netCDF, dates, and sampling rates."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np

from bayesperiodic.data.formats.contents import Clock
from bayesperiodic.data.formats.decimals import step_error

# Types of attributes that are read: h5py crashes on some damaged lists and references.
PLAIN_TYPES = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING)
UNIT_NAMES = ("units", "unit", "Unit", "Units", "UNIT", "UNIT_NAMES", "unit_string")
RATE_NAMES = ("samplingrate", "samplerate", "samplingfrequency", "samplefrequency", "fs")
STEP_NAMES = ("dt", "deltat", "samplinginterval", "sampleinterval", "samplingperiod", "wfincrement")
START_NAMES = ("t0", "starttime", "tstart", "wfstartoffset", "wfstarttime")
# Scales that are no convention, with the values that change nothing.
OTHER_SCALES = {
    "gain": 1.0, "scale": 1.0, "scaling": 1.0, "slope": 1.0, "conversion": 1.0, "calibration": 1.0,
    "sensitivity": 1.0, "factor": 1.0, "offset": 0.0, "intercept": 0.0,
}  # fmt: skip
# What netCDF fills with by default; the fill value of HDF5 is not read, because h5py crashes on some damaged ones.
NOT_WRITTEN = 9.969209968386869e36
# Nanoseconds of the units before "since".
DURATIONS = {
    r"days?|d": 86_400 * 10**9, r"hours?|hrs?|h": 3600 * 10**9, r"minutes?|mins?": 60 * 10**9,
    r"seconds?|secs?|s": 10**9, r"milliseconds?|millisecs?|msecs?|ms": 10**6,
    r"microseconds?|microsecs?|usecs?|us": 10**3, r"nanoseconds?|nanosecs?|nsecs?|ns": 1,
}  # fmt: skip
SINCE_TEXT = re.compile(r"\s*(\w+)\s+since\s+(.+?)\s*", re.IGNORECASE)
# pandas takes a year 1 as 2001.
DATE_START = re.compile(r"\d{4}-\d")
CALENDARS = ("standard", "gregorian", "proleptic_gregorian")
# Numbers from which a start is seconds since 1970; years that nanoseconds since 1970 reach.
LEAST_EPOCH, YEARS = 1e8, (1678, 2262)
# Rounding of dates to nanoseconds, of a step.
LARGEST_ROUNDING = 1e-3


def attributes(item: h5py.Dataset | h5py.Group) -> dict[str, Any]:
    """Return the attributes of an item that are one number or text."""
    result: dict[str, Any] = {}
    for key in item.attrs:
        try:
            kind = item.attrs.get_id(key)
            if kind.get_type().get_class() not in PLAIN_TYPES:
                continue
            if kind.shape not in ((), (1,)) and not (key == "valid_range" and kind.shape == (2,)):
                continue
            value = item.attrs[key]
        except Exception:  # of types that h5py does not know, and of damaged files
            continue
        if isinstance(value, np.ndarray) and value.shape == (1,):
            value = value[0]
        if isinstance(value, bytes):
            value = value.decode("utf-8", "replace")
        if isinstance(value, str | int | float | np.number | np.ndarray):
            result[str(key)] = value
    return result


@dataclass(frozen=True)
class Packing:
    """Scale, offset and missing values after the conventions of netCDF."""

    scale: float = 1.0
    offset: float = 0.0
    missing: tuple[float, ...] = ()
    low: float = -np.inf
    high: float = np.inf
    unsigned: bool = False

    @classmethod
    def of(cls, stored: Mapping[str, Any], item: h5py.Dataset) -> "Packing":
        """Return the packing of an array by its attributes."""
        unsigned = str(stored.get("_Unsigned", "")).lower() == "true"
        given = [stored[key] for key in ("_FillValue", "missing_value") if _number(stored.get(key))]
        given += [NOT_WRITTEN] if item.dtype.kind == "f" and item.dtype.itemsize > 2 else []
        beyond = 2.0 ** (8 * item.dtype.itemsize) if unsigned else 0.0
        missing = [float(value) + (beyond if value < 0 else 0.0) for value in given]
        low, high = stored.get("valid_range", (-np.inf, np.inf))
        return cls(
            float(stored.get("scale_factor", 1.0)),
            float(stored.get("add_offset", 0.0)),
            tuple(missing),
            float(stored.get("valid_min", low)),
            float(stored.get("valid_max", high)),
            unsigned,
        )

    @property
    def remark(self) -> str:
        """What is done to the stored values."""
        scaled = self.scale != 1.0 or self.offset != 0.0
        return f"stored values are multiplied by {self.scale:g} and {self.offset:g} is added" if scaled else ""

    def unpacked(self, values: np.ndarray) -> np.ndarray:
        """Return physical values, missing ones as NaN."""
        if values.dtype.kind not in "fiu":
            return values
        if self.unsigned and values.dtype.kind == "i":
            values = values.view(values.dtype.str.replace("i", "u"))
        lost = [values == value for value in self.missing]
        lost += [values < self.low] if self.low > -np.inf else []
        lost += [values > self.high] if self.high < np.inf else []
        if lost and (missing := np.any(lost, axis=0)).any():
            values = np.where(missing, np.nan, values)
        if self.scale != 1.0 or self.offset != 0.0:
            return values * self.scale + self.offset
        return values


def _number(value: Any) -> bool:
    return isinstance(value, int | float | np.number)


@dataclass(frozen=True)
class Since:
    """A unit of time, with the date from which it counts: "seconds since 2026-01-31T12:00:00"."""

    nanoseconds: int
    origin: np.datetime64 | None = None
    refusal: str = ""

    @classmethod
    def of(cls, unit: str, stored: Mapping[str, Any]) -> "Since | None":
        """Return a unit of time with or without a date; None for other units."""
        match = SINCE_TEXT.fullmatch(unit)
        word = match.group(1) if match else unit.strip()
        size = next((size for names, size in DURATIONS.items() if re.fullmatch(names, word, re.IGNORECASE)), 0)
        if not match:
            return cls(size) if size else None
        calendar = str(stored.get("calendar", "standard")).lower()
        if not size or calendar not in CALENDARS:
            return cls(size, refusal=f"dates in {unit!r} of calendar {calendar!r}; {READ_BY_XARRAY}")
        import pandas as pd

        try:
            date = pd.Timestamp(match.group(2)) if DATE_START.match(match.group(2)) else None
        except ValueError:
            date = None
        if date is None or pd.isna(date) or not YEARS[0] <= date.year < YEARS[1]:
            return cls(size, refusal=f"dates since {match.group(2)!r}; {READ_BY_XARRAY}")
        date = date.tz_convert(None) if date.tzinfo else date
        return cls(size, date.to_datetime64().astype("datetime64[ns]"))

    def seconds(self, values: np.ndarray) -> np.ndarray:
        """Return values in seconds."""
        return values * (self.nanoseconds / 1e9) if self.nanoseconds >= 10**9 else values / (10**9 / self.nanoseconds)

    def dates(self, values: np.ndarray) -> np.ndarray:
        """Return dates in nanoseconds; raise a ValueError if that is too coarse."""
        if values.dtype.kind in "iu":
            return np.asarray(self.origin + (values.astype(np.int64) * self.nanoseconds).astype("timedelta64[ns]"))
        lost = ~np.isfinite(values)
        exact = np.where(lost, 0.0, values.astype(float)) * self.nanoseconds
        if exact.size and np.abs(exact).max() >= 2.0**63:
            raise ValueError("its dates are outside of the years from 1678 to 2261")
        whole = np.round(exact)
        steps = np.abs(np.diff(exact))
        if steps.any() and np.abs(whole - exact).max() > LARGEST_ROUNDING * np.median(steps[steps > 0]):
            raise ValueError(
                "its dates are finer than nanoseconds; read them with xarray and give seconds to from_arrays"
            )
        result = np.asarray(self.origin + whole.astype(np.int64).astype("timedelta64[ns]"))
        result[lost] = np.datetime64("NaT")
        return result


READ_BY_XARRAY = "read it by xarray.open_dataset, and give seconds to from_arrays"


def unused_scale(stored: Mapping[str, Any]) -> str:
    """Return the attribute that may be a scale of no convention, such as "gain = 0.5"."""
    for key, value in stored.items():
        neutral = OTHER_SCALES.get(_plain(key))
        if neutral is not None and not (_number(value) and float(value) == neutral):
            return f"{key} = {value}"
    return ""


def _plain(key: str) -> str:
    return re.sub(r"[\W_]", "", key).lower()


def sampling(stored: Mapping[str, Any]) -> Clock | None:
    """Return the times that attributes say; refused if they are several or no numbers."""
    given = {key: value for key, value in stored.items() if _plain(key) in (*RATE_NAMES, *STEP_NAMES)}
    if not given:
        return None
    shown = ", ".join(f"{key} = {value}" for key, value in given.items())
    steps, error = [], 0.0
    for key, value in given.items():
        if not _number(value) or not np.isfinite(value) or value <= 0.0:
            return Clock(refusal=f"whose attributes say {shown}")
        number = float(str(value))  # of single precision, the decimal number that was written
        is_step = _plain(key) in STEP_NAMES
        steps.append(number if is_step else 1.0 / number)
        if is_step and isinstance(value, np.float32 | np.float16):
            error = step_error(str(value))
    if max(steps) - min(steps) > 1e-12 * max(steps):
        return Clock(refusal=f"whose attributes {shown} contradict each other")
    starts = [(key, value) for key, value in stored.items() if _plain(key) in START_NAMES]
    start, origin = 0.0, None
    for key, value in starts:
        if _number(value) and np.isfinite(value) and abs(value) < LEAST_EPOCH:
            start += float(value)
        elif isinstance(value, str) and re.match(r"\d{4}-\d\d-\d\d", value):
            import pandas as pd

            date = pd.Timestamp(value)
            origin = (date.tz_convert(None) if date.tzinfo else date).to_datetime64().astype("datetime64[ns]")
        else:
            return Clock(refusal=f"whose attribute {key} = {value} is no start in seconds or after ISO 8601")
    remark = (f"times are those of its attributes {shown}",)
    return Clock(start, steps[0], origin=origin, error=error, remarks=remark)
