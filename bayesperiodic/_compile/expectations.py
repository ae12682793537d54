"""Whether Numba's internals are those on which fast compilation rests; otherwise `plain` takes its place."""

import math
import threading
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numba
import numpy as np

POINT = """def check(states, inputs, parameters, tau, frequency, out, sums, columns=(1, 1, 1, 1)):
    out[0] = states[0]*parameters[0] + math.exp(tau)
    sums[0] = inputs[0]*frequency
"""
CALLERS = """
from bayesperiodic._compile.cache import load
from bayesperiodic._compile.code_generation import GRID_SIGNATURE_TYPE, grid_function_at
from bayesperiodic._compile.expectations import verify
from bayesperiodic._compile.intrinsics import as_vector, kernel

@kernel("float64(float64[:,::1])", cache=CACHE, no_cpython_wrapper=True)
def weighted(rows):
    vector = as_vector(rows)
    return vector[0] + 10.0*vector[1] + 100.0*vector[2]

@kernel(TYPE, cache=CACHE)
def check(address, states, inputs, parameters, tau, frequency, out):
    grid_function_at(address)(states, inputs, parameters, tau, frequency, out)
    return weighted(out)

verify(check, load, GRID_SIGNATURE_TYPE)
"""
TYPE = "float64(int64, float64[:,::1], float64[:,::1], float64[::1], float64[::1], float64, float64[:,::1])"
TOLERANCE = 1e-13
_lock = threading.RLock()
_known: list[bool] = []
_running: list[bool] = []


def met(load: Callable[..., Any], is_stored: Callable[..., bool]) -> bool:
    """Return whether functions compiled by Numba's internals give the right values; warn once if they do not.

    The arguments are these functions of `cache`, which calls this one.
    """
    settings: Any = numba.config
    if _known or settings.DISABLE_JIT:  # which `cache.load` refuses
        return not _known or _known[0]
    with _lock:
        if not _known and not _running:
            _running.append(True)
            reason = _difference(load, is_stored)
            if reason:
                warnings.warn(
                    f"Numba {numba.__version__} has other internals than those expected ({reason}); functions are "
                    "compiled by numba.njit, which takes several times as long. Install a version of Numba that "
                    "bayesperiodic requires.",
                    UserWarning,
                    stacklevel=2,
                )
            _known.append(not reason)
        return not _known or _known[0]  # not known: called by the check itself


def _difference(load: Callable[..., Any], is_stored: Callable[..., bool]) -> str:
    """Return what is wrong with small functions; nothing if they are right, or were when the cache stored them."""
    try:
        from bayesperiodic._compile import intrinsics, machine_code  # noqa: F401  # which import the internals

        constants = {"TYPE": TYPE, "DIGEST": machine_code.digest()}
        if not is_stored(CALLERS, constants, unusable=False):
            load(CALLERS, constants)
    except Exception as error:  # whatever Numba and LLVM raise when they are used in another way than they expect
        if isinstance(error, ImportError) and str(error.name).startswith("bayesperiodic"):
            raise  # an error of this package
        return f"{type(error).__name__}: {error}"
    return ""


def verify(check: Callable[..., float], load: Callable[..., Any], signature: Any) -> None:
    """Raise an ArithmeticError if a test function has another value than it must have."""
    from bayesperiodic._compile import machine_code

    address = load(
        f"# {machine_code.digest()}\n{POINT}", run=partial(machine_code.compile_functions, signature=signature)
    ).check
    states, inputs, out = np.array([[2.0], [3.0]]), np.array([[0.5], [0.25]]), np.full((3, 1), np.nan)
    value = check(address, states, inputs, np.array([7.0]), np.array([0.5, -1.5]), 4.0, out)
    first, second, total = 14.0 + math.exp(0.5), 21.0 + math.exp(-1.5), 3.0
    expected = np.array([first, second, total, first + 10.0 * second + 100.0 * total])
    if not np.allclose([*out[:, 0], value], expected, rtol=TOLERANCE, atol=0.0):
        raise ArithmeticError(f"a test function is {value!r} instead of {expected[-1]!r}")
