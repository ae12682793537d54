"""A run that is killed at any moment resumes to the same chain."""

import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import emcee
import numpy as np
import pytest
from tqdm import tqdm

import bayesperiodic as bp
from bayesperiodic import _parallel
from bayesperiodic._files import locked
from bayesperiodic.density.log_posterior import LogPosterior
from bayesperiodic.sampling import checkpoint
from tests.known import LINEAR, linear_experiment

TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.LogNormal(30.0, 0.5), "coulomb": bp.Normal(20.0, 10.0)}
RUN = {"seed": 5, "ensembles": 2, "walkers": 8, "max_steps": 150, "progress": False}
WRITES = [(os, "fsync"), (os, "replace")]


@pytest.fixture(autouse=True)
def lock_of_this_process(monkeypatch):
    """Keep tqdm's lock, a semaphore, from forked children: one that is killed with it would stop this process too."""
    monkeypatch.setattr(tqdm, "_lock", threading.RLock(), raising=False)


@pytest.fixture(scope="module")
def problem():
    problem = bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=1)], priors=PRIORS)
    return problem, bp.map_estimate(problem, progress=False)


@pytest.fixture(scope="module")
def uninterrupted(problem, tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "run.h5"
    return bp.sample(*problem, checkpoint=path, **RUN), content(path)


def content(path: Path) -> dict[str, np.ndarray]:
    """Return everything that emcee finds in the file: chains, log-densities, accepted counts, random states."""
    backend = emcee.backends.HDFBackend(str(path), read_only=True)
    result = {"chain": backend.get_chain(), "lp": backend.get_log_prob(), "accepted": np.array(backend.accepted)}
    return result | {f"random state {n}": np.array(part) for n, part in enumerate(backend.random_state)}


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)


def in_child(work: Callable[[], object]) -> int:
    """Start work in a child process; return its number."""
    child = os.fork()
    if child == 0:
        try:
            work()
        finally:
            os._exit(0)
    return child


def die_at(monkeypatch: pytest.MonkeyPatch, write: int) -> None:
    """Kill this process instead of its nth write."""
    count = 0

    def counted(original: Callable) -> Callable:
        def wrapper(*arguments, **named):
            nonlocal count
            count += 1
            if count == write:
                os.kill(os.getpid(), signal.SIGKILL)
            return original(*arguments, **named)

        return wrapper

    for owner, name in WRITES:
        monkeypatch.setattr(owner, name, counted(getattr(owner, name)))


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_run_killed_between_any_two_writes_of_a_save_resumes_identically(problem, uninterrupted, tmp_path, monkeypatch):
    """The third save is interrupted at each of its writes; the first two are those of 25 and 50 steps."""
    monkeypatch.setattr(checkpoint, "PATIENCE", 0.0)
    with monkeypatch.context() as patch:
        total = 0

        def counting(original: Callable) -> Callable:
            def wrapper(*arguments, **named):
                nonlocal total
                total += 1
                return original(*arguments, **named)

            return wrapper

        for owner, name in WRITES:
            patch.setattr(owner, name, counting(getattr(owner, name)))
        bp.sample(*problem, checkpoint=tmp_path / "counted.h5", **(RUN | {"max_steps": 50}))
    assert total == 2 * len(WRITES)
    for write in range(total + 1, total + len(WRITES) + 1):
        path = tmp_path / f"run {write}.h5"

        def work(path: Path = path, write: int = write) -> None:
            with pytest.MonkeyPatch.context() as patch:
                die_at(patch, write)
                bp.sample(*problem, checkpoint=path, **RUN)

        _, status = os.waitpid(in_child(work), 0)
        assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
        assert len(content(path)["chain"]) == 50
        bp.sample(*problem, checkpoint=path, **RUN)
        assert same(content(path), uninterrupted[1])


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_run_killed_at_random_moments_resumes_identically(problem, uninterrupted, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "PATIENCE", 0.0)
    started = time.monotonic()
    bp.sample(*problem, checkpoint=tmp_path / "timed.h5", **RUN)
    duration = time.monotonic() - started
    for number, moment in enumerate(np.random.default_rng(1).uniform(0.0, duration, 20)):
        path = tmp_path / f"run {number}.h5"
        child = in_child(lambda path=path: bp.sample(*problem, checkpoint=path, **RUN))
        time.sleep(moment)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        resumed = bp.sample(*problem, checkpoint=path, **RUN)
        assert same(content(path), uninterrupted[1])
        assert np.array_equal(resumed.draws("k"), uninterrupted[0].draws("k"))
        assert resumed.log_posterior_calls == uninterrupted[0].log_posterior_calls


