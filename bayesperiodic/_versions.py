"""Versions of the software in use, for reports of errors."""

import importlib.metadata
import platform
import sys

RECORDED_PACKAGES = (
    "bayesperiodic", "numpy", "scipy", "sympy", "numba", "emcee", "arviz", "xarray", "pandas", "matplotlib", "h5py",
    "h5netcdf", "corner", "nutpie", "dask", "mpi4py",
)  # fmt: skip


def show_versions() -> None:
    """Print the versions of Python, the platform and the main dependencies.

    Copy the output into a report of an error. Optional packages that are not installed are marked with "-".

    Returns
    -------
    None

    Examples
    --------
    >>> bp.show_versions()  # doctest: +ELLIPSIS
    python         3...
    platform       ...
    bayesperiodic  ...
    """
    versions = {"python": sys.version.split()[0], "platform": platform.platform()}
    for name in RECORDED_PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "-"
    for name, version in versions.items():
        print(f"{name:15s}{version}")
