"""Recordings: measured signals over time."""

import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.data.folding import Signals, fold_signals


def read_csv(path: str | Path, columns: Iterable[str]) -> dict[str, np.ndarray]:
    """Return named columns of a CSV file with a header line."""
    import pandas as pd

    try:
        table = pd.read_csv(existing(path), skipinitialspace=True, low_memory=False)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise ValueError(f"path: must be a CSV file with a header line, got {str(path)!r} ({error}).") from None
    table.columns = [str(name).strip() for name in table.columns]
    columns, names = [*columns], [*table.columns]
    if not {*columns} <= {*names} and _is_no_header(names):
        raise ValueError(
            f"path: must be a CSV file whose first line names the columns, separated by commas, got {str(path)!r}, "
            f"whose first line is read as {names}. Numbers must have a decimal point."
        )
    result = {}
    for column in columns:
        values = _pick(path, table, column)
        if not pd.api.types.is_numeric_dtype(values):
            row = int(np.flatnonzero(pd.to_numeric(values, errors="coerce").isna() & values.notna())[0])
            raise ValueError(
                f"column {column!r} of {Path(path).name}: must contain numbers, with a decimal point, got "
                f"{values.iloc[row]!r} in data row {row + 1}."
            )
        result[column] = _numbers(path, column, values.to_numpy())
    return result


def read_npz(path: str | Path, columns: Iterable[str]) -> dict[str, np.ndarray]:
    """Return named arrays of an NPZ file, without loading pickled objects."""
    try:
        with np.load(existing(path), allow_pickle=False) as archive:
            return {c: _numbers(path, c, _pick(path, archive, c)) for c in columns}
    except (zipfile.BadZipFile, EOFError, AttributeError, TypeError) as error:
        raise ValueError(
            f"path: must be an NPZ file of named arrays (numpy.savez), got {str(path)!r} ({error})."
        ) from None
    except ValueError as error:
        if "allow_pickle" in str(error):
            raise ValueError(
                f"path: must be an NPZ file without pickled objects, got {str(path)!r}. Save numeric arrays by "
                "numpy.savez, or read a CSV or MAT file by from_csv or from_mat."
            ) from None
        raise


def read_mat(path: str | Path, columns: Iterable[str]) -> dict[str, np.ndarray]:
    """Return named variables of a MAT file, version 5 or 7.3."""
    import h5py
    from scipy.io import loadmat

    file = existing(path)
    if h5py.is_hdf5(file):
        with h5py.File(file, "r") as archive:
            return {c: _numbers(path, c, np.asarray(_pick(path, archive, c))) for c in columns}
    try:
        variables = {name: value for name, value in loadmat(file).items() if not name.startswith("__")}
    except (ValueError, TypeError, NotImplementedError, EOFError) as error:
        raise ValueError(f"path: must be a MAT file, got {str(path)!r} ({error}).") from None
    return {c: _numbers(path, c, _pick(path, variables, c)) for c in columns}


def existing(path: str | Path) -> Path:
    """Return the path; raise a FileNotFoundError if there is no such file."""
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"path: must be an existing file, got {str(path)!r}.")
    return file


def _is_no_header(names: list[str]) -> bool:
    """Return whether a first line contains numbers, or separators other than commas."""
    if len(names) == 1 and any(mark in names[0] for mark in ";\t"):
        return True
    try:
        return bool([float(name) for name in names])
    except ValueError:
        return False


def _pick(path: str | Path, source: Any, column: str) -> Any:
    _checks.one_of(f"column of {Path(path).name}", column, list(source.keys()))
    return source[column]


def _numbers(path: str | Path, column: str, values: Any) -> np.ndarray:
    argument = f"column {column!r} of {Path(path).name}"
    array = np.squeeze(np.asarray(values))
    if array.ndim != 1 or array.dtype.kind not in "fiub":
        raise ValueError(
            f"{argument}: must be one column of real numbers, got shape {np.shape(values)} and type {array.dtype}."
        )
    return array.astype(float)


