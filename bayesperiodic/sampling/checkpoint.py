"""Checkpoints of sampling runs: one HDF5 file, always complete, in the format of emcee's backend."""

import glob
import io
import json
import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import emcee
import h5py
import numpy as np
from filelock import FileLock, Timeout

from bayesperiodic._io import draft_prefix, read_sealed, write_sealed
from bayesperiodic.posterior.description import Description, changed_parts, fingerprint

PATIENCE = 20.0
MARK, RUN = "fingerprint", "run"


class Saved(NamedTuple):
    """Content of a checkpoint: the chains of each ensemble, in memory, and the other data needed to resume the run."""

    backends: list[emcee.backends.Backend]
    state: dict[str, Any]


class Checkpoint:
    """A file with all steps up to some moment; an interrupted write leaves the previous content.

    emcee's HDF5 backend writes every step in pieces, and a run killed between two of them leaves a damaged file. Here
    chains grow in memory; from time to time they are written to a new file, which then replaces the old one. The time
    between is at least twenty times the time of a write.
    Problem and settings (seed, numbers of ensembles and walkers …) must be equal when a run is resumed.
    """

    def __init__(self, path: str | Path, problem: Description, settings: str):
        self._path, self._mark = Path(path), f"{fingerprint(problem)}; {settings}"
        self._lock = FileLock(f"{path}.lock", timeout=0.0)
        self._next = 0.0

    def __enter__(self) -> "Checkpoint":
        try:
            self._lock.acquire()
        except Timeout:
            raise ValueError(
                f"checkpoint: must not be in use by another run, got {str(self._path)!r}; wait, or name another file."
            ) from None
        except OSError as error:
            raise ValueError(
                f"checkpoint: must be a writable file, got {str(self._path)!r} ({error}); name another file."
            ) from None
        for draft in self._path.parent.glob(f"{glob.escape(draft_prefix(self._path))}*"):  # of a killed process
            shutil.rmtree(draft, ignore_errors=True)
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            Path(self._lock.lock_file).unlink()
        self._lock.release()

    def load(self) -> Saved | None:
        """Return the content of the file; None if there is no file."""
        if not self._path.exists():
            return None
        try:
            with h5py.File(io.BytesIO(read_sealed(self._path)), "r") as file:
                found = str(file.attrs.get(MARK, "no run of this package"))
                state = json.loads(file[RUN][()])
            names = [f"ensemble {number}" for number in range(len(state["calls"]))]
            stored = [emcee.backends.HDFBackend(str(self._path), name=name, read_only=True) for name in names]
            saved = Saved([_in_memory(backend) for backend in stored], state)
        except Exception as error:  # whatever HDF5, JSON and emcee raise for damaged files
            raise ValueError(
                f"checkpoint: must be an intact file, got {str(self._path)!r} ({error}); name another file or delete "
                "it."
            ) from None
        if found != self._mark:
            (problem, _, settings), (own, _, wanted) = found.partition("; "), self._mark.partition("; ")
            other = ", ".join(changed_parts(problem, own))
            raise ValueError(
                f"checkpoint: must be a file of this run ({wanted}), got {str(self._path)!r} of another run "
                f"({f'a problem with other {other}' if other else settings}); name another file or delete it."
            )
        return saved

    def save(self, backends: Sequence[emcee.backends.Backend], state: dict[str, Any], *, now: bool = False) -> None:
        """Write all steps so far; without `now` only if the last write was long enough ago.

        An OSError, such as that of a full disk, leaves the previous file.
        """
        started = time.monotonic()
        if not now and started < self._next:
            return
        content = io.BytesIO()
        with h5py.File(content, "w") as file:
            file.attrs[MARK] = self._mark
            file.create_dataset(RUN, data=json.dumps(state))
            for number, backend in enumerate(backends):
                _write(file.create_group(f"ensemble {number}"), backend)
        try:
            write_sealed(self._path, content.getbuffer())
        except OSError as error:
            raise OSError(
                error.errno,
                f"checkpoint: cannot be written ({error.strerror}, {len(content.getbuffer()) / 1e6:.3g} MB needed); an "
                "earlier one is intact, and the same call goes on from it",
                str(self._path),
            ) from error
        ended = time.monotonic()
        self._next = ended + PATIENCE * (ended - started)


def _write(group: h5py.Group, backend: emcee.backends.Backend) -> None:
    """Write a chain in the layout of emcee's HDF5 backend."""
    walkers, dimension = backend.shape
    group.attrs["version"], group.attrs["nwalkers"], group.attrs["ndim"] = emcee.__version__, walkers, dimension
    group.attrs["has_blobs"], group.attrs["iteration"] = backend.has_blobs(), backend.iteration
    for number, part in enumerate(backend.random_state):
        group.attrs[f"random_state_{number}"] = part
    steps = backend.iteration
    group.create_dataset("accepted", data=backend.accepted)
    group.create_dataset("chain", data=backend.chain[:steps], maxshape=(None, walkers, dimension))
    group.create_dataset("log_prob", data=backend.log_prob[:steps], maxshape=(None, walkers))
    if backend.has_blobs():
        blobs = backend.blobs[:steps]
        group.create_dataset("blobs", data=blobs, maxshape=(None, *blobs.shape[1:]))


def _in_memory(stored: emcee.backends.HDFBackend) -> emcee.backends.Backend:
    """Return a chain read into memory, which can be extended."""
    backend = emcee.backends.Backend()
    backend.reset(*stored.shape)
    backend.iteration = stored.iteration
    backend.random_state = stored.random_state
    backend.accepted = np.array(stored.accepted)
    backend.chain, backend.log_prob = stored.get_chain(), stored.get_log_prob()
    if stored.has_blobs():
        backend.blobs = stored.get_blobs()
    return backend
