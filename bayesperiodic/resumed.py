"""Many tasks whose results are kept one by one in a file, so that the same call does only those that are missing."""

import json
import os
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from tqdm import tqdm

from bayesperiodic.parallel import checked_executor, team

Line = dict[str, Any]


def resumed(
    path: Path | None,
    tasks: Sequence[Any],
    work: Callable[[Any, Any], Line],
    task_of: Callable[[Line], Hashable],
    source: str,
    *,
    shared: Any = None,
    executor: Any = None,
    progress: bool = True,
) -> list[Line]:
    """Do the tasks that a file lacks, and return the lines of all in their order.

    A line is written as soon as its task is done. Whatever is killed, and whenever, what was written counts once, and
    the same call does the rest; a last line that was cut off is taken out.

    Parameters
    ----------
    path : Path, optional
        A JSON line a task; those of another source stay in it and do not count. Without a path nothing is kept.
    tasks : sequence
        Different ones, that can be compared and pickled.
    work : callable
        Of a module; returns a task's line, with "source" in it, from the shared data and the task alone.
    task_of : callable
        Returns the task that a line is of.
    source : str
        Tells results of another version or other settings apart.
    shared : object
        What all tasks need; it travels once to each worker.
    executor : None, int, Dask Client, or executor with the interface of concurrent.futures
        None does one task after the other in this process.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ValueError
        If another process has the file in use, or the executor takes no tasks.
    WorkersLost
        If the executor's workers died (a RuntimeError); what was done is in the file.
    """
    given = checked_executor(executor)
    with nullcontext() if path is None else _alone(path):
        done = {task_of(line): line for line in _read(path) if line["source"] == source}
        missing = [task for task in tasks if task not in done]
        with (
            nullcontext() if path is None else path.open("a", encoding="utf-8") as file,
            ThreadPoolExecutor(1) if given is None else nullcontext(given) as executor,
            team(executor, shared) as crew,
            tqdm(total=len(tasks), initial=len(tasks) - len(missing), unit="task", disable=not progress) as bar,
        ):
            for _, line in crew.run(work, missing):
                done[task_of(line)] = line
                if file is not None:
                    file.write(json.dumps(line, ensure_ascii=False) + "\n")
                    file.flush()
                bar.update()
    return [done[task] for task in tasks]


def _alone(path: Path) -> Any:
    from filelock import FileLock, Timeout

    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        return FileLock(path.with_name(f".{path.name}.lock")).acquire(timeout=0.0)
    except Timeout:
        raise ValueError(
            f"folder: {str(path.parent)!r} is in use by another run; wait for it, or name another folder."
        ) from None


def _read(path: Path | None) -> list[Line]:
    """Return the lines of a file, without a last one that was cut off; that one is taken out of it."""
    if path is None or not path.is_file():
        return []
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if whole != content:
        os.truncate(path, len(whole))
    return [json.loads(line) for line in whole.decode("utf-8").splitlines()]
