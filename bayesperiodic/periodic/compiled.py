"""What `kernels` defines, its functions compiled or loaded from the kernel cache."""

from pathlib import Path

from bayesperiodic.models.cache import load

NAMES = (
    "STATUSES", "CONVERGED", "SINGULAR", "MAX_ITERATIONS",
    "factor", "solve", "differentiate", "assemble", "scales", "newton", "solve_many",
)  # fmt: skip
_kernels = load(Path(__file__).with_name("kernels.py").read_text(encoding="utf-8"), NAMES)

STATUSES: tuple[str, ...] = _kernels["STATUSES"]
CONVERGED: int = _kernels["CONVERGED"]
SINGULAR: int = _kernels["SINGULAR"]
MAX_ITERATIONS: int = _kernels["MAX_ITERATIONS"]

factor = _kernels["factor"]
solve = _kernels["solve"]
differentiate = _kernels["differentiate"]
assemble = _kernels["assemble"]
scales = _kernels["scales"]
newton = _kernels["newton"]
solve_many = _kernels["solve_many"]