def test_interrupted_run_returns_its_draws_and_can_be_resumed(problem, uninterrupted, tmp_path, monkeypatch):
    """Ctrl-C in the third block gives a result marked as interrupted; the resumed chain is the same."""
    path, calls = tmp_path / "run.h5", 0
    original = LogPosterior.log_likelihood

    def interrupted(self, *arguments, **named):
        nonlocal calls
        calls += 1
        if calls == 150:
            signal.raise_signal(signal.SIGINT)
        return original(self, *arguments, **named)

    with monkeypatch.context() as patch:
        patch.setattr(LogPosterior, "log_likelihood", interrupted)
        partial = bp.sample(*problem, checkpoint=path, **RUN)
    assert not partial.converged and partial.reason.startswith("interrupted after ")
    assert "NOT CONVERGED" in repr(partial)
    bp.sample(*problem, checkpoint=path, **RUN)
    assert same(content(path), uninterrupted[1])


def test_chain_can_be_extended(problem, uninterrupted, tmp_path):
    path = tmp_path / "run.h5"
    bp.sample(*problem, checkpoint=path, **(RUN | {"max_steps": 100}))
    further = bp.sample(*problem, checkpoint=path, **RUN)
    assert same(content(path), uninterrupted[1])
    again = bp.sample(*problem, checkpoint=path, **RUN)
    assert again.reason == further.reason == uninterrupted[0].reason


def test_checkpoint_of_a_version_without_surrogates_is_resumed(problem, uninterrupted, tmp_path, monkeypatch):
    path, load = tmp_path / "run.h5", checkpoint.Checkpoint.load
    bp.sample(*problem, checkpoint=path, **(RUN | {"max_steps": 100}))

    def earlier(self):
        backend, state = load(self)
        return backend, {key: value for key, value in state.items() if key not in ("shares", "moved")}

    monkeypatch.setattr(checkpoint.Checkpoint, "load", earlier)
    assert bp.sample(*problem, checkpoint=path, **RUN).reason == uninterrupted[0].reason


def test_checkpoint_that_is_damaged_locked_or_of_another_run_is_rejected(problem, tmp_path):
    path = tmp_path / "run.h5"
    bp.sample(*problem, checkpoint=path, **(RUN | {"max_steps": 50}))
    with pytest.raises(
        ValueError, match=r"checkpoint: must be a file of this run \(seed 6.*\), got .* of another run \(seed 5"
    ):
        bp.sample(*problem, checkpoint=path, **(RUN | {"seed": 6}))
    with locked(path), pytest.raises(ValueError, match="checkpoint: must not be in use by another run"):
        bp.sample(*problem, checkpoint=path, **RUN)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="checkpoint: must be an intact file, got .* no checksum"):
        bp.sample(*problem, checkpoint=path, **RUN)
    for place in np.random.default_rng(1).integers(len(whole), size=60):
        damaged = bytearray(whole)
        damaged[place] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="checkpoint: must be an intact file, got"):
            bp.sample(*problem, checkpoint=path, **RUN)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs the limits of Unix")
def test_full_disk_is_an_error_after_which_the_run_goes_on(problem, uninterrupted, tmp_path, monkeypatch):
    import resource

    path = tmp_path / "run.h5"
    bp.sample(*problem, checkpoint=path, **(RUN | {"max_steps": 50}))
    before, (soft, hard) = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before), hard))
    try:
        with pytest.raises(OSError, match=r"checkpoint: cannot be written .*the same call goes on from it"):
            bp.sample(*problem, checkpoint=path, **RUN)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["run.h5"]
    bp.sample(*problem, checkpoint=path, **RUN)
    assert same(content(path), uninterrupted[1])


