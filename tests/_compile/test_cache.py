import errno
import gc
import os
import shutil
import subprocess
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

from bayesperiodic._compile import cache, expectations
from bayesperiodic._compile.code_generation import FUNCTIONS
from bayesperiodic._files import locked
from bayesperiodic._parallel import available_cores
from tests.known import formula_model

# Functions that compile quickly.
SMALL, NAMES = (
    """
from numba import njit

@njit("float64(float64)", cache=CACHE)
def twice(x):
    return 2.0 * x

@njit("float64(float64)", cache=CACHE)
def four_times(x):
    return twice(twice(x))
""",
    ("twice", "four_times"),
)

# Kernels, and a module of functions that call them.
KERNELS = """
from bayesperiodic._compile.functions import inlined, kernel

@inlined("float64(float64)", cache=CACHE)
def next(x):
    return x + 1.0

@kernel("float64(float64)", cache=CACHE)
def twice(x):
    return 2.0 * next(x)

@kernel("float64(float64)", cache=CACHE, no_cpython_wrapper=True)
def thrice(x):
    return 3.0 * x
"""
CALLERS = """
@kernel("float64(float64)", cache=CACHE)
def combined(x):
    return twice(thrice(x)) + next(x)
"""
PROGRAM = f"""
from bayesperiodic._compile import machine_code
from bayesperiodic._compile.cache import load
from bayesperiodic._compile.expectations import internals_expected
from bayesperiodic.models.library import pendulum
internals_expected()
SMALL, NAMES = {SMALL!r}, {NAMES!r}
compiled, append = [], machine_code._append
machine_code._append = lambda *arguments: (compiled.append(arguments), append(*arguments))
pendulum.kernels
small = load(SMALL)
print(len(compiled), sum(sum(getattr(small, name).stats.cache_hits.values()) for name in NAMES))
"""
FIRST, SECOND = f"{len(FUNCTIONS)} 0\n", "0 2\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    expectations.internals_expected()  # which fills another folder
    monkeypatch.setenv("BAYESPERIODIC_CACHE", str(tmp_path))
    return tmp_path / "kernels"


ROOT = Path(__file__).parents[2]


def start(root: Path = ROOT) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-W", "error::RuntimeWarning", "-c", PROGRAM], stdout=subprocess.PIPE, text=True, cwd=root
    )


def load_with_warning(match: str) -> None:
    with pytest.warns(RuntimeWarning, match=match):
        kernels = cache.load(SMALL)
    assert kernels.four_times(1.5) == 6.0


def entry(folder: Path) -> Path:
    (found,) = folder.iterdir()
    return found


def test_second_start_loads_all_functions_from_the_cache(folder):
    first = start()
    assert first.communicate()[0] == FIRST
    second = start()
    assert second.communicate()[0] == SECOND


def test_callers_of_declared_kernels_are_compiled_for_processes_that_have_the_kernels(folder):
    cache.load(KERNELS)
    cache.load(CALLERS, shared=cache.declare(KERNELS))
    program = f"""
from bayesperiodic._compile import cache, expectations
cache._announce = lambda source: None
expectations.internals_expected()
cache._build = None
print(cache.load({CALLERS!r}, shared=cache.load({KERNELS!r})).combined(2.0))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT)
    assert (done.stdout, done.stderr) == (f"{2.0 * (3.0 * 2.0 + 1.0) + 2.0 + 1.0}\n", "")


def test_a_kernel_for_compiled_code_only_cannot_be_called_by_python(folder):
    kernels = cache.load(KERNELS)
    assert kernels.twice(2.0) == 6.0
    with pytest.raises(TypeError, match="thrice: must be called by compiled code"):
        kernels.thrice(2.0)


def kernel_entries(folder: Path) -> set[str]:
    """Return the names of the entries in a cache, without those of the check of Numba's internals."""
    check = folder.with_name("check")
    program = "from bayesperiodic._compile.expectations import internals_expected as check; check()"
    subprocess.run([sys.executable, "-c", program], check=True, env=os.environ | {"BAYESPERIODIC_CACHE": str(check)})
    return {path.name for path in folder.iterdir()} - {path.name for path in (check / "kernels").iterdir()}


@pytest.mark.slow
@pytest.mark.skipif(available_cores() < 2, reason="two cores are needed")
def test_two_processes_compile_half_of_the_solver_each(folder):
    program = """
from bayesperiodic._compile import cache, expectations
from bayesperiodic.periodic.compiled import kernels
expectations.internals_expected()
built, build = [], cache._build
cache._build = lambda source, *arguments: (built.append(source), build(source, *arguments))[1]
kernels("newton", 1, (2, 3, 2))
print(["Compiled linear algebra" in source for source in built])
"""
    for expected in ("[True]\n", "[]\n"):
        assert subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True).stdout == expected
    assert len(kernel_entries(folder)) == 2


