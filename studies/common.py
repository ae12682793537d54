"""Helpers of the studies: data files, timed steps, results and figures, tables of targets, checkpointed tasks.

Results and figures are written completely or not at all.
"""

import hashlib
import importlib.metadata
import json
import math
import multiprocessing
import operator
import os
import pickle
import platform
import textwrap
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import cloudpickle
import matplotlib
import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

import bayesperiodic as bp
from bayesperiodic import _parallel
from bayesperiodic._files import written_whole as written_whole
from bayesperiodic._parallel import TaskPool, available_cores
from bayesperiodic.plot.pairs import draw_ellipses as draw_ellipses
from bayesperiodic.plot.pairs import draw_regions as draw_regions
from bayesperiodic.plot.style import ENSEMBLES as ENSEMBLES
from bayesperiodic.plot.style import axis_label as axis_label

Row = dict[str, Any]


def row(what: str, value: float | None, low: float, high: float | None, note: str = "") -> Row:
    """Return a row of results.json; `high` None means no upper limit, and a missing value gives no verdict."""
    value = None if value is None or math.isnan(value) else float(value)
    low, high = float(low), None if high is None else float(high)
    met = None if value is None else value >= low and (high is None or value <= high)
    return {"what": what, "value": value, "low": low, "high": high, "met": met, "note": note}


def table_of_rows(rows: list[Row]) -> str:
    """Return rows as text, with notes below."""
    verdicts, lines = {True: "yes", False: "NO", None: "-"}, []
    notes = list(dict.fromkeys(entry["note"] for entry in rows if entry["note"]))
    for entry in rows:
        mark = f" ({notes.index(entry['note']) + 1})" if entry["note"] else ""
        low, high = entry["low"], entry["high"]
        value = "-" if entry["value"] is None else f"{entry['value']:.4g}"
        if low == high:
            allowed = f"{low:g}"
        elif high is None:
            allowed = f">= {low:g}"
        else:
            allowed = f"<= {high:g}" if low == 0.0 else f"{low:g} … {high:g}"
        lines.append({"": verdicts[entry["met"]], "what": entry["what"] + mark, "found": value, "allowed": allowed})
    shown = pd.DataFrame(lines).to_string(index=False)
    return "\n".join([shown, *(f"  ({i}) {note}" for i, note in enumerate(notes, start=1))])


Task = tuple[Any, ...]
Value = TypeVar("Value")


def resumed(
    path: Path, tasks: Sequence[Task], work: Callable[[Task], Row], task_of: Callable[[Row], Task], source: str
) -> list[Row]:
    """Compute the tasks missing from a file on all cores, and return the lines of all tasks in order.

    The file has one JSON line per task; lines of another source are ignored. `work` returns a task's line, with
    "source" in it; `task_of` returns the task of a line; `source` identifies the version.
    """
    with workers() as pool:
        return _parallel.checkpointed_tasks(path, tasks, operator.call, task_of, source, shared=work, executor=pool)


def remembered(path: Path, source: str, make: Callable[[], Value]) -> Value:
    """Return a part of a study from the file of an earlier run with the same `source`, or compute and store it."""
    if path.is_file():
        saved, part = pickle.loads(path.read_bytes())
        if saved == source:
            return part
    part = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as draft:
        draft.write_bytes(cloudpickle.dumps((source, part)))
    return part


def each(work: Callable[..., Value], tasks: Sequence[Task], *, here: bool = False) -> Iterator[Value]:
    """Yield work(*task) of every task in order, computed in this process (`here`) or in one process per core."""
    if here:
        yield from (work(*task) for task in tasks)
        return
    done: dict[int, bytes] = {}
    with workers() as pool, TaskPool(pool, work) as task_pool:
        following = 0
        for number, result in task_pool.run(_run_task, tasks):
            done[number] = result
            while following in done:
                yield cloudpickle.loads(done.pop(following))
                following += 1


def in_threads(work: Callable[[Any], Value], items: Sequence[Any]) -> list[Value]:
    """Return work(item) of every item in order, in one thread per core; of use where compiled code takes the time."""
    with ThreadPoolExecutor(available_cores()) as pool:
        return list(pool.map(work, items))


def _run_task(work: Callable[..., Value], task: Task) -> bytes:
    return cloudpickle.dumps(work(*task))


def workers(count: int | None = None) -> ProcessPoolExecutor:
    """Return a pool with so many new processes, by default one per core."""
    return ProcessPoolExecutor(count or available_cores(), mp_context=multiprocessing.get_context("spawn"))


PACKAGES = ("bayesperiodic", "numpy", "scipy", "sympy", "numba", "emcee", "arviz", "corner", "matplotlib", "xarray")
# Of PNG files, and of the clouds of points in vector files.
DOTS_PER_INCH, DOTS_OF_CLOUDS = 100, 300
COLOURS = 128
# Of titles of corner plots: characters per inch, and the height of a line [inches].
CHARACTERS_PER_INCH, LINE = 12.0, 0.2
WITHOUT_TIME = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}


