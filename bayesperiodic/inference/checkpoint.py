"""Where a sampling run is kept while it goes on: emcee's HDF5 backend, one group an ensemble."""

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import emcee
import h5py
import numpy as np

from bayesperiodic.inference.problem import Problem
from bayesperiodic.models.compile import kernel_source


class SharedBackend(emcee.backends.HDFBackend):
    """emcee's HDF5 backend, one thread at a time in the file, because HDF5 opens no file twice in different modes."""

    _lock = threading.RLock()

    @contextmanager
    def open(self, mode: str = "r") -> Iterator[h5py.File]:
        """Open the file for this thread alone."""
        with self._lock, super().open(mode) as file:
            yield file


def backends(checkpoint: str | Path | None, problem: Problem, settings: str, ensembles: int) -> list:
    """Return one emcee backend an ensemble, in memory or in a file that carries the problem's fingerprint.

    Raises
    ------
    ValueError
        If the file is no HDF5 file, or belongs to another problem, seed or number of walkers.
    """
    if checkpoint is None:
        return [emcee.backends.Backend() for _ in range(ensembles)]
    path, mark = Path(checkpoint), fingerprint(problem) + "; " + settings
    try:
        with h5py.File(path, "a") as file:
            if not len(file) and "fingerprint" not in file.attrs:
                file.attrs["fingerprint"] = mark
            found = file.attrs.get("fingerprint", "no run of this package")
            if found != mark:
                raise ValueError(
                    f"checkpoint: {str(path)!r} belongs to another run ({found}), this one is ({mark}); name another "
                    "file or delete it."
                )
    except OSError as error:
        raise ValueError(f"checkpoint: {str(path)!r} cannot be used ({error}).") from None
    return [SharedBackend(str(path), name=f"ensemble {k}") for k in range(ensembles)]


def fingerprint(problem: Problem) -> str:
    """Return a digest of model, data, priors, fixed values, ties, noise model and scheme."""
    digest = hashlib.sha256(kernel_source(problem.model).encode())
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
