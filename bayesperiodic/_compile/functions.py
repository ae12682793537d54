"""What the sources of kernels import: by Numba's internals, or by its public functions where those differ."""

from bayesperiodic._compile.cache import internals_expected
from bayesperiodic._compile.code_generation import grid_function_at
from bayesperiodic._compile.plain import inlined

if internals_expected():
    from bayesperiodic._compile.intrinsics import as_vector, kernel
else:
    from bayesperiodic._compile.plain import as_vector  # type: ignore[assignment]
    from bayesperiodic._compile.plain import inlined as kernel

__all__ = ["as_vector", "grid_function_at", "inlined", "kernel"]
