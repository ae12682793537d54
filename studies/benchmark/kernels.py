"""A model as a system of first order, y' = f(y, u, p), with derivatives, and its compiled integration over a period.

The functions are generated from the model's expressions, so that every method solves the same equations: as text that
Numba compiles, that NumPy evaluates on whole arrays, or that JAX traces. y holds the states, those of second order
followed by their rate; u the inputs and their first two derivatives, then τ; p the parameters, then the frequency.

Compiled are the classical Runge-Kutta method until steady, and shooting based on it: straight-line code with constant
sizes that allocates nothing in a cycle and releases the interpreter's lock.
"""

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

import numba
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


MAX_CYCLES = 5000
# A state larger than this multiple of its scale has diverged.
LOST = 1e6

compiled = numba.njit(nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})


class Integrators(NamedTuple):
    """Compiled functions of one model; all take p, the table of u at half steps, the seconds of a period, and y."""

    # (p, u, period, y, scale, tolerance, path, rates) -> cycles until one changes y by less than the tolerance, or 0
    steady: Callable[..., int]
    # (p, u, period, y, inverse, scale, tolerance, most, path, rates) -> sweeps of shooting with a fixed matrix, or 0
    chord: Callable[..., int]
    # (p, u, period, y, scale, tolerance, most, path, rates, wide, wide_rates) -> sweeps of shooting with the
    # variational equations, or 0; the last one leaves the derivatives by y(0) and by p in `wide`
    newton: Callable[..., int]
    dense: Callable[..., None]  # (path, rates, step, out): cubic Hermite interpolation at equidistant points
    outputs: Callable[..., None]  # (p, u, states, out)
    # (p, u, states, changes, weights, out): Σ weights · d outputs / dp, from the derivatives of the states by p
    pulled: Callable[..., None]
    rates_in_time: Callable[..., np.ndarray]  # (t, y, p, u, period) -> rates, the inputs interpolated in a fine table
    jacobian_in_time: Callable[..., np.ndarray]  # The same for the derivatives by y


@cache
def integrators(model: Any, moving: tuple[str, ...]) -> Integrators:
    """Return the compiled functions of a model, with derivatives by some of its parameters."""
    first = FirstOrder(model, moving)
    size, channels, count = first.size, len(first.outputs), len(moving)
    (f, a, b), (g, c, d) = (
        [compiled(first.function(NUMBA, e)) for e in (values, first.by_states(values), first.by_parameters(values))]
        for values in (first.rates, first.outputs)
    )
    cycle = _cycle(f, size)
    return Integrators(
        _steady(cycle, size),
        _chord(cycle, size),
        _newton(_wide_cycle(f, a, b, size, count), size, count),
        dense,
        _outputs(g),
        _pulled(c, d, size, channels, count),
        *_in_time(f, a, size),
    )


# Loops, because Numba takes seconds to compile an assignment to a part of an array.
@compiled
def keep(y, path, k):
    """Write a state into a row."""
    for i in range(y.size):
        path[k, i] = y[i]


@compiled
def keep_all(s, wide, k):
    """Write derivatives into a row."""
    for i in range(s.shape[0]):
        for j in range(s.shape[1]):
            wide[k, i, j] = s[i, j]


def _cycle(f: Any, size: int) -> Any:
    """Return one cycle of the classical Runge-Kutta method; states and rates at every step are kept."""

    @compiled
    def cycle(p, u, period, y, path, rates):
        steps = u.shape[0] // 2
        h = period / steps
        k2, k3, k4, trial = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
        for k in range(steps):
            k1 = rates[k]
            after = u[2 * k + 2] if k + 1 < steps else u[0]
            keep(y, path, k)
            f(y, u[2 * k], p, k1)
            for i in range(size):
                trial[i] = y[i] + 0.5 * h * k1[i]
            f(trial, u[2 * k + 1], p, k2)
            for i in range(size):
                trial[i] = y[i] + 0.5 * h * k2[i]
            f(trial, u[2 * k + 1], p, k3)
            for i in range(size):
                trial[i] = y[i] + h * k3[i]
            f(trial, after, p, k4)
            for i in range(size):
                y[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i])
        keep(y, path, steps)
        f(y, u[0], p, rates[steps])

    return cycle


