"""Meaning of the columns of a file, and missing samples of files and arrays."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data.files import Format
from bayesperiodic.data.times import seconds
from bayesperiodic.data.units import Units, convert

DROP, INTERPOLATE = "drop", "interpolate"
# Successive samples that may be interpolated.
LONGEST_INTERPOLATION = 3
# Key of the times of a file without a column of times.
NO_COLUMN = "\0"

Times = np.ndarray | dict[str, np.ndarray]


@dataclass(frozen=True)
class Layout:
    """Meaning of the columns of a file, with the arguments of `Recording.from_csv`."""

    file: str
    outputs: Mapping[str, str]
    inputs: Mapping[str, str]
    time: str | None
    sampling_rate: float | None
    units: Units
    missing: str | None

    def __post_init__(self) -> None:
        example = "{'force': 'the column of the force'}"
        for kind in ("outputs", "inputs"):
            _checks.mapping(kind, getattr(self, kind), example)
        if (self.time is None) == (self.sampling_rate is None):
            raise ValueError(
                f"time: must be given or sampling_rate, and not both, got {self.time!r} and {self.sampling_rate!r}."
            )
        for key in self.units:
            _checks.one_of("units", key, ("time", *self.outputs, *self.inputs))

    @property
    def columns(self) -> dict[str, None]:
        """Names of the columns, each once."""
        return dict.fromkeys([*([self.time] if self.time else []), *self.outputs.values(), *self.inputs.values()])

    def timed(self, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the columns of a file with dates and durations in seconds from the first one of the file."""
        if not self.time:
            return dict(columns)
        times = columns[self.time]
        if times.dtype.kind in "mM" and "time" in self.units:
            raise ValueError(
                f"units['time']: must be left out for a column of dates or durations, which is converted to seconds, "
                f"got {self.units['time']!r} for column {self.time!r} of {self.file}."
            )
        argument = f"time (column {self.time!r} of {self.file})"
        return {**columns, self.time: _checks.real_array(argument, seconds(argument, times, unit="time" in self.units))}

    def signals(self, columns: Mapping[str, np.ndarray]) -> tuple[Times, dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Return times, outputs and inputs, without missing samples, from columns of numbers."""
        if not self.time:
            rows = max((values.size for values in columns.values()), default=0)
            columns = {**columns, NO_COLUMN: np.arange(rows) / _checks.positive("sampling_rate", self.sampling_rate)}

        def label(key: str, column: str) -> str:
            return f"{key} (column {column!r} of {self.file})"

        def converted(argument: str, key: str, values: np.ndarray) -> np.ndarray:
            vector = _checks.measured_vector(argument, values)
            return convert(key, vector, self.units[key]) if key in self.units else vector

        sources = {**self.outputs, **self.inputs}
        at = label("time", self.time or NO_COLUMN)
        given = {label(key, column): columns[column] for key, column in sources.items()}
        times, present = without_missing(at, columns[self.time or NO_COLUMN], given, self.missing)
        timed: Times
        if isinstance(times, dict):
            timed = {key: converted(at, "time", time) for key, time in zip(sources, times.values(), strict=True)}
        else:
            timed = converted(at, "time", times)
        values = {
            key: converted(argument, key, vector)
            for key, (argument, vector) in zip(sources, present.items(), strict=True)
        }
        return timed, {key: values[key] for key in self.outputs}, {key: values[key] for key in self.inputs}


def without_missing(
    argument: str, time: Any, channels: Mapping[str, np.ndarray], missing: str | None
) -> tuple[Times, dict[str, np.ndarray]]:
    """Return times and values of channels without NaN, by default refused; the times by channel if they differ.

    `time` is an array, or a mapping with the keys of `channels`.
    """
    if missing is not None:
        _checks.one_of("missing", missing, (DROP, INTERPOLATE))
    times = (
        {f"{argument}[{key!r}]": values for key, values in time.items()} if isinstance(time, dict) else {argument: time}
    )
    for name, values in {**times, **channels}.items():
        if missing is None and values.ndim == 1 and (lost := np.flatnonzero(np.isnan(values))).size:
            raise ValueError(
                f"{name}: must be finite, got nan at index {lost[0]} ({lost.size} of {values.size} values are NaN "
                f"or masked); missing={DROP!r} leaves such samples out, missing={INTERPOLATE!r} fills in single values."
            )
    each = time if isinstance(time, dict) else dict.fromkeys(channels, time)
    if missing is None or any(each[key].shape != values.shape for key, values in channels.items()):
        return time, dict(channels)  # shapes are checked by `Recording`
    if missing == INTERPOLATE:
        channels = {key: _interpolated(key, each[key], values) for key, values in channels.items()}
    keep = {key: ~(np.isnan(each[key]) | np.isnan(values)) for key, values in channels.items()}
    if missing == INTERPOLATE and not isinstance(time, dict):  # of the ends, in all channels
        keep = dict.fromkeys(keep, np.all([*keep.values()], axis=0))
    kept = {key: values[keep[key]] for key, values in channels.items()}
    first = next(iter(keep.values()), np.ones(np.shape(time), dtype=bool))
    if not isinstance(time, dict) and all(np.array_equal(first, mask) for mask in keep.values()):
        return time[first], kept
    return {key: each[key][keep[key]] for key in channels}, kept


def _interpolated(argument: str, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return an array with NaN between numbers replaced; those at the ends remain."""
    known = np.flatnonzero(~np.isnan(values) & ~np.isnan(time))
    if (longest := int(np.max(np.diff(known), initial=1)) - 1) > LONGEST_INTERPOLATION:
        raise ValueError(
            f"missing: must be {DROP!r} for {argument}, got {INTERPOLATE!r}, which fills in at most "
            f"{LONGEST_INTERPOLATION} successive values, and {longest} are missing."
        )
    return np.interp(time, time[known], values[known], left=np.nan, right=np.nan) if known.size else values


def reader(name: str, form: Format, source: str, columns: str, refused: str) -> Any:
    """Return a class method of this name that reads a format as `Recording.from_csv` reads its own."""

    def read(
        cls: Any, path: str | Path, *, outputs: Mapping[str, str], inputs: Mapping[str, str] | None = None,
        time: str | None = None, sampling_rate: float | None = None, units: Units | None = None,
        missing: str | None = None, split: str | None = None, name: str | None = None,
    ) -> Any:  # fmt: skip
        layout = Layout(Path(path).name, outputs, inputs or {}, time, sampling_rate, units or {}, missing)
        return recordings(cls, form, path, name, split, layout)

    read.__name__, read.__qualname__ = name, f"Recording.{name}"
    read.__annotations__["return"] = "Recording | list[Recording]"
    read.__doc__ = f"""Read a recording from the {source}.

        Parameters
        ----------
        path, outputs, inputs, time, sampling_rate, units, missing, split, name
            As for `from_csv`, with {columns} in place of columns.

        Returns
        -------
        Recording, or list of Recording with `split`

        Raises
        ------
        FileNotFoundError, ValueError
            As for `from_csv`, and {refused}.
        """
    return classmethod(read)


def recordings(cls: Any, form: Format, path: str | Path, name: str | None, split: str | None, meaning: Layout) -> Any:
    """Return the recording in a file; with `split`, one for each part in which this column is constant."""
    parts = [cls(*part) for part in read(form, path, name, split, meaning)]
    return parts[0] if split is None else parts


def read(
    form: Format, path: str | Path, name: str | None, split: str | None, meaning: Layout
) -> list[tuple[Any, Any, Any, str]]:
    """Return the arguments of the recordings in a file: one, or one for each part in which `split` is constant."""
    name = name or Path(path).stem
    if split is None:
        columns = form.read(path, meaning.columns, time=meaning.time)
        return [(*meaning.signals(meaning.timed(columns)), name)]
    columns = form.read(path, dict.fromkeys([*meaning.columns, split]), split, meaning.time)
    label = columns[split] if split in meaning.columns else columns.pop(split)
    if any(lost := [value != value for value in label]):
        row = lost.index(True) + 1
        raise ValueError(f"split: must be a column without empty cells, got {split!r}, empty in data row {row}.")
    for column, values in columns.items():
        if values.size != label.size:
            raise ValueError(
                f"split: must be a column with one value per sample, got {split!r} with {label.size} values and "
                f"{column!r} with {values.size}."
            )
    columns = meaning.timed(columns)
    edges = [0, *(np.flatnonzero(label[1:] != label[:-1]) + 1).tolist(), label.size]
    return [
        (
            *meaning.signals({column: values[first:last] for column, values in columns.items()}),
            f"{name} {i}: {split} {label[first]}",
        )
        for i, (first, last) in enumerate(zip(edges[:-1], edges[1:], strict=True), 1)
    ]
