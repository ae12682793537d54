"""What every study needs: where the data are, steps that say what they do, results and figures written whole."""

import hashlib
import importlib.metadata
import json
import os
import platform
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from PIL import Image

PACKAGES = ("bayesperiodic", "numpy", "scipy", "sympy", "numba", "emcee", "arviz", "corner", "matplotlib", "xarray")
DOTS_PER_INCH = 100
COLOURS = 64
WITHOUT_TIME = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}


def find_data(given: Path | None, relative: str) -> tuple[Path, str] | None:
    """Return a measured file and the name to report for it, None where it is not to be had.

    Searched: the path given, then the folder named by BAYESPERIODIC_DATA, then ``data/``.
    """
    if given is not None:
        if not given.is_file():
            raise FileNotFoundError(f"--data: {str(given)!r} is not allowed; there is no such file.")
        return given, str(given)
    for folder in (os.environ.get("BAYESPERIODIC_DATA"), "data"):
        if folder and (Path(folder) / relative).is_file():
            return Path(folder) / relative, relative
    return None


def sha256(path: Path) -> str:
    """Return the digest of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


class Stopwatch:
    """Seconds spent on named parts of a study."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._start = time.perf_counter()

    @contextmanager
    def part(self, name: str, what: str) -> Iterator[None]:
        """Announce a part, time it, and print the warnings that it raises as notes."""
        print(f"* {what} …", flush=True)
        start = time.perf_counter()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("default")
            yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
        for text in dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, UserWarning)):
            print(f"  note: {text}")

    def total(self) -> dict[str, float]:
        """Return the parts and the time since the start."""
        return self.seconds | {"total": time.perf_counter() - self._start}


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that matter."""
    return {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in PACKAGES}


def write_results(folder: Path, results: dict[str, Any]) -> Path:
    """Write results.json, whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    target, draft = folder / "results.json", folder / ".results.json.part"
    draft.write_text(json.dumps(results, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    draft.replace(target)
    return target


def save_figures(folder: Path, figures: dict[str, Figure]) -> list[Path]:
    """Save figures as small PNG files, and as what matplotlib's "savefig.format" says; return the paths.

    Without time stamps, each whole or not at all.
    """
    folder.mkdir(parents=True, exist_ok=True)
    wanted = matplotlib.rcParams["savefig.format"]
    paths = []
    for name, figure in figures.items():
        for suffix in dict.fromkeys(("png", wanted)):
            target, draft = folder / f"{name}.{suffix}", folder / f".{name}.part.{suffix}"
            figure.savefig(draft, dpi=DOTS_PER_INCH, metadata=WITHOUT_TIME.get(suffix))
            if suffix == "png":
                _shrink(draft)
            draft.replace(target)
            paths.append(target)
    return paths


def _shrink(path: Path) -> None:
    with Image.open(path) as picture:
        picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
