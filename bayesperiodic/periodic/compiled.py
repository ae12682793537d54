"""The functions of `kernels`, compiled, or loaded from the kernel cache."""

from pathlib import Path

from bayesperiodic.models.cache import load

STATUSES = ("converged", "stalled", "singular", "not finite", "other orbit")
CONVERGED, STALLED, SINGULAR, NOT_FINITE, OTHER_ORBIT = range(len(STATUSES))
MAX_ITERATIONS = 50

_functions = load(
    Path(__file__).with_name("kernels.py").read_text(encoding="utf-8"),
    ("factor", "solve", "differentiate", "assemble", "scales", "norm", "newton", "solve_many"),
)
factor = _functions["factor"]
solve = _functions["solve"]
differentiate = _functions["differentiate"]
assemble = _functions["assemble"]
scales = _functions["scales"]
newton = _functions["newton"]
solve_many = _functions["solve_many"]
