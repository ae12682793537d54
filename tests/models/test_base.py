"""Structures on a moving base, in relative coordinates, against absolute ones with prescribed supports."""

import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import solve_ivp

import bayesperiodic as bp

Element = bp.elements.Element
KINDS = ("displacement", "velocity", "acceleration")
POINTS, COUNT = 64, 12
TURNING = np.exp(2j * np.pi * np.arange(POINTS) / POINTS)
WAVES = TURNING ** np.arange(1, 4)[:, None]
BOTH = pytest.mark.parametrize("condensed", [True, False])
# Of the beam: a free mass at the tip, and damping that the modes do not diagonalise.
VALUES, FREQUENCY = {"m_half": 0.4, "alpha": 0.04, "beta": 0.002}, 0.11


@BOTH
@pytest.mark.parametrize("given", KINDS)
def test_outputs_have_the_transmissibility_of_one_degree_of_freedom(condensed, given):
    """It is (k + icω)/(k − mω² + icω); with its derivatives by mass, damping, stiffness and frequency."""
    values, rate, order = {"m": 2.0, "c": 0.3, "k": 5.0}, 2.1, KINDS.index(given)
    outputs = {f"relative_{k}": (0, f"relative {k}") for k in KINDS}
    outputs |= {f"absolute_{k}": (0, f"absolute {k}") for k in KINDS[order:]}
    model = bp.Model.from_matrices(
        "oscillator", mass={"m": [[1.0]]}, stiffness={"k": [[1.0]]}, damping={"c": [[1.0]]}, outputs=outputs,
        base={"ground": (np.ones(1), given)}, condensed=condensed,
    )  # fmt: skip
    assert model.inputs == ("ground",)
    assert model.input_derivatives() == {"ground": 2 - order}
    ground = 0.7 * TURNING
    solution = bp.solve_periodic(
        model, values, {"ground": ground.real}, frequency=rate / (2 * np.pi), samples=POINTS, scheme="fourier"
    )

    def exact(name, m, c, k, frequency):
        w = 2 * np.pi * frequency
        reference, kind = name.split("_")
        stiffness = k + 1j * c * w
        transmitted = (stiffness if reference == "absolute" else m * w**2) / (stiffness - m * w**2)
        return (transmitted * (1j * w) ** (KINDS.index(kind) - order) * ground).real

    at = values | {"frequency": rate / (2 * np.pi)}
    for name in outputs:
        np.testing.assert_allclose(solution.outputs[name], exact(name, **at), atol=1e-9)
        for parameter, value in at.items():
            ends = [exact(name, **(at | {parameter: value * (1 + sign * 1e-5)})) for sign in (1, -1)]
            slope = (ends[0] - ends[1]) / (2e-5 * value)
            ours = solution.sensitivities[name][parameter]
            np.testing.assert_allclose(ours, slope, atol=1e-8 * np.abs(slope).max() + 1e-9)


def of_beam():
    """Return mass and stiffness of a beam, the latter with the clamp as its first coordinate, by second differences."""
    second = np.array([np.roll([1.0, -2.0, 1.0] + [0.0] * (COUNT - 2), i) for i in range(COUNT - 1)])
    clamp = np.zeros((1, COUNT + 1))
    clamp[0, :2] = -1.0, 1.0
    second = np.vstack([clamp, second])
    return np.diag(np.linspace(1.0, 2.0, COUNT)), 20.0 * second.T @ second


def beam(**changes):
    """Return the model of a cantilever of 12 deflections with a mass at the tip, on a clamp that moves across."""
    mass, whole = of_beam()
    stiffness, tip = whole[1:, 1:], np.diag(np.arange(COUNT) == COUNT - 1) * 1.0
    settings = {
        "mass": {"1": mass, "2*m_half": tip}, "stiffness": stiffness, "damping": {"alpha": mass, "beta": stiffness},
        "base": {"ground": (np.ones(COUNT), "acceleration")}, "forces": {"shaker": 4},
        "outputs": {
            "tip": (COUNT - 1, "absolute acceleration"), "bent": ((COUNT - 1, 5), "displacement"),
            "near": (0, "relative velocity"),
        },
    }  # fmt: skip
    return bp.Model.from_matrices("beam", **(settings | changes))


