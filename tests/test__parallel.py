"""Task pools: which workers run the tasks, what is sent to them, and what happens when they fail."""

import os
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections import Counter
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

from bayesperiodic import _parallel
from bayesperiodic._parallel import (
    TaskPool,
    WorkersLost,
    available_cores,
    checked_executor,
    ended_by_termination,
    in_threads,
    interrupts_deferred,
)

LOADS: Counter[str] = Counter()


class Cargo:
    """Shared data that count how often this process has unpickled them."""

    def __init__(self):
        self.name = str(uuid.uuid4())

    def __setstate__(self, state):
        self.__dict__.update(state)
        LOADS[self.name] += 1


def report(cargo: Cargo, task: float) -> tuple[int, int, int]:
    time.sleep(task)
    return os.getpid(), LOADS[cargo.name], available_cores()


def power(base: int, exponent: int) -> int:
    return base**exponent


def fail(_: object, task: int) -> None:
    raise ArithmeticError(f"task {task}")


def die(_: object, task: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


class Recording(ProcessPoolExecutor):
    """A pool that remembers which tasks carried the shared data."""

    def __init__(self, workers: int):
        super().__init__(workers, get_context("spawn"))
        self.carried: list[bool] = []

    def submit(self, function, /, *arguments):  # noqa: D102
        self.carried.append(arguments[3] is not None)
        return super().submit(function, *arguments)


class Forgetful:
    """An executor with one process that is replaced after every third task."""

    def __init__(self):
        self.carried: list[bool] = []

    def submit(self, function, /, *arguments) -> Future:  # noqa: D102
        self.carried.append(arguments[3] is not None)
        if len(self.carried) % 3 == 0:
            _parallel._UNPICKLED.clear()
        future: Future = Future()
        future.set_result(function(*arguments))
        return future


@pytest.fixture(params=["threads of this process", "given threads", "processes", "dask", "forgetful"])
def executor(request):
    if request.param in ("processes", "dask"):
        return request.getfixturevalue(request.param)
    if request.param == "given threads":
        pool = ThreadPoolExecutor(2)
        request.addfinalizer(pool.shutdown)
        return pool
    return Forgetful() if request.param == "forgetful" else None


def test_every_task_runs_once_and_keeps_its_number(executor):
    with TaskPool(executor, 2) as tasks:
        found = list(tasks.run(power, range(20)))
    assert sorted(found) == [(n, 2**n) for n in range(20)]


def test_a_task_may_submit_another(executor):
    """Chains of powers, 3 → 3² → 3⁴ and so on, each as long as its number says."""
    lengths = [1, 3, 2, 4]
    done: Counter[int] = Counter()

    def then(number: int, value: int) -> int | None:
        done[number] += 1
        return done[number] + 1 if done[number] < lengths[number] else None

    with TaskPool(executor, 3) as tasks:
        found = list(tasks.run(power, [1] * 4, then))
    assert [max(value for n, value in found if n == number) for number in range(4)] == [3**length for length in lengths]
    assert len(found) == sum(lengths)


def test_exception_of_a_task_is_raised_to_the_caller(executor):
    with pytest.raises(ArithmeticError, match="task 7"), TaskPool(executor, None) as tasks:
        list(tasks.run(fail, [7]))


@pytest.mark.parametrize("which", ["processes", "dask"])
def test_shared_data_are_unpickled_once_in_each_process_and_tasks_have_one_core(which, request):
    executor = request.getfixturevalue(which)
    with TaskPool(executor, Cargo()) as tasks:
        found = [report for _, report in tasks.run(report, [0.02] * 20)]
    assert {loads for _, loads, _ in found} == {1}
    assert {cores for *_, cores in found} == {1}
    assert len({process for process, *_ in found}) <= 2 and os.getpid() not in {process for process, *_ in found}
    assert available_cores() == len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else True


def test_shared_data_are_sent_about_once_per_worker_and_not_copied_for_threads():
    """Two carriers for two workers; a process that starts late asks for them, at most once for each queued task."""
    cargo = Cargo()
    with Recording(2) as pool, TaskPool(pool, cargo) as tasks:
        assert len(list(tasks.run(report, [0.01] * 40))) == 40
    assert 2 <= sum(pool.carried) <= 2 + 2 * _parallel.QUEUED_PER_WORKER
    with TaskPool(None, cargo) as tasks:
        assert {loads for _, (_, loads, _) in tasks.run(report, [0.0] * 4)} == {0}


def test_worker_that_lost_the_shared_data_receives_them_again():
    executor = Forgetful()
    with TaskPool(executor, 2) as tasks:
        assert sorted(tasks.run(power, range(12))) == [(n, 2**n) for n in range(12)]
    assert 1 < sum(executor.carried) < len(executor.carried)


def test_dead_workers_raise_one_error():
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        with pytest.raises(WorkersLost, match=r"executor: its workers were lost \(BrokenProcessPool: "):
            with TaskPool(pool, None) as tasks:
                list(tasks.run(die, [0]))
        with pytest.raises(WorkersLost, match="BrokenProcessPool"), TaskPool(pool, None) as tasks:
            list(tasks.run(power, [0]))
    closed = ThreadPoolExecutor(1)
    closed.shutdown()
    with pytest.raises(WorkersLost, match="cannot schedule new futures after shutdown"), TaskPool(closed, 2) as tasks:
        list(tasks.run(power, [1]))


def test_a_task_that_kills_dask_workers_ends_the_run(dask, monkeypatch):
    """Dask abandons a task after the first worker that it kills."""
    monkeypatch.setattr(dask.cluster.scheduler, "allowed_failures", 0)
    with (
        pytest.raises(WorkersLost, match=r"executor: its workers were lost \(KilledWorker: "),
        TaskPool(dask, None) as tasks,
    ):
        list(tasks.run(die, [0]))


def test_error_for_a_script_without_main_guard_names_it(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import operator\nfrom bayesperiodic._parallel import TaskPool\n"
        "with TaskPool(1, 2) as tasks:\n    print(list(tasks.run(operator.pow, [3])))\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path or "." for path in sys.path)}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=environment)
    assert "must have its calls below: if __name__ == '__main__'" in done.stderr.strip().splitlines()[-1]


def test_script_from_the_standard_input_is_refused_by_one_message():
    """New processes would read a file of the name <stdin>. Code given by -c has no file, and is no obstacle."""
    script = (
        "import operator\nfrom bayesperiodic._parallel import TaskPool\nif __name__ == '__main__':\n"
        "    with TaskPool(1, 2) as tasks:\n        print(list(tasks.run(operator.pow, [3])))\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path or "." for path in sys.path)}
    options = {"capture_output": True, "text": True, "env": environment}
    done = subprocess.run([sys.executable, "-"], input=script, **options)
    assert "ValueError: executor: must be None in a script from <stdin>, got 1" in done.stderr.splitlines()[-1]
    assert done.stderr.count("Traceback") == 1
    assert subprocess.run([sys.executable, "-c", script], **options).stdout == "[(0, 8)]\n"


@pytest.mark.parametrize("bad", [0, -2, True, 1.5, "2", ThreadPoolExecutor, [2], get_context("spawn")])
def test_object_that_is_no_executor_is_rejected(bad):
    with pytest.raises(ValueError, match=r"executor: must be None, a number of processes >= 1, .*got"):
        checked_executor(bad)


def test_object_that_cannot_be_pickled_is_rejected(processes):
    with pytest.raises(
        ValueError,
        match=r"executor: must be None, because the problem cannot be pickled \(TypeError: cannot pickle '_th",
    ):
        with TaskPool(processes, threading.Lock()):
            pass


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_between_the_last_check_and_the_end_is_not_lost(number, monkeypatch):
    ends = []
    monkeypatch.setattr(signal, "raise_signal", ends.append)
    with pytest.raises(KeyboardInterrupt), ended_by_termination():
        with interrupts_deferred() as check:
            check()
            os.kill(os.getpid(), number)
    assert ends == [signal.SIGTERM] * (number == signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_termination_is_not_lost_beside_another_error(monkeypatch):
    """Also where the error, or a handler of it, replaces the interrupt."""
    ends = []
    monkeypatch.setattr(signal, "raise_signal", ends.append)
    with pytest.raises(KeyboardInterrupt), ended_by_termination():
        with interrupts_deferred():
            os.kill(os.getpid(), signal.SIGTERM)
            raise WorkersLost("executor: lost")
    with pytest.raises(KeyboardInterrupt), ended_by_termination():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except KeyboardInterrupt:
            pass
    assert ends == [signal.SIGTERM] * 2


def test_a_second_signal_acts_at_once():
    with pytest.raises(KeyboardInterrupt), interrupts_deferred():
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        raise AssertionError("not interrupted")


def line(_: object, task: int) -> dict:
    return {"task": task, "source": "a"}


@pytest.mark.skipif(os.name == "nt", reason="needs symbolic links")
def test_results_of_tasks_are_appended_through_links_which_exclude_each_other(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "shelf").symlink_to("disk", target_is_directory=True)
    (tmp_path / "lines.jsonl").symlink_to("disk/lines.jsonl")
    (tmp_path / "disk" / ".lines.jsonl.lock").write_text("of another program")
    paths = [tmp_path / "shelf" / "lines.jsonl", tmp_path / "lines.jsonl", tmp_path / "disk" / "lines.jsonl"]

    def run(path: Path, last: int) -> list[dict]:
        return _parallel.checkpointed_tasks(path, range(last), line, lambda done: done["task"], "a", progress=False)

    for last, path in enumerate(paths, 1):
        assert run(path, last) == [line(None, task) for task in range(last)]
    assert len(paths[2].read_text().splitlines()) == 3 and paths[1].is_symlink()
    for one in paths:
        with _parallel._locked(one):
            for other in paths:
                with pytest.raises(ValueError, match="folder: must not be in use by another run"):
                    run(other, 4)
    assert sorted(os.listdir(tmp_path / "disk")) == [".lines.jsonl.lock", "lines.jsonl"]
    assert (tmp_path / "disk" / ".lines.jsonl.lock").read_text() == "of another program"


def test_items_shared_by_threads_keep_their_order_and_raise():
    assert in_threads(lambda x: x * x, list(range(50)), 3) == [x * x for x in range(50)]
    assert in_threads(lambda x: x, [], 3) == []
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda x: 1 / x, [1, 0, 2], 2)


ORPHANS = """
import os, sys, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from bayesperiodic._parallel import TaskPool

def busy(shared, task):
    os.write(1, f"{os.getpid()}\\n".encode())
    time.sleep(600.0)

if __name__ == "__main__":
    executor = 2 if sys.argv[1] == "number" else ProcessPoolExecutor(2, get_context(sys.argv[1]))
    with TaskPool(executor, None) as pool:
        list(pool.run(busy, [1, 2]))
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for processes in /proc")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
@pytest.mark.parametrize("workers", ["number", "spawn", "forkserver", "fork"])
def test_workers_end_when_their_parent_is_killed(tmp_path, how, workers):
    """Also those of an executor of the user, which wait for tasks forever otherwise.

    The tasks would run for ten minutes; the limit of a minute is for slow machines.
    """
    (tmp_path / "orphans.py").write_text(ORPHANS)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen(
        [sys.executable, "orphans.py", workers], cwd=tmp_path, stdout=subprocess.PIPE, text=True, env=environment
    )
    workers = [int(parent.stdout.readline()) for _ in range(2)]
    os.kill(parent.pid, how)
    parent.wait()
    left, limit = workers, time.monotonic() + 60.0
    while left and time.monotonic() < limit:
        time.sleep(0.1)
        left = [number for number in workers if os.path.exists(f"/proc/{number}")]
    parent.stdout.close()
    assert not left
