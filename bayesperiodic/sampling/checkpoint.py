"""Checkpoints of sampling runs: one HDF5 file, always complete, in the format of emcee's backend."""

import hashlib
import json
import os
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import emcee
import h5py
import numpy as np
from filelock import FileLock, Timeout

from bayesperiodic.posterior.description import Description

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
            with h5py.File(self._path, "r") as file:
                found = file.attrs.get(MARK, "no run of this package")
                if found != self._mark:
                    raise ValueError(
                        f"checkpoint: must be a file of this run ({self._mark}), got {str(self._path)!r} of another "
                        f"run ({found}); name another file or delete it."
                    )
                state = json.loads(file[RUN][()])
                names = sorted((name for name in file if name.startswith("ensemble ")), key=lambda name: int(name[9:]))
        except OSError as error:
            raise ValueError(
                f"checkpoint: must be an intact HDF5 file, got {str(self._path)!r} ({error}); name another file or "
                "delete it."
            ) from None
        stored = [emcee.backends.HDFBackend(str(self._path), name=name, read_only=True) for name in names]
        return Saved([_in_memory(backend) for backend in stored], state)

    def save(self, backends: Sequence[emcee.backends.Backend], state: dict[str, Any], *, now: bool = False) -> None:
        """Write all steps so far; without `now` only if the last write was long enough ago."""
        started = time.monotonic()
        if not now and started < self._next:
            return
        handle, draft = tempfile.mkstemp(prefix=f".{self._path.name}.", dir=self._path.parent)
        os.close(handle)
        try:
            with h5py.File(draft, "w") as file:
                file.attrs[MARK] = self._mark
                file.create_dataset(RUN, data=json.dumps(state))
                for number, backend in enumerate(backends):
                    _write(file.create_group(f"ensemble {number}"), backend)
            os.replace(draft, self._path)
        finally:
            Path(draft).unlink(missing_ok=True)
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


def fingerprint(problem: Description) -> str:
    """Return a digest of model, data, priors, fixed values, ties, noise model and scheme."""
    digest = hashlib.sha256(problem.model.symbolic.kernel_source().encode())
    for experiment in problem.experiments:
        names = ("name", "frequency", "samples", "periods", "winding", "independent", "harmonics", "frequency_se")
        blocks = [
            (b.channel, b.kind, b.count, b.averaged, b.measured) for b in problem.observations[experiment.name].blocks
        ]
        digest.update(repr((*(getattr(experiment, name) for name in names), blocks)).encode())
        for signals in (experiment.outputs, experiment.inputs):
            for name, values in signals.items():
                digest.update(name.encode() + np.ascontiguousarray(values).tobytes())
        for name in ("mask", "covariance", "multipliers", "multiplier_sd"):
            values = getattr(experiment, name)
            digest.update(name.encode() + (b"" if values is None else np.ascontiguousarray(values).tobytes()))
    settings = (problem.priors, problem.fixed, problem.tied, problem.noise, problem.likelihood.fixed, problem.scheme)
    digest.update(repr(settings).encode())
    return f"problem {digest.hexdigest()[:16]}"
