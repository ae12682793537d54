"""What `kernels` defines, compiled or loaded from the kernel cache, its loops unrolled for small models."""

import ast
from functools import cache
from pathlib import Path
from types import SimpleNamespace

from bayesperiodic.models.cache import load

NAMES = (
    "CONVERGED", "STALLED", "SINGULAR", "NOT_FINITE", "OTHER_ORBIT", "MAX_ITERATIONS", "MAX_SEGMENTS", "MAX_HALVINGS",
    "STEP_TOLERANCE", "CHORD_RATE", "FAR", "factor", "solve", "solve_transposed", "differentiate", "assemble",
    "factorise", "back_substitute", "scales", "norm", "scaled_step", "newton", "repetitions", "solve_many",
)  # fmt: skip
FREE_NAMES = ("orient", "bordered_solve", "secant", "has_shrunk", "has_shorter_period", "follow_many")
ADJOINT_NAMES = ("back_substitute_transposed", "pull_many")
GENERIC = "STATES, REACH, WIDTH, HALF = 0, 0, 0, 0"
KERNELS = "bayesperiodic.periodic.kernels"
UNROLLED_STATES = 3
ANY = 0, 0, 0, 0

STATUSES = ("converged", "stalled", "singular", "not finite", "other orbit")
CONVERGED, STALLED, SINGULAR, NOT_FINITE, OTHER_ORBIT = range(len(STATUSES))
MAX_SEGMENTS = 12


def kernels(states: int, stencil: tuple[int, int, int]) -> SimpleNamespace:
    """Return the compiled functions for a number of states and the stencil of a grid, see `schemes.CyclicGrid`."""
    return _kernels(_unrolled(states, stencil))


@cache
def _kernels(sizes: tuple[int, ...]) -> SimpleNamespace:
    return SimpleNamespace(**load(_text("kernels.py", sizes), NAMES))


def _unrolled(states: int, stencil: tuple[int, int, int]) -> tuple[int, ...]:
    """Return the sizes for which loops are unrolled, zeros where they are not."""
    return (states, *stencil) if states <= UNROLLED_STATES and any(stencil) else ANY


@cache
def autonomous_kernels() -> SimpleNamespace:
    """Return the compiled functions of `autonomous_kernels`."""
    return SimpleNamespace(**load(_joined("autonomous_kernels.py", ANY), FREE_NAMES))


def adjoint_kernels(states: int, stencil: tuple[int, int, int]) -> SimpleNamespace:
    """Return the compiled functions of `adjoint_kernels`, specialised as those of `kernels` are."""
    return _adjoint(_unrolled(states, stencil))


@cache
def _adjoint(sizes: tuple[int, ...]) -> SimpleNamespace:
    return SimpleNamespace(**load(_joined("adjoint_kernels.py", sizes), ADJOINT_NAMES))


def _joined(name: str, sizes: tuple[int, ...]) -> str:
    """Return the text of a file of kernels after what it needs of `kernels`, directly and in turn."""
    own, shared = ast.parse(_text(name)), ast.parse(_text("kernels.py", sizes))
    functions = {node.name: node for node in shared.body if isinstance(node, ast.FunctionDef)}
    imported = [node for node in own.body if isinstance(node, ast.ImportFrom) and node.module == KERNELS]
    waiting = [alias.name for node in imported for alias in node.names if alias.name in functions]
    needed: set[str] = set()
    while waiting:
        function = waiting.pop()
        if function not in needed:
            needed.add(function)
            names = {node.id for node in ast.walk(functions[function]) if isinstance(node, ast.Name)}
            waiting += sorted(names & functions.keys())
    shared.body = [n for n in shared.body if not isinstance(n, ast.FunctionDef) or n.name in needed]
    own.body = [n for n in own.body if not isinstance(n, ast.Import | ast.ImportFrom)]
    return f"{ast.unparse(shared)}\n{ast.unparse(own)}\n"


def _text(name: str, sizes: tuple[int, ...] = ANY) -> str:
    """Return the text of a file of kernels, specialised where it can be."""
    source = Path(__file__).with_name(name).read_text(encoding="utf-8")
    if sizes != ANY and GENERIC not in source:
        raise RuntimeError(f"{name} does not contain {GENERIC!r}.")
    return source.replace(GENERIC, f"STATES, REACH, WIDTH, HALF = {', '.join(map(str, sizes))}")
