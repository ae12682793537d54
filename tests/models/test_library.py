import doctest
import inspect
import pickle

import numpy as np
import pint
import pytest

import bayesperiodic as bp
from studies.flutter.reference import RIG, flutter_matrices
from tests.pendulum import PENDULUM

LIBRARY = {
    "duffing": lambda: bp.models.duffing,
    "dahl": lambda: bp.models.dahl,
    "pendulum": lambda: bp.models.pendulum,
    "rl_diode": lambda: bp.models.rl_diode,
    "silverbox": lambda: bp.models.silverbox,
    "van_der_pol": lambda: bp.models.van_der_pol,
    "landing_gear_force": lambda: bp.models.landing_gear("force"),
    "landing_gear_displacement": lambda: bp.models.landing_gear("displacement"),
    "chain_3": lambda: bp.models.chain(3),
    "flutter": lambda: bp.models.flutter,
}
GEAR = {
    "theta1": 80.0, "theta2": 9.81, "theta3": 8e3, "theta4": 5e-3, "theta5": 1e6 / 293, "theta6": -2.5,
    "theta7": 2e-4, "theta8": 150.0, "theta9": 1e-4, "theta10": 300.0, "theta11": -500.0, "theta12": 0.03,
    "theta15": 17.0, "theta16": 2.0, "theta17": -293.0,
}  # fmt: skip
SILVERBOX = {"w0": 6.0, "c": 0.2, "k1": 1.1, "k2": 0.3, "k3": 4.0, "g": 1.3, "u0": 0.1}
CHAIN = {"m": 0.7, "c": 0.3, "k": 40.0, "k3": 900.0}
FLUTTER = RIG | {
    "a": -0.3,
    "span": 0.8,
    "U": 16.0,
    "gain_heave": 5.0,
    "gain_pitch": 1.1,
    "offset_heave": 3.0,
    "offset_pitch": 0.7,
}
TYPICAL = {
    "duffing": ({"m": 1.0, "c": 0.2, "k": 3.0, "k3": 2.0}, {"x": 1.0, "force": 1.0}),
    "dahl": ({"Kx": 768.0, "K": 10.0, "F0": 3.0, "Kw": 57.4, "rho": 2e3}, {"w": 1.0, "displacement": 0.01}),
    "pendulum": (PENDULUM, {"phi": 1.0}),
    "silverbox": (SILVERBOX, {"y": 0.5, "drive": 1.0}),
    "van_der_pol": ({"mu": 1.3, "omega": 4.0}, {"x": 1.5}),
    "landing_gear_force": (GEAR, {"q": 0.05, "T": 300.0, "force": 5e3}),
    "landing_gear_displacement": (GEAR, {"displacement": 0.05, "T": 300.0}),
    "chain_3": (CHAIN, {"x1": 0.1, "x2": 0.1, "x3": 0.1, "force": 2.0}),
    "flutter": (FLUTTER, {"h": 0.03, "alpha": 0.1, "w": 0.02}),
}
DIODE = {
    "L": 4.5e-3, "R": 1e3, "R_s": 250.0, "R_L": 60.0, "C_L": 6e-12, "V_f": 0.7, "C_j": 4e-12, "Q_0": 1e-9,
    "transit": 6e-7, "lifetime": 3e-6, "drift": 3e8, "C_s": -5e-12, "bypass": 0.2, "offset": 0.3,
}  # fmt: skip
TYPICAL["rl_diode"] = DIODE, {"i": 1e-3, "v": 5.0, "q": 2e-9, "m": 2e-9, "source": 10.0}
POINTS, FREQUENCY = 20, 1.4


def magnitude(v):
    """Return |v| by a formula that takes complex numbers."""
    return np.sqrt(v * v)


def gear_by_hand(q, v, a, T, rate, p):
    gas = p["theta5"] * T / (1 + p["theta6"] * q + p["theta7"] * T)
    force = (
        p["theta1"] * (a + p["theta2"])
        + p["theta3"] * v * magnitude(v)
        + p["theta4"] * gas
        + (p["theta8"] + p["theta9"] * gas) * np.arctan(p["theta10"] * v)
        + p["theta11"]
    )
    conduction = p["theta16"] * (1 + p["theta6"] * q) * (T + p["theta17"])
    return gas, force, p["theta15"] * rate + conduction - (p["theta4"] * gas + p["theta11"]) * v


