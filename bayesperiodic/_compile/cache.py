"""Compiled kernels and their cache on disk: one folder per source text and constants, private to its user.

An entry is built in a temporary folder and renamed, by the first of several processes that need it, while the others
wait. Before an entry is executed, the folder and the entry must belong to the user and be closed to others, the source
must equal the expected one, and every compiled file must have the digest recorded when it was written. A damaged entry
is removed, with a warning, and built again; if the folder cannot be used, the kernels are compiled in memory.
"""

import errno
import gc
import hashlib
import json
import os
import platform
import re
import shutil
import stat
import sys
import tempfile
import threading
import time
import types
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import llvmlite.binding
import numba
import platformdirs
from tqdm import tqdm

from bayesperiodic._files import locked
from bayesperiodic._printing import progress_bar

try:
    from numba.core.compiler_lock import global_compiler_lock
except ImportError:
    global_compiler_lock = threading.RLock()  # type: ignore[assignment]

SOURCE, MANIFEST, BUILDING = "kernels.py", "manifest.json", "building-"
# Age in seconds after which an unfinished entry is that of a killed process.
ABANDONED = 3600.0
# Seconds for which a process waits for another one that builds the same entry, before it builds it too.
LONGEST_WAIT = 600.0
# Decorated functions of a text, and seconds from which their compilation is shown.
KERNEL, BAR_AFTER = re.compile(r"^@(?:.*\n(?!def ))*.*\ndef (\w+)", re.MULTILINE), 1.0
COMPILING = "compiling kernels (once per machine)"
# Folders in which no entry could be built; this process does not try again.
_UNUSABLE: set[Path] = set()


class CacheProblem(Exception):
    """The cache cannot be used; the message says why."""


def cache_folder() -> Path:
    """Return the folder of the kernel cache, below $BAYESPERIODIC_CACHE or the user's own cache folder."""
    return Path(os.environ.get("BAYESPERIODIC_CACHE") or platformdirs.user_cache_dir("bayesperiodic")) / "kernels"


def load(
    body: str,
    constants: Mapping[str, Any] | None = None,
    shared: types.ModuleType | None = None,
    run: Callable[..., None] | None = None,
) -> types.ModuleType:
    """Return a source text as a module of compiled functions, from the cache or freshly compiled (and then cached).

    Its functions have Numba signatures and the option ``cache=CACHE``. The constants, values with a unique `repr`, and
    the names of the `shared` module, which this function returned, are defined in the module before its text is
    executed. An entry is compiled again when the text, the constants or the shared module change. A function
    ``run(source, path, module)`` may define the functions of other texts in the module and, if its constant `CACHE` is
    true, keep their machine code beside the path, in files `*.nbc` in `__pycache__`.
    """
    configuration: Any = numba.config
    if configuration.DISABLE_JIT:
        raise RuntimeError("NUMBA_DISABLE_JIT: must not be set, because the kernels need compiled code; unset it.")
    source, names = _definitions(body, constants, shared)
    execute = partial(_execute, source, names, run or _run)
    try:
        entry = _private_folder() / _digest(source)
        if module := _stored(source, entry, execute):
            return module
        if entry.parent not in _UNUSABLE:
            return _build(source, entry, execute)
    except (CacheProblem, OSError, NotImplementedError) as problem:
        if cache_folder() not in _UNUSABLE:
            _UNUSABLE.add(cache_folder())
            warnings.warn(
                f"The kernel cache in {cache_folder()} cannot be used ({problem}); compiling in memory, at every "
                f"start. {_remedy(problem)}",
                RuntimeWarning,
                stacklevel=2,
            )
    return execute(Path("<kernels compiled in memory>"), cache=False)


def _remedy(problem: Exception) -> str:
    """Return what to do about a cache that cannot be used."""
    if isinstance(problem, OSError) and problem.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)):
        return "Free space there, or set BAYESPERIODIC_CACHE to a folder on another disk."
    if isinstance(problem, CacheProblem):
        return "Delete the folder, or set BAYESPERIODIC_CACHE to one that you own and others cannot write to."
    return "Set BAYESPERIODIC_CACHE to a folder in which you may write."


