"""Linear algebra in one thread: the matrices of an identification are small, and threads cost more than they gain.

BLAS libraries hand even small matrices to several threads, which wait for each other in a loop that keeps a core busy.
Beside anything else that computes, a step of SciPy's L-BFGS-B on 60 unknowns takes a hundred times as long that way.
"""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

Arguments = ParamSpec("Arguments")
Value = TypeVar("Value")


def in_one_thread(function: Callable[Arguments, Value]) -> Callable[Arguments, Value]:
    """Return the function with linear algebra in one thread as long as it runs; the setting before is restored."""

    @wraps(function)
    def limited(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Value:
        with threadpool_limits(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