def by_hand_pendulum(q, u, p, tau):
    phi, v, a = q
    omega, inertia = 2 * np.pi * FREQUENCY, p["m"] * p["l"] ** 2
    friction = p["k1"] * np.tanh(v / p["v0"]) + p["k2"] * v + p["k3"] * v * magnitude(v)
    drive = p["g"] + p["a"] * omega**2 * np.cos(2 * np.pi * tau)
    return [a + friction / inertia + drive / p["l"] * np.sin(phi)], [phi, v]


def by_hand_silverbox(q, u, p, tau):
    y, v, a = q
    spring = p["k1"] * y + p["k2"] * y**2 + p["k3"] * y**3
    return [a / p["w0"] ** 2 + p["c"] * v / p["w0"] + spring - p["g"] * u[0] - p["u0"]], [y]


def by_hand_rl_diode(q, u, p, tau):
    i, v, junction, base = q[:4]
    injected = 0.5 * (junction + np.sqrt(junction**2 + p["Q_0"] ** 2))
    blocked = (injected - junction) / p["C_j"]
    current = (u[0] - v - p["V_f"] + blocked) / (p["R"] + p["R_s"])
    to_base = (injected - base) / p["transit"]
    return [
        p["L"] * q[4] - (v - p["R_L"] * i),
        p["C_L"] * q[5] - (current - i),
        q[6] - (current - to_base),
        q[7] - (to_base - base / p["lifetime"] - p["drift"] * i * base),
    ], [p["R"] * (current - p["bypass"] * q[6] + p["C_s"] * u[1]) + p["offset"]]


def by_hand_van_der_pol(q, u, p, tau):
    x, v, a = q
    return [a - p["mu"] * p["omega"] * (1 - x**2) * v + p["omega"] ** 2 * x], [x]


def by_hand_landing_gear_force(q, u, p, tau):
    gas, force, energy = gear_by_hand(q[0], q[2], q[4], q[1], q[3], p)
    return [force - u[0], energy], [q[0] + p["theta12"], gas]


def by_hand_landing_gear_displacement(q, u, p, tau):
    gas, force, energy = gear_by_hand(u[0] - p["theta12"], u[1], u[2], q[0], q[1], p)
    return [energy], [force, gas]


def by_hand_chain_3(q, u, p, tau):
    def pull(one, other):
        e, rate = q[other] - q[one] if one is not None else q[other], q[3 + other]
        rate = rate - q[3 + one] if one is not None else rate
        return p["c"] * rate + p["k"] * e + p["k3"] * e**3

    first, second, third = pull(None, 0), pull(0, 1), pull(1, 2)
    m, (a, b, c) = p["m"], q[6:]
    return [m * a + first - second, m * b + second - third, m * c + third - u[0]], [q[2]]


def by_hand_flutter(q, u, p, tau):
    mass, damping, stiffness = flutter_matrices(p)
    force = mass @ np.array(q[6:]) + damping @ np.array(q[3:6]) + stiffness @ np.array(q[:3])
    force[1] += p["k_alpha2"] * q[1] ** 2 + p["k_alpha3"] * q[1] ** 3
    sensors = p["gain_heave"] * q[0] + p["offset_heave"], p["gain_pitch"] * q[1] + p["offset_pitch"]
    return list(force), list(sensors)


BY_HAND = {
    "pendulum": by_hand_pendulum,
    "rl_diode": by_hand_rl_diode,
    "silverbox": by_hand_silverbox,
    "van_der_pol": by_hand_van_der_pol,
    "landing_gear_force": by_hand_landing_gear_force,
    "landing_gear_displacement": by_hand_landing_gear_displacement,
    "chain_3": by_hand_chain_3,
    "flutter": by_hand_flutter,
}


def random_points(name):
    """Return a model, q, q̇, q̈ and u, u̇, ü of typical size, its parameters and τ."""
    model, (parameters, sizes) = LIBRARY[name](), TYPICAL[name]
    generator = np.random.default_rng(5)

    def signals(names):
        values = [generator.uniform(-1, 1, POINTS) * sizes[n] * 5.0**order for order in range(3) for n in names]
        return np.stack(values, axis=-1) if values else np.empty((POINTS, 0))

    states, inputs = signals(model.states), signals(model.inputs)
    if "T" in model.states:
        states[:, model.states.index("T")] = generator.uniform(250, 400, POINTS)
    theta = np.array([parameters[n] for n in model.parameters]) * generator.uniform(0.7, 1.3, len(model.parameters))
    return model, states, inputs, theta, generator.uniform(0, 1, POINTS)


def by_hand(name, model, states, inputs, theta, tau):
    p = dict(zip(model.parameters, theta, strict=True))
    residuals, outputs = BY_HAND[name](list(states.T), list(inputs.T), p, tau)
    return np.stack(residuals, axis=-1), np.stack(outputs, axis=-1)


