"""Backends of emcee: chains in memory, and checkpoints, one HDF5 file, always complete."""

import io
import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import emcee
import h5py
import numpy as np

from bayesperiodic import _hdf5
from bayesperiodic._files import in_folder, locked, read_sealed, remove_drafts, write_sealed
from bayesperiodic.problem.description import Description
from bayesperiodic.problem.fingerprint import changed_parts, fingerprint

PATIENCE = 20.0
MARK, RUN = "fingerprint", "run"


class ColumnBackend(emcee.backends.Backend):
    """emcee's backend with an array for each coordinate, so that chains grow without a second copy of them."""

    def reset(self, nwalkers: int, ndim: int) -> None:
        """Remove all steps."""
        super().reset(nwalkers, ndim)
        self.columns, self.log_prob = [np.empty((0, nwalkers)) for _ in range(ndim)], np.empty((0, nwalkers))
        self.first = 0
        self.blobs: np.ndarray | None = None

    def grow(self, ngrow: int, blobs: np.ndarray | None) -> None:
        """Add the space of some steps."""
        if blobs is not None and self.blobs is None:
            self.blobs = np.empty((0, *blobs.shape))
        self._keep(0, self.iteration - self.first + ngrow)

    def forget(self, first: int) -> None:
        """Give back the memory of the steps before one."""
        if first > self.first:
            self._keep(first - self.first, self.iteration - first)
            self.first = first

    def _keep(self, first: int, count: int) -> None:
        """Make arrays of so many rows, with what there is from the row `first` on."""

        def moved(values: np.ndarray) -> np.ndarray:
            result, old = np.empty((count, *values.shape[1:])), values[first : first + count]
            result[: len(old)] = old
            return result

        for k, column in enumerate(self.columns):
            self.columns[k] = moved(column)
        self.log_prob = moved(self.log_prob)
        if self.blobs is not None:
            self.blobs = moved(self.blobs)

    def save_step(self, state: emcee.State, accepted: np.ndarray) -> None:
        """Add a step."""
        self._check(state, accepted)
        row = self.iteration - self.first
        for column, values in zip(self.columns, state.coords.T, strict=True):
            column[row] = values
        self.log_prob[row] = state.log_prob
        if self.blobs is not None:
            self.blobs[row] = state.blobs
        self.accepted += accepted
        self.random_state = state.random_state
        self.iteration += 1

    def columns_since(self, first: int) -> list[np.ndarray]:
        """Return the coordinates (steps, walkers) from a step on."""
        return [column[first - self.first : self.iteration - self.first] for column in self.columns]

    def get_value(self, name: str, discard: int = 0) -> np.ndarray | None:
        """Return the chain (steps, walkers, coordinates), a copy, or what belongs to it, from a step on."""
        if name == "chain":
            return np.stack(self.columns_since(discard), axis=-1)
        values = getattr(self, name)
        return None if values is None else values[discard - self.first : self.iteration - self.first]


class MemoryBackend(emcee.backends.HDFBackend):
    """emcee's HDF5 backend on a file in memory."""

    def __init__(self, content: bytes = b""):
        super().__init__("in memory")
        self._buffer = io.BytesIO(content)
        self.file = h5py.File(self._buffer, "a")

    @property
    def initialized(self) -> bool:
        """Whether there is a chain."""
        return self.name in self.file

    @contextmanager
    def open(self, mode: str = "r") -> Iterator[h5py.File]:
        """Return the file, which stays open."""
        yield self.file

    def columns_since(self, first: int) -> list[np.ndarray]:
        """Return the coordinates (steps, walkers) from a step on."""
        return [np.ascontiguousarray(column) for column in np.moveaxis(self.get_chain(discard=first), -1, 0)]

    def content(self) -> memoryview:
        """Return the file as bytes, without the space of steps that were not made."""
        if self.initialized:
            group = self.file[self.name]
            for name in {"chain", "log_prob", "blobs"} & {*group}:
                group[name].resize(self.iteration, axis=0)
        self.file.flush()
        return self._buffer.getbuffer()


class Checkpoint:
    """A file with all steps up to some moment; an interrupted write leaves the previous content.

    emcee's HDF5 backend writes every step in pieces, and a run killed between two of them leaves a damaged file. Here
    its file is in memory; from time to time it is written to a new file, which then replaces the old one. The time
    between is at least twenty times the time of a write.
    Problem and settings (seed, numbers of ensembles and walkers …) must be equal when a run is resumed.
    """

    def __init__(self, path: str | Path, problem: Description, settings: str):
        self._path, self._mark = Path(path), f"{fingerprint(problem)}; {settings}"
        self._held, self._next = ExitStack(), 0.0

    def __enter__(self) -> "Checkpoint":
        given = str(self._path)
        try:
            self._path = in_folder(self._path)  # from now on the file itself: links and the current folder may change
            self._held.enter_context(locked(self._path))
        except BlockingIOError:
            raise ValueError(
                f"checkpoint: must not be in use by another run, got {given!r}; wait, or name another file."
            ) from None
        except (OSError, NotImplementedError) as error:
            text = f"path: must be a writable file, got {given!r} ({error}); name another file."
            text = str(error) if str(error).startswith("path: ") else text
            raise ValueError(text.replace("path", "checkpoint", 1)) from None
        remove_drafts(self._path)
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def load(self) -> tuple[MemoryBackend, dict[str, Any]]:
        """Return the chain of the file and the state of its run; both are empty if there is no file."""
        if not self._path.exists():
            return MemoryBackend(), {}
        try:
            content = read_sealed(self._path)
            _hdf5.check_all(content)
            backend = MemoryBackend(content)
            mark = str(backend.file.attrs.get(MARK, "no run of this package"))
            state = json.loads(backend.file[RUN][()])
            _ = backend.get_last_sample(), backend.accepted
        except Exception as error:  # whatever HDF5, JSON and emcee raise for damaged files
            raise ValueError(
                f"checkpoint: must be an intact file, got {str(self._path)!r} ({error}); name another file or delete "
                "it."
            ) from None
        if mark != self._mark:
            (problem, _, settings), (current, _, wanted) = mark.partition("; "), self._mark.partition("; ")
            other = ", ".join(changed_parts(problem, current))
            raise ValueError(
                f"checkpoint: must be a file of this run ({wanted}), got {str(self._path)!r} of another run "
                f"({f'a problem with other {other}' if other else settings}); name another file or delete it."
            )
        return backend, state

    def save(self, backend: MemoryBackend, state: dict[str, Any], *, now: bool = False) -> None:
        """Write all steps so far; without `now` only if the last write was long enough ago.

        An OSError, such as that of a full disk, leaves the previous file.
        """
        started = time.monotonic()
        if not now and started < self._next:
            return
        backend.file.attrs[MARK] = self._mark
        if RUN in backend.file:
            del backend.file[RUN]
        backend.file.create_dataset(RUN, data=json.dumps(state))
        with backend.content() as content:
            try:
                write_sealed(self._path, content)
            except OSError as error:
                raise OSError(
                    error.errno,
                    f"checkpoint: cannot be written ({error.strerror}, {len(content) / 1e6:.3g} MB needed); an earlier "
                    "one is intact, and the same call goes on from it",
                    str(self._path),
                ) from error
        ended = time.monotonic()
        self._next = ended + PATIENCE * (ended - started)
