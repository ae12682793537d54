"""Independent tasks on the cores of this machine or the workers of a cluster: the one seam behind `executor=`."""

import hashlib
import json
import os
import signal
import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from functools import cache, partial
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeVar

from tqdm import tqdm

from bayesperiodic import _checks
from bayesperiodic._linalg import in_one_thread

Item = TypeVar("Item")
Value = TypeVar("Value")

ALLOWED = (
    "None, a number of processes of at least 1, a Dask Client, or an executor with the interface of concurrent.futures "
    "(submit), such as mpi4py.futures.MPIPoolExecutor"
)
GUARD = "A script that asks for processes must have its calls below: if __name__ == '__main__'."
QUEUED_EACH = 2
KEPT = 4


class WorkersLost(RuntimeError):
    """The workers behind an executor died, or cannot be reached any more."""


def available_cores() -> int:
    """Return the number of cores that this process may use; 1 within a task, whose neighbours use the others."""
    return 1 if getattr(_TASK, "inside", False) else _cores()


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_threads(function: Callable[[Item], Value], items: Sequence[Item], threads: int) -> list[Value]:
    """Return function(item) of every item, in order, worked off by this thread and `threads` − 1 others."""
    if min(threads, len(items)) <= 1:
        return [function(item) for item in items]
    results: list[Any] = [None] * len(items)
    waiting = iter(list(enumerate(items)))

    def work() -> None:
        for index, item in waiting:
            results[index] = function(item)

    elsewhere = [_threads().submit(work) for _ in range(min(threads, len(items)) - 1)]
    work()
    for future in elsewhere:
        future.result()
    return results


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_cores(), thread_name_prefix="bayesperiodic")


if hasattr(os, "register_at_fork"):
    # A forked process has the pool without its threads, and would wait for them for ever.
    os.register_at_fork(after_in_child=_threads.cache_clear)


def checked_executor(executor: Any) -> Any:
    """Return what was given as `executor`; raise a ValueError unless tasks can be handed to it."""
    if executor is None or (callable(getattr(executor, "submit", None)) and not isinstance(executor, type)):
        return executor
    with suppress(ValueError):
        return _checks.integer("executor", executor, 1)
    raise ValueError(f"executor: {executor!r} is not allowed; it must be {ALLOWED}.")


@contextmanager
def team(executor: Any, shared: Any) -> Iterator["Team"]:
    """Provide those who work on the tasks of one job; what was given as `executor` stays open, the rest is closed.

    None means threads of this process, which share its memory. A number of processes means that many fresh ones: a fork
    would inherit the locks of the threads that run kernels, and hang on them.

    Parameters
    ----------
    executor : None, int, Dask Client, or executor
    shared : object
        What all tasks need. It travels once to each worker, and is unpickled once in each process.

    Raises
    ------
    ValueError
        If tasks cannot be handed to the executor, or the shared data cannot be pickled.
    """
    given = checked_executor(executor)
    with ExitStack() as stack:
        if given is None:
            given = stack.enter_context(ThreadPoolExecutor(available_cores()))
        elif isinstance(given, int):
            given = stack.enter_context(ProcessPoolExecutor(given, get_context("spawn"), _ignore_interrupts))
        crew = Team(given, shared, GUARD if given is not executor and executor is not None else "")
        stack.callback(crew.cancel)
        yield crew


