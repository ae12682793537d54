"""Generation and compilation of functions of the whole time grid from symbolic expressions.

Every generated function has the signature ``(states, inputs, parameters, tau, frequency, out)`` with

- states (points, 3·states): q, then q̇, then q̈ (per second);
- inputs (points, 3·inputs): u, u̇, ü;
- parameters (parameters,), tau (points,) in forcing periods, frequency [Hz];
- out (points, size): the result, one row per grid point.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

import numpy as np
import sympy as sp
from sympy.printing.codeprinter import PrintMethodNotImplementedError
from sympy.printing.pycode import PythonCodePrinter

from bayesperiodic._compile.grid_function import GridFunction

FUNCTIONS = ("residual", "residual_jacobian", "outputs", "derivatives", "transitions")


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


class VjpKernels(NamedTuple):
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
        return "\n".join(_function(name, needed, arguments) for name, needed in expressions.items() if needed)

    def jacobian_change_source(self) -> str:
        """Return the module of the directional derivative of ∂g/∂(q, q̇, q̈), row by row (states × 3·states), as text.

        It is a function of states (q, q̇, q̈ and their changes), inputs (u, u̇, ü and their changes) and parameters (θ,
        its change and that of the frequency).
        """
        moving = (*self.states, *self.inputs, *self.parameters, self.frequency)
        change = {symbol: sp.Symbol(f"c_{symbol.name}", real=True) for symbol in moving}
        q, u, theta = ((*symbols, *map(change.get, symbols)) for symbols in (self.states, self.inputs, self.parameters))
        arguments = self._arguments(q, u, (*theta, change[self.frequency]))
        changes = [
            sum((sp.diff(e, x) * dx for x, dx in change.items() if x in e.free_symbols), sp.S.Zero)
            for e in _jacobian(self.equations, self.states)
        ]
        return _function("jacobian_change", changes, arguments)

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
        return outputs + "\n" + function("equations_vjp", "l", tuple(-e for e in self.equations), by)

    def _arguments(
        self, states: tuple[sp.Symbol, ...], inputs: tuple[sp.Symbol, ...], parameters: tuple[sp.Symbol, ...]
    ) -> dict[sp.Symbol, str]:
        """Return the Python expression of every symbol at a grid point."""
        return (
            {symbol: f"states[{column}]" for column, symbol in enumerate(states)}
            | {symbol: f"inputs[{column}]" for column, symbol in enumerate(inputs)}
            | {symbol: f"parameters[{index}]" for index, symbol in enumerate(parameters)}
            | {self.tau: "tau", self.frequency: "frequency"}
        )


def grid_functions(source: str, names: Sequence[str]) -> list[GridFunction]:
    """Return functions of a generated text, compiled or from the cache."""
    module = compiled(source)
    return [GridFunction(getattr(module, name)) for name in names]


def compiled(source: str) -> ModuleType:
    """Return the addresses of the functions of a generated text, by their names, compiled or from the cache."""
    from bayesperiodic._compile import functions  # which checks Numba's internals

    return functions.compiled(source)


def _jacobian(rows: Sequence[sp.Expr], columns: Sequence[sp.Symbol]) -> list[sp.Expr]:
    """Return ∂rows/∂columns row by row."""
    return [sp.diff(row, x) if x in row.free_symbols else sp.S.Zero for row in rows for x in columns]


def _function(name: str, expressions: list[sp.Expr], arguments: dict[sp.Symbol, str], summed: int = 0) -> str:
    """Return the source of a function of one grid point, see `machine_code`; the last expressions are `summed`."""
    common, reduced = sp.cse(expressions, symbols=sp.numbered_symbols("common"), order="canonical")
    used = set().union(*(e.free_symbols for e in reduced), *(e.free_symbols for _, e in common))
    columns = [sum(a.startswith(f"{kind}[") for a in arguments.values()) for kind in ("states", "inputs")]
    rows, sums = reduced[: len(reduced) - summed], reduced[len(reduced) - summed :]
    head = (
        f"def {name}(states, inputs, parameters, tau, frequency, out, sums, columns={(*columns, len(rows), summed)}):"
    )
    lines = [
        *(f"    {symbol} = {place}" for symbol, place in arguments.items() if symbol in used),
        *(f"    {symbol} = {_code(expression)}" for symbol, expression in common),
        *(f"    out[{column}] = {_code(expression)}" for column, expression in enumerate(rows)),
        *(f"    sums[{number}] = {_code(term)}" for number, term in enumerate(sums) if term != 0),
    ]
    return "\n".join([head, *(lines or ["    pass"])]) + "\n"


class _PythonPrinter(PythonCodePrinter):
    """SymPy's Python printer, with the function `where` for conditions and generalised functions."""

    def _print_sign(self, expression: sp.Expr) -> str:
        x = self._print(expression.args[0])
        return f"(where({x} > 0.0, 1.0, 0.0) - where({x} < 0.0, 1.0, 0.0))"

    def _print_Heaviside(self, expression: sp.Expr) -> str:
        x = self._print(expression.args[0])
        return f"(0.5*(where({x} > 0.0, 1.0, 0.0) + where({x} >= 0.0, 1.0, 0.0)))"

    def _print_DiracDelta(self, expression: sp.Expr) -> str:
        return "0.0"

    def _print_Piecewise(self, expression: sp.Expr) -> str:
        text = "math.nan"
        for value, condition in reversed(expression.args):
            text = f"where({self._print(condition)}, {self._print(value)}, {text})"
        return text

    def _print_ITE(self, expression: sp.Expr) -> str:
        return f"where({', '.join(map(self._print, expression.args))})"

    def _print_And(self, expression: sp.Expr) -> str:
        return "(" + " & ".join(f"({self._print(part)})" for part in expression.args) + ")"

    def _print_Or(self, expression: sp.Expr) -> str:
        return "(" + " | ".join(f"({self._print(part)})" for part in expression.args) + ")"

    def _print_Not(self, expression: sp.Expr) -> str:
        return f"(({self._print(expression.args[0])}) == False)"


def _code(expression: sp.Expr) -> str:
    try:
        text = _PythonPrinter({"strict": True, "allow_unknown_functions": False}).doprint(expression)
    except PrintMethodNotImplementedError:
        text = "# not supported"
    if "#" in text or "\n" in text:
        raise ValueError(
            "equations or outputs: must be elementary functions, abs, sign, Min, Max and Piecewise, got "
            f"{expression}, which cannot be compiled."
        )
    return text
