"""Calls of kernels by address, and vectors of arrays without `reshape`, by means of Numba's internals."""

import inspect
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import llvmlite.binding
import numba
from numba import types
from numba.core import sigutils, typing
from numba.core.extending import _Intrinsic
from numba.core.imputils import impl_ret_borrowed
from numba.extending import intrinsic


@intrinsic
def as_vector(typing_context: Any, array: Any) -> Any:
    """Return a C-contiguous array as a vector, for use in compiled code; `reshape` takes longer to compile."""
    assert array.layout == "C", f"as_vector: must be C-contiguous, got layout {array.layout!r}"
    vector = types.Array(array.dtype, 1, "C")

    def view(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        given = context.make_array(array)(context, builder, values[0])
        result, size = context.make_array(vector)(context, builder), given.itemsize
        context.populate_array(
            result, data=given.data, shape=[given.nitems], strides=[size], itemsize=size, meminfo=given.meminfo
        )
        return impl_ret_borrowed(context, builder, vector, result._getvalue())

    return vector(array), view


class Kernel(_Intrinsic):  # type: ignore[misc]
    """A compiled function that Python calls as usual, and compiled code by its address.

    Numba copies a called function into every caller and optimises it there again, which took more than a third of the
    compile time of the driven solver. A kernel is called through a symbol instead, whose address the process knows once
    it is compiled or loaded; errors are propagated as usual. The symbol is the name in its module, whose name is a
    digest of its contents (see `cache.load`): it stands for the same code in every process. A call takes some
    nanoseconds, so functions that are called at every point of a grid are compiled with ``njit``.

    With the option `no_cpython_wrapper`, which saves an eighth of the compile time, only compiled code may call it.
    """

    def __init__(self, function: Callable[..., Any], signature: Any, options: dict[str, Any]):
        arguments, result = sigutils.normalize_signature(signature)
        names, symbol = [f"a{k}" for k in range(len(arguments))], f"{function.__module__}.{function.__name__}"
        if function.__globals__["DECLARED"]:
            address = id(self)  # never called
        else:
            self.compiled = numba.njit(signature, **options)(function)
            code = self.compiled.get_compile_result(result(*arguments))
            address = code.library.get_pointer_to_function(code.fndesc.llvm_func_name)
        llvmlite.binding.add_symbol(symbol, address)
        called = SimpleNamespace(
            mangled_name=symbol, restype=result, argtypes=arguments, args=names, noalias=False, inline=False
        )

        def typed(_: Any, *given: Any) -> Any:
            def call(context: Any, builder: Any, signature: Any, values: Any) -> Any:
                return context.call_internal(builder, called, signature, values)

            return (typing.signature(result, *arguments), call) if len(given) == len(arguments) else None

        places = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_ONLY) for name in ("context", *names)]
        typed.__signature__ = inspect.Signature(places)  # type: ignore[attr-defined]
        super().__init__(function.__name__, typed)
        self._register()

    def __call__(self, *arguments: Any) -> Any:
        """Run the compiled function."""
        if self.compiled.targetoptions.get("no_cpython_wrapper"):
            raise TypeError(f"{self._name}: must be called by compiled code, got a call from Python.")
        return self.compiled(*arguments)


def kernel(signature: Any, **options: Any) -> Callable[[Callable[..., Any]], Kernel]:
    """Return a decorator that compiles a function with a signature as a `Kernel`, with options of ``numba.njit``."""
    return lambda function: Kernel(function, signature, options)