def case(modal):
    """Return a beam, its parameters, and what else `expected` takes; with modes the density of all masses is one."""
    if not modal:
        return beam(), VALUES, {}
    mass, whole = of_beam()
    model = beam(mass={"density": mass}, damping={"beta": whole[1:, 1:]})
    return model, {"density": 1.2, "beta": 0.002}, {"m_half": 0.0, "alpha": 0.0}


def expected(m_half, alpha, beta, frequency=FREQUENCY, given=FREQUENCY, density=1.0):
    """Return the base's acceleration, the force, and the outputs, by the absolute coordinates of the beam.

    The first of its 13 coordinates is prescribed, with three harmonics, which have a given acceleration as functions of
    the period. Dashpots alpha·M stand on the clamp.
    """
    mass, whole = of_beam()
    mass, damping = density * mass, beta * whole
    damping[1:, 1:] += alpha * mass
    damping[1:, 0] -= alpha * np.diag(mass)
    mass[-1, -1] += 2 * m_half
    rates = 2 * np.pi * frequency * np.arange(1, 4)
    ground, force = np.array([1.0, 0.3j, -0.1]) * (given / frequency) ** 2, np.array([0.2, 0.0, 0.0])
    x = []
    for rate, z, f in zip(rates, ground, force, strict=True):
        dynamic = whole + 1j * rate * damping
        dynamic[1:, 1:] -= rate**2 * mass
        load = -dynamic[1:, 0] * z
        load[4] += f
        x.append(np.linalg.solve(dynamic[1:, 1:], load))
    x = np.array(x)
    amplitudes = -(rates**2) * x[:, -1], x[:, -1] - x[:, 5], 1j * rates * (x[:, 0] - ground)
    outputs = {name: (a @ WAVES).real for name, a in zip(("tip", "bent", "near"), amplitudes, strict=True)}
    return {"ground": (-(rates**2) * ground @ WAVES).real, "shaker": (force @ WAVES).real}, outputs


