"""How kernels and generated texts are compiled: by Numba's internals, or by its public functions if those differ."""

from bayesperiodic._compile.expectations import internals_expected
from bayesperiodic._compile.grid_function import grid_function_at
from bayesperiodic._compile.plain import inlined

if internals_expected():
    from bayesperiodic._compile.intrinsics import as_vector, kernel
    from bayesperiodic._compile.machine_code import compiled
else:
    from bayesperiodic._compile.plain import as_vector, compiled  # type: ignore[assignment]
    from bayesperiodic._compile.plain import inlined as kernel

__all__ = ["as_vector", "compiled", "grid_function_at", "inlined", "kernel"]
