"""Structures on a moving base, in relative coordinates, against absolute ones with prescribed supports."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bayesperiodic as bp

Element = bp.elements.Element
POINTS, COUNT = 64, 12
TURNING = np.exp(2j * np.pi * np.arange(POINTS) / POINTS)
VALUES = {"m_tip": 0.3, "alpha": 0.04, "beta": 0.02}
BOTH = pytest.mark.parametrize("condensed", [True, False])


def oscillator(condensed, given, **changes):
    """Return a mass on a base whose motion is the input, as displacement, velocity or acceleration."""
    kinds = [kind for kind in ("displacement", "velocity", "acceleration")]
    outputs = {f"relative_{k}": (0, f"relative {k}") for k in kinds}
    outputs |= {f"absolute_{k}": (0, f"absolute {k}") for k in kinds[kinds.index(given) :]}
    settings = {
        "mass": {"m": [[1.0]]}, "stiffness": {"k": [[1.0]]}, "damping": {"c": [[1.0]]}, "outputs": outputs,
        "base": {"ground": (np.ones(1), given)}, "condensed": condensed,
    }  # fmt: skip
    return bp.Model.from_matrices("oscillator", **(settings | changes))


@BOTH
@pytest.mark.parametrize("given", ["displacement", "velocity", "acceleration"])
def test_outputs_have_the_transmissibility_of_one_degree_of_freedom(condensed, given):
    """Thomson's (k + icω)/(k − mω² + icω); its derivatives by mass, damping, stiffness and frequency."""
    values, rate, order = {"m": 2.0, "c": 0.3, "k": 5.0}, 2.1, ("displacement", "velocity", "acceleration").index(given)
    model = oscillator(condensed, given)
    assert model.inputs == ("ground",)
    ground = 0.7 * TURNING
    solution = bp.solve_periodic(
        model, values, {"ground": ground.real}, frequency=rate / (2 * np.pi), samples=POINTS, scheme="fourier"
    )

    def exact(name, m, c, k, frequency):
        w = 2 * np.pi * frequency
        stiff = k + 1j * c * w
        kind, motion = name.split("_")
        transmitted = stiff / (stiff - m * w**2) if kind == "absolute" else m * w**2 / (stiff - m * w**2)
        to_order = ("displacement", "velocity", "acceleration").index(motion) - order
        return (transmitted * (1j * w) ** to_order * ground).real

    at = values | {"frequency": rate / (2 * np.pi)}
    for name in model.outputs:
        np.testing.assert_allclose(solution.outputs[name], exact(name, **at), atol=1e-9)
        for parameter, value in at.items():
            ends = [exact(name, **(at | {parameter: value * (1 + sign * 1e-5)})) for sign in (1, -1)]
            slope = (ends[0] - ends[1]) / (2e-5 * value)
            ours = solution.sensitivities[name][parameter]
            np.testing.assert_allclose(ours, slope, atol=1e-8 * np.abs(slope).max() + 1e-9)


def beam():
    """Return mass, stiffness (with the clamped end first) and direction of a cantilever, 12 free deflections."""
    second = np.zeros((COUNT, COUNT + 1))
    for i in range(COUNT):
        second[i, i : i + 3] = np.array([1.0, -2.0, 1.0])[: COUNT + 1 - i]
    second[0, :2] = [-1.0, 1.0]  # no rotation at the clamp
    second = second[:-1] if not second[-1, -1] == 1.0 else second
    whole = 20.0 * second.T @ second
    return np.diag(np.linspace(1.0, 2.0, COUNT)), whole


@BOTH
def test_dummy(condensed):
    mass, whole = beam()
    print(whole @ np.ones(COUNT + 1))
