"""Files are written completely or not at all, through any link, and a lock keeps other runs and no file of the user."""

import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic import _files
from bayesperiodic._files import in_folder, locked, remove_drafts, written_whole

needs_links = pytest.mark.skipif(not hasattr(os, "symlink") or os.name == "nt", reason="needs symbolic links")
needs_pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")


def experiment(level=0.0):
    return bp.Experiment("run", 2.0, {"x": [level, 1.0, 0.0, -1.0]}, samples=4)


def linked(folder: Path, how: str) -> tuple[Path, Path]:
    """Return a link and the file to which it leads."""
    disk = folder / "disk"
    disk.mkdir()
    link, target = folder / "run.h5", disk / "data.h5"
    if how == "absolute":
        link.symlink_to(target)
    elif how == "relative":
        link.symlink_to(Path("disk", "data.h5"))
    elif how == "link to a link":
        (disk / "middle").symlink_to("data.h5")
        link.symlink_to("disk/middle")
    else:  # a link to the folder
        (folder / "shelf").symlink_to("disk", target_is_directory=True)
        link = folder / "shelf" / "data.h5"
    return link, target


LINKS = ["absolute", "relative", "link to a link", "folder"]


@needs_links
@pytest.mark.parametrize("how", LINKS)
@pytest.mark.parametrize("exists", [True, False])
def test_links_stay_and_their_targets_are_written(tmp_path, how, exists):
    link, target = linked(tmp_path, how)
    if exists:
        target.write_text("old")
    before = {path: os.readlink(path) for path in tmp_path.rglob("*") if path.is_symlink()}
    experiment().save(link)
    assert not target.is_symlink() and bp.load(target).outputs["x"][1] == bp.load(link).outputs["x"][1] == 1.0
    assert {path: os.readlink(path) for path in tmp_path.rglob("*") if path.is_symlink()} == before
    assert not [*tmp_path.rglob(".*")]