@pytest.mark.parametrize("name", BY_HAND)
def test_equations_and_outputs_are_the_formulas_written_by_hand(name):
    model, *at = random_points(name)
    columns = model.kernels.evaluate("residual_jacobian", *at, FREQUENCY)
    residuals, outputs = by_hand(name, model, *at)
    assert columns[:, : len(model.states)] == pytest.approx(residuals, rel=1e-10)
    assert model.kernels.evaluate("outputs", *at, FREQUENCY) == pytest.approx(outputs, rel=1e-10)


@pytest.mark.parametrize("name", BY_HAND)
def test_jacobian_is_the_complex_step_of_the_formulas_written_by_hand(name):
    model, states, *at = random_points(name)
    count = len(model.states)
    columns = model.kernels.evaluate("residual_jacobian", states, *at, FREQUENCY)
    jacobian = columns[:, count:].reshape(-1, count, 3 * count)
    for column in range(3 * count):
        stepped = states.astype(complex)
        stepped[:, column] += 1e-30j
        slopes = by_hand(name, model, stepped, *at)[0].imag / 1e-30
        assert jacobian[:, :, column] == pytest.approx(slopes, rel=1e-10, abs=1e-12)


@pytest.mark.parametrize("name", LIBRARY)
def test_equations_hold_in_any_system_of_units(name):
    """With other base units a residual changes by one factor, an output by that of its unit."""
    model, states, inputs, theta, tau = random_points(name)
    registry = pint.UnitRegistry()
    base = {"[length]": 1.7, "[mass]": 0.6, "[time]": 1.3, "[temperature]": 0.8, "[current]": 1.2}

    def factors(names, orders=1):
        dimensions = [registry.Quantity(1.0, model.units[n]).dimensionality for n in names]
        sizes = np.array([np.prod([base[d] ** power for d, power in of.items()]) for of in dimensions])
        return np.concatenate([sizes / base["[time]"] ** order for order in range(orders)])

    scaled = (
        states * factors(model.states, 3),
        inputs * factors(model.inputs, 3) if model.inputs else inputs,
        theta * factors(model.parameters),
        tau,
        FREQUENCY / base["[time]"],
    )
    before, after = (
        model.kernels.evaluate("residual_jacobian", *at)[:, : len(model.states)]
        for at in ((states, inputs, theta, tau, FREQUENCY), scaled)
    )
    assert after / before == pytest.approx(np.broadcast_to(after[0] / before[0], before.shape), rel=1e-8)
    outputs = model.kernels.evaluate("outputs", states, inputs, theta, tau, FREQUENCY)
    assert model.kernels.evaluate("outputs", *scaled) == pytest.approx(outputs * factors(model.outputs), rel=1e-10)


@pytest.mark.parametrize("name", LIBRARY)
def test_every_quantity_has_a_unit_and_every_model_a_description_that_runs(name):
    model = LIBRARY[name]()
    assert set(model.units) == {*model.parameters, *model.states, *model.inputs, *model.outputs}
    text = inspect.getdoc(model)
    assert len(text.splitlines()[0]) > 40 and text != inspect.getdoc(bp.Model)
    example = doctest.DocTestParser().get_doctest(text, {"bp": bp, "np": np}, name, None, None)
    assert doctest.DocTestRunner(verbose=False).run(example).failed == 0


@pytest.mark.parametrize("name", ["landing_gear_displacement", "chain_3"])
def test_models_made_by_functions_can_be_pickled(name):
    model = LIBRARY[name]()
    copy = pickle.loads(pickle.dumps(model))
    assert copy.equations == model.equations and copy.__doc__ == model.__doc__


def test_names_of_states_inputs_outputs_and_parameters_are_those_documented():
    pendulum = bp.models.pendulum
    force, displacement = bp.models.landing_gear("force"), bp.models.landing_gear("displacement")
    assert set(pendulum.parameters) == {"m", "l", "k1", "k2", "k3", "a", "g", "v0"}
    assert (pendulum.states, pendulum.inputs, pendulum.outputs) == (("phi",), (), ("angle", "rate"))
    assert set(pendulum.angles) == {"phi", "angle"}
    thetas = tuple(f"theta{i}" for i in (*range(1, 13), 15, 16, 17))
    assert force.parameters == displacement.parameters == thetas
    assert (force.states, force.inputs, force.outputs) == (("q", "T"), ("force",), ("displacement", "pressure"))
    assert (displacement.states, displacement.inputs) == (("T",), ("displacement",))
    assert displacement.outputs == ("force", "pressure")


