"""Independent tasks on the cores of this machine or on the workers of a cluster, for the argument `executor`."""

import hashlib
import json
import os
import pickle
import signal
import sys
import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from functools import cache, partial
from itertools import islice
from multiprocessing import get_context, parent_process
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeVar

from tqdm import tqdm

from bayesperiodic import _checks
from bayesperiodic._files import in_folder, locked
from bayesperiodic._linalg import in_one_thread

Item = TypeVar("Item")
Value = TypeVar("Value")

EXECUTORS = (
    "None, a number of processes >= 1, a Dask Client, or an executor with the interface of concurrent.futures, such as "
    "mpi4py.futures.MPIPoolExecutor"
)
MAIN_GUARD = "A script that uses processes must have its calls below: if __name__ == '__main__'."
QUEUED_PER_WORKER = 2
# Shared objects that a process keeps unpickled.
KEPT = 4
# Digest of a shared object, and the process that submits the tasks.
Key = tuple[str, int]


class WorkersLost(RuntimeError):
    """The workers of an executor died or cannot be reached."""


def available_cores() -> int:
    """Return the number of cores that this process may use; 1 within a task, because others run at the same time."""
    return 1 if getattr(_TASK, "inside", False) else _cores()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_threads(function: Callable[[Item], Value], items: Sequence[Item], threads: int) -> list[Value]:
    """Return function(item) of every item, in order, computed by `threads` threads, this one included."""
    if min(threads, len(items)) <= 1:
        return [function(item) for item in items]
    results: list[Any] = [None] * len(items)
    pending = iter(list(enumerate(items)))

    def work() -> None:
        for index, item in pending:
            results[index] = function(item)

    others = [_threads().submit(work) for _ in range(min(threads, len(items)) - 1)]
    work()
    for future in others:
        future.result()
    return results


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_cores(), thread_name_prefix="bayesperiodic")


if hasattr(os, "register_at_fork"):
    # A forked process inherits the pool without its threads.
    os.register_at_fork(after_in_child=_threads.cache_clear)


def checked_executor(executor: Any) -> Any:
    """Return `executor`; raise a ValueError unless it takes tasks."""
    if executor is None or (callable(getattr(executor, "submit", None)) and not isinstance(executor, type)):
        return executor
    try:
        number = _checks.integer("executor", executor, 1)
    except ValueError:
        raise ValueError(f"executor: must be {EXECUTORS}, got {executor!r}.") from None
    main = sys.modules["__main__"]
    script = getattr(main, "__file__", None) or ""
    if getattr(main, "__spec__", None) is None and script.startswith("<") and not os.path.isfile(script):
        raise ValueError(
            f"executor: must be None in a script from {script}, got {number}, as new processes read the script again; "
            "save it as a file."
        )
    return number


def _start_worker() -> None:
    """Ignore Ctrl-C, which the main process handles, and end with the main process, whatever ends that."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _end_with(os.getppid())


@cache
def _end_with(parent: int) -> None:
    """End this process, from a thread, when the process with this number ends, if that has started it."""
    process = parent_process()
    if process is not None and process.pid == parent:

        def wait() -> None:
            process.join()
            os._exit(1)

        threading.Thread(target=wait, daemon=True).start()


class Terminated(KeyboardInterrupt):
    """SIGTERM inside `ended_by_termination`."""


@contextmanager
def ended_by_termination() -> Iterator[None]:
    """Let SIGTERM, unless the user's program handles it, raise a `Terminated`, and end the process after the block.

    The process ends by the signal, as without this package, however the block ends. Where the signal has no effect, as
    in the first process of a container, the exception is raised.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield
        return
    _TERMINATED.clear()
    signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if _TERMINATED:
            signal.raise_signal(signal.SIGTERM)
            raise Terminated


_TERMINATED: list[int] = []


def _terminate(number: int, _: Any) -> None:
    _TERMINATED.append(number)
    raise Terminated


