"""Contents of a file of measurements: channels with units and times, and what a user would not guess about them."""

import contextlib
import importlib
import logging
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bayesperiodic import _checks

# Bytes of an array, against files that unpack to more than the memory.
LARGEST_ARRAY = 2**31
# Ends of messages.
BY_RATE = "sampling_rate= gives it"
OTHERWISE = "read the part that you need with h5py or NumPy, and give it to from_arrays"

Key = str | int | tuple[str, str]


@dataclass(frozen=True, eq=False)
class Clock:
    """Times of channels: evenly spaced by `step`, or `stored` in the file; channels with one clock share the object.

    Times count from `origin`, in UTC, if the file has one. A step that the file gives with few `digits` is
    ``step ± error``; `refusal` says why the times cannot be used, and `sampling_rate=` takes their place.
    """

    start: float = 0.0  # of the first sample [s]
    step: float = float("nan")  # [s]
    stored: Callable[[], np.ndarray] | None = None  # times [s] of all samples, in place of start and step
    origin: np.datetime64 | None = None
    error: float = 0.0  # of the step [s], half a unit of its last digit
    refusal: str = ""
    remarks: tuple[str, ...] = ()

    def times(self, samples: int) -> np.ndarray:
        """Return the times of all samples [s]."""
        if self.stored is not None:
            return self.stored()
        times = np.arange(samples, dtype=float)
        times *= self.step
        times += self.start
        return times


@dataclass(frozen=True, eq=False)
class StoredChannel:
    """A channel of a file.

    `values` returns its physical values, with the scale of the file applied: numbers, dates or texts, in an array that
    nobody else has. `refusal` says why they cannot be used, and what to do; `remarks` say what a user would not guess.
    """

    name: str
    samples: int
    values: Callable[[], Any]
    group: str = ""
    unit: str = ""  # as in the file
    clock: Clock | None = None  # None: the file does not say when it was sampled
    remarks: tuple[str, ...] = ()
    refusal: str = ""
    frequencies: Callable[[], np.ndarray] | None = None  # [Hz] of a frequency response, whose values are complex

    @property
    def label(self) -> str:
        """Name, with the group if there is one."""
        return f"{self.group}/{self.name}" if self.group else self.name


@dataclass(frozen=True, eq=False)
class Contents:
    """Channels of a file in its order, and remarks on the whole of it.

    Names of channels differ within a group. `word` is what the format calls a channel, `suggested_time` the channel
    that seems to hold the times of all.
    """

    kind: str  # such as "TDMS file"
    channels: tuple[StoredChannel, ...]
    remarks: tuple[str, ...] = ()
    word: str = "channel"
    suggested_time: str = ""
    numbered: bool = True  # whether a channel is also found by its number; else numbers are names

    def find(self, file: str, key: Key) -> StoredChannel:
        """Return the channel of a name, a number from 1, or a pair of group and name; the error names those there."""
        argument = f"{self.word} of {file}"
        if isinstance(key, int) and not self.numbered:
            key = str(key)
        if isinstance(key, int) and not isinstance(key, bool):
            if not 1 <= key <= len(self.channels):
                raise ValueError(f"{argument}: must be a number from 1 to {len(self.channels)}, got {key!r}.")
            return self.channels[key - 1]
        if isinstance(key, tuple | list):
            matches = [channel for channel in self.channels if (channel.group, channel.name) == tuple(key)]
            if not matches:
                listed = ", ".join(repr((channel.group, channel.name)) for channel in self.channels[:20])
                raise ValueError(f"{argument}: must be one of {listed}, got {tuple(key)!r}.")
        else:
            matches = [channel for channel in self.channels if channel.name == key]
            if not matches:
                _checks.one_of(argument, key, [channel.name for channel in self.channels])
        if len(matches) > 1:
            pairs = ", ".join(repr((channel.group, channel.name)) for channel in matches)
            raise ValueError(
                f"{argument}: must be the name of one {self.word}, got {key!r}, the name of {len(matches)}; give the "
                f"group too: {pairs}."
            )
        return matches[0]


def package(module: str, distribution: str, kind: str) -> Any:
    """Return an optional package; the error says how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"format: must be one whose package is installed, got {kind}, which is read by {distribution} ({error}); "
            'pip install "bayesperiodic[files]".'
        ) from None


@contextlib.contextmanager
def silenced(name: str) -> Iterator[None]:
    """Let a package write no messages and warn of nothing; what they would say is found out and said here."""
    names = [one for one in [*logging.root.manager.loggerDict] if one.split(".")[0] == name]
    before = {one: one.disabled for one in map(logging.getLogger, names)}
    try:
        for one in before:
            one.disabled = True
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for one, disabled in before.items():
            one.disabled = disabled


def existing(path: str | Path) -> Path:
    """Return the path; raise a FileNotFoundError if there is no such file."""
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"path: must be an existing file, got {str(path)!r}.")
    return file


def unique_names(names: Iterable[str]) -> Iterator[str]:
    """Yield names that differ: later ones of a name get its number, such as "force (2)"."""
    used: set[str] = set()
    for name in names:
        number, new = 1, name
        while new in used:
            number += 1
            new = f"{name} ({number})"
        used.add(new)
        yield new
