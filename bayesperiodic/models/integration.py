"""Compiled functions of small dense systems and of time integration."""

from functools import cache
from pathlib import Path
from types import ModuleType

from bayesperiodic._compile.cache import load


@cache
def dense_kernels(path: Path | None = None) -> ModuleType:
    """Return the compiled solution of small dense systems, or the compiled functions of a source that uses it."""
    text = (path or Path(__file__).with_name("_kernels") / "dense.py").read_text(encoding="utf-8")
    return load(text, shared=dense_kernels() if path else None)


def integration_kernels() -> ModuleType:
    """Return the compiled functions of time integration."""
    return dense_kernels(Path(__file__).with_name("_kernels") / "integrate.py")