def _ignore_interrupts() -> None:
    """Leave Ctrl-C, which reaches all processes of a terminal, to the one that can save what is there."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class Team:
    """Workers with the same shared data, for independent tasks.

    The pickled data go with the first tasks, one for each worker that the executor knows of. Every process keeps them,
    named by their digest; one that gets a task without having them says so, and the task is sent again with them. With
    Dask they are a result on the cluster, which workers pass on among themselves and the scheduler has made again if
    all who had it are gone. Threads take them as they are.

    Parameters
    ----------
    executor : Dask Client, or executor
    shared : object
    hint : str
        Added to the message if the workers are lost before any has given a result.
    """

    def __init__(self, executor: Any, shared: Any, hint: str = ""):
        self._submit, self._hint = executor.submit, hint
        self._running: dict[int, tuple[Any, Any]] = {}
        self._key, self._content, self._carriers, self._at_once = "", shared, 0, None
        if isinstance(executor, ThreadPoolExecutor):
            self._always = True
            return
        payload = _pickled(shared)
        self._key, self._content = hashlib.sha256(payload).hexdigest(), payload
        self._always = _is_dask(executor) and hasattr(executor, "scatter")
        if self._always:
            self._submit = partial(executor.submit, pure=False)
            with warnings.catch_warnings(), _losses(RuntimeError, OSError):
                warnings.simplefilter("ignore")  # of a large task graph: it is large once
                self._content = self._submit(_same, payload)
            return
        workers = getattr(executor, "num_workers", None) or getattr(executor, "_max_workers", None)
        self._carriers, self._at_once = workers or 1, workers and QUEUED_EACH * workers

    def run(
        self,
        function: Callable[[Any, Any], Any],
        tasks: Iterable[Any],
        then: Callable[[int, Any], Any] | None = None,
    ) -> Iterator[tuple[int, Any]]:
        """Yield the number and the result of every task as it is done: function(shared, task).

        An exception that the function raises comes out here. A task must be a pure function of what it is given:
        clusters do those of a lost worker again.

        Parameters
        ----------
        function : callable
            Of a module, so that workers can import it.
        tasks : iterable
            Read as workers become free.
        then : callable, optional
            Of a number and its result: the task that follows under the same number, or None.

        Raises
        ------
        WorkersLost
            If the workers died or cannot be reached.
        """
        finished: SimpleQueue[int] = SimpleQueue()
        waiting = enumerate(tasks)

        def start(number: int, task: Any, again: bool = False) -> None:
            content = self._content if self._always or again or self._carriers > 0 else None
            self._carriers -= content is not None
            with _losses(RuntimeError, OSError, hint=self._hint):
                future = self._submit(_call, function, task, self._key, content)
            self._running[number] = future, task
            future.add_done_callback(lambda _: finished.put(number))

        for number, task in islice(waiting, self._at_once):
            start(number, task)
        while self._running:
            number = finished.get()
            future, task = self._running.pop(number)
            with _losses(hint=self._hint):
                result = future.result()
            self._hint = ""
            if isinstance(result, _Missing):
                start(number, task, again=True)
                continue
            following = None if then is None else then(number, result)
            upcoming = next(waiting, None) if following is None else (number, following)
            if upcoming is not None:
                start(*upcoming)
            yield number, result

    def cancel(self) -> None:
        """Withdraw the tasks that have not begun, and forget the others."""
        for future, _ in self._running.values():
            with suppress(Exception):
                future.cancel()
        self._running.clear()


def _pickled(shared: Any) -> bytes:
    import cloudpickle

    try:
        return cloudpickle.dumps(shared)
    except Exception as error:  # whatever an object of the user's answers to pickle
        raise ValueError(
            f"executor: it is not allowed here, the problem cannot be pickled ({type(error).__name__}: {error}); leave "
            "the executor out, or give what is in the problem (priors, noise model) a form that can."
        ) from error


def _is_dask(thing: Any) -> bool:
    return type(thing).__module__.partition(".")[0] == "distributed"


@contextmanager
def _losses(*more: type[Exception], hint: str = "") -> Iterator[None]:
    """Turn what executors raise for dead or unreachable workers into one exception."""
    try:
        yield
    except Exception as error:
        known = isinstance(error, (BrokenExecutor, CancelledError, *more))
        if not known and not _is_dask(error):
            raise
        reason = f"{type(error).__name__}: {error}".rstrip(". ")
        raise WorkersLost(f"executor: its workers were lost ({reason}). {hint}".rstrip()) from error


class _Missing:
    """The answer of a process that has not got the shared data."""


_TASK = threading.local()
_OPENED: OrderedDict[str, Any] = OrderedDict()
_OPENING = threading.Lock()


@in_one_thread
def _call(function: Callable[[Any, Any], Any], task: Any, key: str, content: Any) -> Any:
    """Do one task; the shared data come as they are (without a key), pickled, or have come before (None)."""
    shared = _opened(key, content) if key else content
    if isinstance(shared, _Missing):
        return shared
    outside, _TASK.inside = getattr(_TASK, "inside", False), True
    try:
        return function(shared, task)
    finally:
        _TASK.inside = outside


def _opened(key: str, content: bytes | None) -> Any:
    with _OPENING:
        if key not in _OPENED:
            if content is None:
                return _Missing()
            import cloudpickle

            _OPENED[key] = cloudpickle.loads(content)
            while len(_OPENED) > KEPT:
                _OPENED.popitem(last=False)
        _OPENED.move_to_end(key)
        return _OPENED[key]


def _same(content: bytes) -> bytes:
    return content


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
