"""Many tasks whose results are kept one by one in a file, so that the same command does only those that are missing."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

REPORTED = 50

Task = tuple[Any, ...]
Line = dict[str, Any]


def resumed(
    path: Path, tasks: Sequence[Task], work: Callable[[Task], Line], task_of: Callable[[Line], Task], source: str
) -> list[Line]:
    """Do the tasks that a file lacks, all cores at it, and return the lines of all in their order.

    Parameters
    ----------
    path : Path
        A JSON line a task; those of another source stay in it and do not count.
    tasks : sequence of tuple
    work : callable
        Returns a task's line, with "source" in it.
    task_of : callable
        Returns the task that a line is of.
    source : str
        Tells results of another version apart.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    done = {task_of(line): line for line in _read(path) if line["source"] == source}
    missing = [task for task in tasks if task not in done]
    print(f"  {len(tasks) - len(missing)} replicates found in {path}, {len(missing)} to do", flush=True)
    with path.open("a", encoding="utf-8") as file, workers() as pool:
        futures = [pool.submit(work, task) for task in missing]
        try:
            for number, future in enumerate(as_completed(futures), 1):
                line = future.result()
                done[task_of(line)] = line
                file.write(json.dumps(line, ensure_ascii=False) + "\n")
                file.flush()
                if number % REPORTED == 0:
                    print(f"  {number} of {len(missing)}", flush=True)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    return [done[task] for task in tasks]


def workers() -> ProcessPoolExecutor:
    """Return a pool of as many fresh processes as there are cores."""
    return ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn"))


def _read(path: Path) -> list[Line]:
    """Return the lines of a file, without a last one that was cut off; that one is taken out of it."""
    if not path.is_file():
        return []
    text = path.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        path.write_text(whole, encoding="utf-8")
    return [json.loads(line) for line in whole.splitlines()]