@pytest.mark.slow
def test_an_upgrade_that_keeps_the_sources_loads_the_entries_of_the_version_before(folder, tmp_path):
    first = start()
    assert first.communicate()[0] == FIRST
    for part in ("bayesperiodic", "tests"):
        shutil.copytree(ROOT / part, tmp_path / "upgraded" / part, ignore=shutil.ignore_patterns("__pycache__"))
    package = tmp_path / "upgraded" / "bayesperiodic"
    for path in ("__init__.py", "_compile/cache.py", "models/model.py", "_compile/code_generation.py"):
        with (package / path).open("a", encoding="utf-8") as file:
            file.write("\n# changed\n")
    second = start(package.parent)
    assert second.communicate()[0] == SECOND


def test_numba_settings_of_the_user_do_not_move_the_files(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(cache.numba.config, "CACHE_DIR", str(tmp_path / "elsewhere"))
    cache.load(SMALL)
    names = {path.name.split("-")[0].split(".")[1] for path in (entry(folder) / "__pycache__").glob("*.nbi")}
    assert names >= set(NAMES)
    assert cache.numba.config.CACHE_DIR == str(tmp_path / "elsewhere")


@pytest.mark.slow
def test_two_processes_may_fill_the_cache_at_once(folder):
    both = [start(), start()]
    for process in both:
        process.communicate()
        assert process.returncode == 0
    assert len(kernel_entries(folder)) == 2
    assert start().communicate()[0] == SECOND


def test_the_garbage_collector_is_as_before_after_loading_in_threads_and_after_an_error(folder):
    thresholds = gc.get_threshold()
    with ThreadPoolExecutor(4) as pool:
        modules = pool.map(cache.load, [SMALL.replace("2.0", f"{number}.0") for number in range(1, 5)])
        assert [module.twice(3.0) for module in modules] == [3.0, 6.0, 9.0, 12.0]
    assert gc.get_threshold() == thresholds
    with pytest.raises(ZeroDivisionError):
        cache.load("1 / 0")
    assert gc.get_threshold() == thresholds and gc.isenabled()


def test_folder_is_private_to_the_user(folder):
    cache.load(SMALL)
    assert folder.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("damage", ["truncate", "alter", "remove", "source", "manifest"])
def test_damaged_entry_is_never_executed_but_built_again(folder, damage):
    cache.load(SMALL)
    compiled = sorted((entry(folder) / "__pycache__").glob("*.nbc"))[0]
    if damage == "truncate":
        compiled.write_bytes(compiled.read_bytes()[:100])
    elif damage == "alter":
        content = bytearray(compiled.read_bytes())
        content[len(content) // 2] ^= 1
        compiled.write_bytes(content)
    elif damage == "remove":
        compiled.unlink()
    elif damage == "source":
        source = entry(folder) / cache.SOURCE
        source.write_text(source.read_text() + "\nraise SystemExit('executed')\n")
    else:
        (entry(folder) / cache.MANIFEST).write_text("{")
    load_with_warning("damaged entry of the kernel cache is built again")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cache.load(SMALL).four_times(1.5) == 6.0
    assert len(list(folder.iterdir())) == 1


def test_machine_code_of_a_model_is_built_again_when_damaged_and_in_memory_without_a_cache(folder, monkeypatch):
    def values():
        made = formula_model("any", ["a"], lambda p, u, s: {"y": p.a * sp.exp(u.x)})
        return made.kernels.evaluate("outputs", *np.ones((2, 5, 3)), np.full(1, 2.0), np.zeros(5), 1.0)[:, 0]

    assert values() == pytest.approx(np.full(5, 2.0 * np.e), rel=1e-15)
    (stored,) = folder.glob("*/__pycache__/functions.nbc")
    stored.write_bytes(stored.read_bytes()[:-1])
    with pytest.warns(RuntimeWarning, match="damaged entry of the kernel cache is built again"):
        assert values() == pytest.approx(np.full(5, 2.0 * np.e), rel=1e-15)
    folder.chmod(0o777)
    with pytest.warns(RuntimeWarning, match="compiling in memory"):
        assert values() == pytest.approx(np.full(5, 2.0 * np.e), rel=1e-15)


def test_file_in_the_place_of_an_entry_is_replaced(folder):
    cache.load(SMALL)
    place = entry(folder)
    shutil.rmtree(place)
    place.write_text("not a folder")
    load_with_warning("built again")
    assert entry(folder).is_dir()


def test_folders_of_killed_builds_are_removed_after_an_hour(folder):
    for name, age in (("building-killed", 3700.0), ("building-running", 60.0)):
        other = folder / name
        other.mkdir(parents=True)
        other.parent.chmod(0o700)
        os.utime(other, (time.time() - age,) * 2)
    cache.load(SMALL)
    assert sorted(path.name for path in folder.glob("building-*")) == ["building-running"]


def test_disabled_compilation_is_refused_with_the_setting(folder, monkeypatch):
    monkeypatch.setattr(cache.numba.config, "DISABLE_JIT", 1)
    with pytest.raises(RuntimeError, match="NUMBA_DISABLE_JIT: must not be set"):
        cache.load(SMALL)


def test_folder_open_to_others_is_not_used(folder):
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    load_with_warning("not private")
    assert not list(folder.iterdir())


def test_folder_that_others_can_replace_is_not_used(folder):
    """The folder above: open to all without the restriction of /tmp, but a group may write to it."""
    cache.load(SMALL)
    filled = entry(folder)
    for mode, used in ((0o777, False), (0o757, False), (0o1777, True), (0o775, True)):
        folder.parent.chmod(mode)
        cache._UNUSABLE.clear()
        with nullcontext() if used else pytest.warns(RuntimeWarning, match="others can replace it.*Delete the folder"):
            loaded = cache.load(SMALL)
        assert (loaded.__file__ == str(filled / cache.SOURCE)) is used
    folder.parent.chmod(0o700)


def owned_by(monkeypatch, owner, places):
    """Let files of these places be those of another user, without the right to give files away."""
    original = os.stat_result

    def changed(status, path):
        return original([*status[:4], owner if path in places else status[4], *status[5:]])

    for name in ("stat", "lstat"):
        ask = getattr(Path, name)
        monkeypatch.setattr(Path, name, lambda self, ask=ask, **named: changed(ask(self, **named), self))


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="needs owners of files")
def test_folder_of_another_user_is_not_used(folder, monkeypatch):
    cache.load(SMALL)
    for place in (folder, folder.parent):
        cache._UNUSABLE.clear()
        with monkeypatch.context() as patch:
            owned_by(patch, os.getuid() + 1, {place})
            with pytest.warns(RuntimeWarning, match="cannot be used .*compiling in memory"):
                assert cache.load(SMALL).__file__ == "<kernels compiled in memory>"


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="needs owners of files")
@pytest.mark.parametrize("what", ["entry", "machine code"])
def test_files_of_another_user_in_an_own_folder_are_not_executed(folder, monkeypatch, what):
    """As they stand there if the folder was once open to others."""
    cache.load(SMALL)
    place = entry(folder) if what == "entry" else sorted((entry(folder) / "__pycache__").glob("*.nbc"))[0]
    mark = entry(folder) / "mark"
    mark.touch()
    with monkeypatch.context() as patch:
        owned_by(patch, os.getuid() + 1, {place})
        with pytest.warns(RuntimeWarning, match="damaged entry .* is built again .*files of another user"):
            cache.load(SMALL)
    assert place.exists() and not mark.exists()


