"""Experiments from a table of frequencies, amplitudes and phases, or from frequency response functions."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic.data import objects
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.formats import recognise
from bayesperiodic.data.formats.contents import Contents, Key, StoredChannel
from bayesperiodic.data.layout import numbers
from bayesperiodic.data.sweep import RESOLUTION, Sweep
from bayesperiodic.data.units import Units, from_file, kind_of

# Values in the table over the amplitude of the fundamental.
AMPLITUDES_IN = {"peak": 1.0, "rms": np.sqrt(0.5), "peak to peak": 2.0}
PHASE_UNITS = {"deg": np.pi / 180.0, "rad": 1.0}
# Degrees beyond which a phase is none.
LARGEST_PHASE = 720.0


def response_table(
    table: Any,
    *,
    outputs: Mapping[str, Key],
    inputs: Mapping[str, float | Key],
    frequency: Key | None = None,
    phases: Mapping[str, Key] | None = None,
    per: str | None = None,
    size: str = "peak",
    phase_unit: str = "deg",
    units: Units | None = None,
    sweep: str | None = None,
    resolution: float = RESOLUTION,
    samples: int = 128,
) -> list[Experiment]:
    """Return one experiment for each frequency of a table of measured responses.

    The response is Re c exp(iωt) with the amplitude \\|c\\| and the phase arg c against the first input, whose phase is
    zero: a phase that lags is negative. Only this harmonic is data: the mean and higher harmonics are not compared.

    Parameters
    ----------
    table : pandas.DataFrame, mapping of str to array (rows,), or path
        Of a file in any format of `Recording.from_file`; of a universal file with frequency response functions these,
        whose abscissa is the frequency.
    outputs : mapping of str to str, int or (group, name)
        Column of the amplitudes of each channel, or of complex amplitudes.
    inputs : mapping of str to float, str, int or (group, name)
        Amplitude of each input in SI, or its column. Inputs are cosines.
    frequency : str, int or (group, name), optional
        Column of the frequencies [Hz]; not for frequency response functions.
    phases : mapping of str to str, int or (group, name), optional
        Column of the phase of each output; not for complex amplitudes.
    per : str, optional
        Input per whose amplitude the outputs are given, as in frequency response functions.
    size : "peak", "rms" or "peak to peak"
        What the amplitudes of outputs and inputs are.
    phase_unit : "deg" or "rad"
    units : mapping of str to float, unit or (from, to), optional
        As for `Recording.from_file`, by channel or "frequency"; of outputs with `per` for the quotient.
    sweep : "up", "down" or None
        Direction in which the frequency was stepped: the response stays on its branch up to a fold, and jumps there.
        None: each row was measured by itself. Of a sweep up and one down make a table each. See `Sweep`.
    resolution : float
        Standard deviation of the frequencies, relative to them. A row that was measured beyond the fold of the model's
        branch is compared with the orbit at the fold, and the distance to it, over this standard deviation, is one
        more residual.
    samples : int
        Grid points per period. The default, with the scheme "central4", is enough for responses in which harmonics
        above the fifth do not matter; `check` tells what twice as many would change.

    Returns
    -------
    list of Experiment
        In the order of the table, each with its `sweep`.

    Raises
    ------
    FileNotFoundError, ImportError, ValueError
        As for `Recording.from_file`, and for negative amplitudes, phases that are missing or beyond 720°, frequencies
        ≤ 0, and levels in dB.

    Examples
    --------
    >>> f = np.array([0.10, 0.14, 0.18])
    >>> omega = 2 * np.pi * f
    >>> c = 0.5 / (1.0 - omega**2 + 0.2j * omega)
    >>> table = {"f": f, "A": 1e3 * abs(c), "phi": np.degrees(np.angle(c))}
    >>> runs = bp.response_table(
    ...     table, frequency="f", outputs={"displacement": "A"}, phases={"displacement": "phi"},
    ...     inputs={"force": 0.5}, units={"displacement": ("mm", "m")},
    ... )
    >>> [run.name for run in runs], runs[0].independent
    (['0.1 Hz', '0.14 Hz', '0.18 Hz'], {'displacement': 2})
    """  # noqa: D301
    _checks.mapping("outputs", outputs, "{'displacement': 'the column of its amplitudes'}")
    _checks.mapping("inputs", inputs, "{'force': 0.5}")
    _checks.one_of("size", size, AMPLITUDES_IN)
    _checks.one_of("phase_unit", phase_unit, PHASE_UNITS)
    if per is not None:
        _checks.one_of("per", per, inputs)
    for key in units or {}:
        _checks.one_of("units", key, ("frequency", *outputs, *inputs))
    for key in phases or {}:
        _checks.one_of("phases", key, outputs)
    columns: list[Any] = [*outputs.values(), *inputs.values(), *(phases or {}).values(), frequency]
    wanted: list[Key] = [key for key in columns if isinstance(key, str | tuple)]
    label, contents = _contents(table, wanted)
    source = _Columns(label, contents, units or {})
    at = source.frequencies([contents.find(label, key) for key in outputs.values()], frequency)
    drive = {name: source.drive(name, value, at.size) / AMPLITUDES_IN[size] for name, value in inputs.items()}
    responses = {}
    for channel, column in outputs.items():
        phase = (phases or {}).get(channel)
        angles = None if phase is None else source.angles(phase, PHASE_UNITS[phase_unit])
        c = source.response(channel, column, angles, at.size, per)
        responses[channel] = c * drive[per] if per is not None else c / AMPLITUDES_IN[size]
    of_table = Sweep(_table_name(label, outputs, inputs), sweep, resolution)
    return [
        replace(
            Experiment.from_harmonics(
                name, float(at[k]), {channel: [None, c[k]] for channel, c in responses.items()},
                {channel: [0.0, level[k]] for channel, level in drive.items()}, samples=samples,
            ),
            sweep=of_table,
        )
        for k, name in enumerate(_names(at))
    ]  # fmt: skip


class _Columns:
    """Columns of a table, in SI."""

    def __init__(self, label: str, contents: Contents, units: Units):
        self.label, self.contents, self.units = label, contents, units

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
                    f"frequency: must be in Hz, got {stored.unit!r} of {stored.label!r}; give units={{'frequency': …}}."
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
        if _is_number(value):
            return np.full(rows, _checks.positive(f"inputs[{name!r}]", value))
        stored, values = self.column(value)  # type: ignore[arg-type]
        values = from_file(name, self.sized(f"inputs[{name!r}]", values, rows), self.units.get(name), stored.unit)
        return self.amplitudes(f"inputs[{name!r}]", values)

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

    def response(self, name: str, key: Key, angles: np.ndarray | None, rows: int, per: str | None) -> np.ndarray:
        """Return the complex amplitudes of an output."""
        argument = f"outputs[{name!r}]"
        stored, values = self.column(key)
        values = self.sized(argument, values, rows)
        unit = self.units.get(name)
        if per is None and unit is None and re.search(r"/ kg|/ \(.*kg|^1 / kg", kind_of(stored.unit)):
            raise ValueError(
                f"per: must be the input per which {name!r} is given, got None and values in {stored.unit!r}."
            )
        if values.dtype.kind == "c":
            if angles is not None:
                raise ValueError(f"phases: must be left out for complex amplitudes, got one for {name!r}.")
            return from_file(name, values.real, unit, stored.unit) + 1j * from_file(
                name, values.imag, unit, stored.unit
            )
        if angles is None:
            raise ValueError(
                f"phases: must have the phase of {name!r}, got none; amplitudes alone are no data of an experiment yet."
            )
        size = self.amplitudes(argument, from_file(name, values, unit, stored.unit))
        return size * np.exp(1j * self.sized(f"phases[{name!r}]", angles, rows))

    def sized(self, argument: str, values: np.ndarray, rows: int) -> np.ndarray:
        """Return values; raise a ValueError unless there is one for each frequency."""
        if values.shape != (rows,):
            raise ValueError(f"{argument}: must have {rows} values, one for each frequency, got {values.size}.")
        return values

    def amplitudes(self, argument: str, values: np.ndarray) -> np.ndarray:
        """Return values; raise a ValueError unless they are positive."""
        if not np.all(values > 0.0):
            row = int(np.flatnonzero(~(values > 0.0))[0])
            raise ValueError(
                f"{argument}: must be amplitudes > 0, got {values[row]:g} in row {row + 1} of {self.label}; levels in "
                "dB are converted first, reference*10**(level/20)."
            )
        return values


def _contents(table: Any, wanted: list[Key]) -> tuple[str, Contents]:
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


def _table_name(label: str, outputs: Mapping[str, Key], inputs: Mapping[str, float | Key]) -> str:
    """Return a name of the table that tells it from others: its file, columns and levels."""
    parts = [f"{name} {column}" for name, column in (*outputs.items(), *inputs.items())]
    return f"{label}: {', '.join(parts)}"


def _is_number(value: Any) -> bool:
    """Return whether the value of an input is an amplitude; an integer is, not the number of a column."""
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _names(frequencies: np.ndarray) -> list[str]:
    """Return different names of experiments."""
    texts = [f"{value:.6g} Hz" for value in frequencies]
    return [text if texts.count(text) == 1 else f"{k}: {text}" for k, text in enumerate(texts, 1)]
