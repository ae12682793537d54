"""Whether Numba's internals are those on which fast compilation rests; otherwise `plain` takes its place."""

import math
import warnings
from functools import cache
from typing import Any

import numba
import numpy as np

from bayesperiodic._compile.cache import load

POINT = """def check(states, inputs, parameters, tau, frequency, out, sums, columns=(1, 1, 1, 1)):
    out[0] = states[0]*parameters[0] + math.exp(tau)
    sums[0] = inputs[0]*frequency
"""
CALLERS = """
from numba import types
from bayesperiodic._compile.grid_function import GRID_SIGNATURE, grid_function_at
from bayesperiodic._compile.intrinsics import as_vector, kernel

@kernel("float64(float64[:,::1])", cache=CACHE, no_cpython_wrapper=True)
def weighted(rows):
    vector = as_vector(rows)
    return vector[0] + 10.0*vector[1] + 100.0*vector[2]

@kernel(types.float64(types.int64, *GRID_SIGNATURE.args), cache=CACHE)
def check(address, states, inputs, parameters, tau, frequency, out):
    grid_function_at(address)(states, inputs, parameters, tau, frequency, out)
    return weighted(out)
"""
TOLERANCE = 1e-13


@cache
def internals_expected() -> bool:
    """Return whether functions compiled by Numba's internals give the right values; warn if they do not."""
    settings: Any = numba.config
    try:
        if not settings.DISABLE_JIT:  # which `cache.load` refuses
            _check()
    except Exception as error:  # whatever Numba and LLVM raise when they are used in another way than they expect
        if isinstance(error, ImportError) and str(error.name).startswith("bayesperiodic"):
            raise  # an error of this package
        warnings.warn(
            f"Numba {numba.__version__} has other internals than those expected ({type(error).__name__}: {error}); "
            "functions are compiled by numba.njit, which takes longer. Install a version of Numba that bayesperiodic "
            "requires.",
            UserWarning,
            stacklevel=2,
        )
        return False
    return True


def _check() -> None:
    """Raise an error if the internals cannot be used, or a small function has another value than it must have."""
    from bayesperiodic._compile import machine_code  # which imports internals

    check, address = load(CALLERS).check, machine_code.compiled(POINT).check
    states, inputs, out = np.array([[2.0], [3.0]]), np.array([[0.5], [0.25]]), np.full((3, 1), np.nan)
    value = check(address, states, inputs, np.array([7.0]), np.array([0.5, -1.5]), 4.0, out)
    rows = np.array([14.0 + math.exp(0.5), 21.0 + math.exp(-1.5), 3.0])
    if not np.allclose([*out[:, 0], value], [*rows, rows @ [1.0, 10.0, 100.0]], rtol=TOLERANCE, atol=0.0):
        raise ArithmeticError(f"a test function has the values {out[:, 0]} and {value!r} instead of {rows}")