def test_draft_of_a_killed_process_is_removed_at_the_next_run(problem, tmp_path):
    draft = tmp_path / ".run.h5.draft-killed"
    draft.mkdir()
    (draft / "run.h5").write_bytes(b"half")
    bp.sample(*problem, checkpoint=tmp_path / "run.h5", **(RUN | {"max_steps": 50}))
    assert os.listdir(tmp_path) == ["run.h5"]


def terminated_at(monkeypatch: pytest.MonkeyPatch, call: int) -> None:
    """Send SIGTERM at the nth call of the likelihood."""
    original, calls = LogPosterior.log_likelihood, iter(range(10**9))

    def terminated(self, *arguments, **named):
        if next(calls) == call:
            os.kill(os.getpid(), signal.SIGTERM)
        return original(self, *arguments, **named)

    monkeypatch.setattr(LogPosterior, "log_likelihood", terminated)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
@pytest.mark.parametrize("call", [10, 150])
@pytest.mark.parametrize("with_checkpoint", [True, False])
def test_termination_ends_the_process_after_the_checkpoint_was_saved(
    problem, uninterrupted, tmp_path, with_checkpoint, call
):
    """Also after fewer steps than a result needs; nothing that follows `sample` runs."""
    path, after = tmp_path / "run.h5", tmp_path / "after"

    def work() -> None:
        with pytest.MonkeyPatch.context() as patch:
            terminated_at(patch, call)
            bp.sample(*problem, checkpoint=path if with_checkpoint else None, **RUN)
        after.write_text("the program went on")

    _, status = os.waitpid(in_child(work), 0)
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGTERM
    assert os.listdir(tmp_path) == (["run.h5"] if with_checkpoint else [])
    if with_checkpoint:
        assert 0 < len(content(path)["chain"]) < 150
        bp.sample(*problem, checkpoint=path, **RUN)
        assert same(content(path), uninterrupted[1])


def test_termination_raises_where_the_signal_has_no_effect(problem, uninterrupted, tmp_path, monkeypatch):
    """As in the first process of a container, which the kernel protects."""
    path = tmp_path / "run.h5"
    with monkeypatch.context() as patch:
        terminated_at(patch, 150)
        patch.setattr(signal, "raise_signal", lambda _: None)
        with pytest.raises(KeyboardInterrupt):
            bp.sample(*problem, checkpoint=path, **RUN)
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    bp.sample(*problem, checkpoint=path, **RUN)
    assert same(content(path), uninterrupted[1])


class Stopped(Exception):
    """Raised by the handler of a user."""


@pytest.mark.parametrize("raises", [True, False])
def test_handler_of_the_user_is_called_and_stays(problem, tmp_path, monkeypatch, raises):
    received = []

    def handler(number, _):
        received.append(number)
        if raises:
            raise Stopped

    before = signal.signal(signal.SIGTERM, handler)
    try:
        terminated_at(monkeypatch, 30)
        with pytest.raises(Stopped) if raises else nullcontext():
            bp.sample(*problem, checkpoint=tmp_path / "run.h5", **(RUN | {"max_steps": 50}))
        assert received == [signal.SIGTERM] and signal.getsignal(signal.SIGTERM) is handler
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_run_in_another_thread_leaves_signals_alone(problem, monkeypatch):
    found, original = set(), LogPosterior.log_likelihood

    def watched(self, *arguments, **named):
        found.update(map(signal.getsignal, (signal.SIGINT, signal.SIGTERM)))
        return original(self, *arguments, **named)

    monkeypatch.setattr(LogPosterior, "log_likelihood", watched)
    with ThreadPoolExecutor(1) as pool:
        posterior = pool.submit(lambda: bp.sample(*problem, **(RUN | {"max_steps": 50}))).result()
    assert posterior.draws("k").size and found == {signal.default_int_handler, signal.SIG_DFL}


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_termination_of_a_whole_group_of_processes_ends_the_run_though_its_workers_were_lost(problem, tmp_path):
    """As a cluster's batch system sends it: the broken pool must not turn it into a result."""
    path, after = tmp_path / "run.h5", tmp_path / "after"

    def work() -> None:
        os.setsid()
        original, calls = _parallel.TaskPool.run, iter(range(10**9))

        def killing(self, *arguments, **named):
            yield from original(self, *arguments, **named)
            if next(calls) == 120:
                os.killpg(0, signal.SIGTERM)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(_parallel.TaskPool, "run", killing)
            bp.sample(*problem, checkpoint=path, executor=2, **RUN)
        after.write_text("the program went on")

    _, status = os.waitpid(in_child(work), 0)
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGTERM
    assert os.listdir(tmp_path) == ["run.h5"] and len(content(path)["chain"]) >= 50