@pytest.mark.parametrize("modal", [True, False])
def test_beam_moves_as_that_whose_clamp_is_prescribed(modal):
    """Outputs, absolute and relative, states, and derivatives by factors of mass and damping and by the frequency."""
    model, values, known = case(modal)
    inputs, outputs = expected(**(known | values))
    solution = bp.solve_periodic(model, values, inputs, frequency=FREQUENCY, samples=POINTS)
    for name, exact in outputs.items():
        np.testing.assert_allclose(solution.outputs[name], exact, atol=1e-9 * np.abs(exact).max())
    bent = solution.states[f"x{COUNT - 1}"] - solution.states["x5"]
    np.testing.assert_allclose(bent, outputs["bent"], atol=1e-9 * np.abs(bent).max())
    at = values | {"frequency": FREQUENCY}
    for parameter, value in at.items():
        above, below = (expected(**(known | at | {parameter: value * (1 + sign * 1e-5)}))[1] for sign in (1, -1))
        for name, by_parameter in solution.sensitivities.items():
            slope = (above[name] - below[name]) / (2e-5 * value)
            np.testing.assert_allclose(by_parameter[parameter], slope, atol=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("modal", [True, False])
def test_density_of_many_points_is_that_of_the_prescribed_clamp(modal):
    """Far from the anchors too."""
    model, values, known = case(modal)
    name, *others = values
    inputs, outputs = expected(**(known | values))
    outputs.pop("near")
    noisy = {n: y + 0.01 * np.ptp(y) * np.random.default_rng(1).standard_normal(POINTS) for n, y in outputs.items()}
    run = bp.Experiment("run", FREQUENCY, noisy, inputs, samples=POINTS)
    variances = {f"variance[{n}]": np.var(y) for n, y in noisy.items()}
    problem = bp.Problem(
        model, [run], priors={name: bp.LogNormal(values[name], 0.3)}, fixed={n: values[n] for n in others},
        input_noise="exact",
    )  # fmt: skip
    for value in values[name] * np.array([0.7, 0.99, 1.2]):
        _, exact = expected(**(known | values | {name: value}))
        log_likelihood = sum(
            -0.5 * np.sum((noisy[n] - exact[n]) ** 2) / v - 0.5 * POINTS * np.log(v)
            for n, v in zip(noisy, variances.values(), strict=True)
        )
        assert problem.log_likelihood([value], variances) == pytest.approx(
            log_likelihood, abs=1e-6 * abs(log_likelihood)
        )


def test_participation_factors_of_all_modes_are_the_matrices():
    mass, whole = of_beam()
    squares, vectors = scipy.linalg.eigh(whole[1:, 1:], mass)
    ratio, points = 0.02, [0, 5, COUNT - 1]
    model = bp.Model.from_modes(
        "modes", frequencies=np.sqrt(squares) / (2 * np.pi), damping_ratios=ratio, shapes=vectors[points],
        base={"ground": (np.ones(3), "acceleration", vectors.T @ mass @ np.ones(COUNT))},
        outputs={"tip": (2, "absolute acceleration"), "near": (0, "relative displacement")},
    )  # fmt: skip
    rates = 2 * np.pi * FREQUENCY * np.arange(1, 4)
    acceleration = np.array([1.0, 0.3j, -0.1])
    modal = mass @ vectors @ np.diag(2 * ratio * np.sqrt(squares)) @ vectors.T @ mass
    x = [
        np.linalg.solve(whole[1:, 1:] + 1j * rate * modal - rate**2 * mass, -mass @ np.ones(COUNT) * a)
        for rate, a in zip(rates, acceleration, strict=True)
    ]
    near, tip = np.array(x)[:, 0], acceleration - rates**2 * np.array(x)[:, -1]
    solution = bp.solve_periodic(
        model, {}, {"ground": (acceleration @ WAVES).real}, frequency=FREQUENCY, samples=POINTS
    )
    for name, exact in {"near": (near @ WAVES).real, "tip": (tip @ WAVES).real}.items():
        np.testing.assert_allclose(solution.outputs[name], exact, atol=1e-9 * np.abs(exact).max())


@BOTH
def test_elements_end_at_the_moving_base_as_in_scipys_integration(condensed):
    """A cubic spring and quadratic damping between a mass and the base, in absolute coordinates."""
    rate, amplitude = 1.3, 0.4
    model = bp.Model.from_matrices(
        "mounted", mass=[[1.0]], stiffness=[[1.0]], damping=[[0.1]], condensed=condensed,
        base={"ground": ({0: 1.0}, "displacement")}, outputs={"x": (0, "absolute displacement")},
        elements=[
            Element("spring", bp.elements.cubic, 0, {"k3": 0.8}),
            Element("air", bp.elements.quadratic_damping, 0, {"c2": 0.3}),
        ],
    )  # fmt: skip

    def rates(t, y):
        z, v = amplitude * np.cos(rate * t), -rate * amplitude * np.sin(rate * t)
        d, dv = y[0] - z, y[1] - v
        return [y[1], -d - 0.1 * dv - 0.8 * d**3 - 0.3 * dv * abs(dv)]

    period = 2 * np.pi / rate
    times = (60 + np.arange(POINTS) / POINTS) * period
    exact = solve_ivp(rates, (0, 61 * period), [0.0, 0.0], t_eval=times, rtol=1e-10, atol=1e-12).y[0]
    solution = bp.solve_periodic(
        model, {}, {"ground": amplitude * TURNING.real}, frequency=1 / period, samples=POINTS, scheme="fourier"
    )
    assert solution.status == "converged"
    np.testing.assert_allclose(solution.outputs["x"], exact, atol=1e-4)


@BOTH
def test_directions_turn_with_the_frame(condensed):
    """Two springs across each other with an element, a force, a base and a sensor along inclined directions."""
    angle, across = 0.4, 1.1
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    stiffness = np.diag([1.0, 2.5])

    def along(direction):
        return {0: np.cos(direction), 1: np.sin(direction)}

    def frame(start, k):
        return bp.Model.from_matrices(
            "frame", mass=np.eye(2), stiffness=k, damping={"beta": k}, condensed=condensed,
            forces={"force": along(start)}, base={"ground": (along(start + across), "acceleration")},
            outputs={
                "a": (along(start + 0.3), "absolute acceleration"), "across": (along(start - 0.2), "relative velocity")
            },
            elements=[Element("spring", bp.elements.cubic, along(start + 0.7), {"k3": 0.5})],
        )  # fmt: skip

    inputs = {"force": TURNING.real, "ground": 0.5 * TURNING.imag}
    how = {"frequency": 0.17, "samples": POINTS, "scheme": "fourier"}
    plain, turned = (
        bp.solve_periodic(model, {"beta": 0.1}, inputs, **how)
        for model in (frame(0.0, stiffness), frame(angle, turn @ stiffness @ turn.T))
    )
    assert plain.status == turned.status == "converged"
    for name, values in plain.outputs.items():
        np.testing.assert_allclose(turned.outputs[name], values, atol=1e-8 * np.abs(values).max())
    assert np.abs(np.fft.rfft(plain.outputs["a"]))[3] > 1e-3 * np.abs(np.fft.rfft(plain.outputs["a"]))[1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"outputs": {"x": (0, "acceleration")}}, r"outputs\['x'\]: must be 'absolute acceleration', as of an acc.*"),
        ({"outputs": {"x": (0, "absolute displacement")}}, "which is an integral of it; take 'relative displacement'"),
        ({"outputs": {"x": (1, "absolute acceleration")}}, "must be one of 'displacement'"),
        ({"outputs": {"x": (0, "absolute jerk")}}, "must be one of 'absolute displacement'"),
        ({"base": {"ground": np.ones(2)}}, r"base\['ground'\]: must be a direction and a kind"),
        ({"base": {"ground": (1, "acceleration")}}, r"base\['ground'\]: must have a direction of 2 displacements"),
        ({"base": {"ground": ((0, 1), "acceleration")}}, "must have a direction of 2 displacements"),
        ({"base": {"ground": (np.ones(3), "acceleration")}}, "must be 2 finite weights"),
        ({"base": {"ground": ({0: 1.0}, "force")}}, r"base\['ground'\]: must be one of 'displacement'"),
        ({"base": {"ground": ({2: 1.0}, "velocity")}}, r"base\['ground'\]: must be below 2"),
        ({"base": ["ground"]}, "base: must be a mapping"),
        ({"forces": {"ground": 0}}, "base: must have names that differ from those of forces, got 'ground'"),
        ({"forces": {"force": {}}}, r"forces\['force'\]: must have a weight that is not zero"),
        ({"forces": {"force": {0: np.nan}}}, r"forces\['force'\]: must be finite"),
        ({"forces": {"force": {"x0": 1.0}}}, r"forces\['force'\]: must be an integer"),
    ],
)
def test_wrong_bases_and_weights_are_refused(changes, message):
    arguments = {
        "mass": np.eye(2), "stiffness": np.eye(2), "base": {"ground": ({0: 1.0}, "acceleration")},
        "outputs": {"x": (0, "relative displacement")},
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        bp.Model.from_matrices("refused", **(arguments | changes))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((np.ones(1), "acceleration"), "participation"),
        ((np.ones(1), "acceleration", [1.0]), "must have a finite participation factor of each of the 2 modes"),
    ],
)
def test_base_of_modes_needs_their_participation_factors(given, message):
    with pytest.raises(ValueError, match=message):
        bp.Model.from_modes(
            "modes", frequencies=[1.0, 2.0], damping_ratios=0.01, shapes=np.ones((1, 2)), base={"ground": given},
            outputs={"x": (0, "relative displacement")},
        )  # fmt: skip


def test_equations_of_a_condensed_model_show_the_base():
    text = beam(base={"ground": (np.ones(COUNT), "velocity")}).latex()
    assert r"B u - \left(M_{0} + 2 m_{half}\,M_{1}\right) r_{0} \dot{\mathrm{ground}}" in text
