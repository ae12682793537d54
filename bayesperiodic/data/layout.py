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
        return {**columns, self.time: _checks.real_array(argument, seconds(argument, times))}

    def signals(
        self, columns: Mapping[str, np.ndarray]
    ) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Return time, outputs and inputs, without missing samples, from columns of numbers."""
        if not self.time:
            rows = max((values.size for values in columns.values()), default=0)
            columns = {**columns, NO_COLUMN: np.arange(rows) / _checks.positive("sampling_rate", self.sampling_rate)}
        sources = [("time", self.time or NO_COLUMN), *self.outputs.items(), *self.inputs.items()]
        labels = [f"{key} (column {column!r} of {self.file})" for key, column in sources]
        given = {label: columns[column] for label, (_, column) in zip(labels, sources, strict=True)}
        present = without_missing(given, self.missing)
        values = []
        for label, (key, _) in zip(labels, sources, strict=True):
            vector = _checks.measured_vector(label, present[label])
            values.append(convert(key, vector, self.units[key]) if key in self.units else vector)
        first = 1 + len(self.outputs)
        outputs = dict(zip(self.outputs, values[1:first], strict=True))
        return values[0], outputs, dict(zip(self.inputs, values[first:], strict=True))


def without_missing(arrays: Mapping[str, np.ndarray], missing: str | None) -> dict[str, np.ndarray]:
    """Return arrays of numbers, of which the first is the time, without NaN; by default NaN is refused."""
    if missing is not None:
        _checks.one_of("missing", missing, (DROP, INTERPOLATE))
    for argument, values in arrays.items():
        if missing is None and values.ndim == 1 and (lost := np.flatnonzero(np.isnan(values))).size:
            raise ValueError(
                f"{argument}: must be finite, got nan at index {lost[0]} ({lost.size} of {values.size} values are NaN "
                f"or masked); missing={DROP!r} leaves such samples out, missing={INTERPOLATE!r} fills in single values."
            )
    result = dict(arrays)
    if missing is None or len({values.shape for values in arrays.values()}) > 1:  # shapes are checked by `Recording`
        return result
    if missing == INTERPOLATE:
        time = next(iter(arrays.values()))
        result |= {name: _interpolated(name, time, values) for name, values in [*arrays.items()][1:]}
    keep = ~np.any([np.isnan(values) for values in result.values()], axis=0)
    return {name: values[keep] for name, values in result.items()}


def _interpolated(argument: str, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return an array with NaN between numbers replaced; those at the ends remain."""
    known = np.flatnonzero(~np.isnan(values) & ~np.isnan(time))
    if (longest := int(np.max(np.diff(known), initial=1)) - 1) > LONGEST_INTERPOLATION:
        raise ValueError(
            f"missing: must be {DROP!r} for {argument}, got {INTERPOLATE!r}, which fills in at most "
            f"{LONGEST_INTERPOLATION} successive values, and {longest} are missing."
        )
    return np.interp(time, time[known], values[known], left=np.nan, right=np.nan) if known.size else values


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
