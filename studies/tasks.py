"""Tasks for all cores, and long runs that go on where they were ended, by tasks (a line each in a file) or by parts."""

from __future__ import annotations

import multiprocessing
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import cloudpickle

from bayesperiodic import _parallel as kept
from bayesperiodic._parallel import TaskPool

Task = tuple[Any, ...]
Line = dict[str, Any]
Part = TypeVar("Part")
Value = TypeVar("Value")


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
        return kept.checkpointed_tasks(path, tasks, _do, task_of, source, shared=work, executor=pool)


def _do(work: Callable[[Task], Line], task: Task) -> Line:
    return work(task)


def remembered(path: Path, source: str, make: Callable[[], Part]) -> Part:
    """Return a part of a study from the file of an earlier run, or make it and keep it there.

    Parameters
    ----------
    path : Path
    source : str
        Tells parts of another version, or with other settings, apart.
    make : callable
    """
    if path.is_file():
        saved, part = pickle.loads(path.read_bytes())
        if saved == source:
            return part
    part = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".unfinished")
    unfinished.write_bytes(cloudpickle.dumps((source, part)))
    unfinished.replace(path)
    return part


def each(work: Callable[..., Value], tasks: Sequence[Task], *, here: bool = False) -> Iterator[Value]:
    """Yield work(*task) of every task, in their order.

    Parameters
    ----------
    work : callable
        Of a module.
    tasks : sequence of tuple
    here : bool
        One after the other in this process; else in processes, each task on one core.
    """
    if here:
        yield from (work(*task) for task in tasks)
        return
    done: dict[int, bytes] = {}
    with workers() as pool, TaskPool(pool, work) as task_pool:
        following = 0
        for number, result in task_pool.run(_one, tasks):
            done[number] = result
            while following in done:
                yield cloudpickle.loads(done.pop(following))
                following += 1


def _one(work: Callable[..., Value], task: Task) -> bytes:
    return cloudpickle.dumps(work(*task))


def workers() -> ProcessPoolExecutor:
    """Return a pool of as many fresh processes as there are cores."""
    return ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn"))
