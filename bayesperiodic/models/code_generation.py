"""Generation and compilation of functions of the whole time grid from symbolic expressions.

Every generated function has the signature ``(states, inputs, parameters, tau, frequency, out)`` with

- states (points, 3·states): q, then q̇, then q̈ (per second);
- inputs (points, 3·inputs): u, u̇, ü;
- parameters (parameters,), tau (points,) in forcing periods, frequency [Hz];
- out (points, size): the result, one row per grid point.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import llvmlite.binding
import numpy as np
import sympy as sp
from numba import types
from numba.core import cgutils, sigutils
from numba.core.imputils import impl_ret_borrowed
from numba.extending import intrinsic
from sympy.printing.codeprinter import PrintMethodNotImplementedError
from sympy.printing.pycode import PythonCodePrinter

from bayesperiodic.models.cache import load

GRID_SIGNATURE = "void(float64[:,::1], float64[:,::1], float64[::1], float64[::1], float64, float64[:,::1])"
FUNCTIONS = ("residual", "residual_jacobian", "outputs", "derivatives", "transitions")
MANY_ZEROS = 30
IMPORTS = "from bayesperiodic.models.code_generation import as_vector, without_gathers"
NO_GATHER, FIRST_LLVM = "+prefer-no-gather", 17  # and the first version of LLVM that has this feature
_arguments, _result = sigutils.normalize_signature(GRID_SIGNATURE)
GRID_FUNCTION = types.FunctionType(_result(*_arguments))


class GridFunction(types.WrapperAddressProtocol):
    """A compiled grid function that can be passed to other compiled functions.

    Numba looks up the address of a compiled function at every call that takes one as an argument, which takes longer
    than a periodic solve. Here the address is looked up once, and so is the type (`_numba_type_`). In short calls even
    the conversion of this argument counts; these take the `address`, see `grid_function_at`.
    """

    def __init__(self, compiled: Any):
        self._numba_type_ = GRID_FUNCTION
        self._compiled = compiled
        code = compiled.get_compile_result(GRID_FUNCTION.signature)
        self.address = code.library.get_pointer_to_function(code.fndesc.llvm_cfunc_wrapper_name)

    def __wrapper_address__(self) -> int:
        return self.address

    def signature(self) -> Any:
        """Return the Numba signature."""
        return GRID_FUNCTION.signature

    def __call__(self, *arguments: Any) -> None:
        """Run the compiled function."""
        self._compiled(*arguments)


@intrinsic
def grid_function_at(typing_context: Any, address: Any) -> Any:
    """Return the grid function at an address; for use in compiled code."""

    def structure(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        function = cgutils.create_struct_proxy(GRID_FUNCTION)(context, builder)
        function.c_addr = builder.inttoptr(values[0], context.get_value_type(types.voidptr))
        return function._getvalue()

    return GRID_FUNCTION(types.int64), structure


@intrinsic
def without_gathers(typing_context: Any) -> Any:
    """Compile the calling function without gather instructions: strided columns are loaded one number at a time.

    Gathers are slow on most Intel processors since the mitigation of gather data sampling (Intel, advisory 00828,
    2023): without them the sweeps of a landing gear over its grid take a third of the time.
    """

    def attribute(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        features = context.codegen().magic_tuple()[2]
        if "+avx2" in features.split(",") and llvmlite.binding.llvm_version_info[0] >= FIRST_LLVM:
            given = builder.function.attributes
            set.add(given, f'"target-features"="{features},{NO_GATHER}"')  # `given.add` accepts only a few names.
            given.add("noinline")  # A caller that inlines the loop has its own attributes.
        return context.get_dummy_value()

    return types.void(), attribute


@intrinsic
def as_vector(typing_context: Any, array: Any) -> Any:
    """Return a C-contiguous array as a vector, for use in compiled code; `reshape` takes longer to compile."""
    assert array.layout == "C", f"as_vector: must be C-contiguous, got layout {array.layout!r}"
    vector = types.Array(array.dtype, 1, "C")

    def view(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        own = context.make_array(array)(context, builder, values[0])
        result, size = context.make_array(vector)(context, builder), own.itemsize
        context.populate_array(
            result, data=own.data, shape=[own.nitems], strides=[size], itemsize=size, meminfo=own.meminfo
        )
        return impl_ret_borrowed(context, builder, vector, result._getvalue())

    return vector(array), view


@dataclass(frozen=True)
class Kernels:
    """The compiled grid functions of one model, and the numbers of its variables."""

    residual: GridFunction  # g (states)
    residual_jacobian: GridFunction  # g, then ∂g/∂(q, q̇, q̈) row by row (states × 3·states)
    outputs: GridFunction  # ŷ (channels)
    derivatives: GridFunction  # see `split_derivatives`, each row by row
    states: int
    inputs: int
    parameters: int
    channels: int
    smooth_signs: int
    output_rates: bool  # whether the outputs depend on q̇ or q̈
    transitions: GridFunction | None = None  # arguments of the smooth signs in g, whose transitions are within −1 … 1

    def evaluate(
        self, name: str, states: np.ndarray, inputs: np.ndarray, theta: np.ndarray, tau: np.ndarray, frequency: float
    ) -> np.ndarray:
        """Return one of the functions on a grid, (points, columns)."""
        out = np.empty((tau.size, self.columns(name)))
        getattr(self, name)(states, inputs, theta, tau, frequency, out)
        return out

    def columns(self, name: str) -> int:
        """Return the number of columns of one of the functions."""
        return {
            "residual": self.states,
            "residual_jacobian": self.states * (1 + 3 * self.states),
            "outputs": self.channels,
            "transitions": self.smooth_signs,
            "derivatives": sum(rows * columns for rows, columns in self._derivative_shapes()),
        }[name]

    def split_derivatives(self, columns: np.ndarray) -> list[np.ndarray]:
        """Return g_θ, g_u, g_ν, f_q, f_θ, f_u, f_ν as arrays (points, rows, columns), ν being the frequency."""
        shapes = self._derivative_shapes()
        ends = np.cumsum([rows * columns for rows, columns in shapes])
        parts = np.split(columns, ends[:-1], axis=1)
        return [part.reshape(len(columns), *shape) for part, shape in zip(parts, shapes, strict=True)]

    def _derivative_shapes(self) -> list[tuple[int, int]]:
        g, f = self.states, self.channels
        theta, u = self.parameters, 3 * self.inputs
        return [(g, theta), (g, u), (g, 1), (f, 3 * g), (f, theta), (f, u), (f, 1)]


@dataclass(frozen=True)
class VjpKernels:
    """Compiled vector-Jacobian products, with respect to some of a model's parameters θ.

    Usually either the outputs or the equations of a model are expensive; therefore these are two functions.

    - outputs_vjp, of states (q, q̇, q̈, weights w of the outputs): columns Σ w·∂f/∂(q, q̇, q̈); then, after the last
      row, Σ w·∂f/∂θ summed over the grid.
    - equations_vjp, of states (q, q̇, q̈, adjoint state λ): −Σ λ·∂g/∂θ summed over the grid.
    """

    outputs_vjp: GridFunction
    equations_vjp: GridFunction


@dataclass(frozen=True)
class SymbolicModel:
    """Symbols and expressions of a model, from which its compiled functions are generated."""

    states: tuple[sp.Symbol, ...]  # q, q̇, q̈
    inputs: tuple[sp.Symbol, ...]  # u, u̇, ü
    parameters: tuple[sp.Symbol, ...]
    tau: sp.Symbol
    frequency: sp.Symbol
    equations: tuple[sp.Expr, ...]  # g
    outputs: tuple[sp.Expr, ...]  # f
    transitions: tuple[sp.Expr, ...]  # arguments of the smooth signs in g

    def kernels(self) -> Kernels:
        """Return the compiled residual, Jacobian, outputs and derivatives."""
        rates = set(self.states[len(self.equations) :])
        needed = FUNCTIONS if self.transitions else FUNCTIONS[:-1]
        return Kernels(
            **dict(zip(needed, grid_functions(self.kernel_source(), needed), strict=True)),
            states=len(self.equations),
            inputs=len(self.inputs) // 3,
            parameters=len(self.parameters),
            channels=len(self.outputs),
            smooth_signs=len(self.transitions),
            output_rates=any(expression.free_symbols & rates for expression in self.outputs),
        )

    def kernel_source(self) -> str:
        """Return the module of `kernels` as text; the same model always gives the same text."""
        g, f, q, u = self.equations, self.outputs, self.states, self.inputs
        theta, frequency = self.parameters, (self.frequency,)
        blocks = ((g, theta), (g, u), (g, frequency), (f, q), (f, theta), (f, u), (f, frequency))
        expressions = {
            "residual": [*g],
            "residual_jacobian": [*g, *_jacobian(g, q)],
            "outputs": [*f],
            "derivatives": [entry for rows, columns in blocks for entry in _jacobian(rows, columns)],
            "transitions": [*self.transitions],
        }
        arguments = self._arguments(q, u, theta)
        return _module([_function(name, needed, arguments) for name, needed in expressions.items() if needed])

    def jacobian_change_source(self) -> str:
        """Return the module of the directional derivative of ∂g/∂(q, q̇, q̈), row by row (states × 3·states), as text.

        It is a function of states (q, q̇, q̈ and their changes), inputs (u, u̇, ü and their changes) and parameters (θ,
        its change and that of the frequency).
        """
        moving = (*self.states, *self.inputs, *self.parameters, self.frequency)
        change = {symbol: sp.Symbol(f"c_{symbol.name}", real=True) for symbol in moving}
        q, u, theta = ((*own, *map(change.get, own)) for own in (self.states, self.inputs, self.parameters))
        arguments = self._arguments(q, u, (*theta, change[self.frequency]))
        changes = [
            sum((sp.diff(e, x) * dx for x, dx in change.items() if x in e.free_symbols), sp.S.Zero)
            for e in _jacobian(self.equations, self.states)
        ]
        return _module([_function("jacobian_change", changes, arguments)])

    def vjp_source(self, moving: tuple[int, ...]) -> str:
        """Return the module of `VjpKernels`, with respect to the parameters of these indices, as text."""
        by = tuple(self.parameters[i] for i in moving)

        def function(name: str, letter: str, rows: tuple[sp.Expr, ...], columns: tuple[sp.Symbol, ...]) -> str:
            factors = tuple(sp.Symbol(f"{letter}_{i}", real=True) for i in range(len(rows)))
            products = [
                sum((w * sp.diff(e, x) for w, e in zip(factors, rows, strict=True) if x in e.free_symbols), sp.S.Zero)
                for x in columns
            ]
            arguments = self._arguments((*self.states, *factors), self.inputs, self.parameters)
            return _function(name, products, arguments, len(by))

        outputs = function("outputs_vjp", "w", self.outputs, (*self.states, *by))
        return _module([outputs, function("equations_vjp", "l", tuple(-e for e in self.equations), by)])

    def _arguments(
        self, states: tuple[sp.Symbol, ...], inputs: tuple[sp.Symbol, ...], parameters: tuple[sp.Symbol, ...]
    ) -> dict[sp.Symbol, str]:
        """Return the Python expression of every symbol in a grid function."""
        return (
            {symbol: f"flat_states[{len(states)}*i + {column}]" for column, symbol in enumerate(states)}
            | {symbol: f"flat_inputs[{len(inputs)}*i + {column}]" for column, symbol in enumerate(inputs)}
            | {symbol: f"parameters[{index}]" for index, symbol in enumerate(parameters)}
            | {self.tau: "tau[i]", self.frequency: "frequency"}
        )


def grid_functions(source: str, names: Sequence[str]) -> list[GridFunction]:
    """Return functions of a generated module, compiled or from the cache."""
    module = load(source)
    return [GridFunction(getattr(module, name)) for name in names]


def _jacobian(rows: Sequence[sp.Expr], columns: Sequence[sp.Symbol]) -> list[sp.Expr]:
    """Return ∂rows/∂columns row by row."""
    return [sp.diff(row, x) if x in row.free_symbols else sp.S.Zero for row in rows for x in columns]


def _module(functions: list[str]) -> str:
    """Return the source of grid functions, preceded by the elementary functions that they call."""
    body = "\n\n".join(functions)
    text = Path(__file__).with_name("_kernels").joinpath("elementary.py").read_text(encoding="utf-8")
    header, *blocks = text.strip().split("\n\n\n")
    for block in reversed(blocks):
        name = block.partition("def ")[2].partition("(")[0]
        if f"{name}(" in body:
            body = f"{block}\n\n\n{body}"
    return f"{header}\n{IMPORTS}\n\n\n{body}"


def _function(name: str, expressions: list[sp.Expr], arguments: dict[sp.Symbol, str], summed: int = 0) -> str:
    """Return the source of a grid function.

    Strides are literals, so that the loop can be vectorised. The last `summed` expressions are summed over the grid, in
    any order, and stored after the rows.
    """
    common, reduced = sp.cse(expressions, symbols=sp.numbered_symbols("common"), order="canonical")
    used = set().union(*(e.free_symbols for e in reduced), *(e.free_symbols for _, e in common))
    places = {symbol: place for symbol, place in arguments.items() if symbol in used and symbol.name != place}
    varying = {symbol: place for symbol, place in places.items() if place.startswith(("flat_", "tau["))}
    columns = len(reduced) - summed
    before, own, after = _sums(reduced[columns:], columns)
    lines = [
        "    without_gathers()",
        *(f"    flat_{a} = as_vector({a})" for a in ("states", "inputs", "out")),
        *(f"    {symbol} = {place}" for symbol, place in places.items() if symbol not in varying),
        *before,
        "    for i in range(states.shape[0]):",
        *(f"        {symbol} = {place}" for symbol, place in varying.items()),
        *(f"        {symbol} = {_code(expression)}" for symbol, expression in common),
        *([*_row(reduced[:columns]), *own] or ["        pass"]),
        *after,
    ]
    fast = ', fastmath={"reassoc"}' if summed else ""
    header = f'@njit("{GRID_SIGNATURE}", cache=CACHE, nogil=True, error_model="numpy"{fast})\n'
    return header + f"def {name}(states, inputs, parameters, tau, frequency, out):\n" + "\n".join(lines) + "\n"


def _row(expressions: list[sp.Expr]) -> list[str]:
    """Return the lines that fill a row; many zeros are set in a loop."""
    size, zeros = len(expressions), sum(expression == 0 for expression in expressions)
    cleared = zeros > MANY_ZEROS
    clearing = [f"        for column in range({size}):", f"            flat_out[{size}*i + column] = 0.0"]
    return (clearing if cleared else []) + [
        f"        flat_out[{size}*i + {column}] = {_code(expression)}"
        for column, expression in enumerate(expressions)
        if not cleared or expression != 0
    ]


def _sums(expressions: list[sp.Expr], columns: int) -> tuple[list[str], list[str], list[str]]:
    """Return the lines before, in and after the loop that sum expressions and store them after rows of `columns`."""
    start = f"{columns}*states.shape[0]" if columns else "0"
    there = [column for column, expression in enumerate(expressions) if expression != 0]
    return (
        [f"    sum_{column} = 0.0" for column in there],
        [f"        sum_{column} += {_code(expressions[column])}" for column in there],
        [f"    flat_out[{start} + {c}] = {f'sum_{c}' if c in there else 0.0}" for c in range(len(expressions))],
    )


class _Printer(PythonCodePrinter):
    """SymPy's Python printer, with the elementary functions of `_kernels` and generalised functions."""

    def _print_sign(self, expression: sp.Expr) -> str:
        argument = self._print(expression.args[0])
        return f"(({argument} > 0.0) - ({argument} < 0.0))"

    def _print_Heaviside(self, expression: sp.Expr) -> str:
        argument = self._print(expression.args[0])
        return f"(0.5*(({argument} > 0.0) + ({argument} >= 0.0)))"

    def _print_elementary(self, expression: sp.Expr) -> str:
        return f"{expression.func.__name__}({self._print(expression.args[0])})"

    _print_exp = _print_tanh = _print_atan = _print_elementary

    def _print_DiracDelta(self, expression: sp.Expr) -> str:
        return "0.0"


def _code(expression: sp.Expr) -> str:
    try:
        text = _Printer({"strict": True, "allow_unknown_functions": False}).doprint(expression)
    except PrintMethodNotImplementedError:
        text = "# not supported"
    if "#" in text or "\n" in text:
        raise ValueError(
            "equations or outputs: must be elementary functions, abs, sign, Min, Max and Piecewise, got "
            f"{expression}, which cannot be compiled."
        )
    return text


def as_columns(values: Iterable[np.ndarray], points: int) -> np.ndarray:
    """Return signals as the columns of a C-contiguous array (points, signals)."""
    stacked = [np.asarray(v, dtype=float) for v in values]
    return np.ascontiguousarray(np.stack(stacked, axis=-1)) if stacked else np.empty((points, 0))
