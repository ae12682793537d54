"""What `kernels` defines, compiled or loaded from the kernel cache, its loops unrolled for small models."""

from functools import cache
from pathlib import Path
from types import SimpleNamespace

from bayesperiodic.models.cache import load

NAMES = (
    "CONVERGED", "STALLED", "SINGULAR", "NOT_FINITE", "OTHER_ORBIT", "MAX_ITERATIONS", "MAX_SEGMENTS", "MAX_HALVINGS",
    "STEP_TOLERANCE", "MAX_CHORDS", "CHORD_RATE", "FAR", "LARGEST_PART", "SMALLEST_PART", "factor", "solve",
    "solve_transposed", "differentiate", "assemble", "factorise", "back_substitute", "scales", "norm", "scaled_step",
    "newton", "repetitions", "solve_many",
)  # fmt: skip
GENERIC = "STATES, REACH = 0, 0"
UNROLLED_STATES, UNROLLED_REACH = 3, (2, 3)

STATUSES = ("converged", "stalled", "singular", "not finite", "other orbit")
CONVERGED, STALLED, SINGULAR, NOT_FINITE, OTHER_ORBIT = range(len(STATUSES))
MAX_SEGMENTS = 12


def kernels(states: int, reach: int) -> SimpleNamespace:
    """Return the compiled functions for a number of states and, if the scheme marches, of start points (else 0)."""
    unrolled = states <= UNROLLED_STATES and reach in UNROLLED_REACH
    return _specialised(states, reach) if unrolled else _specialised(0, 0)


@cache
def _specialised(states: int, reach: int) -> SimpleNamespace:
    source = Path(__file__).with_name("kernels.py").read_text(encoding="utf-8")
    if GENERIC not in source:
        raise RuntimeError(f"kernels.py does not contain {GENERIC!r}.")
    return SimpleNamespace(**load(source.replace(GENERIC, f"STATES, REACH = {states}, {reach}"), NAMES))
