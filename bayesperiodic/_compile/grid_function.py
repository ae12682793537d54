"""Functions of a whole grid, by the addresses of their machine code; see `code_generation` for their arguments."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from bayesperiodic._compile.cache import load

_ROWS, _VECTOR = types.float64[:, ::1], types.float64[::1]
GRID_SIGNATURE = types.void(_ROWS, _ROWS, _VECTOR, _VECTOR, types.float64, _ROWS)
GRID_FUNCTION = types.FunctionType(GRID_SIGNATURE)
CALL = """
from numba import njit, types
from bayesperiodic._compile.grid_function import GRID_SIGNATURE, grid_function_at

@njit(types.void(types.int64, *GRID_SIGNATURE.args), cache=CACHE, nogil=True)
def call(address, states, inputs, parameters, tau, frequency, out):
    grid_function_at(address)(states, inputs, parameters, tau, frequency, out)
"""


@dataclass(frozen=True)
class GridFunction:
    """A grid function that Python can call; compiled functions take its address, see `grid_function_at`."""

    address: int

    def __call__(self, *arguments: Any) -> None:
        """Run the compiled function."""
        _call()(self.address, *arguments)


@intrinsic
def grid_function_at(typing_context: Any, address: Any) -> Any:
    """Return the grid function at an address; for use in compiled code."""

    def structure(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        function = ir.Constant(context.get_value_type(GRID_FUNCTION), None)
        address = builder.inttoptr(values[0], context.get_value_type(types.voidptr))
        return builder.insert_value(function, address, 0)

    return GRID_FUNCTION(types.int64), structure


@cache
def _call() -> Callable[..., None]:
    """Return the compiled function that calls the grid function at an address."""
    return load(CALL).call
