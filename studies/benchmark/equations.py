"""A model as a system of first order, y' = f(y, u, p), with derivatives, for time integrators.

Generated from the model's expressions, so that every method solves the same equations: as text that Numba compiles,
that NumPy evaluates on whole arrays, or that JAX traces.

y holds the states, each of second order followed by its rate; u the inputs and their first two derivatives, then τ; p
the model's parameters, then the frequency.
"""

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp
from sympy.printing.numpy import JaxPrinter, NumPyPrinter
from sympy.printing.pycode import PythonCodePrinter

import bayesperiodic as bp

# Evaluators of the text: SymPy's printer and the module that the text refers to.
NUMBA, NUMPY, JAX = (PythonCodePrinter, "math"), (NumPyPrinter, "numpy"), (JaxPrinter, "jax")


@dataclass(frozen=True)
class FirstOrder:
    """A model with the parameters by which derivatives are wanted."""

    model: bp.Model
    moving: tuple[str, ...]  # Names of parameters

    @cached_property
    def states(self) -> list[sp.Symbol]:
        """The symbols of y."""
        symbols = self.model.state_symbols
        return [symbols[prefix + name] for name, order in self.model.orders.items() for prefix in ("", "d")[:order]]

    @property
    def size(self) -> int:
        """The length of y."""
        return len(self.states)

    @cached_property
    def _highest(self) -> dict[sp.Symbol, sp.Expr]:
        """The equations solved for the highest derivatives, in which they are linear."""
        tops = [self.model.state_symbols["d" * order + name] for name, order in self.model.orders.items()]
        matrix, right = sp.linear_eq_to_matrix(list(self.model.equations), tops)
        return dict(zip(tops, matrix.LUsolve(right), strict=True))

    @property
    def rates(self) -> list[sp.Expr]:
        """The expressions of f."""
        symbols = self.model.state_symbols
        rates = [symbols["d" * k + name] for name, order in self.model.orders.items() for k in range(1, order + 1)]
        return [self._highest.get(rate, rate) for rate in rates]

    @property
    def outputs(self) -> list[sp.Expr]:
        """The expressions of the outputs in y, u and p."""
        return [expression.xreplace(self._highest) for expression in self.model.output_expressions]

    def by_states(self, expressions: Sequence[sp.Expr]) -> list[list[sp.Expr]]:
        """Return the derivatives of expressions by y, a row an expression."""
        return [[sp.diff(e, y) for y in self.states] for e in expressions]

    def by_parameters(self, expressions: Sequence[sp.Expr]) -> list[list[sp.Expr]]:
        """Return the derivatives of expressions by the moving parameters, a row an expression."""
        symbols = self.model.parameter_symbols
        return [[sp.diff(e, symbols[name]) for name in self.moving] for e in expressions]

    def function(self, kind: tuple[Any, str], expressions: Any) -> Callable[..., Any]:
        """Return a function of y, u, p and, but for JAX, an array to fill, in the shape of the nested expressions."""
        rows = [entry if isinstance(entry, list) else [entry] for entry in expressions]
        nested = isinstance(expressions[0], list)
        flat = [entry for row in rows for entry in row]
        places = [f"{i}, {j}" if nested else f"{i}" for i, row in enumerate(rows) for j in range(len(row))]
        common, reduced = sp.cse(flat, symbols=sp.numbered_symbols("common"), order="none")
        printer, module = kind[0]({"fully_qualified_modules": True}), kind[1]
        used = set().union(*(e.free_symbols for e in reduced), *(e.free_symbols for _, e in common))
        lines = [f"{symbol} = {place}" for symbol, place in self._arguments.items() if symbol in used]
        lines += [f"{symbol} = {printer.doprint(e)}" for symbol, e in common]
        if kind == JAX:
            inner = ", ".join(printer.doprint(e) for e in reduced)
            shape = f".reshape({len(rows)}, {len(rows[0])})" if nested else ""
            lines.append(f"return jax.numpy.stack([{inner}]){shape}")
        else:
            lines += [f"out[{place}] = {printer.doprint(e)}" for place, e in zip(places, reduced, strict=True)]
        text = f"def function(y, u, p{'' if kind == JAX else ', out'}):\n    " + "\n    ".join(lines) + "\n"
        space: dict[str, Any] = {module: importlib.import_module(module)}
        exec(compile(text, f"<{self.model.name}, {module}>", "exec"), space)  # of the model's own expressions
        return space["function"]

    @property
    def _arguments(self) -> dict[sp.Symbol, str]:
        inputs = [self.model.input_symbols[prefix + name] for name in self.model.inputs for prefix in ("", "d", "dd")]
        signals = [*inputs, self.model.time_symbols["tau"]]
        parameters = [*self.model.parameter_symbols.values(), self.model.time_symbols["frequency"]]
        return {
            symbol: f"{vector}[{k}]"
            for vector, symbols in (("y", self.states), ("u", signals), ("p", parameters))
            for k, symbol in enumerate(symbols)
        }


def table(experiment: bp.Experiment, inputs: Sequence[str], points: int) -> np.ndarray:
    """Return the inputs, their first two derivatives by time and τ (points, 3·inputs + 1) over a period.

    Trigonometric interpolation of the experiment's samples, as the package takes derivatives.
    """
    columns: list[np.ndarray] = []
    for name in inputs:
        amplitudes = np.fft.rfft(experiment.inputs[name]) / len(experiment.inputs[name])
        turning = 2j * np.pi * experiment.frequency / experiment.periods * np.arange(amplitudes.size)
        kept = min(amplitudes.size, points // 2 + 1)
        columns += [np.fft.irfft((amplitudes * turning**k)[:kept] * points, points) for k in range(3)]
    columns.append(np.arange(points) * (experiment.periods / points))
    return np.ascontiguousarray(np.stack(columns, axis=-1))
