"""Attributes of arrays in HDF5 files: units, scales and missing values of netCDF, dates, and sampling rates."""

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import h5py
import numpy as np

from bayesperiodic.data.formats.contents import OTHERWISE, Clock
from bayesperiodic.data.formats.decimals import step_error
from bayesperiodic.data.times import YEARS

# Types of attributes that are read: h5py crashes on some damaged lists and references.
PLAIN_TYPES = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING)
# Values of an attribute that are read.
MOST_VALUES = 64
UNIT_NAMES = ("units", "unit", "Unit", "Units", "UNIT", "UNIT_NAMES", "unit_string")
RATE_NAMES = ("samplingrate", "samplerate", "samplingfrequency", "samplefrequency", "fs")
STEP_NAMES = ("dt", "deltat", "samplinginterval", "sampleinterval", "samplingperiod", "wfincrement")
START_NAMES = ("t0", "starttime", "tstart", "wfstartoffset", "wfstarttime")
# Attributes of units of rates, steps, starts, and of any of them, by their names without "unit".
UNITS_OF = {
    "rate": (*RATE_NAMES, "rate", "freq", "frequency"),
    "step": (*STEP_NAMES, "step", "increment", "interval", "period", "delta"),
    "start": (*START_NAMES, "start"),
    "": ("time", "times", "t", "timebase", "timeaxis", "x", "xaxis", "wfx", "wftime", "sampling", "sample"),
}
# Hertz of units of rates; a mHz that may be MHz is none.
HERTZ = {
    **dict.fromkeys(("Hz", "hz", "HZ", "hertz", "Hertz", "1/s", "s-1", "s^-1", "s**-1", "S/s", "Sa/s", "sps"), 1.0),
    **dict.fromkeys(("samples/s", "samples/sec", "samples/second", "samples per second"), 1.0),
    **dict.fromkeys(("kHz", "khz", "KHz", "KHZ", "kilohertz", "1/ms", "kS/s", "kSa/s", "ksps"), 1e3),
    **dict.fromkeys(("MHz", "megahertz", "MS/s", "MSa/s"), 1e6),
    "GHz": 1e9,
}
# Scales of no convention: of these names also texts, of those that contain a word only numbers.
OTHER_SCALES = (
    "gain", "scale", "scaling", "slope", "conversion", "calibration", "sensitivity", "factor", "offset", "intercept",
)  # fmt: skip
SCALE_WORDS = re.compile(
    r"scale|scaling|gain|factor(?!y)|mult|sens(?!or)|resol|lsb|offset|calib|slope|intercept|conver|coef|zero|bias"
    r"|counts?per|per(count|volt|bit)"
)
# Names of what is added, of what says nothing by its value 1, and of no scale.
ADDED, FULL_SCALE, DATE_NAME = re.compile("offset|zero|bias|intercept"), re.compile("fullscale"), re.compile("date")
# Ranges or counts of a converter, and not those of netCDF that limit the values.
RANGE = re.compile(r"(?!valid|actual|display|plot|color|time|freq).*range|.*counts|fsr")
NUMBER_START = re.compile(r"\s*[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?(\s*[^\W\d].*|\s*[/%*].*|\s*)", re.DOTALL)
APPLIED = ("scale_factor", "add_offset")
# What netCDF fills with by default; the fill value of HDF5 is not read, because h5py crashes on some damaged ones.
NOT_WRITTEN = 9.969209968386869e36
# Nanoseconds of the units before "since".
DURATIONS = {
    r"days?|d": 86_400 * 10**9, r"hours?|hrs?|h": 3600 * 10**9, r"minutes?|mins?": 60 * 10**9,
    r"seconds?|secs?|s": 10**9, r"milliseconds?|millisecs?|msecs?|ms": 10**6,
    r"microseconds?|microsecs?|usecs?|[u\u00b5\u03bc]s": 10**3, r"nanoseconds?|nanosecs?|nsecs?|ns": 1,
}  # fmt: skip
SINCE_TEXT = re.compile(r"\s*(\w+)\s+since\s+(.+?)\s*", re.IGNORECASE)
# pandas takes a year 1 as 2001.
DATE_START, DAY_START = re.compile(r"\d{4}-\d"), re.compile(r"\d{4}-\d\d-\d\d(?![T ]\d\d?-)")
CALENDARS = ("standard", "gregorian", "proleptic_gregorian")
# Numbers from which a start is seconds since 1970.
LEAST_EPOCH = 1e8
# Rounding of dates to nanoseconds, of a step.
LARGEST_ROUNDING = 1e-3
# Numbers of netCDF, with how many they are.
NETCDF_NUMBERS = {
    "_FillValue": (1,), "missing_value": range(1, MOST_VALUES + 1), "valid_range": (2,), "valid_min": (1,),
    "valid_max": (1,),
}  # fmt: skip