def is_stored(body: str, constants: Mapping[str, Any]) -> bool:
    """Return whether the cache has an entry of a text without a shared module, or cannot be used."""
    try:
        return (_private_folder() / _digest(_definitions(body, constants, None)[0])).exists()
    except (CacheProblem, OSError):
        return True


def declare(body: str, constants: Mapping[str, Any] | None = None) -> types.ModuleType:
    """Return a text as a module whose kernels are not compiled: what calls them can be, for the cache, but not run."""
    source, names = _definitions(body, constants, None)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / SOURCE
        path.write_text(source, encoding="utf-8")
        return _execute(source, {**names, "DECLARED": True}, _run, path, cache=True)


def _definitions(
    body: str, constants: Mapping[str, Any] | None, shared: types.ModuleType | None
) -> tuple[str, dict[str, Any]]:
    """Return the text of an entry, and the names that are defined before it is executed."""
    constants, before = dict(constants or {}), vars(shared) if shared else {}
    source = f"{_header()}# {constants!r}, {shared.__name__ if shared else None}\n{body}"
    shown = {name: value for name, value in before.items() if not name.startswith("__")}
    return source, {**shown, **constants, "DECLARED": False}


def _digest(source: str) -> str:
    return hashlib.sha256(source.encode()).hexdigest()[:32]


def _stored(source: str, entry: Path, execute: Callable[..., types.ModuleType]) -> types.ModuleType | None:
    """Return the module of an entry; None if there is none, or if it was damaged and has been removed."""
    if not os.path.lexists(entry):
        return None
    try:
        _check(entry, source)
        return execute(entry / SOURCE, cache=True)
    except CacheProblem as problem:
        reason = str(problem)
    except Exception as problem:  # any error that a damaged compiled file causes in the loader
        reason = f"{type(problem).__name__}: {problem}"
    _remove(entry)  # before the warning, which may be an error
    warnings.warn(f"A damaged entry of the kernel cache is built again ({reason}).", RuntimeWarning, stacklevel=3)
    return None


def _remove(entry: Path) -> None:
    """Remove an entry at once, also while another process reads it."""
    with tempfile.TemporaryDirectory(prefix=BUILDING, dir=entry.parent, ignore_cleanup_errors=True) as aside:
        entry.rename(Path(aside) / entry.name)


def _header() -> str:
    """Return the versions and the processor, on which the machine code depends besides the text."""
    settings: Any = numba.config
    name = settings.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    features = settings.CPU_FEATURES or llvmlite.binding.get_host_cpu_features().flatten()
    machine = f"{platform.machine()} {llvmlite.binding.get_process_triple()} {name} {features}"
    versions = f"numba {numba.__version__}, llvmlite {llvmlite.__version__}, python {platform.python_version()}"
    return f"# {versions}, {machine}\n"


def _private_folder() -> Path:
    """Return the folder; raise a CacheProblem if others could put entries there.

    The folder above may be open to the user's group, as many systems create it, or to all like /tmp, where only the
    owner of a folder can rename it.
    """
    folder = cache_folder()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if hasattr(os, "getuid"):
        status, above = folder.stat(), folder.parent.stat()
        if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
            raise CacheProblem("it is not private to this user (owner only, mode 0700)")
        if above.st_uid not in (os.getuid(), 0) or stat.S_IMODE(above.st_mode) & (0o002 | stat.S_ISVTX) == 0o002:
            raise CacheProblem(f"others can replace it, because {folder.parent} is theirs or open to all")
    return folder


def _announce(source: str) -> None:
    """Tell how many kernels are compiled, where no progress bar can be updated; functions of models take no time."""
    count = len(KERNEL.findall(source))
    if count and not sys.stderr.isatty():
        print(f"compiling {count} kernel{'s'[: count > 1]} (once per machine) …", file=sys.stderr, flush=True)


