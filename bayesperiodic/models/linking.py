"""Kernels that call each other by address, so that each is optimised once.

Numba copies the code of a called function into that of every caller and optimises it there again: three quarters of the
compile time of the periodic solver. A `kernel` is called through a symbol instead, whose address the process knows once
the kernel is compiled or loaded from the cache. Errors are propagated as by any compiled function. A call takes some
nanoseconds, so functions that are called at every point of a grid are compiled with ``njit``.
"""

import inspect
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import llvmlite.binding
from numba import njit
from numba.core import sigutils, typing
from numba.core.extending import _Intrinsic


def kernel(signature: Any, **options: Any) -> Callable[[Callable[..., Any]], "Kernel"]:
    """Compile a function with an explicit signature as a `Kernel`; the options are those of ``numba.njit``."""
    return lambda function: Kernel(function, signature, options)


class Kernel(_Intrinsic):
    """A compiled function that Python calls as usual, and compiled code by its address.

    The symbol is the name in its module. Names of the modules of `cache.load` are digests of their contents, so that a
    symbol stands for the same code in every process.
    """

    def __init__(self, function: Callable[..., Any], signature: Any, options: dict[str, Any]):
        self.compiled = njit(signature, **options)(function)
        arguments, result = sigutils.normalize_signature(signature)
        code = self.compiled.get_compile_result(result(*arguments))
        symbol = f"{function.__module__}.{function.__name__}"
        address = code.library.get_pointer_to_function(code.fndesc.llvm_func_name)
        llvmlite.binding.add_symbol(symbol, address)
        names = [f"argument_{number}" for number in range(len(arguments))]
        described = SimpleNamespace(
            mangled_name=symbol, restype=result, argtypes=arguments, args=names, noalias=False, inline=False
        )

        def call(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            return context.call_internal(builder, described, signature, values)

        def typed(_: Any, *given: Any) -> Any:
            return (typing.signature(result, *arguments), call) if len(given) == len(arguments) else None

        kind = inspect.Parameter.POSITIONAL_ONLY
        typed.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
            [inspect.Parameter(name, kind) for name in ("context", *names)]
        )
        super().__init__(function.__name__, typed)
        self._register()
        self.__doc__ = function.__doc__

    def __call__(self, *arguments: Any) -> Any:
        """Run the compiled function."""
        return self.compiled(*arguments)
