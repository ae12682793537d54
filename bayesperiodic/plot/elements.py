"""Figure of the force of elements over a cycle of displacement."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import sympy as sp
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

from bayesperiodic import _checks
from bayesperiodic.models.elements import Hysteretic
from bayesperiodic.models.names import Names
from bayesperiodic.plot.style import ENSEMBLES, axis_label, styled

Element = Callable[..., Any]
LOOP_POINTS, LOOP_CYCLES = 1000, 3
STYLES_OF_LINES = ("-", "--", ":", "-.")


class Loop(NamedTuple):
    """A cycle of an element: displacement [m], velocity [m/s] and force [N], each (points,)."""

    displacement: np.ndarray
    velocity: np.ndarray
    force: np.ndarray

    @property
    def energy(self) -> float:
        """Energy that is dissipated in the cycle [J]."""
        return float(np.trapezoid(self.force, self.displacement))


class ElementStates(Names):
    """States that exist as soon as an element asks for them, in place of those of a model."""

    def __init__(self) -> None:
        super().__init__("states", {})

    def __getitem__(self, name: str) -> sp.Symbol:
        return self._symbols.setdefault(name, sp.Symbol(f"s_{name}", real=True))


@styled
def elements(
    elements: Element | Mapping[str, Element],
    amplitudes: float | Sequence[float],
    *,
    frequency: float = 1.0,
    figure: Figure | None = None,
) -> Figure:
    """Draw the force of elements during a harmonic displacement, over displacement and over velocity.

    The enclosed area on the left is the energy that a cycle dissipates; the legend gives it. Elements with states begin
    without force, and the third cycle is shown.

    Parameters
    ----------
    elements : callable (d, v, s) -> expression or Hysteretic, or mapping of str to such callables
        Force of displacement [m], velocity [m/s] and states, without other symbols; by its label. Several elements, or
        one with several widths, are compared.
    amplitudes : number > 0 or sequence of numbers
        Of the displacement [m].
    frequency : number > 0
        Of the displacement [Hz].

    Raises
    ------
    ValueError
        If an element contains other symbols, or a number is not positive and finite.

    Examples
    --------
    Elastic friction, sharp and rounded:

    >>> friction = {
    ...     f"width {width}": lambda d, v, s, width=width: bp.elements.jenkins(s, "joint", v, 2e5, 10, width)
    ...     for width in (0.05, 0.5)
    ... }
    >>> figure = bp.plot.elements(friction, 2e-4)
    >>> [axes.get_xlabel() for axes in figure.axes]
    ['displacement [m]', 'velocity [m/s]']
    """
    shown = elements if isinstance(elements, Mapping) else {"": elements}
    wanted = [_checks.positive("amplitudes", amplitude) for amplitude in np.atleast_1d(amplitudes).tolist()]
    frequency = _checks.positive("frequency", frequency)
    figure = figure or plt.figure(figsize=(8.4, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for row, (label, element) in enumerate(shown.items()):
        for column, amplitude in enumerate(wanted):
            loop = cycle(element, amplitude, frequency)
            parts = [axis_label(label)] * bool(label) + [f"{amplitude:.3g} m"] * (len(wanted) > 1 or not label)
            look = {
                "color": ENSEMBLES[(row if len(shown) > 1 else column) % len(ENSEMBLES)],
                "ls": STYLES_OF_LINES[column % len(STYLES_OF_LINES)] if len(shown) > 1 else "-",
                "lw": 1.4,
                "label": f"{', '.join(parts)}: {_written(loop)}",
            }
            left.plot(loop.displacement, loop.force, **look)
            right.plot(loop.velocity, loop.force, **look)
    left.set(xlabel="displacement [m]", ylabel="force [N]")
    right.set(xlabel="velocity [m/s]")
    for axes in (left, right):
        axes.axhline(0.0, color="0.8", lw=0.8, zorder=0)
        axes.locator_params(axis="x", nbins=5)
        axes.ticklabel_format(axis="x", scilimits=(-3, 3))
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False)
    return figure


def cycle(element: Element, amplitude: float, frequency: float) -> Loop:
    """Return the force of an element in the last of three cycles of d = amplitude·sin(2π·frequency·t)."""
    d, v, states = sp.Symbol("d", real=True), sp.Symbol("v", real=True), ElementStates()
    given = element(d, v, states)
    force, equations = given if isinstance(given, Hysteretic) else (sp.sympify(given), ())
    known = {d, v, *states._symbols.values()}
    if other := sorted(map(str, set().union(*(e.free_symbols for e in (force, *equations))) - known)):
        raise ValueError(
            f"elements: must contain no symbols but d, v and states, got {', '.join(other)}; insert numbers."
        )
    rates = [name for name in states._symbols if name[0] == "d" and name[1:] in states._symbols]
    unknown = [states[name[1:]] for name in rates]
    matrix, right = sp.linear_eq_to_matrix(equations, [states[name] for name in rates])
    slopes = sp.lambdify([d, v, *unknown], list(matrix.LUsolve(right)) if rates else [], "math")
    forces = sp.lambdify([d, v, *unknown], force, "math")

    def motion(phase: float) -> tuple[float, float]:
        return amplitude * np.sin(phase), 2 * np.pi * frequency * amplitude * np.cos(phase)

    phases = 2 * np.pi * (LOOP_CYCLES - 1 + np.linspace(0.0, 1.0, LOOP_POINTS + 1))
    values = np.empty((0, phases.size))
    if rates:
        values = solve_ivp(
            lambda phase, z: np.array(slopes(*motion(phase), *z), dtype=float) / (2 * np.pi * frequency),
            (0.0, phases[-1]), np.zeros(len(rates)), t_eval=phases, max_step=0.03, rtol=1e-6, atol=1e-9,
        ).y  # fmt: skip
    moved = np.array([motion(phase) for phase in phases])
    force_values = np.array([forces(*at, *z) for at, z in zip(moved, values.T, strict=True)], dtype=float)
    return Loop(moved[:, 0], moved[:, 1], force_values)


def _written(loop: Loop) -> str:
    """Return the energy of a cycle, or that there is none."""
    scale = np.ptp(loop.displacement) * np.ptp(loop.force)
    return f"{loop.energy:.3g} J a cycle" if abs(loop.energy) > 1e-6 * scale else "no loss"