def test_only_van_der_pol_and_flutter_are_autonomous():
    assert [name for name in LIBRARY if LIBRARY[name]().autonomous] == ["van_der_pol", "flutter"]


def test_pendulum_swings_at_the_root_of_g_over_l():
    model = bp.models.pendulum
    theta = np.array([(PENDULUM | {"a": 0.0})[n] for n in model.parameters])
    at = np.zeros((1, 3)), np.empty((1, 0)), theta, np.zeros(1), FREQUENCY
    _, stiffness, damping, inertia = model.kernels.evaluate("residual_jacobian", *at)[0]
    assert stiffness / inertia == pytest.approx(9.81 / 0.3)
    assert damping / inertia == pytest.approx((1.8e-4 / 0.05 + 4.5e-4) / (0.1 * 0.3**2))


@pytest.mark.parametrize(
    ("phi", "rate", "multiplier"), [(-0.5676231, 13.8571218, -1.71), (-2.9184347, 5.8256325, 11.12)]
)
def test_unstable_rotations_of_the_pendulum_repeat_after_one_period(phi, rate, multiplier):
    """Section points at 9.09 rad/s from Newton's method on a Runge-Kutta map, with seven decimals."""
    f = 9.09 / (2 * np.pi)
    run = bp.simulate(
        bp.models.pendulum,
        PENDULUM,
        frequency=f,
        duration=1.001 / f,
        sampling_rate=f,
        start={"phi": phi, "dphi": rate},
    )
    error = abs(multiplier) * 5e-7
    assert run.outputs["angle"][1] == pytest.approx(phi + 2 * np.pi, abs=error)
    assert run.outputs["rate"][1] == pytest.approx(rate, abs=10 * error)


def test_pendulum_locks_to_one_turn_a_period():
    f = 13.0 / (2 * np.pi)
    run = bp.simulate(
        bp.models.pendulum, PENDULUM, frequency=f, duration=50.001 / f, sampling_rate=f, start={"dphi": 13.0}
    )
    assert np.diff(run.outputs["angle"])[-5:] == pytest.approx(np.full(5, 2 * np.pi), abs=1e-5)


def test_scale_of_time_and_offset_of_the_silverbox_are_redundant():
    """Twice w0 with half c and a quarter of the rest; a shifted response with other k1, k2 and u0."""
    model, states, inputs, theta, tau = random_points("silverbox")
    p = dict(zip(model.parameters, theta, strict=True))
    quartered = {n: p[n] / 4 for n in ("k1", "k2", "k3", "g", "u0")} | {"w0": 2 * p["w0"], "c": p["c"] / 2}
    b, k1, k2, k3 = 0.2, p["k1"], p["k2"], p["k3"]
    springs = {"k1": k1 + 2 * k2 * b + 3 * k3 * b**2, "k2": k2 + 3 * k3 * b}
    shifted = p | springs | {"u0": p["u0"] - k1 * b - k2 * b**2 - k3 * b**3}

    def residual(parameters, y):
        values = np.array([parameters[n] for n in model.parameters])
        return model.kernels.evaluate("residual_jacobian", y, inputs, values, tau, FREQUENCY)[:, 0]

    assert 4 * residual(quartered, states) == pytest.approx(residual(p, states), rel=1e-10)
    assert residual(shifted, states - [b, 0, 0]) == pytest.approx(residual(p, states), rel=1e-10)


def test_van_der_pol_has_the_published_period_and_amplitude():
    """At mu = 1, omega = 1 (Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I, I.16, exercise 1)."""
    period, amplitude = 6.66328686 / 3.0, 2.00861986
    run = bp.simulate(
        bp.models.van_der_pol,
        {"mu": 1.0, "omega": 3.0},
        frequency=1 / period,
        duration=1.001 * period,
        sampling_rate=1000 / period,
        start={"x": amplitude},
    )
    x = run.outputs["displacement"]
    assert x[1000] == pytest.approx(amplitude, abs=1e-7)
    assert x.max() == pytest.approx(amplitude, abs=1e-7)
    assert x[500] == pytest.approx(-amplitude, abs=1e-7)


