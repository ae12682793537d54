"""Models from matrices against linear algebra, hand-written models and SciPy's integration."""

import numpy as np
import pytest
import scipy.sparse
from scipy.integrate import solve_ivp

import bayesperiodic as bp

Element = bp.elements.Element


def chained(count):
    """Return the matrix of a chain of unit springs with the first mass grounded."""
    matrix = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    matrix[-1, -1] = 1
    return matrix


def cosine(points=64):
    return np.cos(2 * np.pi * np.arange(points) / points)


def test_linear_response_is_that_of_the_frequency_response_matrix():
    """Rayleigh damping, a stiffness with a factor, all kinds of outputs and places; exact by the Fourier scheme."""
    rng = np.random.default_rng(3)
    m = rng.normal(size=(3, 3))
    m = m @ m.T + 3 * np.eye(3)
    shape, at = np.array([0.3, -1.0, 0.5]), np.array([1.0, 0.0, 2.0])
    model = bp.Model.from_matrices(
        "rayleigh",
        mass=m,
        stiffness={"1": scipy.sparse.csr_array(chained(3)), "k2": np.diag([0, 1.0, 0])},
        damping={"alpha": m, "beta": chained(3)},
        forces={"force": shape, "pair": (2, 0)},
        outputs={"x": (1, "displacement"), "dx": ((2, 1), "velocity"), "ddx": (at, "acceleration")},
    )
    values = {"k2": 0.7, "alpha": 0.02, "beta": 0.1}
    assert set(model.parameters) == set(values)
    force, rate = cosine(), 2 * np.pi * 0.13
    solution = bp.solve_periodic(
        model, values, {"force": force, "pair": 2 * np.roll(force, 16)}, frequency=0.13, samples=64, scheme="fourier"
    )
    damping = 0.02 * m + 0.1 * chained(3)
    stiffness = chained(3) + 0.7 * np.diag([0, 1.0, 0])
    load = shape + 2 * np.exp(-0.5j * np.pi) * np.array([-1.0, 0.0, 1.0])
    x = np.linalg.solve(stiffness + 1j * rate * damping - rate**2 * m, load)
    turning = np.exp(2j * np.pi * np.arange(64) / 64)
    expected = {"x": x[1], "dx": 1j * rate * (x[2] - x[1]), "ddx": -(rate**2) * at @ x}
    for name, amplitude in expected.items():
        np.testing.assert_allclose(solution.outputs[name], (amplitude * turning).real, atol=1e-8)


@pytest.mark.parametrize("count", [2, 4])
def test_chain_of_cubic_springs_is_that_of_the_library(count):
    """The hand-written model has the springs as sums over neighbours; residuals and multipliers agree."""
    k = chained(count)
    springs = [Element(f"s{i}", bp.elements.cubic, (i, i - 1) if i else 0) for i in range(count)]
    model = bp.Model.from_matrices(
        "matrix_chain", mass={"m": np.eye(count)}, damping={"c": k}, stiffness={"k": k}, forces={"force": count - 1},
        outputs={"displacement": (count - 1, "displacement")}, elements=springs,
    )  # fmt: skip
    values = {"m": 1.0, "c": 0.1, "k": 1.0}
    how = {"frequency": 0.1, "samples": 64, "scheme": "central4"}
    ours = bp.solve_periodic(model, values | {f"s{i}_k3": 0.5 for i in range(count)}, {"force": cosine()}, **how)
    other = bp.solve_periodic(bp.models.chain(count), values | {"k3": 0.5}, {"force": cosine()}, **how)
    assert ours.status == other.status == "converged"
    np.testing.assert_allclose(ours.outputs["displacement"], other.outputs["displacement"], atol=1e-8)
    np.testing.assert_allclose(sorted(np.abs(ours.multipliers)), sorted(np.abs(other.multipliers)), atol=1e-8)


def test_joint_and_stop_between_degrees_of_freedom_move_as_in_scipys_integration():
    m, k = np.diag([1.0, 0.5]), np.array([[2.0, -0.5], [-0.5, 0.5]])
    model = bp.Model.from_matrices(
        "jointed", mass=m, stiffness=k, damping={"c": k}, forces={"force": 0},
        outputs={"x": (0, "displacement"), "y": (1, "displacement")},
        elements=[
            Element("joint", bp.elements.jenkins, (1, 0), {"width": 0.02}),
            Element("stop", bp.elements.gap, 0, {"clearance": 0.3, "width": 0.005}),
        ],
    )  # fmt: skip
    assert model.states == ("x0", "x1", "joint")
    assert model.parameters == ("c", "joint_stiffness", "joint_limit", "stop_k")
    values = {"c": 0.2, "joint_stiffness": 1.0, "joint_limit": 0.2, "stop_k": 5.0}
    rate, points = 0.9, 800
    period = 2 * np.pi / rate

    def rates(t, y):
        x, v, f = y[:2], y[2:4], y[4]
        relative = v[1] - v[0]
        load = np.array([0.6 * np.cos(rate * t) + f - 5 * max(x[0] - 0.3, 0.0), -f])
        sliding = abs(f) >= 0.2 and f * relative > 0.0
        return [*v, *np.linalg.solve(m, load - k @ (x + 0.2 * v)), 0.0 if sliding else relative]

    times = 11 * period + np.arange(points) / points * period
    exact = solve_ivp(rates, (0, 12 * period), np.zeros(5), t_eval=times, max_step=period / 80, rtol=1e-6).y
    solution = bp.solve_periodic(
        model, values, {"force": 0.6 * cosine(points)}, frequency=rate / (2 * np.pi), samples=points,
        scheme="central4",
    )  # fmt: skip
    assert solution.status == "converged" and exact[0].max() > 0.32 and exact[4].max() > 0.199
    for row, name in enumerate(("x", "y")):
        np.testing.assert_allclose(solution.outputs[name], exact[row], atol=5e-3 * np.abs(exact[row]).max())