def test_entry_that_is_a_link_is_not_executed(folder, tmp_path):
    cache.load(SMALL)
    place = entry(folder)
    place.rename(tmp_path / "elsewhere")
    place.symlink_to(tmp_path / "elsewhere")
    load_with_warning("built again .*contains links")
    assert not entry(folder).is_symlink() and (tmp_path / "elsewhere").is_dir()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_full_disk_is_one_warning_that_advises_to_free_space(folder, monkeypatch, number):
    """Not one for each of the kernels, and no advice to delete what is in the cache; entries are still read."""
    cache.load(SMALL)
    stored = entry(folder)

    def full(*_, **__):
        raise OSError(number, os.strerror(number))

    built = []
    original = cache._announce
    monkeypatch.setattr(cache, "_announce", lambda source: built.append(original(source)))
    monkeypatch.setattr(Path, "write_text", full)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for factor in ("3.0", "4.0", "5.0", "6.0"):
            assert cache.load(SMALL.replace("2.0", factor)).twice(1.0) == float(factor)
        assert cache.load(SMALL).__file__ == str(stored / cache.SOURCE)
    (warning,) = caught
    assert f"({OSError(number, os.strerror(number))}); compiling in memory" in str(warning.message)
    assert "Free space there, or set BAYESPERIODIC_CACHE" in str(warning.message)
    assert "elete" not in str(warning.message) and warning.filename == __file__
    assert built == [None] and [*folder.iterdir()] == [stored]


