"""Many tasks on all cores whose results are kept one by one in a file."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from bayesperiodic import resumed as kept

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
    with workers() as pool:
        return kept.resumed(path, tasks, _do, task_of, source, shared=work, executor=pool)


def _do(work: Callable[[Task], Line], task: Task) -> Line:
    return work(task)


def workers() -> ProcessPoolExecutor:
    """Return a pool of as many fresh processes as there are cores."""
    return ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn"))