@needs_links
@pytest.mark.parametrize("how", LINKS)
def test_failed_write_through_a_link_leaves_link_and_target(tmp_path, how, monkeypatch):
    link, target = linked(tmp_path, how)
    target.write_text("old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        experiment().save(link)
    with pytest.raises(ZeroDivisionError), written_whole(link) as draft:
        draft.write_text("half")
        1 / 0  # noqa: B018
    assert target.read_text() == link.read_text() == "old" and not [*tmp_path.rglob(".*")]


@needs_links
def test_path_that_leads_nowhere_is_refused(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    (tmp_path / "c").symlink_to("nowhere/run.h5")
    with pytest.raises(OSError, match="path: must not be a loop of symbolic links"):
        experiment().save(tmp_path / "a")
    with pytest.raises(FileNotFoundError, match="path: must be in an existing folder"):
        experiment().save(tmp_path / "c")
    assert sorted(os.listdir(tmp_path)) == ["a", "b", "c"]


@needs_pipes
def test_folders_devices_and_pipes_are_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    for name in ("pipe", "link"):
        with pytest.raises(OSError, match="path: must be a file, got .*, a device or a pipe"):
            experiment().save(tmp_path / name)
        with pytest.raises(FileNotFoundError, match="path: must be an existing file"):
            bp.load(tmp_path / name)
    with pytest.raises(OSError, match="path: must be a file, got '/dev/null', a device"):
        experiment().save("/dev/null")
    with pytest.raises(IsADirectoryError, match="path: must be a file, got the folder"):
        experiment().save(tmp_path)
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode) and not Path("/dev/null").is_file()


@pytest.mark.skipif(os.name == "nt", reason="needs modes of files")
def test_a_replaced_file_keeps_who_may_read_it(tmp_path):
    path = tmp_path / "run.h5"
    for mode in (0o600, 0o640, 0o664):
        experiment().save(path)
        path.chmod(mode)
        experiment().save(path)
        assert stat.S_IMODE(path.stat().st_mode) == mode


@pytest.mark.skipif(not hasattr(os, "getgroups"), reason="needs groups of files")
def test_a_replaced_file_keeps_its_group(tmp_path):
    """Otherwise the user's first group could read what was open to another one only."""
    path = tmp_path / "run.h5"
    experiment().save(path)
    others = {12345, *os.getgroups()} if os.getuid() == 0 else {*os.getgroups()}
    for group in sorted(others - {path.stat().st_gid})[:2]:
        os.chown(path, -1, group)
        path.chmod(0o640)
        experiment(1.0).save(path)
        assert path.stat().st_gid == group and stat.S_IMODE(path.stat().st_mode) == 0o640


def test_a_file_that_must_not_be_written_is_not_replaced(tmp_path, monkeypatch):
    """A folder in which the user may write would allow it; root may write every file."""
    path = tmp_path / "run.h5"
    experiment().save(path)
    before = path.read_bytes()
    monkeypatch.setattr(os, "access", lambda place, mode: mode != os.W_OK)
    with pytest.raises(PermissionError, match="path: must be a writable file"):
        experiment(1.0).save(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("letters", [251, 120])
def test_long_names_are_written(tmp_path, letters):
    """Names have at most 255 bytes; those of temporary files must not be longer."""
    path = tmp_path / ("ä" * (letters // 2) + "a" * (letters % 2))
    experiment().save(path)
    with locked(path):
        assert bp.load(path).outputs["x"][1] == 1.0
    assert os.listdir(tmp_path) == [path.name]


@needs_links
@pytest.mark.parametrize("how", LINKS)
def test_a_lock_by_a_link_is_that_of_the_file(tmp_path, how):
    link, target = linked(tmp_path, how)
    for one, other in ((link, target), (target, link)):
        with locked(in_folder(one)), pytest.raises(BlockingIOError), locked(in_folder(other)):
            pass
    assert not [*tmp_path.rglob(".*")]


def test_locks_touch_no_file_of_another_program(tmp_path):
    others = ["poetry.lock", ".poetry.lock", "poetry.h5.lock", ".poetry.h5.lock", "poetry.lock.lock"]
    for name in others:
        (tmp_path / name).write_text("of another program")
    for name in ("poetry", "poetry.h5", "poetry.lock"):
        with locked(tmp_path / name):
            pass
    assert {(tmp_path / name).read_text() for name in others} == {"of another program"}
    assert sorted(os.listdir(tmp_path)) == sorted(others)


def lock_file(path: Path) -> Path:
    with locked(path):
        (found,) = [other for other in path.parent.iterdir() if other.name.endswith("-lock")]
    return found


def test_what_stands_in_the_place_of_a_lock_is_not_removed(tmp_path):
    path = tmp_path / "run.h5"
    place = lock_file(path)
    place.write_text("of a user")
    try:
        with locked(path):
            pass
    except (OSError, NotImplementedError):
        pass  # some versions of filelock take a file with content for a lock of theirs
    assert place.read_text() == "of a user"
    place.unlink()
    place.mkdir()
    with pytest.raises(FileExistsError, match="nothing in the place of its lock, got .*; remove it"), locked(path):
        pass
    place.rmdir()


@needs_links
def test_a_link_in_the_place_of_a_lock_is_not_followed(tmp_path):
    path = tmp_path / "run.h5"
    place = lock_file(path)
    (tmp_path / "thesis.tex").write_text("of a user")
    place.symlink_to("thesis.tex")
    with pytest.raises(FileExistsError, match="nothing in the place of its lock, got .*; remove it"), locked(path):
        pass
    assert (tmp_path / "thesis.tex").read_text() == "of a user"


HOLDER = """
import sys, time
from pathlib import Path
from bayesperiodic._files import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600.0)
"""


def test_lock_of_another_process_holds_until_that_ends_in_whatever_way(tmp_path):
    path = tmp_path / "run.h5"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(os.path.abspath(place or ".") for place in sys.path)}
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, path], stdout=subprocess.PIPE, text=True, env=environment)
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(BlockingIOError), locked(path):
        pass
    holder.kill()
    holder.wait()
    holder.stdout.close()
    assert os.listdir(tmp_path)  # the file of the dead process
    with locked(path):
        pass
    assert not os.listdir(tmp_path)


CONTENDER = """
import os, sys
from pathlib import Path
from bayesperiodic._files import locked
path, held = Path(sys.argv[1]), 0
print("ready", flush=True)
sys.stdin.readline()
while held < 200:
    try:
        with locked(path):
            os.close(os.open(path, os.O_CREAT | os.O_EXCL))  # fails if another process holds the lock
            os.unlink(path)
            held += 1
    except BlockingIOError:
        pass
"""


def test_processes_exclude_each_other_while_files_of_locks_come_and_go(tmp_path):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(os.path.abspath(place or ".") for place in sys.path)}
    command, pipe = [sys.executable, "-c", CONTENDER, tmp_path / "run.h5"], subprocess.PIPE
    every = [
        subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment) for _ in range(3)
    ]
    for one in every:
        assert one.stdout.readline() == "ready\n"
    for one in every:
        one.stdin.write("\n")
        one.stdin.flush()
    assert [one.communicate()[1] for one in every] == [""] * 3 and not os.listdir(tmp_path)


def test_threads_of_one_process_exclude_each_other(tmp_path):
    found = []

    def work():
        try:
            with locked(tmp_path / "run.h5"):
                found.append("held")
        except BlockingIOError:
            found.append("in use")

    with locked(tmp_path / "run.h5"):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    work()
    assert found == ["in use", "held"]


def test_only_what_a_killed_process_left_is_removed(tmp_path):
    """A folder of the user whose name begins alike, and that of another file, stay."""
    path = tmp_path / "run.h5"
    for name, file in (("1", "run.h5"), ("2", "thesis.tex"), ("3", None)):
        (tmp_path / f".run.h5.draft-{name}").mkdir()
        if file:
            (tmp_path / f".run.h5.draft-{name}" / file).write_text("")
    (tmp_path / ".run.h5.draft-4").write_text("")
    remove_drafts(path)
    assert sorted(os.listdir(tmp_path)) == [".run.h5.draft-2", ".run.h5.draft-4"]


def test_content_is_sealed_and_read_back(tmp_path):
    for size in (0, 1, 1000):
        content = np.random.default_rng(size).bytes(size)
        _files.write_sealed(tmp_path / "a", memoryview(content))
        assert _files.read_sealed(tmp_path / "a") == content
    for length in (0, 10, 85):
        (tmp_path / "a").write_bytes(b"a" * length)
        with pytest.raises(ValueError, match="it has no checksum"):
            _files.read_sealed(tmp_path / "a")