def find_data(given: Path | None, relative: str) -> tuple[Path, str] | None:
    """Return a measured file and the name to report for it, None if it is missing.

    Searched: the path given, a file or a folder with the file in it, then the folder named by BAYESPERIODIC_DATA, then
    ``data/``.
    """
    if given is not None and given.is_dir():
        given = next(
            (one for one in (given / relative, given / Path(relative).name) if one.is_file()), given / relative
        )
    if given is not None:
        if not given.is_file():
            raise FileNotFoundError(f"--data: must be an existing file, got {str(given)!r}.")
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
    """Return the versions of Python and of the main packages."""
    return {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in PACKAGES}


def write_results(folder: Path, results: dict[str, Any]) -> Path:
    """Write results.json atomically, as strict JSON: null instead of numbers that are not finite, with the reasons."""
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / "results.json"
    reasons: dict[str, str] = {}
    finite = _finite(results, "", reasons)
    whole = finite | ({"null": reasons} if reasons else {})
    text = json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with written_whole(target) as draft:
        draft.write_text(text, encoding="utf-8")
    return target


def _finite(value: Any, place: str, reasons: dict[str, str]) -> Any:
    """Return a value with None for numbers that are not finite; their places and the reasons are added to `reasons`."""
    if isinstance(value, dict):
        return {key: _finite(one, f"{place}.{key}" if place else str(key), reasons) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one, f"{place}[{i}]", reasons) for i, one in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        reasons[place] = "not known" if math.isnan(value) else "no upper bound" if value > 0.0 else "no lower bound"
        return None
    return value


def save_figures(folder: Path, figures: dict[str, Figure]) -> list[Path]:
    """Save figures as small PNG files and in matplotlib's "savefig.format", without time stamps; return the paths.

    Each file is written atomically.
    """
    folder.mkdir(parents=True, exist_ok=True)
    wanted = matplotlib.rcParams["savefig.format"]
    paths = []
    for name, figure in figures.items():
        for suffix in dict.fromkeys(("png", wanted)):
            target, dots = folder / f"{name}.{suffix}", DOTS_PER_INCH if suffix == "png" else DOTS_OF_CLOUDS
            with written_whole(target) as draft:
                figure.savefig(draft, dpi=dots, metadata=WITHOUT_TIME.get(suffix))
                if suffix == "png":
                    _shrink(draft)
            paths.append(target)
    return paths


def titled(figure: Figure, title: str) -> Figure:
    """Return a corner plot with a title above its panels, in lines that fit."""
    width, height = figure.get_size_inches()
    lines = textwrap.wrap(title, int(width * CHARACTERS_PER_INCH))
    scale = height / (height + LINE * len(lines) + 0.08)
    for axes in figure.axes:
        x, y, across, up = axes.get_position().bounds
        axes.set_position((x, scale * y, across, scale * up))
    for legend in figure.legends:
        legend.set_bbox_to_anchor((0.0, 0.0, 1.0, scale))
    figure.set_size_inches(width, height / scale)
    figure.suptitle("\n".join(lines), y=1.0 - 0.08 * scale / height, va="top", fontsize="medium")
    return figure


def _shrink(path: Path) -> None:
    with Image.open(path) as picture:
        picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


def source_key(*files: str | None) -> str:
    """Return a key of the package's source and of further files, which marks the results of older code as stale."""
    package = sorted(Path(bp.__file__).parent.rglob("*.py"))
    text = "".join(sha256(Path(str(file))) for file in (*package, *files))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def described(found: tuple[Path, str] | None) -> Row:
    """Return the entry of results.json on a file from `find_data`, or on generated data."""
    if found is None:
        return {"path": "generated", "sha256": None, "synthetic": True}
    return {"path": found[1], "sha256": sha256(found[0]), "synthetic": False}


def finish(folder: Path, results: Row, watch: Stopwatch, paths: Sequence[Path] = (), *, synthetic: bool) -> None:
    """Write results.json with the times and versions, and print the paths of figures and results."""
    path = write_results(folder, results | {"seconds": watch.total(), "versions": versions()})
    kind = " (synthetic data)" if synthetic else ""
    print(f"figures{kind}: {', '.join(map(str, paths))}\nresults: {path}" if paths else f"results{kind}: {path}")


def shared_legend(figure: Figure, columns: int, loc: Any = "outside lower center", **options: Any) -> None:
    """Draw one legend of all labels in a figure, outside its axes."""
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(handles.values(), handles, frameon=False, ncols=columns, loc=loc, **options)


def shown(title: str, rows: Mapping[str, Mapping[str, Any]], columns: Sequence[str] | None = None) -> str:
    """Return named rows as a table under a title, entries of nested mappings as "outer.inner"; all columns or some."""
    table = pd.json_normalize([dict(row) for row in rows.values()]).set_axis(list(rows))
    table = table if columns is None else table.reindex(columns=list(columns))
    return f"{title}\n{table.to_string(float_format='{:.4g}'.format, na_rep='-')}"
