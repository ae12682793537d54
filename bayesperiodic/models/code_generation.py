"""From symbolic expressions to compiled functions that sweep the whole time grid.

Every generated function has the signature ``(states, inputs, parameters, tau, frequency, out)`` with

- states (points, 3·states): q, then q̇, then q̈ (per second);
- inputs (points, 3·inputs): u, u̇, ü;
- parameters (parameters,), tau (points,) in forcing periods, frequency [Hz];
- out (points, size): filled, one row a grid point.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy as sp
from numba import types
from numba.core import cgutils, sigutils
from numba.extending import intrinsic
from sympy.printing.codeprinter import PrintMethodNotImplementedError
from sympy.printing.pycode import PythonCodePrinter

from bayesperiodic.models.cache import load

if TYPE_CHECKING:
    from bayesperiodic.models.model import Model


GRID_SIGNATURE = "void(float64[:,::1], float64[:,::1], float64[::1], float64[::1], float64, float64[:,::1])"
FUNCTIONS = ("residual", "residual_jacobian", "outputs", "derivatives", "transitions")
SECOND_FUNCTIONS = ("jacobian_change",)
PULLED_FUNCTIONS = ("pulled_outputs", "pulled_equations")
MANY_ZEROS = 30
GATHERS = "from bayesperiodic.models._kernels.gathers import without_gathers"


class GridFunction(types.WrapperAddressProtocol):
    """A compiled grid function that other compiled code takes as an argument.

    Handing over the compiled function itself would look its address up at every call, for longer than a solve takes.
    Without `_numba_type_` Numba would make its type anew at every call.

    Attributes
    ----------
    address : int
        For calls that are too short even for Numba's conversion of this argument, see `grid_function_at`.
    """

    def __init__(self, compiled: Any):
        arguments, result = sigutils.normalize_signature(GRID_SIGNATURE)
        self._signature = result(*arguments)
        self._numba_type_ = types.FunctionType(self._signature)
        self._compiled = compiled
        code = compiled.get_compile_result(self._signature)
        self.address = code.library.get_pointer_to_function(code.fndesc.llvm_cfunc_wrapper_name)

    def __wrapper_address__(self) -> int:
        return self.address

    def signature(self) -> Any:
        """Return the signature, as the protocol asks."""
        return self._signature

    def __call__(self, *arguments: Any) -> None:
        """Run the compiled function."""
        self._compiled(*arguments)


@intrinsic
def grid_function_at(typing_context: Any, address: Any) -> Any:
    """Return, within compiled code, the grid function at an address."""
    arguments, result = sigutils.normalize_signature(GRID_SIGNATURE)
    kind = types.FunctionType(result(*arguments))

    def structure(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        function = cgutils.create_struct_proxy(kind)(context, builder)
        function.c_addr = builder.inttoptr(values[0], context.get_value_type(types.voidptr))
        return function._getvalue()

    return kind(types.int64), structure


@dataclass(frozen=True)
class Kernels:
    """The compiled grid functions of one model.

    Attributes
    ----------
    residual : GridFunction
        Columns: g (states).
    residual_jacobian : GridFunction
        Columns: g, then ∂g/∂(q, q̇, q̈) row by row (states × 3·states).
    outputs : GridFunction
        Columns: ŷ (outputs).
    derivatives : GridFunction
        Columns: ∂g/∂θ, ∂g/∂(u, u̇, ü), ∂g/∂f, ∂f/∂(q, q̇, q̈), ∂f/∂θ, ∂f/∂(u, u̇, ü), ∂f/∂f, each row by row; see
        `split_derivatives`.
    transitions : GridFunction
        Columns: the arguments of the smooth signs in the equations, which change over within −1 … 1.
    output_rates : bool
        Whether `outputs` depends on q̇ or q̈.
    """

    residual: GridFunction
    residual_jacobian: GridFunction
    outputs: GridFunction
    derivatives: GridFunction
    transitions: GridFunction
    states: int
    inputs: int
    parameters: int
    channels: int
    smooth_signs: int
    output_rates: bool

    def evaluate(
        self,
        name: str,
        states: np.ndarray,
        inputs: np.ndarray,
        parameters: np.ndarray,
        tau: np.ndarray,
        frequency: float,
    ) -> np.ndarray:
        """Return one of the functions on a grid, (points, size)."""
        size = {
            "residual": self.states,
            "residual_jacobian": self.states * (1 + 3 * self.states),
            "outputs": self.channels,
            "transitions": self.smooth_signs,
            "derivatives": sum(rows * columns for rows, columns in self._derivative_shapes()),
        }[name]
        out = np.empty((tau.size, size))
        getattr(self, name)(states, inputs, parameters, tau, frequency, out)
        return out

    def split_derivatives(self, columns: np.ndarray) -> list[np.ndarray]:
        """Return g_θ, g_u, g_f, f_q, f_θ, f_u, f_f as arrays (points, rows, columns); g_f is to the frequency."""
        parts, start = [], 0
        for shape in self._derivative_shapes():
            stop = start + shape[0] * shape[1]
            parts.append(columns[:, start:stop].reshape(len(columns), *shape))
            start = stop
        return parts

    def _derivative_shapes(self) -> list[tuple[int, int]]:
        g, f = self.states, self.channels
        theta, u = self.parameters, 3 * self.inputs
        return [(g, theta), (g, u), (g, 1), (f, 3 * g), (f, theta), (f, u), (f, 1)]


def compile_kernels(model: Model) -> Kernels:
    """Return the compiled functions of a model, from the disk cache where they are there and undamaged."""
    functions = load(kernel_source(model), FUNCTIONS)
    rates = set(list(model.state_symbols.values())[len(model.states) :])
    return Kernels(
        **{name: GridFunction(compiled) for name, compiled in functions.items()},
        states=len(model.states),
        inputs=len(model.inputs),
        parameters=len(model.parameters),
        channels=len(model.outputs),
        smooth_signs=len(model.smooth_signs),
        output_rates=any(expression.free_symbols & rates for expression in model.output_expressions),
    )


def kernel_source(model: Model) -> str:
    """Return the generated module as text; the same model always gives the same text."""
    g, f = list(model.equations), list(model.output_expressions)
    q, u = list(model.state_symbols.values()), list(model.input_symbols.values())
    theta, frequency = list(model.parameter_symbols.values()), [model.time_symbols["frequency"]]
    needs = {
        "residual": g,
        "residual_jacobian": [*g, *_jacobian(g, q)],
        "outputs": [*f],
        "transitions": [sign.args[0] for sign in model.smooth_signs],
        "derivatives": [
            entry
            for rows, columns in ((g, theta), (g, u), (g, frequency), (f, q), (f, theta), (f, u), (f, frequency))
            for entry in _jacobian(rows, columns)
        ],
    }
    return _with_elementary(_functions(needs, q, u, theta, model.time_symbols))


def compile_second(model: Model) -> GridFunction:
    """Return the compiled `jacobian_change` of a model: the change of ∂g/∂(q, q̇, q̈) along a direction.

    It is a grid function of states (q, q̇, q̈ and their changes), inputs (u, u̇, ü and their changes), parameters (θ, its
    change and that of the frequency); columns row by row (states × 3·states).
    """
    return GridFunction(load(second_source(model), SECOND_FUNCTIONS)["jacobian_change"])


def second_source(model: Model) -> str:
    """Return the generated module with `jacobian_change` as text."""
    q, u = list(model.state_symbols.values()), list(model.input_symbols.values())
    theta, frequency = list(model.parameter_symbols.values()), model.time_symbols["frequency"]
    change = {symbol: sp.Symbol(f"c_{symbol.name}", real=True) for symbol in (*q, *u, *theta, frequency)}
    jacobian = _jacobian(list(model.equations), q)
    changes = [
        sum((sp.diff(e, x) * dx for x, dx in change.items() if x in e.free_symbols), sp.S.Zero) for e in jacobian
    ]
    text = _functions(
        {"jacobian_change": changes},
        q + [change[x] for x in q],
        u + [change[x] for x in u],
        theta + [change[x] for x in (*theta, frequency)],
        model.time_symbols,
    )
    return _with_elementary(text)


@dataclass(frozen=True)
class PullingKernels:
    """The compiled grid functions that gradients by some of a model's parameters need.

    What is costly to evaluate stands in the outputs or in the equations, rarely in both, so that no function has both.

    Attributes
    ----------
    pulled_outputs : GridFunction
        Of states (q, q̇, q̈, weights w of the outputs). Columns: Σ w·∂f/∂(q, q̇, q̈); then, after the last row, summed
        over the grid: Σ w·∂f/∂θ by those parameters.
    pulled_equations : GridFunction
        Of states (q, q̇, q̈, an adjoint state λ). Summed over the grid: −Σ λ·∂g/∂θ by those parameters.
    """

    pulled_outputs: GridFunction
    pulled_equations: GridFunction


def compile_pulling(model: Model, moving: tuple[int, ...]) -> PullingKernels:
    """Return the compiled functions that gradients by the parameters of these indices need."""
    functions = load(pulling_source(model, moving), PULLED_FUNCTIONS)
    return PullingKernels(**{name: GridFunction(compiled) for name, compiled in functions.items()})


def pulling_source(model: Model, moving: tuple[int, ...]) -> str:
    """Return the generated module of `PullingKernels` as text."""
    g, f = list(model.equations), list(model.output_expressions)
    q, u = list(model.state_symbols.values()), list(model.input_symbols.values())
    theta = list(model.parameter_symbols.values())
    weights, adjoint = ([sp.Symbol(f"{w}_{i}", real=True) for i in range(len(e))] for w, e in (("w", f), ("l", g)))
    by, rest = [theta[i] for i in moving], (u, theta, model.time_symbols)
    changes, moved = _weighed_changes(weights, f, [*q, *by]), _weighed_changes(adjoint, [-e for e in g], by)
    functions = [
        _functions({"pulled_outputs": changes}, [*q, *weights], *rest, summed=len(by)),
        _functions({"pulled_equations": moved}, [*q, *adjoint], *rest, summed=len(by)),
    ]
    return _with_elementary("\n\n".join(functions))


def _weighed_changes(weights: list[sp.Symbol], rows: list[sp.Expr], columns: list[sp.Symbol]) -> list[sp.Expr]:
    """Return Σ weight·∂row/∂column of each column."""
    return [
        sum((w * sp.diff(e, x) for w, e in zip(weights, rows, strict=True) if x in e.free_symbols), sp.S.Zero)
        for x in columns
    ]


def _jacobian(rows: list[sp.Expr], columns: list[sp.Symbol]) -> list[sp.Expr]:
    """Return ∂rows/∂columns row by row."""
    return [sp.diff(row, x) if x in row.free_symbols else sp.S.Zero for row in rows for x in columns]


def _functions(
    needs: dict[str, list[sp.Expr]],
    states: list[sp.Symbol],
    inputs: list[sp.Symbol],
    parameters: list[sp.Symbol],
    time: dict[str, sp.Symbol],
    *,
    summed: int = 0,
) -> str:
    arguments = {
        **{symbol: f"flat_states[{len(states)}*i + {column}]" for column, symbol in enumerate(states)},
        **{symbol: f"flat_inputs[{len(inputs)}*i + {column}]" for column, symbol in enumerate(inputs)},
        **{symbol: f"parameters[{index}]" for index, symbol in enumerate(parameters)},
        time["tau"]: "tau[i]",
        time["frequency"]: "frequency",
    }
    return "\n\n".join(_function(name, expressions, arguments, summed) for name, expressions in needs.items())


def _with_elementary(functions: str) -> str:
    """Return the text after the elementary functions that it calls and what these call."""
    text = Path(__file__).with_name("_kernels").joinpath("elementary.py").read_text(encoding="utf-8")
    header, *blocks = text.strip().split("\n\n\n")
    for block in reversed(blocks):
        name = block.partition("def ")[2].partition("(")[0]
        if f"{name}(" in functions:
            functions = f"{block}\n\n\n{functions}"
    return f"{header}\n{GATHERS}\n\n\n{functions}"


def _function(name: str, expressions: list[sp.Expr], arguments: dict[sp.Symbol, str], summed: int) -> str:
    """Return a function that sweeps the grid; strides known at compile time let its loop be vectorised.

    The last `summed` expressions are added up in whatever order is fastest on this machine, and put after the rows.
    """
    common, reduced = sp.cse(expressions, symbols=sp.numbered_symbols("common"), order="canonical")
    used = set().union(*(e.free_symbols for e in reduced), *(e.free_symbols for _, e in common))
    places = {symbol: place for symbol, place in arguments.items() if symbol in used and symbol.name != place}
    lines = ["    without_gathers()", *(f"    flat_{a} = {a}.reshape({a}.size)" for a in ("states", "inputs", "out"))]
    lines += [f"    {s} = {place}" for s, place in places.items() if "[" not in place or "i" not in place.split("[")[1]]
    columns = len(reduced) - summed
    before, own, after = _sums(reduced[columns:], columns)
    row = [*_row(reduced[:columns]), *own] or ["        pass"]
    lines += [*before, "    for i in range(states.shape[0]):"]
    lines += [f"        {s} = {place}" for s, place in places.items() if "[" in place and "i" in place.split("[")[1]]
    lines += [f"        {symbol} = {_code(expression)}" for symbol, expression in common]
    lines += [*row, *after]
    fast = ', fastmath={"reassoc"}' if summed else ""
    header = f'@njit("{GRID_SIGNATURE}", cache=CACHE, nogil=True, error_model="numpy"{fast})\n'
    return header + f"def {name}(states, inputs, parameters, tau, frequency, out):\n" + "\n".join(lines) + "\n"


def _row(expressions: list[sp.Expr]) -> list[str]:
    """Return the lines that fill a row, zeros by a loop where there are many."""
    size, zeros = len(expressions), sum(expression == 0 for expression in expressions)
    cleared = zeros > MANY_ZEROS
    lines = (
        [f"        for column in range({size}):", f"            flat_out[{size}*i + column] = 0.0"] if cleared else []
    )
    lines += [
        f"        flat_out[{size}*i + {column}] = {_code(expression)}"
        for column, expression in enumerate(expressions)
        if not cleared or expression != 0
    ]
    return lines


def _sums(expressions: list[sp.Expr], columns: int) -> tuple[list[str], list[str], list[str]]:
    """Return the lines before, in and after the loop that sum up expressions and put them after rows of `columns`."""
    start = f"{columns}*states.shape[0]" if columns else "0"
    there = [column for column, expression in enumerate(expressions) if expression != 0]
    return (
        [f"    sum_{column} = 0.0" for column in there],
        [f"        sum_{column} += {_code(expressions[column])}" for column in there],
        [f"    flat_out[{start} + {c}] = {f'sum_{c}' if c in there else 0.0}" for c in range(len(expressions))],
    )


class _Printer(PythonCodePrinter):
    """SymPy's Python printer with the generalised functions that differentiation leaves behind."""

    def _print_sign(self, expression: sp.Expr) -> str:
        argument = self._print(expression.args[0])
        return f"(({argument} > 0.0) - ({argument} < 0.0))"

    def _print_Heaviside(self, expression: sp.Expr) -> str:
        argument = self._print(expression.args[0])
        return f"(0.5*(({argument} > 0.0) + ({argument} >= 0.0)))"

    def _print_exp(self, expression: sp.Expr) -> str:
        return f"exp({self._print(expression.args[0])})"

    def _print_tanh(self, expression: sp.Expr) -> str:
        return f"tanh({self._print(expression.args[0])})"

    def _print_atan(self, expression: sp.Expr) -> str:
        return f"atan({self._print(expression.args[0])})"

    def _print_DiracDelta(self, expression: sp.Expr) -> str:
        return "0.0"


def _code(expression: sp.Expr) -> str:
    try:
        text = _Printer({"strict": True, "allow_unknown_functions": False}).doprint(expression)
    except PrintMethodNotImplementedError:
        text = "# not supported"
    if "#" in text or "\n" in text:
        raise ValueError(
            f"equations or outputs: {expression} is not allowed; it has a function (or a derivative of one) that "
            "cannot be compiled. Elementary functions, abs, sign, Min, Max and Piecewise are."
        )
    return text


def as_columns(values: Iterable[np.ndarray], points: int) -> np.ndarray:
    """Return signals (or their derivatives) side by side as a C-contiguous array (points, columns)."""
    stacked = [np.asarray(v, dtype=float) for v in values]
    return np.ascontiguousarray(np.stack(stacked, axis=-1)) if stacked else np.empty((points, 0))