def _build(source: str, entry: Path, execute: Callable[..., types.ModuleType]) -> types.ModuleType:
    """Return the module of a new entry, or of one that another process has built meanwhile."""
    for other in entry.parent.glob(f"{BUILDING}*"):
        with suppress(OSError):
            if other.stat().st_mtime < time.time() - ABANDONED:
                shutil.rmtree(other)
    with global_compiler_lock, _alone(entry):  # in this order, because texts that are executed may load others
        if module := _stored(source, entry, execute):
            return module
        _announce(source)
        workshop = Path(tempfile.mkdtemp(prefix=BUILDING, dir=entry.parent))
        try:
            (workshop / SOURCE).write_text(source, encoding="utf-8")
            module = execute(workshop / SOURCE, cache=True)
            (workshop / MANIFEST).write_text(json.dumps(_digests(workshop)), encoding="utf-8")
            try:
                workshop.rename(entry)
            except OSError:
                if not entry.is_dir():
                    raise
            return module
        finally:
            shutil.rmtree(workshop, ignore_errors=True)


@contextmanager
def _alone(entry: Path) -> Iterator[None]:
    """Wait until no other process builds an entry, where files can be locked."""
    with ExitStack() as held:
        with suppress(OSError, NotImplementedError):
            held.enter_context(locked(entry, wait=LONGEST_WAIT))
        yield


def _check(entry: Path, source: str) -> None:
    """Raise a CacheProblem unless an entry is complete, unchanged, and was written by this user."""
    try:
        files = [entry, *entry.rglob("*")]
        if hasattr(os, "getuid") and ({file.lstat().st_uid for file in files} != {os.getuid()}):
            raise CacheProblem(f"the entry {entry.name} has files of another user")
        if any(file.is_symlink() for file in files):
            raise CacheProblem(f"the entry {entry.name} contains links")
        if (entry / SOURCE).read_text(encoding="utf-8") != source:
            raise CacheProblem(f"the source in {entry.name} is not the one expected")
        if json.loads((entry / MANIFEST).read_text(encoding="utf-8")) != _digests(entry):
            raise CacheProblem(f"the compiled files in {entry.name} have changed since they were written")
    except (OSError, ValueError):
        raise CacheProblem(f"the entry {entry.name} is incomplete") from None


def _digests(entry: Path) -> dict[str, str]:
    files = sorted(p for p in (entry / "__pycache__").glob("*") if p.suffix in (".nbi", ".nbc"))
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


class _Names(dict[str, Any]):
    """The names of a module that is executed, which advance a progress bar by each kernel that is defined."""

    def __init__(self, module: types.ModuleType, source: str, bar: tqdm):
        super().__init__()
        self._module, self._kernels, self._bar = module, set(KERNEL.findall(source)), bar

    def __setitem__(self, name: str, value: Any) -> None:
        self._module.__dict__[name] = value
        self._bar.update(name in self._kernels)


def _run(source: str, path: Path, module: types.ModuleType) -> None:
    """Execute a text, with a progress bar of its functions in a terminal if that takes long."""
    settings = {"desc": COMPILING, "unit": "kernel", "delay": BAR_AFTER, "leave": False}
    with progress_bar(total=len(KERNEL.findall(source)), disable=not sys.stderr.isatty(), **settings) as bar:
        exec(compile(source, str(path), "exec"), module.__dict__, _Names(module, source, bar))


def _execute(
    source: str, names: Mapping[str, Any], run: Callable[..., None], path: Path, *, cache: bool
) -> types.ModuleType:
    module = types.ModuleType(f"bayesperiodic_kernels_{_digest(source)}")
    module.__dict__.update(names, __file__=str(path), CACHE=cache)
    sys.modules[module.__name__] = module
    settings: Any = numba.config
    with global_compiler_lock:
        elsewhere, thresholds = settings.CACHE_DIR, gc.get_threshold()
        settings.CACHE_DIR = ""  # beside the source, where its digests are kept
        gc.set_threshold(0)  # looking for garbage takes a fifth of the compiler's time
        try:
            run(source, path, module)
        finally:
            settings.CACHE_DIR = elsewhere
            gc.set_threshold(*thresholds)
    return module
