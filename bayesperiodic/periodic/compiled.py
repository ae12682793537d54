"""What `kernels` defines, compiled or loaded from the kernel cache, its loops unrolled for small models."""

from functools import cache
from pathlib import Path
from types import SimpleNamespace

from bayesperiodic.models.cache import load

NAMES = (
    "CONVERGED", "STALLED", "SINGULAR", "NOT_FINITE", "OTHER_ORBIT", "MAX_ITERATIONS", "MAX_SEGMENTS", "MAX_HALVINGS",
    "STEP_TOLERANCE", "CHORD_RATE", "FAR", "factor", "solve", "solve_transposed", "differentiate", "assemble",
    "factorise", "back_substitute", "scales", "norm", "scaled_step", "newton", "repetitions",
)  # fmt: skip
BATCH_NAMES = ("solve_many",)
FREE_NAMES = ("orient", "bordered_solve", "secant", "has_shrunk", "has_shorter_period", "follow_many")
ADJOINT_NAMES = ("back_substitute_transposed", "pull_many")
GENERIC = "STATES, REACH, WIDTH, HALF = 0, 0, 0, 0"
SHARED = "from bayesperiodic.periodic._kernels.newton import"
UNROLLED_STATES = 3
ANY = 0, 0, 0, 0

STATUSES = ("converged", "stalled", "singular", "not finite", "other orbit")
CONVERGED, STALLED, SINGULAR, NOT_FINITE, OTHER_ORBIT = range(len(STATUSES))
MAX_SEGMENTS = 12


def kernels(states: int, stencil: tuple[int, int, int]) -> SimpleNamespace:
    """Return the compiled functions for a number of states and the stencil of a grid, see `schemes.CyclicGrid`."""
    return _kernels(_unrolled(states, stencil))


def batch_kernels(states: int, stencil: tuple[int, int, int]) -> SimpleNamespace:
    """Return the compiled functions of `batch_kernels`, specialised likewise."""
    return _with_shared("batch.py", BATCH_NAMES, _unrolled(states, stencil))


def adjoint_kernels(states: int, stencil: tuple[int, int, int]) -> SimpleNamespace:
    """Return the compiled functions of `adjoint_kernels`, specialised likewise."""
    return _with_shared("adjoint.py", ADJOINT_NAMES, _unrolled(states, stencil))


def autonomous_kernels() -> SimpleNamespace:
    """Return the compiled functions of `autonomous_kernels`."""
    return _with_shared("autonomous.py", FREE_NAMES, ANY)


def _unrolled(states: int, stencil: tuple[int, int, int]) -> tuple[int, ...]:
    """Return the sizes for which loops are unrolled, zeros where they are not."""
    return (states, *stencil) if states <= UNROLLED_STATES and any(stencil) else ANY


@cache
def _kernels(sizes: tuple[int, ...]) -> SimpleNamespace:
    source = _text("newton.py")
    if GENERIC not in source:
        raise RuntimeError(f"newton.py does not contain {GENERIC!r}.")
    sized = f"STATES, REACH, WIDTH, HALF = {', '.join(map(str, sizes))}"
    return SimpleNamespace(**load(source.replace(GENERIC, sized), NAMES))


@cache
def _with_shared(name: str, wanted: tuple[str, ...], sizes: tuple[int, ...]) -> SimpleNamespace:
    """Return the compiled functions of a file whose text imports others from `kernels`, taken as they are compiled.

    The module that these are in is named by its own text, so that the text that imports them changes with theirs: code
    compiled from one text goes stale when a function of another that it calls has changed.
    """
    source, shared = _text(name), _kernels(sizes).newton.__module__
    if SHARED not in source:
        raise RuntimeError(f"{name} does not contain {SHARED!r}.")
    return SimpleNamespace(**load(source.replace(SHARED, f"from {shared} import"), wanted))


def _text(name: str) -> str:
    return Path(__file__).with_name("_kernels").joinpath(name).read_text(encoding="utf-8")
