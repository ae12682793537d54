"""Channels and the times at which they were sampled, from files of all formats."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self, overload

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic.data import objects
from bayesperiodic.data.formats import recognise
from bayesperiodic.data.formats.contents import Contents, Key
from bayesperiodic.data.layout import Layout, Rate, recordings
from bayesperiodic.data.signals import Signals
from bayesperiodic.data.times import channel_seconds, seconds, shared
from bayesperiodic.data.units import Units


@dataclass(frozen=True)
class Channels(Result):
    """Outputs and inputs with common times, or with times of each channel: the fields of a `Recording`."""

    time: Any
    outputs: dict[str, np.ndarray]
    inputs: dict[str, np.ndarray]
    name: str = "recording"
    synthetic: bool = False
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _checks.text("name", self.name)
        for kind in ("outputs", "inputs"):
            _checks.mapping(kind, getattr(self, kind), "{'displacement': values}")
        if not len(self.outputs):
            raise ValueError("outputs: must have at least one channel, got none.")
        _checks.identifiers("outputs and inputs", (*self.outputs, *self.inputs))
        if isinstance(self.time, Mapping):
            _checks.same_names("time", self.time, (*self.inputs, *self.outputs))
            given = channel_seconds(self.time)
            times = shared({c: _increasing(f"time[{c!r}]", given[c], self.name) for c in (*self.inputs, *self.outputs)})
            distinct = {id(time): time for time in times.values()}
            object.__setattr__(self, "time", times if len(distinct) > 1 else [*distinct.values()][0])
        else:
            object.__setattr__(self, "time", _increasing("time", seconds("time", self.time), self.name))
        times = self.times
        for kind in ("outputs", "inputs"):
            channels = {
                name: _checks.measured_vector(f"{kind}[{name!r}]", values, times[name].size, "one per time")
                for name, values in getattr(self, kind).items()
            }
            object.__setattr__(self, kind, channels)
        object.__setattr__(self, "units", _checks.checked_units(self.units, times))

    @property
    def times(self) -> dict[str, np.ndarray]:
        """Times (samples,) of each channel [s]."""
        if isinstance(self.time, Mapping):
            return dict(self.time)
        return dict.fromkeys((*self.inputs, *self.outputs), self.time)

    @property
    def sampling_rate(self) -> float:
        """Mean sampling rate [Hz], of the slowest channel."""
        return min(_rate(time) for time in self.times.values())

    def _by_time(self, select: Callable[[np.ndarray], Any]) -> dict[str, Any]:
        """Return by channel what is selected of its times; one object for channels with common times."""
        times = self.times
        chosen = {id(time): select(time) for time in {id(time): time for time in times.values()}.values()}
        return {channel: chosen[id(time)] for channel, time in times.items()}

    def _part(self, samples: Mapping[str, Any], name: str) -> Self:
        """Return the selected samples of each channel; those with common times keep them."""
        times = self.times
        cut = {(id(times[c]), id(samples[c])): times[c][samples[c]] for c in times}
        outputs, inputs = ({c: v[samples[c]] for c, v in kind.items()} for kind in (self.outputs, self.inputs))
        time = (
            {c: cut[id(times[c]), id(samples[c])] for c in times}
            if isinstance(self.time, Mapping)
            else [*cut.values()][0]
        )
        return replace(self, time=time, outputs=outputs, inputs=inputs, name=name)

    def _groups(self, without: Iterable[str] = ()) -> list[Signals]:
        """Return the channels in groups that have common times, inputs first."""
        groups: dict[int, list[str]] = {}
        for channel, time in self.times.items():
            if channel not in without:
                groups.setdefault(id(time), []).append(channel)
        signals, times = self.inputs | self.outputs, self.times
        if not groups:
            return [Signals(self.name, next(iter(times.values())), (), np.zeros((0, 0)), 0)]
        return [
            Signals(
                self.name, times[group[0]], tuple(group), np.array([signals[c] for c in group], dtype=float),
                sum(channel in self.inputs for channel in group),
            )
            for group in groups.values()
        ]  # fmt: skip

    def __repr__(self) -> str:
        kind = "synthetic recording" if self.synthetic else "recording"
        if not isinstance(self.time, Mapping):
            return (
                f"Recording({self.name!r}: {kind} of {self.time.size} samples at {self.sampling_rate:.6g} Hz, "
                f"inputs {list(self.inputs)}, outputs {list(self.outputs)})"
            )
        listed = []
        for label, channels in (("inputs", self.inputs), ("outputs", self.outputs)):
            same: dict[int, list[str]] = {}
            for channel in channels:
                same.setdefault(id(self.time[channel]), []).append(channel)
            each = [(names, self.time[names[0]]) for names in same.values()]
            shown = [f"{names} ({time.size} samples at {_rate(time):.6g} Hz)" for names, time in each]
            listed += [f"{label} {', '.join(shown)}"] if shown else []
        return f"Recording({self.name!r}: {kind} of {', '.join(listed)})"


@dataclass(frozen=True, repr=False)
class FromFile(Channels):
    """Channels that are read from files."""

    @overload
    @classmethod
    def from_file(cls, path: str | Path, *, split: None = None, **arguments: Any) -> Self: ...

    @overload
    @classmethod
    def from_file(cls, path: str | Path, *, split: Key, **arguments: Any) -> list[Self]: ...

    @classmethod  # type: ignore[misc]
    def from_file(
        cls,
        path: str | Path,
        *,
        outputs: Mapping[str, Key],
        inputs: Mapping[str, Key] | None = None,
        time: Key | None = None,
        sampling_rate: Rate = None,
        units: Units | None = None,
        format: str | None = None,
        missing: str | None = None,
        split: Key | None = None,
        name: str | None = None,
        encoding: str | None = None,
        separator: str | None = None,
        decimal: str | None = None,
        thousands: str | None = None,
        header: int | None = None,
        date_format: str | None = None,
    ) -> Self | list[Self]:
        """Read a recording from a file of one of eleven formats.

        `bayesperiodic.inspect` prints what is in a file, and the call that reads it. The formats are CSV and other
        texts, NPZ, MAT, HDF5 and WAV, and with ``pip install "bayesperiodic[files]"`` UFF 58, TDMS, MDF, LVM, Parquet
        and Excel.

        Parameters
        ----------
        path : path
        outputs, inputs : mapping of str to str, int or (group, name)
            Channel in the file by channel of the model, such as ``{"force": "Force [N]"}``, or the number of a column
            from 1.
        time : str, int or (group, name), optional
            Channel of times [s], or of dates or times of day, such as 2026-01-31T12:00:00.01, 31.01.2026 12:00:00,01
            or 12:00:00.01, which are converted to seconds from the first one. By default the times that the file has
            for each channel; channels with different ones keep them.
        sampling_rate : float or mapping of channel to float, optional
            Sampling rate [Hz], if the file does not say it, or with too few digits.
        units : mapping of str to float, unit or (from, to), optional
            Conversion of a channel (or of "time"). If the file says the unit, it is converted to SI by default (angles
            to rad, temperatures to K), or to the unit given here, such as ``{"x": "mm"}``. If not, values are taken as
            they are, or are converted by a factor or a pair such as ``("mm", "m")``. Angles must be in both units or
            in neither; a hertz is a cycle per second where the other unit has an angle: ``("rpm", "Hz")`` divides by
            60, ``("Hz", "rad/s")`` multiplies by 2π. Temperatures are absolute, differences are "delta_degC".
            Logarithmic units such as dB, and names of two units such as g, are refused.
        format : str, optional
            "csv", "npz", "mat", "uff", "tdms", "mdf", "lvm", "wav", "hdf5", "parquet" or "excel"; by default it is
            recognised by the first bytes of the file.
        missing : "drop" or "interpolate", optional
            What to do with NaN and empty cells (in a file with one column: empty lines), which are refused by default:
            leave them out of their channel, or interpolate linearly in time over at most three successive ones.
        split : str, int or (group, name), optional
            Column of numbers or texts that distinguishes successive records, such as the drive frequency: each part in
            which it is constant is a recording. `Recording.split` divides a recording by the steps of its drive.
        name : str, optional
            By default the file name without its extension.
        encoding, separator, decimal, thousands, header, date_format : optional
            Of texts, where they are not recognised: Python's name of the encoding, such as "latin-1" or "cp1252"; the
            characters between fields, before decimals and between thousands; the line of the names, from 1, or 0 for
            none; dates as `datetime.strptime` reads them, such as "%d.%m.%Y %H:%M:%S.%f". `header` also of Excel.

        Returns
        -------
        Recording, or list of Recording with `split`

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ImportError
            If the package for its format is not installed.
        ValueError
            As for `Recording`, and for a missing or repeated channel, rows with other numbers of fields than the
            header, a cell that is not a number, neither or both of ``time`` and ``sampling_rate`` for a file without
            times, an unknown or ambiguous unit, a damaged file, and one that can be read in several ways.

        Examples
        --------
        >>> import pathlib, tempfile, numpy as np, scipy.io.wavfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.wav"
        >>> swing = 0.5 * np.sin(2 * np.pi * 5 * np.arange(8000) / 8000)
        >>> scipy.io.wavfile.write(path, 8000, np.round(2**15 * swing).astype("int16"))
        >>> run = bp.Recording.from_file(path, outputs={"x": "channel 1"}, units={"x": 20.0})
        >>> run, round(float(run.outputs["x"].max()), 3)
        (Recording('run': recording of 8000 samples at 8000 Hz, inputs [], outputs ['x']), 10.0)
        """
        layout = Layout(Path(path).name, outputs, inputs or {}, time, sampling_rate, units or {}, missing)
        options = {
            "encoding": encoding,
            "separator": separator,
            "decimal": decimal,
            "thousands": thousands,
            "header": header,
            "date_format": date_format,
        }
        wanted = [*layout.wanted, *([] if split is None else [split])]
        contents = recognise.contents(path, format, wanted, options)
        return recordings(cls, layout, contents, split, name or Path(path).stem)

    @classmethod
    def from_csv(cls, path: str | Path, **arguments: Any) -> Any:
        """Read a recording from a text of columns.

        Parameters
        ----------
        path, **arguments
            As for `from_file`.

        Returns
        -------
        Recording, or list of Recording with `split`

        Raises
        ------
        FileNotFoundError, ValueError
            As for `from_file`.

        Examples
        --------
        >>> import pathlib, tempfile, numpy as np, pandas as pd
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
        >>> t = np.arange(500) / 50
        >>> pd.DataFrame({"t": t, "x_mm": 25 * np.sin(2 * np.pi * t)}).to_csv(path, index=False)
        >>> run = bp.Recording.from_csv(path, time="t", outputs={"x": "x_mm"}, units={"x": ("mm", "m")})
        >>> run.name, round(float(run.outputs["x"].max()), 3)
        ('run', 0.025)
        """
        return cls.from_file(path, format="csv", **arguments)

    @classmethod
    def from_npz(cls, path: str | Path, **arguments: Any) -> Any:
        """Read a recording from the named arrays of an NPZ file.

        Parameters
        ----------
        path, **arguments
            As for `from_file`, with arrays as channels.

        Returns
        -------
        Recording, or list of Recording with `split`

        Raises
        ------
        FileNotFoundError, ValueError
            As for `from_file`, and for an array of objects, which would have to be unpickled.
        """
        return cls.from_file(path, format="npz", **arguments)

    @classmethod
    def from_mat(cls, path: str | Path, **arguments: Any) -> Any:
        """Read a recording from the variables of a MAT file, version 5 or 7.3.

        Parameters
        ----------
        path, **arguments
            As for `from_file`, with variables as channels.

        Returns
        -------
        Recording, or list of Recording with `split`

        Raises
        ------
        FileNotFoundError, ValueError
            As for `from_file`, and for a file of version 4 or a variable that is not a vector of real numbers.
        """
        return cls.from_file(path, format="mat", **arguments)

    @classmethod
    def from_dataframe(cls, table: Any, **arguments: Any) -> Any:
        """Make a recording from the columns of a pandas DataFrame.

        Parameters
        ----------
        table : pandas.DataFrame
            Columns are channels; those with two levels of names are ``(group, name)``. An index of dates or durations
            has the times, another one with a name is a channel too. Units are those of ``table.attrs["units"]``, of
            a column's ``attrs["units"]``, of the type ``pint[…]`` of pint-pandas, or of names such as "x [mm]".
        **arguments
            ``outputs, inputs, time, sampling_rate, units, missing, split, name`` as for `from_file`.

        Returns
        -------
        Recording, or list of Recording with `split`

        Raises
        ------
        ValueError
            As for `from_file`.

        Examples
        --------
        >>> import numpy as np, pandas as pd
        >>> t = pd.timedelta_range("0s", periods=400, freq="10ms")
        >>> table = pd.DataFrame({"x": 25 * np.cos(2 * np.pi * t.total_seconds())}, index=t)
        >>> table.attrs["units"] = {"x": "mm"}
        >>> run = bp.Recording.from_dataframe(table, outputs={"x": "x"})
        >>> run, round(float(run.outputs["x"].max()), 4)
        (Recording('recording': recording of 400 samples at 100 Hz, inputs [], outputs ['x']), 0.025)
        """
        return _from_object(cls, "DataFrame", objects.dataframe(table), arguments)

    @classmethod
    def from_xarray(cls, dataset: Any, **arguments: Any) -> Any:
        """Make a recording from the variables of an xarray Dataset, or from a DataArray with a name.

        Parameters
        ----------
        dataset : Dataset or DataArray of xarray (samples,)
            Variables and coordinates with one dimension are channels. A coordinate of dates or durations, or of numbers
            whose ``attrs["units"]`` is a unit of time, has the times of the variables along its dimension; variables
            along others keep their own. Units are those of ``attrs["units"]``.
        **arguments
            ``outputs, inputs, time, sampling_rate, units, missing, split, name`` as for `from_file`.

        Returns
        -------
        Recording, or list of Recording with `split`

        Raises
        ------
        ValueError
            As for `from_file`.
        """
        return _from_object(cls, "Dataset", objects.dataset(dataset), arguments)

    @classmethod
    def from_sep005(cls, channels: Any, **arguments: Any) -> Any:
        """Make a recording from time series after SEP 005 of the project SDyPy, as its readers return them.

        Parameters
        ----------
        channels : list of dict
            Each has "data", "name" and "unit_str", "fs" [Hz] or "time" [s], and perhaps "group" and "start_timestamp"
            (ISO 8601), from which the times of channels with different starts are counted.
        **arguments
            ``outputs, inputs, time, sampling_rate, units, missing, split, name`` as for `from_file`.

        Returns
        -------
        Recording, or list of Recording with `split`

        Raises
        ------
        ValueError
            As for `from_file`, and for "fs" and "time" that contradict each other.

        Examples
        --------
        >>> import numpy as np
        >>> force = {"name": "F", "unit_str": "kN", "fs": 100.0, "data": np.cos(np.arange(400) / 10)}
        >>> run = bp.Recording.from_sep005([force], outputs={"force": "F"})
        >>> run, float(run.outputs["force"][0])
        (Recording('recording': recording of 400 samples at 100 Hz, inputs [], outputs ['force']), 1000.0)
        """
        return _from_object(cls, "the list", objects.sep005(channels), arguments)


def _from_object(cls: Any, label: str, contents: Contents, arguments: dict[str, Any]) -> Any:
    """Return the recording in an object in memory."""
    known = ("outputs", "inputs", "time", "sampling_rate", "units", "missing", "split", "name")
    for argument in arguments:
        _checks.one_of("arguments", argument, known)
    outputs, inputs, time, rate, units, missing, split, name = (arguments.get(argument) for argument in known)
    layout = Layout(label, {} if outputs is None else outputs, inputs or {}, time, rate, units or {}, missing)
    return recordings(cls, layout, contents, split, name or "recording")


def _rate(time: np.ndarray) -> float:
    return float((time.size - 1) / (time[-1] - time[0]))


def _increasing(argument: str, values: Any, name: str) -> np.ndarray:
    """Return times that increase."""
    time = _checks.measured_vector(argument, values)
    if time.size < 2:
        raise ValueError(f"{argument}: must have at least 2 samples, got {time.size} in {name!r}.")
    later = time[1:] > time[:-1]
    if not later.all():
        index = int(np.argmin(later))
        raise ValueError(
            f"{argument}: must increase, got {time[index + 1]:g} s after {time[index]:g} s at index {index + 1} of "
            f"{name!r}; a file of several records is divided by `from_csv(split=…)`."
        )
    return time
