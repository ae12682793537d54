"""Recording: long measured signals, before they are folded into periods."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesperiodic import checks
from bayesperiodic.data import reading
from bayesperiodic.data.units import convert
from bayesperiodic.store import Result

if TYPE_CHECKING:
    from bayesperiodic.data.experiment import Experiment

Units = Mapping[str, float | Sequence[str]]


@dataclass(frozen=True)
class Recording(Result):
    """Signals measured together over time.

    Attributes
    ----------
    time : array (samples,)
        Strictly increasing [s]; the steps need not be equal.
    outputs, inputs : dict of str to array (samples,)
    name : str
    synthetic : bool
        True if the recording was simulated.
    """

    time: np.ndarray
    outputs: dict[str, np.ndarray]
    inputs: dict[str, np.ndarray]
    name: str = "recording"
    synthetic: bool = False

    def __post_init__(self) -> None:
        checks.finite_vector("time", self.time)
        if self.time.size < 2:
            raise ValueError(f"time: {self.time.size} samples are not allowed; a recording needs at least 2.")
        step = np.diff(self.time)
        if np.any(step <= 0):
            index = int(np.flatnonzero(step <= 0)[0])
            raise ValueError(
                f"time: {self.time[index + 1]:g} s after {self.time[index]:g} s at index {index + 1} is not allowed; "
                "time must increase."
            )
        if not self.outputs:
            raise ValueError("outputs: {} is not allowed; a recording needs at least one measured output.")
        checks.identifiers("outputs and inputs", (*self.outputs, *self.inputs))
        for kind, channels in (("outputs", self.outputs), ("inputs", self.inputs)):
            for name, values in channels.items():
                checks.finite_vector(f"{kind}[{name!r}]", values, self.time.size)

    @property
    def sampling_rate(self) -> float:
        """Mean sampling rate [Hz]."""
        return float((self.time.size - 1) / (self.time[-1] - self.time[0]))

    @classmethod
    def from_arrays(
        cls, time: Any, outputs: Mapping[str, Any], inputs: Mapping[str, Any] | None = None, *, name: str | None = None
    ) -> "Recording":
        """Make a recording of arrays, pandas Series or xarray DataArrays.

        Parameters
        ----------
        time : array (samples,)
            Strictly increasing [s].
        outputs, inputs : mapping of str to array (samples,)
        name : str, optional

        Raises
        ------
        ValueError
            For samples that are NaN or infinite, lengths that differ, or a time that does not increase.

        Examples
        --------
        >>> import numpy as np, bayesperiodic as bp
        >>> t = np.arange(1000) / 100
        >>> bp.Recording.from_arrays(t, {"angle": np.sin(2 * np.pi * 1.3 * t)}).sampling_rate
        100.0
        """
        time = checks.finite_vector("time", time)
        return cls(
            time,
            {key: checks.finite_vector(f"outputs[{key!r}]", values) for key, values in outputs.items()},
            {key: checks.finite_vector(f"inputs[{key!r}]", values) for key, values in (inputs or {}).items()},
            name or "recording",
        )

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
            [Hz], where the file has no column of times.
        units : mapping of str to float or (from, to), optional
            Conversion of a channel (or of "time") by a factor or a pair of units such as ``("mm", "m")``.
        name : str, optional
            By default the file's name without its ending.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            For a missing column, a cell that is no number, NaN or infinite samples, a time that does not increase,
            both or neither of `time` and `sampling_rate`, an unknown unit.
        """
        return cls._from_file(reading.read_csv, path, outputs, inputs, time, sampling_rate, units, name)

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
        """Read a recording from the arrays of an NPZ file; the arguments are those of `from_csv`."""
        return cls._from_file(reading.read_npz, path, outputs, inputs, time, sampling_rate, units, name)

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
        """Read a recording from a MAT file, version 5 or 7.3; the arguments are those of `from_csv`."""
        return cls._from_file(reading.read_mat, path, outputs, inputs, time, sampling_rate, units, name)

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
        inputs, units = inputs or {}, units or {}
        if (time is None) == (sampling_rate is None):
            raise ValueError(f"time: {time!r} with sampling_rate {sampling_rate!r} is not allowed; give exactly one.")
        for key in units:
            checks.one_of("units", key, ("time", *outputs, *inputs))
        wanted = dict.fromkeys([*([time] if time else []), *outputs.values(), *inputs.values()])
        columns = read(path, wanted)

        def channel(key: str, column: str) -> np.ndarray:
            values = checks.finite_vector(f"{key} (column {column!r} of {Path(path).name})", columns[column])
            return convert(key, values, units[key]) if key in units else values

        signals = {key: channel(key, column) for key, column in (*outputs.items(), *inputs.items())}
        if time:
            seconds = channel("time", time)
        else:
            samples = next(iter(signals.values())).size if signals else 0
            seconds = np.arange(samples) / checks.positive("sampling_rate", sampling_rate)
        return cls(
            seconds,
            {key: signals[key] for key in outputs},
            {key: signals[key] for key in inputs},
            name or Path(path).stem,
        )

    def between(self, start: float, stop: float) -> "Recording":
        """Return the part with start ≤ time ≤ stop [s]; raise a ValueError if fewer than two samples are left."""
        keep = (self.time >= start) & (self.time <= stop)
        if keep.sum() < 2:
            raise ValueError(
                f"start, stop: {start!r}, {stop!r} is not allowed; the recording runs from {self.time[0]:g} to "
                f"{self.time[-1]:g} s and two samples at least must remain."
            )
        return replace(
            self,
            time=self.time[keep],
            outputs={key: values[keep] for key, values in self.outputs.items()},
            inputs={key: values[keep] for key, values in self.inputs.items()},
        )

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
    ) -> "Experiment":
        """Fold the steady part of the recording into its mean period; see `folding.fold`."""
        from bayesperiodic.data.folding import fold

        return fold(
            self,
            samples,
            frequency=frequency,
            periods=periods,
            harmonics=harmonics,
            origin=origin,
            largest_drift=largest_drift,
            name=name,
        )

    def __repr__(self) -> str:
        kind = "synthetic recording" if self.synthetic else "recording"
        return (
            f"Recording({self.name!r}: {kind} of {self.time.size} samples at {self.sampling_rate:.6g} Hz, "
            f"inputs {list(self.inputs)}, outputs {list(self.outputs)})"
        )