def test_states_and_parameters_carry_the_name_of_the_element():
    names = bp.elements.iwan_states("lap", 3)
    model = bp.Model.from_matrices(
        "named", mass=np.eye(2), stiffness=np.eye(2), forces={"force": 0}, outputs={"x": (0, "displacement")},
        elements=[
            Element("lap", bp.elements.iwan, 0, {"names": names, "width": 0.1, "beta": 0.0}),
            Element("air", lambda v, drag: drag * v * abs(v), 1),
        ],
    )  # fmt: skip
    assert model.states == ("x0", "x1", "lap_1", "lap_2", "lap_3")
    assert model.parameters == ("lap_stiffness", "lap_limit", "lap_chi", "air_drag")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": np.eye(3)[:2]}, "mass: must be a square matrix"),
        ({"mass": np.zeros((2, 2))}, "mass: must be regular"),
        ({"stiffness": np.eye(3)}, r"stiffness: must have the shape of mass, \(2, 2\), got \(3, 3\)"),
        ({"stiffness": np.full((2, 2), np.nan)}, "stiffness: must be finite"),
        ({"damping": {}}, "damping: must have at least one matrix"),
        ({"forces": {"force": 2}}, r"forces\['force'\]: must be below 2"),
        ({"forces": {"force": (1, 1)}}, r"forces\['force'\]: must be .* two different ones"),
        ({"forces": {"force": np.ones(3)}}, r"forces\['force'\]: must be 2 finite weights"),
        ({"outputs": {"x": 0}}, r"outputs\['x'\]: must be a place and a kind"),
        ({"outputs": {"x": (0, "speed")}}, r"outputs\['x'\]: must be one of"),
        ({"forces": {"force": [0, 1]}}, r"forces\['force'\]: must be one degree of freedom, .* got \[0, 1\]"),
        ({"outputs": {"x": ([0, 1], "displacement")}}, r"outputs\['x'\]: must be one degree of freedom"),
        ({"elements": [bp.elements.cubic]}, "elements: must be a Element"),
        ({"elements": Element("e", bp.elements.cubic, 0)}, "elements: must be a list of elements, got 'e' alone"),
        ({"elements": [Element("e", lambda d: None, 0)]}, "force of element 'e': must return an expression"),
        ({"elements": [Element("e", bp.elements.cubic, -1)]}, "place of element 'e': must be an integer >= 0"),
    ],
)
def test_wrong_arguments_of_matrices_are_refused(changes, message):
    arguments = {
        "mass": np.eye(2), "stiffness": np.eye(2), "forces": {"force": 0}, "outputs": {"x": (0, "displacement")},
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        bp.Model.from_matrices("refused", **(arguments | changes))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("two words", bp.elements.cubic, 0), "name: must be"),
        (("e", "cubic", 0), "force: must be a function"),
        (("e", bp.elements.gap, 0, {"with": 1}), "constants: must be one of"),
        (("e", bp.elements.iwan, 0), "constants: must have the names of the states"),
    ],
)
def test_wrong_elements_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Element(*arguments)


@pytest.mark.parametrize("condensed", [False, True])
def test_models_of_structures_have_units_of_channels_and_parameters(condensed):
    units = {"force": "N", "x": "m", "beta": "s", "joint_k3": "N/m^3", "x1": "m"}
    places = {"forces": {"force": 0}, "outputs": {"x": (1, "displacement")}}
    places |= {"elements": [Element("joint", bp.elements.cubic, 1)], "condensed": condensed}
    k = chained(2)
    of_matrices = bp.Model.from_matrices(
        "frame", mass=np.eye(2), stiffness=k, damping={"beta": k}, units=units, **places
    )
    shapes = np.eye(2)
    modes = {"frequencies": ["f", 1.0], "damping_ratios": 0.01, "shapes": shapes, **places}
    of_modes = bp.Model.from_modes("modes", units={"f": "Hz", "x": "m"}, **modes)
    assert of_matrices.units == units and of_modes.units == {"f": "Hz", "x": "m"}
    with pytest.raises(ValueError, match="units: must be one of .*'beta'.*, got 'zeta'"):
        bp.Model.from_matrices("frame", mass=np.eye(2), stiffness=k, damping={"beta": k}, units={"zeta": "1"}, **places)
    force = cosine()
    run = bp.Experiment("run", 0.1, {"x": force}, {"force": force}, samples=64)
    priors = {"beta": bp.LogNormal(0.1, 1), "joint_k3": bp.Normal(0, 1)}
    problem = bp.Problem(of_matrices, [run], priors=priors)
    assert (problem.units["beta"], problem.units["x"]) == ("s", "m")
