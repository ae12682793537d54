"""The figure of the loops of elements: energies against closed forms, axes, legend, refusals."""

import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from bayesperiodic.plot.elements import cycle
from tests.drawn import faults

K, LIMIT = 2e5, 10.0
TRAVEL = LIMIT / K


def jenkins(d, v, s, width=0.1):
    return bp.elements.jenkins(s, "joint", v, K, LIMIT, width)


def test_enclosed_area_is_the_energy_of_closed_forms():
    amplitude = 3 * TRAVEL
    dahl = cycle(lambda d, v, s: bp.elements.dahl(s, "z", v, K, LIMIT), amplitude, 1.0)
    assert dahl.energy == pytest.approx(4 * LIMIT * TRAVEL * (3 - np.tanh(3)), rel=1e-3)
    assert cycle(jenkins, amplitude, 5.0).energy == pytest.approx(4 * LIMIT * TRAVEL * (2 - 0.1**2 / 4), rel=1e-3)
    viscous = cycle(lambda d, v, s: 3.0 * v, 0.2, 2.0)
    assert viscous.energy == pytest.approx(np.pi * 3.0 * 4 * np.pi * 0.2**2, rel=1e-4)
    assert np.abs(viscous.velocity).max() == pytest.approx(4 * np.pi * 0.2)
    spring = cycle(lambda d, v, s: bp.elements.cubic(d, 2.0), 0.2, 1.0)
    assert abs(spring.energy) < 1e-12 and spring.force.max() == pytest.approx(2.0 * 0.2**3)


def test_figure_names_axes_units_and_energies():
    rounded = {f"width {w}": lambda d, v, s, w=w: jenkins(d, v, s, w) for w in (0.05, 0.5)}
    figure = bp.plot.elements(rounded, [2e-4, 4e-4])
    left, right = figure.axes
    assert (left.get_xlabel(), left.get_ylabel()) == ("displacement [m]", "force [N]")
    assert right.get_xlabel() == "velocity [m/s]"
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert len(texts) == 4 and texts[0] == "width 0.05, 0.0002 m: 0.006 J a cycle"
    assert len({(line.get_color(), line.get_linestyle()) for line in left.lines[1:]}) == 4
    assert not faults(figure)
    (entry,) = bp.plot.elements(lambda d, v, s: bp.elements.cubic(d, 2.0), 0.1).legends[0].get_texts()
    assert entry.get_text() == "0.1 m: no loss"


def test_other_symbols_and_amplitudes_that_are_not_positive_are_refused():
    with pytest.raises(ValueError, match="elements: must contain no symbols but d, v and states, got k; insert"):
        bp.plot.elements(lambda d, v, s: sp.Symbol("k") * d, 1.0)
    with pytest.raises(ValueError, match="amplitudes: must be > 0"):
        bp.plot.elements(jenkins, [1.0, 0.0])
    with pytest.raises(ValueError, match="frequency: must be > 0"):
        bp.plot.elements(jenkins, 1.0, frequency=-1.0)