def test_no_temporary_files_remain_beside_the_checkpoint(problem, tmp_path):
    bp.sample(*problem, checkpoint=tmp_path / "run.h5", **(RUN | {"max_steps": 50}))
    assert [path.name for path in tmp_path.iterdir()] == ["run.h5"]


SHORT = RUN | {"max_steps": 50}


def test_files_of_other_programs_beside_a_checkpoint_stay(problem, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "poetry.lock").write_text("of another program")
    (tmp_path / ".poetry.draft-1").mkdir()
    (tmp_path / ".poetry.draft-1" / "thesis.tex").write_text("")
    bp.sample(*problem, checkpoint="poetry", **SHORT)
    assert (tmp_path / "poetry.lock").read_text() == "of another program"
    assert sorted(os.listdir(tmp_path)) == [".poetry.draft-1", "poetry", "poetry.lock"]


@pytest.mark.skipif(os.name == "nt", reason="needs symbolic links")
@pytest.mark.parametrize("exists", [True, False])
def test_a_link_and_its_file_are_one_checkpoint(problem, uninterrupted, tmp_path, monkeypatch, exists):
    """The link is relative to its folder, and the current folder changes while the run goes on."""
    (tmp_path / "disk").mkdir()
    link, target = tmp_path / "run.h5", tmp_path / "disk" / "data.h5"
    if exists:
        bp.sample(*problem, checkpoint=target, **SHORT)
    link.symlink_to("disk/data.h5")
    monkeypatch.chdir(tmp_path)
    original, in_use = LogPosterior.log_likelihood, []

    def elsewhere(self, *arguments, **named):
        if not in_use:
            in_use.append(True)
            for other in (link, target, Path("run.h5"), Path("disk", "..", "run.h5")):
                with pytest.raises(ValueError, match="checkpoint: must not be in use by another run"):
                    bp.sample(*problem, checkpoint=other, **SHORT)
            os.chdir(tmp_path / "disk")
        return original(self, *arguments, **named)

    with monkeypatch.context() as patch:
        patch.setattr(LogPosterior, "log_likelihood", elsewhere)
        bp.sample(*problem, checkpoint="run.h5", **(RUN if exists else SHORT))
    assert link.is_symlink() and not target.is_symlink() and in_use
    assert sorted(os.listdir(tmp_path)) == ["disk", "run.h5"] and os.listdir(tmp_path / "disk") == ["data.h5"]
    bp.sample(*problem, checkpoint=target, **RUN)
    assert same(content(link), uninterrupted[1])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_checkpoint_that_is_no_file_is_refused(problem, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    messages = {
        tmp_path: "must be a file, got the folder .*; add a file name",
        tmp_path / "pipe": "must be a file, got .*, a device or a pipe; name another file",
        "/dev/null": "must be a file, got '/dev/null', a device or a pipe; name another file",
        tmp_path / "loop": "must be a writable file, got .* a loop of symbolic links.*; name another file",
        tmp_path / "nowhere" / "run.h5": "must be in an existing folder, got '[^']*run.h5'; create the folder",
    }
    for place, message in messages.items():
        with pytest.raises(ValueError, match=f"^checkpoint: {message}"):
            bp.sample(*problem, checkpoint=place, **SHORT)
    assert sorted(os.listdir(tmp_path)) == ["loop", "pipe"]


def test_checkpoint_in_a_folder_that_cannot_be_written_is_refused(problem, tmp_path, monkeypatch):
    def denied(path, flags, *arguments, **named):
        if flags & os.O_CREAT and str(tmp_path) in os.fspath(path):
            raise PermissionError(13, "Permission denied", path)
        return original(path, flags, *arguments, **named)

    original = os.open
    monkeypatch.setattr(os, "open", denied)
    with pytest.raises(ValueError, match="checkpoint: must be a writable file, got .*Permission denied"):
        bp.sample(*problem, checkpoint=tmp_path / "run.h5", **SHORT)