def convert(name: str, values: np.ndarray, unit: float | Sequence[str]) -> np.ndarray:
    """Return the values of a channel, multiplied by a factor or converted by a pair of units such as ("mm", "m")."""
    argument = f"units[{name!r}]"
    if isinstance(unit, int | float):
        factor = _checks.finite_number(argument, unit)
        if factor == 0.0:
            raise ValueError(f"{argument}: must not be zero, got {unit!r}.")
        return values * factor
    if isinstance(unit, str) or len(unit) != 2 or not all(isinstance(u, str) for u in unit):
        raise ValueError(f"{argument}: must be a factor or a pair such as ('mm', 'm'), got {unit!r}.")
    import pint

    try:
        return np.asarray(pint.UnitRegistry().Quantity(values, unit[0]).to(unit[1]).magnitude, dtype=float)
    except (pint.errors.PintError, AssertionError, TypeError, ValueError) as error:
        raise ValueError(
            f"{argument}: must be two units of the same dimension, got {tuple(unit)!r} ({error})."
        ) from None


Units = Mapping[str, float | Sequence[str]]


@dataclass(frozen=True)
class Recording(Result):
    """Signals measured at the same times.

    Attributes
    ----------
    time : array (samples,)
        Strictly increasing times [s]; the steps need not be equal.
    outputs, inputs : dict of str to array (samples,)
    name : str
    synthetic : bool
        True if the recording was simulated.

    Raises
    ------
    ValueError
        For fewer than two samples, samples that are NaN or infinite, different lengths, a time that does not increase,
        no output, names that are repeated or not identifiers.

    Examples
    --------
    >>> t = np.arange(0, 60, 0.01)
    >>> recording = bp.Recording.from_arrays(t, {"angle": np.sin(2 * np.pi * 1.3 * t)}, name="swing")
    >>> recording.between(10, 50)
    Recording('swing': recording of 4001 samples at 100 Hz, inputs [], outputs ['angle'])
    >>> experiment = recording.fold(samples=64)
    >>> print(f"{experiment.cycles} cycles at {experiment.frequency:.6f} Hz")
    78 cycles at 1.300000 Hz
    """

    time: np.ndarray
    outputs: dict[str, np.ndarray]
    inputs: dict[str, np.ndarray]
    name: str = "recording"
    synthetic: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", _checks.finite_vector("time", self.time))
        if self.time.size < 2:
            raise ValueError(f"time: must have at least 2 samples, got {self.time.size}.")
        step = np.diff(self.time)
        if np.any(step <= 0):
            index = int(np.flatnonzero(step <= 0)[0])
            raise ValueError(
                f"time: must increase, got {self.time[index + 1]:g} s after {self.time[index]:g} s at index "
                f"{index + 1}."
            )
        if not self.outputs:
            raise ValueError("outputs: must have at least one channel, got none.")
        _checks.identifiers("outputs and inputs", (*self.outputs, *self.inputs))
        for kind in ("outputs", "inputs"):
            channels = {
                name: _checks.finite_vector(f"{kind}[{name!r}]", values, self.time.size, "one per time")
                for name, values in getattr(self, kind).items()
            }
            object.__setattr__(self, kind, channels)

    @property
    def sampling_rate(self) -> float:
        """Mean sampling rate [Hz]."""
        return float((self.time.size - 1) / (self.time[-1] - self.time[0]))

    @classmethod
    def from_arrays(
        cls, time: Any, outputs: Mapping[str, Any], inputs: Mapping[str, Any] | None = None, *, name: str | None = None
    ) -> "Recording":
        """Make a recording from arrays, pandas Series or xarray DataArrays.

        Parameters
        ----------
        time : array (samples,)
            Strictly increasing times [s].
        outputs, inputs : mapping of str to array (samples,)
            Values in the units of the model's channels.
        name : str, optional
            By default "recording".

        Returns
        -------
        Recording

        Raises
        ------
        ValueError
            As for `Recording`.
        """
        measured = _checks.mapping("outputs", outputs, "{'force': values}")
        given = _checks.mapping("inputs", {} if inputs is None else inputs, "{'force': values}")
        return cls(time, dict(measured.items()), dict(given.items()), name or "recording")

    @classmethod
    def from_csv(
        cls,
        path: str | Path,
        *,
        outputs: Mapping[str, str],
        inputs: Mapping[str, str] | None = None,
        time: str | None = None,
        sampling_rate: float | None = None,
        units: Units | None = None,
        name: str | None = None,
    ) -> "Recording":
        """Read a recording from a CSV file with a header line.

        Parameters
        ----------
        path : path
        outputs, inputs : mapping of str to str
            Column in the file by channel, such as ``{"force": "force_N"}``.
        time : str, optional
            Column of times [s].
        sampling_rate : float, optional
            Sampling rate [Hz], if the file has no column of times.
        units : mapping of str to float or (from, to), optional
            Conversion of a channel (or of "time") by a factor or a pair of units such as ``("mm", "m")``.
        name : str, optional
            By default the file name without its extension.

        Returns
        -------
        Recording

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            As for `Recording`, and for a missing column, a cell that is not a number, both or neither of ``time`` and
            ``sampling_rate``, an unknown unit.

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
        return cls._from_file(read_csv, path, outputs, inputs, time, sampling_rate, units, name)

    @classmethod
    def from_npz(
        cls,
        path: str | Path,
        *,
        outputs: Mapping[str, str],
        inputs: Mapping[str, str] | None = None,
        time: str | None = None,
        sampling_rate: float | None = None,
        units: Units | None = None,
        name: str | None = None,
    ) -> "Recording":
        """Read a recording from the named arrays of an NPZ file.

        Parameters
        ----------
        path, outputs, inputs, time, sampling_rate, units, name
            As for `from_csv`, with arrays in place of columns.

        Returns
        -------
        Recording

        Raises
        ------
        FileNotFoundError, ValueError
            As for `from_csv`, and for an array of objects, which would have to be unpickled.
        """
        return cls._from_file(read_npz, path, outputs, inputs, time, sampling_rate, units, name)

    @classmethod
    def from_mat(
        cls,
        path: str | Path,
        *,
        outputs: Mapping[str, str],
        inputs: Mapping[str, str] | None = None,
        time: str | None = None,
        sampling_rate: float | None = None,
        units: Units | None = None,
        name: str | None = None,
    ) -> "Recording":
        """Read a recording from the variables of a MAT file, version 5 or 7.3.

        Parameters
        ----------
        path, outputs, inputs, time, sampling_rate, units, name
            As for `from_csv`, with variables in place of columns.

        Returns
        -------
        Recording

        Raises
        ------
        FileNotFoundError, ValueError
            As for `from_csv`, and for a variable that is not a vector of real numbers.
        """
        return cls._from_file(read_mat, path, outputs, inputs, time, sampling_rate, units, name)

    @classmethod
    def _from_file(
        cls,
        read: Callable[[str | Path, Iterable[str]], dict[str, np.ndarray]],
        path: str | Path,
        outputs: Mapping[str, str],
        inputs: Mapping[str, str] | None,
        time: str | None,
        sampling_rate: float | None,
        units: Units | None,
        name: str | None,
    ) -> "Recording":
        example = "{'force': 'the column of the force'}"
        _checks.mapping("outputs", outputs, example)
        inputs, units = _checks.mapping("inputs", {} if inputs is None else inputs, example), units or {}
        if (time is None) == (sampling_rate is None):
            raise ValueError(f"time: must be given or sampling_rate, and not both, got {time!r} and {sampling_rate!r}.")
        for key in units:
            _checks.one_of("units", key, ("time", *outputs, *inputs))
        wanted = dict.fromkeys([*([time] if time else []), *outputs.values(), *inputs.values()])
        columns = read(path, wanted)

        def channel(key: str, column: str) -> np.ndarray:
            values = _checks.finite_vector(f"{key} (column {column!r} of {Path(path).name})", columns[column])
            return convert(key, values, units[key]) if key in units else values

        measured, given = ({key: channel(key, name) for key, name in kind.items()} for kind in (outputs, inputs))
        if time:
            seconds = channel("time", time)
        else:
            samples = next((values.size for values in (measured | given).values()), 0)
            seconds = np.arange(samples) / _checks.positive("sampling_rate", sampling_rate)
        return cls(seconds, measured, given, name or Path(path).stem)

    def between(self, start: float, stop: float) -> "Recording":
        """Return the part with start ≤ time ≤ stop.

        Parameters
        ----------
        start, stop : float
            Times [s].

        Returns
        -------
        Recording

        Raises
        ------
        ValueError
            If fewer than two samples remain.
        """
        keep = (self.time >= start) & (self.time <= stop)
        if keep.sum() < 2:
            raise ValueError(
                f"start, stop: must select at least two samples between {self.time[0]:g} and {self.time[-1]:g} s, got "
                f"{start!r}, {stop!r}."
            )
        outputs, inputs = ({key: values[keep] for key, values in kind.items()} for kind in (self.outputs, self.inputs))
        return replace(self, time=self.time[keep], outputs=outputs, inputs=inputs)

    def fold(
        self,
        samples: int = 800,
        *,
        frequency: float | None = None,
        periods: int = 1,
        harmonics: int | Mapping[str, int] | None = None,
        origin: float | str = 0.0,
        largest_drift: float | None = None,
        name: str | None = None,
    ) -> Experiment:
        """Fold the steady part of the recording into its mean period on an equidistant grid.

        The whole cycles after the transient are used. The fundamental frequency is estimated by least squares over all
        of them. The mean period is a least-squares Fourier series, so that the sampling rate may be arbitrary.

        The variance of the mean's amplitudes is measured harmonic by harmonic. The spectrum of K cycles has lines at
        multiples of 1/K of the fundamental, and those between the harmonics contain noise only; the variance at a
        harmonic is the mean power of the nearest K/4 lines (from 4 to 16, at most K/2) on each side. The variance of
        harmonic 0 is extrapolated from the lines above it, as that of white, exponentially correlated or 1/f noise,
        whichever explains them. Noise that lasts longer than the recording cannot be told from the mean value.
        Values that are multiples of one step, of eight or more, have quantisation errors; the part of them that repeats
        in every cycle, and that no average removes, is added.

        Parameters
        ----------
        samples : int
            Grid points per forcing period.
        frequency : float, optional
            Exact forcing frequency [Hz]; by default it is estimated, with a standard error.
        periods : int
            Forcing periods per response period.
        harmonics : int or mapping of str to int, optional
            Harmonics of the response period to keep, for all channels or by channel. By default each channel keeps all
            harmonics up to the last one that is significant relative to the noise around it: an F-test on the
            squared amplitude, with a false-alarm rate of 1 % over all harmonics tested.
        origin : float or "crossing"
            Time [s] at which τ = 0. "crossing", for autonomous systems, whose phase is arbitrary: the first time >= 0
            at which the fundamental of the first output crosses zero upwards.
        largest_drift : float, optional
            Limit of the relative change of a channel's fundamental over the recording, by linear regression.
        name : str, optional
            By default the recording's name.

        Returns
        -------
        Experiment
            NOPE

        Raises
        ------
        ValueError
            For fewer than three cycles, a constant channel, a signal that is not periodic, more harmonics than the
            samples resolve, an unknown channel in `harmonics`, a drift beyond the limit.

        Examples
        --------
        The displacement of an oscillator with noise of 0.1 mm; forcing and sampling rate are incommensurate:

        >>> recording = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, force, frequency=0.1,
        ...                         duration=400, sampling_rate=9.7, noise={"displacement": 1e-4}, seed=1)
        >>> run = recording.fold(samples=64, harmonics={"displacement": 9}, name="run 1")
        >>> print(f"{run.frequency:.4f} Hz, {run.independent['displacement']} independent values")
        0.1000 Hz, 19 independent values
        """
        periods, samples = _checks.integer("periods", periods, 1), _checks.integer("samples", samples, 4)
        channels = self.inputs | self.outputs
        signals = Signals(self.name, self.time, tuple(channels), np.stack([*channels.values()]), len(self.inputs))
        folded = fold_signals(signals, samples, periods, frequency, harmonics, origin, largest_drift)
        return Experiment(name or self.name, synthetic=self.synthetic, **folded)

    def __repr__(self) -> str:
        kind = "synthetic recording" if self.synthetic else "recording"
        return (
            f"Recording({self.name!r}: {kind} of {self.time.size} samples at {self.sampling_rate:.6g} Hz, "
            f"inputs {list(self.inputs)}, outputs {list(self.outputs)})"
        )
