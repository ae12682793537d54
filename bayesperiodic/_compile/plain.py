"""Compilation by public functions of Numba alone, for versions whose internals are not those that are expected.

Values are the same up to rounding; a model takes about 1.2 s to compile instead of 0.7 s.
"""

import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numba

from bayesperiodic._compile.cache import load

NJIT_OPTIONS = "cache=CACHE, error_model='numpy'"
# What the generated texts use, as in `machine_code`.
SOURCE_PREAMBLE = f"""
import math
from numba import cfunc, njit
from bayesperiodic._compile.grid_function import GRID_SIGNATURE

@njit({NJIT_OPTIONS})
def where(condition, one, other):
    return float(one) if condition else float(other)
"""
# The loop over the grid of a function of one point; the sums follow the last row.
LOOP = f"""
@cfunc(GRID_SIGNATURE, {NJIT_OPTIONS})
def {{name}}(states, inputs, parameters, tau, frequency, out):
    flat = out.reshape(out.size)
    sums = flat[states.shape[0] * {{rows}} :]
    for number in range({{sums}}):
        sums[number] = 0.0
    for point in range(states.shape[0]):
        row = flat[point * {{rows}} : (point + 1) * {{rows}}]
        {{name}}_at(states[point], inputs[point], parameters, tau[point], frequency, row, sums)
"""
FUNCTION_HEADER = re.compile(r"^def (\w+)\((.*), columns=\((\d+), (\d+), (\d+), (\d+)\)\):$", re.MULTILINE)


def compiled(source: str) -> ModuleType:
    """Return the addresses of the functions of a text, as `machine_code.compiled` does."""
    return load(source, run=_compile)


def _compile(source: str, path: Path, module: ModuleType) -> None:
    heads = FUNCTION_HEADER.findall(source)
    points = FUNCTION_HEADER.sub(rf"@njit({NJIT_OPTIONS})\ndef \1_at(\2):", source)
    points = re.sub(r"^( +sums\[\d+\]) = ", r"\1 += ", points, flags=re.MULTILINE)
    loops = "".join(LOOP.format(name=name, rows=rows, sums=sums) for name, _, _, _, rows, sums in heads)
    exec(compile(SOURCE_PREAMBLE + points + loops, str(path), "exec"), module.__dict__)
    module.__dict__["library"] = [module.__dict__[name] for name, *_ in heads]
    for function, (name, *_) in zip(module.__dict__["library"], heads, strict=True):
        module.__dict__[name] = function.address


def inlined(signature: Any, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function by ``njit`` into its callers; in a declared module if it has any.

    Python must not call it, if it has the option `no_cpython_wrapper`.
    """
    return lambda function: numba.njit(*[] if function.__globals__["DECLARED"] else [signature], **options)(function)


@numba.njit
def as_vector(array: Any) -> Any:
    """Return a C-contiguous array as a vector, for use in compiled code."""
    return array.reshape(array.size)