@pytest.mark.parametrize("what", ["name", "features"])
def test_another_processor_gets_an_entry_of_its_own(folder, monkeypatch, what):
    """As in a home folder that the different computers of a cluster share."""
    cache.load(SMALL)
    here = entry(folder)
    with monkeypatch.context() as patch:
        if what == "name":
            patch.setattr(cache.llvmlite.binding, "get_host_cpu_name", lambda: "another")
        else:
            features = {**cache.llvmlite.binding.get_host_cpu_features(), "another": True}
            patch.setattr(
                cache.llvmlite.binding,
                "get_host_cpu_features",
                lambda: type("Features", (), {"flatten": lambda self: str(features)})(),
            )
        assert not cache.is_stored(SMALL, {})
    assert cache.is_stored(SMALL, {}) and entry(folder) == here


def test_four_processes_that_start_with_an_empty_cache_build_each_entry_once(folder):
    program = f"from bayesperiodic._compile import cache; print(cache.load({SMALL!r}).four_times(1.5))"
    command = [sys.executable, "-W", "error::RuntimeWarning", "-c", program]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "cwd": ROOT}
    processes = [subprocess.Popen(command, **pipes) for _ in range(4)]
    found = [process.communicate() for process in processes]
    assert [output for output, _ in found] == ["6.0\n"] * 4
    assert sorted(announced for _, announced in found) == ["", "", "", "compiling 2 kernels (once per machine) …\n"]
    assert len([*folder.iterdir()]) == 1


def test_a_terminal_shows_how_many_kernels_are_to_come(folder, monkeypatch, capsys):
    monkeypatch.setattr(cache, "BAR_AFTER", 0.0)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr("bayesperiodic._printing.OFTEN", 0.0)
    assert cache.load(SMALL).four_times(1.5) == 6.0
    shown = capsys.readouterr().err
    places = [shown.index(f"| {done}/2 [") for done in range(3)]
    assert places == sorted(places) and "compiling kernels (once per machine): " in shown and "\n" not in shown


def test_texts_that_others_compile_are_not_announced(folder, capsys):
    """Those of models, which take no time."""
    cache.load("def f(x):\n    return x", run=lambda source, path, module: None)
    assert len([*folder.iterdir()]) == 1 and capsys.readouterr().err == ""


def test_a_process_that_waits_too_long_builds_the_entry_too(folder, monkeypatch):
    """Another one may have been stopped, or the file system has no locks."""
    monkeypatch.setattr(cache, "LONGEST_WAIT", 0.0)
    folder.mkdir(mode=0o700, parents=True)
    with locked(folder / cache._digest(cache._definitions(SMALL, {}, None)[0])):
        assert cache.load(SMALL).four_times(1.5) == 6.0
    assert cache.is_stored(SMALL, {})


def test_unwritable_cache_falls_back_to_memory(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("BAYESPERIODIC_CACHE", str(tmp_path / "file"))
    load_with_warning("compiling in memory")


HOMELESS = """
from bayesperiodic._compile import cache
from bayesperiodic.sampling import convergence
from tests._compile.test_cache import SMALL
print(cache.load(SMALL).four_times(1.5), convergence.arviz().rhat)
"""


@pytest.mark.slow
def test_unwritable_home_is_a_warning(tmp_path):
    """A file in the place of the home folder, which no user can write below, not even root; ArviZ 0.23 would fail."""
    (tmp_path / "home").write_text("")
    dropped = ("BAYESPERIODIC_CACHE", "XDG_CACHE_HOME")
    environment = {key: value for key, value in os.environ.items() if key not in dropped}
    done = subprocess.run(
        [sys.executable, "-c", HOMELESS],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
        env=environment | {"HOME": str(tmp_path / "home")},
    )
    assert done.stdout.startswith("6.0 <function rhat"), done.stderr
    assert "cannot be used" in done.stderr and "compiling in memory" in done.stderr


def test_failed_build_leaves_nothing_behind(folder, monkeypatch):
    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(cache, "_digests", full)
    load_with_warning("no space left")
    assert not list(folder.iterdir())


def test_other_versions_get_an_entry_of_their_own(folder, monkeypatch):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cache.load(SMALL)
        monkeypatch.setattr(cache.numba, "__version__", "0.0")
        cache.load(SMALL)
    assert len(kernel_entries(folder)) == 2
    assert os.environ["BAYESPERIODIC_CACHE"]
