"""Compiled functions that load strided columns one number at a time, and not by gather instructions.

Gathers have become slow on most Intel processors since these were made safe against gather data sampling (Intel,
advisory 00828, 2023): without them the sweeps of a landing gear over its grid take a third of the time.
"""

from typing import Any

import llvmlite.binding
from numba import types
from numba.extending import intrinsic

NO_GATHER, LLVM_THAT_KNOWS_IT = "+prefer-no-gather", 17


@intrinsic
def without_gathers(typing_context: Any) -> Any:
    """Have the function that calls this compiled without gathers, where the processor has any."""

    def attribute(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        features = context.codegen().magic_tuple()[2]
        if "+avx2" in features.split(",") and llvmlite.binding.llvm_version_info[0] >= LLVM_THAT_KNOWS_IT:
            given = builder.function.attributes
            set.add(given, f'"target-features"="{features},{NO_GATHER}"')  # `add` of its own knows but a few names.
            given.add("noinline")  # A caller that takes the loop in has attributes of its own.
        return context.get_dummy_value()

    return types.void(), attribute