def _steady(cycle: Any, size: int) -> Any:
    @compiled
    def steady(p, u, period, y, scale, tolerance, path, rates):
        for count in range(MAX_CYCLES):
            cycle(p, u, period, y, path, rates)
            change, largest = 0.0, 0.0
            for i in range(size):
                change = max(change, abs(y[i] - path[0, i]) / scale[i])
                largest = max(largest, abs(y[i]) / scale[i])
            if change < tolerance:
                return count + 1
            if not largest < LOST:
                return 0
        return 0

    return steady


def _chord(cycle: Any, size: int) -> Any:
    @compiled
    def chord(p, u, period, y, inverse, scale, tolerance, most, path, rates):
        for count in range(most):
            cycle(p, u, period, y, path, rates)
            change = 0.0
            for i in range(size):
                step = 0.0
                for j in range(size):
                    step += inverse[i, j] * (y[j] - path[0, j])
                rates[u.shape[0] // 2, i] = step
                change = max(change, abs(step) / scale[i])
            if not change < LOST:
                return 0
            if change < tolerance:
                return count + 1
            for i in range(size):
                y[i] = path[0, i] + rates[u.shape[0] // 2, i]
        return 0

    return chord


def _wide_cycle(f: Any, a: Any, b: Any, size: int, count: int) -> Any:
    """Return one cycle of the same method for the states and their derivatives by y(0) and p, side by side."""
    columns = size + count

    @compiled
    def slope(p, u, y, s, matrix, forcing, rate, change):
        f(y, u, p, rate)
        a(y, u, p, matrix)
        b(y, u, p, forcing)
        for i in range(size):
            for j in range(columns):
                total = forcing[i, j - size] if j >= size else 0.0
                for k in range(size):
                    total += matrix[i, k] * s[k, j]
                change[i, j] = total

    @compiled
    def wide_cycle(p, u, period, y, path, rates, wide, wide_rates):
        steps = u.shape[0] // 2
        h = period / steps
        matrix, forcing = np.empty((size, size)), np.empty((size, count))
        trial, s, probe = np.empty(size), np.zeros((size, columns)), np.empty((size, columns))
        k2, k3, k4 = np.empty(size), np.empty(size), np.empty(size)
        s2, s3, s4 = np.empty((size, columns)), np.empty((size, columns)), np.empty((size, columns))
        for i in range(size):
            s[i, i] = 1.0
        for k in range(steps):
            k1, s1 = rates[k], wide_rates[k]
            after = u[2 * k + 2] if k + 1 < steps else u[0]
            keep(y, path, k)
            keep_all(s, wide, k)
            slope(p, u[2 * k], y, s, matrix, forcing, k1, s1)
            for i in range(size):
                trial[i] = y[i] + 0.5 * h * k1[i]
                for j in range(columns):
                    probe[i, j] = s[i, j] + 0.5 * h * s1[i, j]
            slope(p, u[2 * k + 1], trial, probe, matrix, forcing, k2, s2)
            for i in range(size):
                trial[i] = y[i] + 0.5 * h * k2[i]
                for j in range(columns):
                    probe[i, j] = s[i, j] + 0.5 * h * s2[i, j]
            slope(p, u[2 * k + 1], trial, probe, matrix, forcing, k3, s3)
            for i in range(size):
                trial[i] = y[i] + h * k3[i]
                for j in range(columns):
                    probe[i, j] = s[i, j] + h * s3[i, j]
            slope(p, after, trial, probe, matrix, forcing, k4, s4)
            for i in range(size):
                y[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i])
                for j in range(columns):
                    s[i, j] += h / 6.0 * (s1[i, j] + 2.0 * (s2[i, j] + s3[i, j]) + s4[i, j])
        keep(y, path, steps)
        keep_all(s, wide, steps)
        slope(p, u[0], y, s, matrix, forcing, rates[steps], wide_rates[steps])

    return wide_cycle


def _newton(wide_cycle: Any, size: int, count: int) -> Any:
    @compiled
    def newton(p, u, period, y, scale, tolerance, most, path, rates, wide, wide_rates):
        steps = u.shape[0] // 2
        matrix, step = np.empty((size, size)), np.empty(size)
        for sweep in range(most):
            wide_cycle(p, u, period, y, path, rates, wide, wide_rates)
            for i in range(size):
                step[i] = y[i] - path[0, i]
                for j in range(size):
                    matrix[i, j] = (1.0 if i == j else 0.0) - wide[steps, i, j]
            eliminate(matrix, step)
            change = 0.0
            for i in range(size):
                change = max(change, abs(step[i]) / scale[i])
            if not change < LOST:
                return 0
            if change < tolerance:
                return sweep + 1
            for i in range(size):
                y[i] = path[0, i] + step[i]
        return 0

    return newton


@compiled
def eliminate(matrix, right):
    """Solve a small system in place, by elimination with pivoting."""
    size = right.size
    for k in range(size):
        at = k
        for i in range(k + 1, size):
            if abs(matrix[i, k]) > abs(matrix[at, k]):
                at = i
        for j in range(size):
            matrix[k, j], matrix[at, j] = matrix[at, j], matrix[k, j]
        right[k], right[at] = right[at], right[k]
        for i in range(k + 1, size):
            factor = matrix[i, k] / matrix[k, k]
            right[i] -= factor * right[k]
            for j in range(k, size):
                matrix[i, j] -= factor * matrix[k, j]
    for k in range(size - 1, -1, -1):
        for j in range(k + 1, size):
            right[k] -= matrix[k, j] * right[j]
        right[k] /= matrix[k, k]


@compiled
def dense(path, rates, step, out):
    """Fill the states at equidistant points of a cycle; path and rates hold those at every step and at the end."""
    steps, points = path.shape[0] - 1, out.shape[0]
    for k in range(points):
        at = k * steps
        i, left = at // points, at % points
        s = left / points
        a, b = (1.0 + 2.0 * s) * (1.0 - s) * (1.0 - s), s * (1.0 - s) * (1.0 - s) * step
        c, d = s * s * (3.0 - 2.0 * s), s * s * (s - 1.0) * step
        for j in range(out.shape[1]):
            out[k, j] = a * path[i, j] + b * rates[i, j] + c * path[i + 1, j] + d * rates[i + 1, j]


def _outputs(g: Any) -> Any:
    @compiled
    def outputs(p, u, states, out):
        for k in range(out.shape[0]):
            g(states[k], u[k], p, out[k])

    return outputs


def _pulled(c: Any, d: Any, size: int, channels: int, count: int) -> Any:
    @compiled
    def pulled(p, u, states, changes, weights, out):
        by_state, by_parameter = np.empty((channels, size)), np.empty((channels, count))
        for j in range(count):
            out[j] = 0.0
        for k in range(states.shape[0]):
            c(states[k], u[k], p, by_state)
            d(states[k], u[k], p, by_parameter)
            for i in range(channels):
                for j in range(count):
                    total = by_parameter[i, j]
                    for m in range(size):
                        total += by_state[i, m] * changes[k, m * count + j]
                    out[j] += weights[k, i] * total

    return pulled


def _in_time(f: Any, a: Any, size: int) -> tuple[Any, Any]:
    """Return rates and their derivatives by y at a time, as SciPy requires them."""

    @compiled
    def rates_in_time(t, y, p, u, period):
        now, rate = np.empty(u.shape[1]), np.empty(size)
        signals(u, t / period, now)
        f(y, now, p, rate)
        return rate

    @compiled
    def jacobian_in_time(t, y, p, u, period):
        now, matrix = np.empty(u.shape[1]), np.empty((size, size))
        signals(u, t / period, now)
        a(y, now, p, matrix)
        return matrix

    return rates_in_time, jacobian_in_time


@compiled
def signals(table, at, u):
    """Fill the inputs at a time [periods], by cubic interpolation in a fine table; τ, the last, is taken as it is."""
    count, last = table.shape[0], table.shape[1] - 1
    place = (at - np.floor(at)) * count
    k = int(place)
    s = place - k
    a, b = -s * (s - 1.0) * (s - 2.0) / 6.0, (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0
    c, d = -(s + 1.0) * s * (s - 2.0) / 2.0, (s + 1.0) * s * (s - 1.0) / 6.0
    for i in range(last):
        u[i] = (
            a * table[(k - 1) % count, i] + b * table[k % count, i] + c * table[(k + 1) % count, i]
            + d * table[(k + 2) % count, i]
        )  # fmt: skip
    u[last] = table[1, last] * place


@compiled
def misfit(data, out, weights):
    """Return Σ weights · (data − out)² over points and channels."""
    total = 0.0
    for i in range(data.shape[1]):
        squares = 0.0
        for k in range(data.shape[0]):
            r = data[k, i] - out[k, i]
            squares += r * r
        total += weights[i] * squares
    return total
