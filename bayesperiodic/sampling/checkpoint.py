"""Where a sampling run is kept while it goes on: one HDF5 file, always whole, that emcee's own backend reads."""

import hashlib
import json
import os
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import emcee
import h5py
import numpy as np
from filelock import FileLock, Timeout

from bayesperiodic.posterior.description import Description

PATIENCE = 20.0
MARK, RUN = "fingerprint", "run"


@dataclass(frozen=True)
class Saved:
    """What a checkpoint holds.

    Attributes
    ----------
    backends : list of emcee.backends.Backend
        In memory, one an ensemble.
    state : dict
        Whatever else the run needs to go on as if nothing had happened.
    """

    backends: list[emcee.backends.Backend]
    state: dict[str, Any]


class Checkpoint:
    """A file that holds all steps up to some moment, or the one before it, and never anything between.

    emcee's HDF5 backend writes every step in pieces, and a run killed between two of them leaves a torn file. Here
    chains grow in memory; now and then they are written to a new file that then takes the place of the old one. The
    time between is at least twenty times what writing takes.

    Parameters
    ----------
    path : path
    problem : Description
    settings : str
        What else must be the same for a run to go on: seed, numbers of ensembles and walkers, and so on.

    Raises
    ------
    ValueError
        If the file cannot be read, belongs to another problem or other settings, or is in use by another run.
    """

    def __init__(self, path: str | Path, problem: Description, settings: str):
        self._path, self._mark = Path(path), f"{fingerprint(problem)}; {settings}"
        self._lock = FileLock(f"{path}.lock", timeout=0.0)
        self._next = 0.0
        self._check()

    def __enter__(self) -> "Checkpoint":
        try:
            self._lock.acquire()
        except Timeout:
            raise ValueError(
                f"checkpoint: {str(self._path)!r} is in use by another run; wait for it, or name another file."
            ) from None
        except OSError as error:
            raise ValueError(f"checkpoint: {str(self._path)!r} cannot be used ({error}); name another file.") from None
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            Path(self._lock.lock_file).unlink()
        self._lock.release()

    def _check(self) -> None:
        if not self._path.exists():
            return
        try:
            with h5py.File(self._path, "r") as file:
                found = file.attrs.get(MARK, "no run of this package")
        except OSError as error:
            raise ValueError(
                f"checkpoint: {str(self._path)!r} cannot be used, it is damaged or no HDF5 file ({error}); name "
                "another file or delete it."
            ) from None
        if found != self._mark:
            raise ValueError(
                f"checkpoint: {str(self._path)!r} belongs to another run ({found}), this one is ({self._mark}); name "
                "another file or delete it."
            )

    def load(self) -> Saved | None:
        """Return what the file holds; None if there is no file."""
        if not self._path.exists():
            return None
        with h5py.File(self._path, "r") as file:
            state = json.loads(file[RUN][()])
            names = sorted((name for name in file if name.startswith("ensemble ")), key=lambda name: int(name[9:]))
        stored = [emcee.backends.HDFBackend(str(self._path), name=name, read_only=True) for name in names]
        return Saved([_in_memory(backend) for backend in stored], state)

    def save(self, backends: Sequence[emcee.backends.Backend], state: dict[str, Any], *, now: bool = False) -> None:
        """Write all steps so far; without `now` only if the last time was long enough ago."""
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
    """Return a chain read whole into memory, ready to grow."""
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
        digest.update(
            repr(
                (
                    experiment.name,
                    experiment.frequency,
                    experiment.samples,
                    experiment.periods,
                    experiment.winding,
                    experiment.independent,
                    experiment.harmonics,
                    experiment.frequency_se,
                    [(b.channel, b.kind, b.count, b.measured) for b in problem.observations[experiment.name].blocks],
                )
            ).encode()
        )
        for signals in (experiment.outputs, experiment.inputs):
            for name, values in signals.items():
                digest.update(name.encode() + np.ascontiguousarray(values).tobytes())
        for name in ("mask", "covariance", "multipliers", "multiplier_sd"):
            values = getattr(experiment, name)
            digest.update(name.encode() + (b"" if values is None else np.ascontiguousarray(values).tobytes()))
    settings = (problem.priors, problem.fixed, problem.tied, problem.noise, problem.likelihood.fixed, problem.scheme)
    digest.update(repr(settings).encode())
    return f"problem {digest.hexdigest()[:16]}"