def attributes(item: h5py.Dataset | h5py.Group) -> dict[str, Any]:
    """Return the attributes of an item that are a number, a text, or a tuple of numbers; else how many there are."""
    result: dict[str, Any] = {}
    for key in item.attrs:
        try:
            kind = item.attrs.get_id(key)
            group = kind.get_type().get_class()
            if group not in PLAIN_TYPES or not (count := math.prod(kind.shape)):
                continue
            if count > (1 if group == h5py.h5t.STRING else MOST_VALUES):
                result[str(key)] = f"{count} values"
                continue
            value = item.attrs[key]
        except Exception:  # of types that h5py does not know, and of damaged files
            continue
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.ravel()[0]
        if isinstance(value, np.ndarray):
            value = tuple(value.ravel().tolist())
        if isinstance(value, bytes):
            value = value.decode("utf-8", "replace")
        if isinstance(value, str | int | float | np.number | tuple):
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
    unused: str = ""  # a scale that is none
    refusal: str = ""

    @classmethod
    def of(cls, stored: Mapping[str, Any], item: h5py.Dataset) -> "Packing":
        """Return the packing of an array by its attributes."""
        if item.dtype.kind in "OSU":
            return cls()
        unsigned = str(stored.get("_Unsigned", "")).lower() == "true"
        read: dict[str, list[float]] = {}
        for key, counts in NETCDF_NUMBERS.items():
            numbers = _numbers(stored[key]) if key in stored else []
            if numbers is None or key in stored and len(numbers) not in counts:
                reason = f"an attribute {key} = {stored[key]}, which is no {'range' if 2 in counts[:1] else 'number'}"
                return cls(refusal=f"{reason}; {OTHERWISE}")
            read[key] = numbers
        missing = read["_FillValue"] + read["missing_value"]
        missing += [NOT_WRITTEN] if item.dtype.kind == "f" and item.dtype.itemsize > 2 else []
        beyond = 2.0 ** (8 * item.dtype.itemsize) if unsigned else 0.0
        low, high = read["valid_range"] or (-np.inf, np.inf)
        scale, offset = (_numbers(stored.get(key, neutral)) for key, neutral in zip(APPLIED, (1.0, 0.0), strict=True))
        packed = scale and offset and len(scale) == len(offset) == 1 and np.isfinite([scale, offset]).all() and scale[0]
        shown = ", ".join(f"{key} = {stored[key]}" for key in APPLIED if key in stored)
        return cls(
            scale[0] if packed and scale else 1.0,
            offset[0] if packed and offset else 0.0,
            tuple(value + (beyond if value < 0 else 0.0) for value in missing),
            (read["valid_min"] or [low])[0],
            (read["valid_max"] or [high])[0],
            unsigned,
            "" if packed else shown,
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


def _numbers(value: Any) -> list[float] | None:
    """Return the numbers of an attribute, None if it has others."""
    values = value if isinstance(value, tuple) else (value,)
    if isinstance(value, str) and value.strip().lower() == "nan":
        return [np.nan]
    return [float(one) for one in values] if all(map(_number, values)) else None


def _date(text: str) -> np.datetime64 | None:
    """Return a date after ISO 8601, in UTC; None if it is none, or beyond the years of nanoseconds."""
    import pandas as pd

    if not DATE_START.match(text):
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            date = pd.Timestamp(text)
    except (ValueError, OverflowError, Warning):
        return None
    if pd.isna(date) or not YEARS[0] <= date.year < YEARS[1]:
        return None
    date = date.tz_convert(None) if date.tzinfo else date
    return date.to_datetime64().astype("datetime64[ns]")


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
        date = _date(match.group(2))
        if date is None:
            return cls(size, refusal=f"dates since {match.group(2)!r}; {READ_BY_XARRAY}")
        return cls(size, date)

    def seconds(self, values: Any) -> Any:
        """Return values in seconds."""
        return values * (self.nanoseconds / 1e9) if self.nanoseconds >= 10**9 else values / (10**9 / self.nanoseconds)

    def dates(self, values: np.ndarray) -> np.ndarray:
        """Return dates in nanoseconds; raise a ValueError if that is too coarse."""
        assert self.origin is not None
        lost = ~np.isfinite(values)
        given = values[~lost]
        ends = [int(end * self.nanoseconds) for end in (given.min().item(), given.max().item())] if given.size else [0]
        start = int(self.origin.astype(np.int64))
        if not all(-(2**63) < end < 2**63 and -(2**63) < start + end < 2**63 for end in ends):
            raise ValueError(f"its dates are outside of the years from {YEARS[0]} to {YEARS[1] - 1}")
        if values.dtype.kind in "iu":
            return np.asarray(self.origin + (values.astype(np.int64) * self.nanoseconds).astype("timedelta64[ns]"))
        exact = np.where(lost, 0.0, values.astype(float)) * self.nanoseconds
        whole = np.round(exact)
        steps = np.abs(np.diff(exact))
        if steps.any() and np.abs(whole - exact).max() > LARGEST_ROUNDING * np.median(steps[steps > 0]):
            raise ValueError(
                "its dates are finer than nanoseconds; read them with xarray and give seconds to from_arrays"
            )
        result = np.asarray(self.origin + whole.astype(np.int64).astype("timedelta64[ns]"))
        result[lost] = np.datetime64("NaT", "ns")
        return result


READ_BY_XARRAY = "read it by xarray.open_dataset, and give seconds to from_arrays"


def unused_scale(stored: Mapping[str, Any]) -> str:
    """Return the attribute that may be a scale of no convention, such as "gain = 0.5"."""
    for key, value in stored.items():
        plain = _plain(key)
        if key in APPLIED or plain in START_NAMES or not SCALE_WORDS.search(plain) or DATE_NAME.search(plain):
            continue
        if plain not in OTHER_SCALES and isinstance(value, str) and not NUMBER_START.fullmatch(value):
            continue
        neutral: tuple[float, ...] = () if FULL_SCALE.search(plain) else (0.0,) if ADDED.search(plain) else (1.0,)
        if "resol" in plain:
            neutral = (1.0, -1.0)  # -1 stands for unknown in Neurodata Without Borders
        if isinstance(value, str) or any(one not in neutral for one in _numbers(value) or ()):
            return f"{key} = {value}"
    return ""


def meaning_of_integers(stored: Mapping[str, Any], kind: np.dtype[Any]) -> str:
    """Return the attribute that may say what counts of a converter mean, such as "range = 10", and not their limits."""
    if kind.kind not in "iu":
        return ""
    limits = np.iinfo(kind)
    neutral = (0, limits.min, -limits.max, limits.max, limits.max + 1, limits.max - limits.min + 1)
    for key, value in stored.items():
        if RANGE.fullmatch(_plain(key)) and any(one not in neutral for one in _numbers(value) or [np.nan]):
            return f"{key} = {value}"
    return ""


def _plain(key: str) -> str:
    return re.sub(r"[\W_]", "", key).lower()


def sampling(stored: Mapping[str, Any]) -> Clock | None:
    """Return the times that attributes say; refused if they are several or no numbers."""
    given = {key: value for key, value in stored.items() if _plain(key) in (*RATE_NAMES, *STEP_NAMES)}
    if not given:
        return None
    units = {key: value for key, value in stored.items() if _unit_of(key) is not None and value != ""}
    shown = ", ".join(f"{key} = {value}" for key, value in {**given, **units}.items())
    steps, error = [], 0.0
    is_step = {key: _plain(key) in STEP_NAMES for key in given}
    factors = _factors(units)
    start, origin, refusal = _start(stored, factors["start"] if factors else None)
    refused = partial(Clock, start, origin=origin)  # the start is used with sampling_rate=
    if factors is None or (factors["other"] and any(is_step.values()) == (factors["other"] == "rate")):
        return refused(refusal=f"whose attributes {shown} do not say one unit")
    for key, value in given.items():
        if not _number(value) or not np.isfinite(value) or value <= 0.0:
            return refused(refusal=f"whose attributes say {shown}")
        number = float(str(value))  # of single precision, the decimal number that was written
        seconds = Since(factors["step"]).seconds
        steps.append(seconds(number) if is_step[key] else 1.0 / (number * factors["rate"]))
        if is_step[key] and isinstance(value, np.float32 | np.float16):
            error = seconds(step_error(str(value)))
    if max(steps) - min(steps) > 1e-12 * max(steps):
        return refused(refusal=f"whose attributes {shown} contradict each other")
    if refusal:
        return Clock(refusal=refusal)
    remark = (f"times are those of its attributes {shown}",)
    return Clock(start, steps[0], origin=origin, error=error, remarks=remark)


def _unit_of(key: str) -> str | None:
    """Return of what an attribute is the unit: rate, step, start, "" for any of them; None for other attributes."""
    name, count = re.subn(r"unit(s?(string|label|name)|s)?", "", _plain(key))
    return next((of for of, names in UNITS_OF.items() if count and name in names), None)


def _factors(units: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return hertz of rates, nanoseconds of steps and starts, after attributes of their units; None if unclear.

    A start has no nanoseconds if its unit is unclear. "other" is what a unit of anything, but Hz and s, is a unit of.
    """
    result: dict[str, Any] = {}
    other = ""
    for key, value in units.items():
        of, text = _unit_of(key), str(value).strip()
        since = Since.of(text, {})
        duration = since.nanoseconds if since and not SINCE_TEXT.fullmatch(text) else 0
        rate = HERTZ.get(text, 0.0)
        if not (rate if of == "rate" else duration if of else rate or duration):
            return None
        if not of:
            other = other if (rate or duration) in (1.0, 10**9) else "rate" if rate else "step"
        for kind in (of,) if of else ("rate",) if rate else ("step", "start"):
            if result.setdefault(kind, rate or duration) != (rate or duration):
                return None
    step = result.get("step", 10**9)
    return {"rate": 1.0, "step": step, "start": None if step != 10**9 else step, **result, "other": other}


def _start(stored: Mapping[str, Any], nanoseconds: int | None) -> tuple[float, np.datetime64 | None, str]:
    """Return start [s] and origin after attributes, of which equal ones count once, and why they cannot be used."""
    starts: dict[str, float] = {}
    origins: dict[str, np.datetime64] = {}
    for key, value in stored.items():
        if _plain(key) not in START_NAMES:
            continue
        if _number(value) and np.isfinite(value) and abs(value) < LEAST_EPOCH:
            if value and nanoseconds is None:
                return 0.0, None, f"whose attribute {key} = {value} has no unit"
            starts[key] = float(Since(nanoseconds or 10**9).seconds(float(str(value))))
        elif isinstance(value, str) and DAY_START.match(value) and (date := _date(value)) is not None:
            origins[key] = date
        else:
            return 0.0, None, f"whose attribute {key} = {value} is no start in seconds or after ISO 8601"
    for given in (starts, origins):
        if len({*given.values()}) > 1:
            shown = ", ".join(f"{key} = {stored[key]}" for key in given)
            return 0.0, None, f"whose attributes {shown} contradict each other"
    return next(iter(starts.values()), 0.0), next(iter(origins.values()), None), ""