@contextmanager
def interrupts_deferred() -> Iterator[Callable[[], None]]:
    """Defer Ctrl-C, and SIGTERM within `ended_by_termination`, until the function provided is called, or to the end.

    A second signal acts at once.
    """
    noted: list[int] = []
    actions: dict[int, Any] = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: _terminate}

    def note(number: int, frame: Any) -> None:
        noted.append(number)
        if len(noted) > 1:
            check(frame)

    def check(frame: Any = None) -> None:
        if noted:
            number = signal.SIGTERM if signal.SIGTERM in noted else signal.SIGINT
            noted.clear()
            actions[number](number, frame)

    main = threading.current_thread() is threading.main_thread()
    taken = [number for number, action in actions.items() if main and signal.getsignal(number) is action]
    for number in taken:
        signal.signal(number, note)
    try:
        yield check
    finally:
        for number in taken:
            signal.signal(number, actions[number])
        check()


class TaskPool:
    """Workers for independent tasks that need the same data; a context manager.

    A given executor stays open; one that is created here is closed at the end. None stands for threads of this process,
    which use the shared object directly. A number stands for new processes; they are spawned, because forked processes
    would inherit the locks of threads that run kernels, and wait for them forever.

    The shared object is pickled once and sent with the first tasks, one per worker that the executor reports. Each
    process keeps it under its digest; a process that lacks it returns a marker, and the task is sent again with the
    object. With Dask the object is a result on the cluster, which is computed again if all workers with it are lost.
    Raises a ValueError if the executor takes no tasks, or the shared object cannot be pickled.
    """

    def __init__(self, executor: Any, shared: Any):
        self._executor, self._shared = checked_executor(executor), shared
        self._hint = MAIN_GUARD if isinstance(self._executor, int) else ""
        self._running: dict[int, tuple[Any, Any]] = {}
        self._key: Key | None = None
        self._content, self._always_sent, self._unsent, self._at_once = shared, True, 0, None
        self._stack = ExitStack()

    def __enter__(self) -> "TaskPool":
        with self._stack as stack:
            executor = self._executor
            if executor is None:
                executor = stack.enter_context(ThreadPoolExecutor(available_cores()))
            elif isinstance(executor, int):
                executor = stack.enter_context(ProcessPoolExecutor(executor, get_context("spawn"), _start_worker))
            stack.callback(self._cancel)
            self._connect(executor)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.close()

    def _connect(self, executor: Any) -> None:
        self._submit = executor.submit
        if isinstance(executor, ThreadPoolExecutor):
            return
        payload = _pickled(self._shared)
        self._key, self._content = (hashlib.sha256(payload).hexdigest(), os.getpid()), payload
        self._always_sent = _is_dask(executor) and hasattr(executor, "scatter")
        if self._always_sent:
            self._submit = partial(executor.submit, pure=False)
            with warnings.catch_warnings(), _losses(RuntimeError, OSError):
                warnings.simplefilter("ignore")  # about the size of the task graph
                self._content = self._submit(bytes, payload)
            return
        workers = getattr(executor, "num_workers", None) or getattr(executor, "_max_workers", None)
        self._unsent, self._at_once = workers or 1, workers and QUEUED_PER_WORKER * workers

    def run(
        self, function: Callable[[Any, Any], Any], tasks: Iterable[Any], then: Callable[[int, Any], Any] | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Yield the number and the result function(shared, task) of every task when it is finished.

        The function is defined in a module, so that workers can import it, and depends on its arguments only, because
        clusters repeat the tasks of a lost worker. Tasks are consumed as workers become free; then(number, result)
        returns the next task with the same number, or None. Exceptions of the function are raised here, a WorkersLost
        if the workers died or cannot be reached.
        """
        finished: SimpleQueue[int] = SimpleQueue()
        pending = enumerate(tasks)

        def start(number: int, task: Any, again: bool = False) -> None:
            content = self._content if self._always_sent or again or self._unsent > 0 else None
            self._unsent -= content is not None
            with _losses(RuntimeError, OSError, hint=self._hint):
                future = self._submit(_call, function, task, self._key, content)
            self._running[number] = future, task
            future.add_done_callback(lambda _: finished.put(number))

        for number, task in islice(pending, self._at_once):
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
            upcoming = next(pending, None) if following is None else (number, following)
            if upcoming is not None:
                start(*upcoming)
            yield number, result

    def _cancel(self) -> None:
        for future, _ in self._running.values():
            with suppress(Exception):
                future.cancel()
        self._running.clear()


def _pickled(shared: Any) -> bytes:
    import cloudpickle

    try:
        return cloudpickle.dumps(shared)
    except Exception as error:  # objects of the user may raise anything
        raise ValueError(
            f"executor: must be None, because the problem cannot be pickled ({type(error).__name__}: {error}); or make "
            "its contents (priors, noise model) picklable."
        ) from error


def _is_dask(thing: Any) -> bool:
    return type(thing).__module__.partition(".")[0] == "distributed"


@contextmanager
def _losses(*more: type[Exception], hint: str = "") -> Iterator[None]:
    """Convert what executors raise for dead or unreachable workers to `WorkersLost`."""
    try:
        yield
    except Exception as error:
        known = isinstance(error, (BrokenExecutor, CancelledError, *more))
        if not known and not _is_dask(error):
            raise
        reason = f"{type(error).__name__}: {error}".rstrip(". ")
        raise WorkersLost(f"executor: its workers were lost ({reason}). {hint}".rstrip()) from error


class _Missing:
    """Result of a process that lacks the shared object."""


_TASK = threading.local()
_UNPICKLED: OrderedDict[Key, Any] = OrderedDict()
_UNPICKLING = threading.Lock()


@in_one_thread
def _call(function: Callable[[Any, Any], Any], task: Any, key: Key | None, content: Any) -> Any:
    """Run one task; `content` is the shared object itself (no key), pickled, or None if it was sent before."""
    if key:
        _end_with(key[1])  # also a worker of an executor of the user, which may have been forked
    shared = _unpickled(key, content) if key else content
    if isinstance(shared, _Missing):
        return shared
    outside, _TASK.inside = getattr(_TASK, "inside", False), True
    try:
        return function(shared, task)
    finally:
        _TASK.inside = outside


def _unpickled(key: Key, content: bytes | None) -> Any:
    with _UNPICKLING:
        if key not in _UNPICKLED:
            if content is None:
                return _Missing()
            _UNPICKLED[key] = pickle.loads(content)
            if len(_UNPICKLED) > KEPT:
                _UNPICKLED.popitem(last=False)
        _UNPICKLED.move_to_end(key)
        return _UNPICKLED[key]


Line = dict[str, Any]


def checkpointed_tasks(
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
    """Run the tasks whose results a file lacks, and return the results (lines) of all in the order of the tasks.

    The file has one JSON line per task, written when the task is finished; without a path nothing is stored. After an
    interruption the same call runs the remaining tasks; an incomplete last line is removed. Tasks are distinct,
    hashable and picklable. work(shared, task), defined in a module, returns the line; its "source" identifies version
    and settings, and lines of another source are ignored. task_of(line) returns the task. Without an executor the tasks
    run sequentially in this process. Raises a ValueError if another process uses the file or the executor takes no
    tasks, a WorkersLost if workers died; finished tasks are in the file.
    """
    given = checked_executor(executor)
    with nullcontext() if path is None else _locked(path):
        done = {task_of(line): line for line in _read(path) if line["source"] == source}
        missing = [task for task in tasks if task not in done]
        with (
            nullcontext() if path is None else path.open("a", encoding="utf-8") as file,
            ThreadPoolExecutor(1) if given is None else nullcontext(given) as executor,
            TaskPool(executor, shared) as pool,
            tqdm(total=len(tasks), initial=len(tasks) - len(missing), unit="task", disable=not progress) as bar,
        ):
            for _, line in pool.run(work, missing):
                done[task_of(line)] = line
                if file is not None:
                    file.write(json.dumps(line, ensure_ascii=False) + "\n")
                    file.flush()
                bar.update()
    return [done[task] for task in tasks]


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    path.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as held:
        try:
            held.enter_context(locked(in_folder(path)))
        except BlockingIOError:
            raise ValueError(
                f"folder: must not be in use by another run, got {str(path.parent)!r}; wait, or choose another folder."
            ) from None
        yield


def _read(path: Path | None) -> list[Line]:
    """Return the complete lines of a file; remove an incomplete last line."""
    if path is None or not path.is_file():
        return []
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if whole != content:
        os.truncate(path, len(whole))
    return [json.loads(line) for line in whole.decode("utf-8").splitlines()]
