"""Channels and the times at which they were sampled."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._io import Result
from bayesperiodic.data.signals import Signals
from bayesperiodic.data.times import channel_seconds, seconds, shared


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