def test_the_two_drives_of_the_landing_gear_agree():
    forced, moved = bp.models.landing_gear("force"), bp.models.landing_gear("displacement")
    _, states, inputs, theta, tau = random_points("landing_gear_force")
    motion = np.ascontiguousarray(states[:, ::2])
    motion[:, 0] += theta[moved.parameters.index("theta12")]
    temperature = np.ascontiguousarray(states[:, 1::2])
    force, pressure = moved.kernels.evaluate("outputs", temperature, motion, theta, tau, FREQUENCY).T
    inputs[:, 0] = force
    residuals = forced.kernels.evaluate("residual_jacobian", states, inputs, theta, tau, FREQUENCY)[:, :2]
    energy = moved.kernels.evaluate("residual_jacobian", temperature, motion, theta, tau, FREQUENCY)[:, 0]
    assert residuals[:, 0] == pytest.approx(np.zeros(POINTS), abs=1e-9 * np.abs(force).max())
    assert residuals[:, 1] == pytest.approx(energy, rel=1e-10)
    outputs = forced.kernels.evaluate("outputs", states, inputs, theta, tau, FREQUENCY)
    assert outputs == pytest.approx(np.stack([motion[:, 0], pressure], axis=-1))


def test_gas_without_conduction_is_compressed_adiabatically():
    """0.82 mol of nitrogen: p V^γ is constant with γ − 1 = R/c_v = 0.40."""
    p = GEAR | {"theta7": 0.0, "theta11": 0.0, "theta12": 0.0, "theta16": 0.0}
    run = bp.simulate(
        bp.models.landing_gear("displacement"),
        p,
        {"displacement": 0.1 + 0.08 * np.sin(2 * np.pi * np.arange(16) / 16)},
        frequency=2.0,
        duration=1.0,
        sampling_rate=50.0,
        start={"T": 293.0},
    )
    volume = 1 - 2.5 * run.inputs["displacement"]
    gamma = 1 + (5e-3 * 1e6 / 293) / (17.0 * 2.5)
    assert gamma == pytest.approx(1.40, abs=0.005)
    expected = 1e6 / volume[0] * (volume / volume[0]) ** -gamma
    assert run.outputs["pressure"] == pytest.approx(expected, rel=1e-7)


def test_gear_at_rest_at_ambient_temperature_carries_the_net_gas_force_and_its_weight():
    model = bp.models.landing_gear("displacement")
    theta = np.array([(GEAR | {"theta7": 0.0})[n] for n in model.parameters])
    at = np.array([[293.0, 0.0, 0.0]]), np.array([[0.13, 0.0, 0.0]]), theta, np.zeros(1), 1.0
    assert model.kernels.evaluate("residual_jacobian", *at)[0, 0] == 0.0
    pressure = 1e6 / 0.75
    assert model.kernels.evaluate("outputs", *at)[0] == pytest.approx(
        [80 * 9.81 + 5e-3 * (pressure - 1e5), pressure], rel=1e-12
    )


@pytest.mark.parametrize("masses", [1, 3])
def test_linear_chain_has_the_natural_frequencies_of_a_row_clamped_at_one_end(masses):
    model = bp.models.chain(masses)
    theta = np.array([CHAIN[n] for n in model.parameters])
    at = np.zeros((1, 3 * masses)), np.zeros((1, 3)), theta, np.zeros(1), 1.0
    columns = model.kernels.evaluate("residual_jacobian", *at)[0, masses:].reshape(masses, 3, masses)
    stiffness, damping, inertia = columns.transpose(1, 0, 2)
    squares = np.linalg.eigvals(np.linalg.solve(inertia, stiffness))
    j = np.arange(1, masses + 1)
    exact = 2 * np.sqrt(40.0 / 0.7) * np.sin((2 * j - 1) * np.pi / (2 * (2 * masses + 1)))
    assert np.sort(np.sqrt(squares)) == pytest.approx(exact)
    assert damping == pytest.approx(stiffness * 0.3 / 40.0)


def test_one_mass_is_the_duffing_oscillator():
    one, duffing = bp.models.chain(1), bp.models.duffing
    swap = {one.state_symbols[d + "x1"]: duffing.state_symbols[d + "x"] for d in ("", "d", "dd")}
    assert one.equations[0].subs(swap) == duffing.equations[0]


def test_repeated_calls_return_the_same_model():
    assert bp.models.landing_gear() is bp.models.landing_gear("force")
    assert bp.models.chain(3) is bp.models.chain(np.int64(3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: bp.models.landing_gear("forces"),
            "drive: must be one of 'force', 'displacement', got 'forces'. Did you mean 'force'",
        ),
        (lambda: bp.models.landing_gear(None), "drive: must be .*got None"),
        (lambda: bp.models.chain(0), "masses: must be an integer >= 1, got 0"),
        (lambda: bp.models.chain(2.0), "masses: must be .*got 2.0"),
        (lambda: bp.models.chain([3]), r"masses: must be .*got \[3\]"),
    ],
)
def test_error_names_the_bad_argument(call, message):
    with pytest.raises(ValueError, match=message):
        call()
