"""Files that are written completely or not at all, also through symbolic links, and locks of files.

Names of temporary files and of locks are derived from the name of the file itself, not of a link to it, and stand
beside it, so that runs that use links and runs that use the name exclude each other.
"""

import errno
import glob
import hashlib
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

SEAL = b"\nbayesperiodic sha256 "
# Bytes of a seal with its digest.
SEAL_BYTES = len(SEAL) + 2 * hashlib.sha256().digest_size
# Bytes of the name of a file that are repeated in the names beside it; file systems take 255 in all.
LONGEST_REPEATED = 150


def in_folder(path: str | Path) -> Path:
    """Return the file to which a path leads, with all links resolved; raise an OSError if it cannot be written."""
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise OSError(errno.ELOOP, "path: must not be a loop of symbolic links", str(path))
    if not target.parent.is_dir():
        raise FileNotFoundError(f"path: must be in an existing folder, got {str(path)!r}; create the folder.")
    if target.is_dir():
        raise IsADirectoryError(f"path: must be a file, got the folder {str(path)!r}; add a file name.")
    if target.exists() and not target.is_file():
        raise OSError(f"path: must be a file, got {str(path)!r}, a device or a pipe; name another file.")
    if target.exists() and not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, "path: must be a writable file", str(path))
    return target


def _beside(target: Path, kind: str) -> str:
    """Return the name of a hidden file beside a file."""
    name = target.name
    if len(os.fsencode(name)) > LONGEST_REPEATED:
        name = hashlib.sha256(os.fsencode(name)).hexdigest()
    return f".{name}.{kind}"


@contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """Provide a temporary path; when the block ends without an error, its file replaces that to which `path` leads."""
    target = in_folder(path)
    with tempfile.TemporaryDirectory(prefix=_beside(target, "draft-"), dir=target.parent) as folder:
        draft = Path(folder) / target.name
        yield draft
        with draft.open("rb+") as file:
            os.fsync(file.fileno())
        if target.exists():  # who may read the file remains as it was
            with suppress(OSError):  # of a group of which the user is no member
                if hasattr(os, "chown"):
                    os.chown(draft, -1, target.stat().st_gid)
            shutil.copymode(target, draft)
        os.replace(draft, target)


def remove_drafts(target: Path) -> None:
    """Remove the temporary folders that a killed process has left beside a file; only its holder may do so."""
    for draft in target.parent.glob(f"{glob.escape(_beside(target, 'draft-'))}*"):
        with suppress(OSError):
            if not draft.is_symlink() and {*os.listdir(draft)} <= {target.name}:
                shutil.rmtree(draft)


@contextmanager
def locked(target: Path, *, wait: float = 0.0) -> Iterator[None]:
    """Hold the lock of a file from `in_folder`; raise a BlockingIOError if another run holds it for so many seconds.

    The lock ends with its process. Its file has a name that no other program uses; one that was there before is taken
    over only if it is empty, as a killed process leaves it, and others are not removed.
    """
    from filelock import FileLock, Timeout

    place = target.with_name(_beside(target, "bayesperiodic-lock"))
    foreign = False
    with suppress(FileNotFoundError):  # its holder may remove it at any time
        status = os.lstat(place)
        if not stat.S_ISREG(status.st_mode):
            raise FileExistsError(f"path: must have nothing in the place of its lock, got {str(place)!r}; remove it.")
        foreign = status.st_size > 0
    lock = FileLock(place, timeout=wait)
    try:
        lock.acquire()
    except Timeout:
        raise BlockingIOError(errno.EAGAIN, "used by another run", str(target)) from None
    try:
        yield
    finally:
        if not foreign:
            with suppress(OSError):  # Windows removes no open file
                place.unlink()
        lock.release()


def write_sealed(path: str | Path, content: memoryview) -> None:
    """Write content and its checksum; an existing file is replaced when the new one is complete, or else stays."""
    with written_whole(path) as draft, draft.open("wb") as file:
        file.write(content)
        file.write(SEAL + hashlib.sha256(content).hexdigest().encode())


def read_sealed(path: str | Path) -> bytes:
    """Return the content of a file; raise a ValueError if its checksum is missing or wrong."""
    with Path(path).open("rb") as file:
        length = max(file.seek(0, os.SEEK_END) - SEAL_BYTES, 0)
        file.seek(length)
        mark, digest = (end := file.read())[: len(SEAL)], end[len(SEAL) :]
        if mark != SEAL:
            raise ValueError("it has no checksum; it was cut off, or not written by this version of bayesperiodic")
        file.seek(0)
        content = file.read(length)
    if hashlib.sha256(content).hexdigest().encode() != digest:
        raise ValueError("its content has changed since it was written")
    return content
