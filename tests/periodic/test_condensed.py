"""Condensed models against symbolic ones, harmonic balance of all degrees of freedom, and SciPy's integration."""

import pickle
from functools import cache

import numpy as np
import pytest
import scipy.optimize
from scipy.integrate import solve_ivp

import bayesperiodic as bp
from bayesperiodic.periodic import condensed, condensed_solution
from bayesperiodic.periodic.batch import Anchor
from bayesperiodic.periodic.compiled import STATUSES
from bayesperiodic.periodic.condensed import CondensedEquations, receptance
from bayesperiodic.periodic.condensed_batch import CondensedBatch
from bayesperiodic.periodic.harmonics import harmonics
from bayesperiodic.periodic.receptance import Receptance

Element = bp.elements.Element
VALUES = {"alpha": 0.05, "beta": 0.01, "spring_k3": 0.05, "air_drag": 0.1}
FREQUENCY, SAMPLES = 0.055, 64
FORCE = 0.05 + 0.2 * np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES)
GENERAL = {"alpha": 0.02, "cut": 0.3, "soft": 0.8, "spring_k3": 0.05, "air_drag": 0.1}


def matrices(count):
    """Return mass and stiffness of a cantilever by finite differences."""
    chain = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    chain[-1, -1] = 1
    return 4 / count * np.eye(count), (count / 4) ** 2 * chain @ chain + chain


@cache
def beam(count, condensed=True, general=False):
    """Return a beam with a cubic spring and cubic air drag; `general` has damping that modes do not diagonalise."""
    mass, stiffness = matrices(count)
    place, tip = np.diag(np.arange(count) == 0) * 1.0, np.diag(np.arange(count) == count - 1) * 1.0
    parts = (
        {"damping": {"alpha": mass, "cut": place}, "stiffness": {"1": stiffness, "soft": tip}}
        if general
        else {"damping": {"alpha": mass, "beta": stiffness}, "stiffness": stiffness}
    )
    return bp.Model.from_matrices(
        "beam", mass=mass, **parts, forces={"force": count - 1}, condensed=condensed,
        outputs={"x": (count - 1, "displacement"), "v": (0, "velocity"), "a": (count // 2, "acceleration")},
        elements=[
            Element("spring", bp.elements.cubic, count - 1),
            Element("air", lambda v, drag: drag * v**3, (count // 2, 0)),
        ],
    )  # fmt: skip


def solved(count, condensed=True, values=None, general=False, frequency=FREQUENCY, **changes):
    """Return the solution of a beam."""
    how = {"frequency": frequency, "samples": SAMPLES, "scheme": "fourier"} | changes
    return bp.solve_periodic(
        beam(count, condensed, general), values or (GENERAL if general else VALUES), {"force": FORCE}, **how
    )


def worst(ours, other):
    """Return the largest difference of arrays by name, relative to the largest value of each."""
    return max(np.abs(ours[name] - other[name]).max() / np.abs(other[name]).max() for name in other)


@pytest.mark.parametrize("general", [False, True])
@pytest.mark.parametrize("count", [2, 4, pytest.param(8, marks=pytest.mark.slow)])
def test_condensed_solution_and_sensitivities_are_those_of_the_symbolic_model(count, general):
    ours, symbolic = (solved(count, condensed, general=general) for condensed in (True, False))
    assert ours.status == symbolic.status == "converged"
    assert ours.residual < 1e-12
    assert receptance(beam(count, True, general)).modal != general
    for kind in ("outputs", "states"):
        assert worst(getattr(ours, kind), getattr(symbolic, kind)) < 1e-8
    for kind in ("sensitivities", "state_sensitivities"):
        for name, by_parameter in getattr(symbolic, kind).items():
            assert worst(getattr(ours, kind)[name], by_parameter) < 1e-8


def harmonic_balance(count, harmonics):
    """Return outputs of the beam by SciPy's root of all harmonics, with one inverse a harmonic of all coordinates."""
    mass, stiffness = matrices(count)
    damping, rate, points = VALUES["alpha"] * mass + VALUES["beta"] * stiffness, 2 * np.pi * FREQUENCY, 256
    rates = rate * np.arange(harmonics + 1)
    places = np.zeros((2, count))
    places[0, -1], places[1, count // 2], places[1, 0] = 1, 1, -1
    response = np.linalg.inv(-(rates[:, None, None] ** 2) * mass + 1j * rates[:, None, None] * damping + stiffness)
    waves = np.exp(2j * np.pi * np.outer(np.arange(harmonics + 1), np.arange(points) / points))
    load = np.zeros((harmonics + 1, count), complex)
    load[:2, -1] = 0.05, 0.1

    def in_time(amplitudes):
        return amplitudes[:, :1].real + 2 * (amplitudes[:, 1:] @ waves[1:]).real

    def motion(vector):
        real, imaginary = np.split(vector.reshape(2, -1), [harmonics + 1], axis=1)
        d = real + 1j * np.pad(imaginary, ((0, 0), (1, 0)))
        cubes = in_time(d)[0] ** 3, in_time(1j * rates * d)[1] ** 3
        forces = np.array([VALUES["spring_k3"] * cubes[0], VALUES["air_drag"] * cubes[1]]) @ waves.conj().T / points
        return d, np.einsum("kij,kj->ki", response, load - forces.T @ places)

    def residual(vector):
        d, x = motion(vector)
        error = d - places @ x.T
        return np.concatenate([error.real, error.imag[:, 1:]], axis=1).ravel()

    root = scipy.optimize.root(residual, np.zeros(2 * (2 * harmonics + 1)), tol=1e-14)
    x = motion(root.x)[1]
    amplitudes = np.array([x[:, -1], 1j * rates * x[:, 0], -(rates**2) * x[:, count // 2]])
    return dict(zip("xva", in_time(amplitudes)[:, :: points // SAMPLES], strict=True))


@pytest.mark.parametrize("count", [32, pytest.param(128, marks=pytest.mark.slow)])
def test_many_degrees_of_freedom_move_as_in_an_independent_harmonic_balance(count):
    assert worst(solved(count).outputs, harmonic_balance(count, 27)) < 1e-6


@pytest.mark.parametrize("general", [False, True])
def test_sensitivities_of_many_degrees_of_freedom_are_finite_differences(general):
    values = GENERAL if general else VALUES
    here = solved(32, general=general)
    for name in (*values, "frequency"):
        ends, value = [], values.get(name, FREQUENCY)
        for sign in (1, -1):
            changed = {"frequency": FREQUENCY} | values
            changed[name] = value * (1 + 1e-4 * sign)
            frequency = changed.pop("frequency")
            ends.append(solved(32, values=changed, general=general, frequency=frequency, guess=here).outputs)
        for output, by_parameter in here.sensitivities.items():
            difference = (ends[0][output] - ends[1][output]) / (2e-4 * value)
            np.testing.assert_allclose(by_parameter[name], difference, atol=1e-5 * np.abs(difference).max())


def test_multipliers_are_those_of_scipys_integration_of_the_linearised_equations():
    """All 16 of 8 degrees of freedom; their estimated error, that of the largest, holds."""
    count, solution = 8, solved(8)
    mass, stiffness = matrices(count)
    damping, rate = VALUES["alpha"] * mass + VALUES["beta"] * stiffness, 2 * np.pi * FREQUENCY
    states = np.array([solution.states[f"x{i}"] for i in range(count)])
    amplitudes = np.fft.rfft(states) / SAMPLES
    orders = np.arange(amplitudes.shape[1])
    weight = np.where(orders == 0, 1.0, 2.0)
    between = np.zeros(count)
    between[count // 2], between[0] = 1, -1

    def rates(t, flat):
        y = flat.reshape(2 * count, -1)
        turning = weight * np.exp(1j * orders * rate * t)
        tip, relative = (amplitudes[-1] @ turning).real, (between @ amplitudes @ (1j * rate * orders * turning)).real
        k = stiffness + np.diag(np.eye(count)[-1]) * 3 * VALUES["spring_k3"] * tip**2
        c = damping + np.outer(between, between) * 3 * VALUES["air_drag"] * relative**2
        return np.concatenate([y[count:], -np.linalg.solve(mass, k @ y[:count] + c @ y[count:])]).ravel()

    end = solve_ivp(rates, (0, 1 / FREQUENCY), np.eye(2 * count).ravel(), rtol=1e-9, atol=1e-11).y[:, -1]
    exact = np.linalg.eigvals(end.reshape(2 * count, -1))
    exact = exact[np.argsort(-np.abs(exact))]
    for value in exact[:8]:
        assert np.abs(solution.multipliers - value).min() < 1e-6
    assert abs(abs(solution.multipliers[0]) - abs(exact[0])) < 1e-7
    assert solution.multiplier_error < 1e-7


def test_multipliers_in_few_modes_are_those_in_all_to_their_error(monkeypatch):
    """Of 24 degrees of freedom in 16 and in 24 modes; only the former have an error of the modes left out."""
    few = solved(24)
    monkeypatch.setattr(condensed_solution, "MOST_MODES", 24)
    monkeypatch.setattr(condensed_solution, "CLEAR_OF_CIRCLE", 0.0)
    every = solved(24)
    assert few.multipliers.shape == (32,) and every.multipliers.shape == (48,)
    difference = abs(abs(few.multipliers[0]) - abs(every.multipliers[0]))
    assert every.multiplier_error < difference <= few.multiplier_error < 1e-3
    assert few.stable


def errors_with_flexibility_and_without(monkeypatch, modes, multipliers, exact):
    """Return errors of the multiplier next to an exact one with and without the flexibility of modes left out."""
    monkeypatch.setattr(condensed_solution, "MOST_MODES", modes)
    errors, lowest = [], Receptance.lowest
    for scale in (1, 0):
        monkeypatch.setattr(
            Receptance,
            "lowest",
            lambda *given, scale=scale: (m := lowest(*given))._replace(compliance=scale * m.compliance),
        )
        errors.append(np.abs(multipliers() - exact).min())
    return errors


def test_modes_left_out_bend_statically(monkeypatch):
    """A linear spring as an element: in 3 of 8 modes, the multiplier of the lowest mode is nearer with flexibility."""
    mass, stiffness = matrices(8)
    model = bp.Model.from_matrices(
        "sprung", mass=mass, stiffness=stiffness, damping={"alpha": mass}, forces={"force": 7}, condensed=True,
        outputs={"x": (7, "displacement")}, elements=[Element("spring", lambda d, k: k * d, 7)],
    )  # fmt: skip
    tip = np.diag(np.arange(8) == 7) * 2.0
    rate = np.sqrt(np.linalg.eigvals(np.linalg.solve(mass, stiffness + tip)).real.min() - 0.025**2)
    how = {"parameters": {"alpha": 0.05, "spring_k": 2.0}, "frequency": 0.1, "samples": SAMPLES}
    errors = errors_with_flexibility_and_without(
        monkeypatch, 3, lambda: bp.solve_periodic(model, inputs={"force": FORCE}, **how).multipliers,
        np.exp((-0.025 + 1j * rate) / 0.1),
    )  # fmt: skip
    assert errors[0] < 0.2 * errors[1]


def test_newtons_matrix_is_that_of_the_linearised_equations():
    """With all harmonics strongly coupled, it inverts a finite difference of the residual."""
    equations = CondensedEquations.build(beam(8), {"force": FORCE}, frequency=FREQUENCY, samples=SAMPLES)
    theta, random = np.array([*VALUES.values()]), np.random.default_rng(0)
    d, step = random.standard_normal((2, 16, 2)) + 1j * random.standard_normal((2, 16, 2))
    d[0], step[0] = d[0].real, step[0].real
    response = equations.matrices(theta, 32)[0].d_f

    def residual(at):
        forces = harmonics(equations.forces(at, theta).values)
        return at + (response @ forces[..., None])[..., 0]

    change = (residual(d + 1e-5 * step) - residual(d - 1e-5 * step)) / 2e-5
    inverse = condensed.Preconditioner(equations.forces(d, theta), equations.rates(32), response, 16)
    np.testing.assert_allclose(inverse(change), step, atol=1e-6)


def test_order_of_convergence_at_a_kink():
    """The displacement of a beam at a sharp stop is at least of order 1.5 in the number of points."""
    mass, stiffness = matrices(12)
    model = bp.Model.from_matrices(
        "stopped", mass=mass, stiffness=stiffness, damping={"alpha": mass}, forces={"force": 11},
        outputs={"x": (11, "displacement")},
        elements=[Element("stop", lambda d, k, clearance: k * (abs(d - clearance) + d - clearance) / 2, 11)],
    )  # fmt: skip
    equations = CondensedEquations.build(model, {"force": FORCE}, frequency=0.04, samples=SAMPLES)
    theta = np.array([0.2, 0.5, 0.1])
    reference = equations.solve(theta, np.zeros((4096, 1)))
    exact, errors = equations.outputs(reference.z, theta), []
    for points in (64, 128, 256, 512):
        solution = equations.solve(theta, reference.z[:: 4096 // points])
        assert solution.code == 0
        errors.append(np.abs(equations.outputs(solution.z, theta) - exact).max())
    assert exact.max() > 0.15  # it touches the stop
    slope = np.polyfit(np.log([64, 128, 256, 512]), np.log(errors), 1)[0]
    assert -slope > 1.5


def test_points_are_doubled_until_the_outputs_are_resolved():
    """What half of the points leave of the error is what the solution states, and is below a millionth."""
    solution = solved(12)
    assert 0.0 < max(solution.error_estimate().values()) < 1e-6


def test_model_of_hundreds_of_degrees_of_freedom_is_condensed_and_can_be_pickled():
    model = beam(300, None)
    again = pickle.loads(pickle.dumps(model))
    assert type(model).__name__ == "CondensedModel" and again.definition == model.definition
    assert type(beam(10, None)).__name__ == "Model"
    assert "W^T f" in model.latex()


def test_structure_without_elements_has_its_frequency_response():
    mass, stiffness = matrices(12)
    model = bp.Model.from_matrices(
        "linear", mass=mass, stiffness=stiffness, damping={"alpha": 2 * mass}, forces={"force": 0},
        outputs={"x": (11, "displacement")},
    )  # fmt: skip
    solution = bp.solve_periodic(model, {"alpha": 0.05}, {"force": FORCE}, frequency=0.1, samples=SAMPLES)
    rate = 0.2 * np.pi
    x = [np.linalg.solve(stiffness - r**2 * mass + 0.1j * r * mass, np.eye(12)[0])[-1] for r in (0.0, rate)]
    expected = 0.05 * x[0].real + 0.2 * (x[1] * np.exp(2j * np.pi * solution.tau)).real
    np.testing.assert_allclose(solution.outputs["x"], expected, atol=1e-12)


def free_bar(**changes):
    chain = matrices(12)[1]
    arguments = {
        "mass": np.eye(12), "stiffness": chain, "forces": {"force": 0}, "outputs": {"x": (0, "displacement")},
        "condensed": True,
    }  # fmt: skip
    return bp.Model.from_matrices("bar", **(arguments | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"elements": [Element("late", lambda s, k: k * s.tau, 0)]}, "elements: must be functions of"),
        ({"forces": {}}, "forces: must have at least one force or a base in a condensed model"),
    ],
)
def test_what_cannot_be_condensed_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        free_bar(**changes)


def test_structure_that_moves_without_deformation_is_refused():
    rigid = 2 * np.eye(12) - np.eye(12, k=1) - np.eye(12, k=-1)
    rigid[0, 0] = rigid[-1, -1] = 1
    with pytest.raises(ValueError, match="stiffness: must be regular in a condensed model"):
        bp.solve_periodic(free_bar(stiffness=rigid), {}, {"force": FORCE}, frequency=0.1, samples=SAMPLES)


def test_what_needs_symbolic_equations_is_refused_with_the_alternative():
    model, solution = beam(12), solved(12)
    for call in (
        lambda: bp.double_period(model, solution, "frequency"),
        lambda: bp.structure(model),
        lambda: bp.double_period(model, solution, "frequency"),
        lambda: bp.multiplier_sensitivities(model, solution),
        lambda: bp.simulate(model, VALUES, {"force": FORCE}, frequency=FREQUENCY, duration=1.0, sampling_rate=10.0),
    ):
        with pytest.raises(ValueError, match=r"must have symbolic equations for this.*condensed=False"):
            call()
    with pytest.raises(ValueError, match="scheme: must be 'fourier' or None"):
        solved(12, scheme="central4")


STOPPED = {"alpha": 0.5, "stop_k": 10.0, "stop_clearance": 0.6}


@cache
def stopped():
    """Return a beam of 6 degrees of freedom with a stiff and sharp stop."""
    mass, stiffness = matrices(6)
    return bp.Model.from_matrices(
        "stopped", mass=mass, stiffness=stiffness, damping={"alpha": mass}, forces={"force": 5}, condensed=True,
        outputs={"x": (5, "displacement"), "v": (2, "velocity")},
        elements=[Element("stop", lambda d, k, clearance: k * (abs(d - clearance) + d - clearance) / 2, 5)],
    )  # fmt: skip


def integrated(values, frequency):
    """Return the outputs of the stopped beam after 30 periods of SciPy's integration from rest."""
    mass, stiffness = matrices(6)
    inverse = np.linalg.inv(mass)

    def rates(t, y):
        push = 0.05 + 0.2 * np.cos(2 * np.pi * frequency * t)
        push -= values["stop_k"] * max(y[5] - values["stop_clearance"], 0.0)
        return np.concatenate([y[6:], inverse @ (push * np.eye(6)[5] - stiffness @ y[:6]) - values["alpha"] * y[6:]])

    times = (30 + np.arange(SAMPLES) / SAMPLES) / frequency
    y = solve_ivp(rates, (0, times[-1]), np.zeros(12), t_eval=times, rtol=1e-9, atol=1e-11, max_step=0.05).y
    return {"x": y[5], "v": y[8]}


def unstopped(frequency):
    """Return equations, and an anchor out of contact, of few points, and the parameters in contact."""
    equations = CondensedEquations.build(stopped(), {"force": FORCE}, frequency=frequency, samples=SAMPLES)
    theta = np.array([*STOPPED.values()])
    free = theta * [1, 1, 2]
    z = equations.find(free, None)[0].z
    assert len(z) <= 64 and z.max() < free[2]
    return (
        equations,
        Anchor.of(equations, free, z, equations.sensitivities_along(z, free, np.eye(3)), np.arange(3)),
        theta,
    )


def test_points_of_a_batch_are_doubled_where_those_of_the_anchor_do_not_resolve_the_response():
    """A stiff stop far from an anchor out of contact, against SciPy's integration."""
    frequency = 0.04
    equations, anchor, theta = unstopped(frequency)
    solved = CondensedBatch([equations], [anchor]).solve(np.stack([theta, anchor.parameters]), keep=True)
    assert solved.status.tolist() == [[0, 0]] and solved.z.shape[2] > len(anchor.z)
    exact = integrated(STOPPED, frequency)
    assert exact["x"].max() > 1.02 * STOPPED["stop_clearance"]
    assert worst(dict(zip("xv", solved.outputs[0, 0].T, strict=True)), exact) < 1e-4
    coarse = equations.solve(theta, solved.z[0, 0][:: solved.z.shape[2] // len(anchor.z)])
    assert worst(dict(zip("xv", equations.outputs(coarse.z, theta).T, strict=True)), exact) > 1e-3
    np.testing.assert_allclose(equations.outputs(solved.z[0, 0], theta), solved.outputs[0, 0], atol=1e-9)


def test_response_that_no_points_resolve_does_not_enter_a_likelihood(monkeypatch):
    """With 64 points at most, the status in contact is "not resolved", and the log-likelihood −∞."""
    frequency = 0.04
    monkeypatch.setattr(condensed, "MOST_ELEMENT_POINTS", 64)
    monkeypatch.setattr(condensed, "LARGEST_OUTPUT_CHANGE", 1e-3)
    equations, anchor, theta = unstopped(frequency)
    solved = CondensedBatch([equations], [anchor]).solve(np.stack([theta, anchor.parameters]))
    assert [STATUSES[code] for code in solved.status[0]] == ["not resolved", "converged"]
    run = bp.Experiment("run", frequency, {"x": solved.outputs[0, 1, :, 0]}, {"force": FORCE}, samples=SAMPLES)
    free = dict(zip(STOPPED, anchor.parameters, strict=True))
    problem = bp.Problem(stopped(), [run], priors={n: bp.LogNormal(v, 1.0) for n, v in free.items()})
    order = [[*STOPPED].index(n) for n in problem.names]
    values = problem.log_likelihood(np.stack([anchor.parameters, theta])[:, order], {"x": 1e-3})
    assert np.isfinite(values[0]) and values[1] == -np.inf


@cache
def response(count, condensed=True, vary="frequency", until=0.1):
    """Return the branch of a beam over its first resonance, or in a parameter or the force."""
    start = solved(count, condensed, frequency=0.045)
    step = abs(until - {"frequency": 0.045, "force": 1.0}.get(vary, VALUES.get(vary))) / (50 if condensed else 12)
    return bp.continue_periodic(beam(count, condensed), start, vary, until=until, step=step, progress=False)


@pytest.mark.parametrize("count", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_branch_has_the_folds_and_multipliers_of_the_symbolic_model(count):
    """Over the bent peak, stable, unstable and stable; multipliers of the orbits at one frequency."""
    ours, symbolic = (response(count, condensed) for condensed in (True, False))
    assert ours.complete and symbolic.complete and len(ours.folds) == len(symbolic.folds) == 2
    np.testing.assert_allclose([s.frequency for s in ours.folds], [s.frequency for s in symbolic.folds], rtol=1e-7)
    middle = np.mean([s.frequency for s in ours.folds])
    orbits = (bp.solutions_at(beam(count, c), b, middle) for c, b in ((True, ours), (False, symbolic)))
    for one, other in zip(*orbits, strict=True):
        assert worst(one.outputs, other.outputs) < 1e-7
        assert one.stable == other.stable
        for value in other.multipliers[:4]:
            assert np.abs(one.multipliers - value).min() < 1e-6
    stable = [s.stable for s in ours if s.stable is not None]
    # Between the folds; of 8 degrees of freedom also where two multipliers leave and enter the circle as a pair.
    assert np.count_nonzero(np.diff(stable)) == (2 if count == 4 else 4)
    assert set(bp.solutions_at(beam(count), ours, middle)[1].outputs) == {"x", "v", "a"}


@pytest.mark.parametrize(("vary", "until"), [("force", 0.2), ("spring_k3", 0.5), ("alpha", 0.01)])
def test_branches_in_other_quantities_end_at_the_solution_there(vary, until):
    branch = response(12, vary=vary, until=until)
    assert branch.complete and branch.values[-1] == until
    if vary == "force":
        last = bp.solve_periodic(
            beam(12), VALUES, {"force": until * FORCE}, frequency=0.045, samples=SAMPLES, guess=branch[-1].states
        )
    else:
        last = solved(12, values=VALUES | {vary: until}, frequency=0.045, guess=branch[-1].states)
    assert last.converged and worst(branch[-1].outputs, last.outputs) < 1e-8
    assert branch.data.sizes["point"] == len(branch)


def test_points_are_doubled_along_a_branch_into_contact():
    """The clearance falls until a sharp stop is touched: the end is that of SciPy's integration."""
    values, frequency = STOPPED | {"stop_clearance": 1.2}, 0.04
    start = bp.solve_periodic(stopped(), values, {"force": FORCE}, frequency=frequency, samples=SAMPLES)
    branch = bp.continue_periodic(stopped(), start, "stop_clearance", until=0.6, progress=False)
    assert branch.complete and branch[-1].stable
    assert worst(branch[-1].outputs, integrated(STOPPED, frequency)) < 1e-4


def test_multipliers_of_an_unstable_orbit_are_those_of_scipys_integration_of_the_nonlinear_equations():
    """A small perturbation of the unstable orbit of 8 degrees of freedom grows by the largest multiplier a period."""
    count, branch = 8, response(8)
    orbit = bp.solutions_at(beam(8), branch, np.mean([s.frequency for s in branch.folds]))[1]
    mass, stiffness = matrices(count)
    damping, inverse = VALUES["alpha"] * mass + VALUES["beta"] * stiffness, np.linalg.inv(mass)
    between = np.zeros(count)
    between[count // 2], between[0] = 1, -1

    def rates(t, y):
        x, v = np.split(y, 2)
        f = stiffness @ x + damping @ v + VALUES["air_drag"] * (between @ v) ** 3 * between
        f[-1] += VALUES["spring_k3"] * x[-1] ** 3 - 0.05 - 0.2 * np.cos(2 * np.pi * orbit.frequency * t)
        return np.concatenate([v, -inverse @ f])

    amplitudes = np.fft.rfft(np.array([orbit.states[f"x{i}"] for i in range(count)])) / SAMPLES
    turning = np.where(np.arange(amplitudes.shape[1]) == 0, 1.0, 2.0) * amplitudes
    here = np.concatenate(
        [
            turning.sum(axis=1).real,
            (2j * np.pi * orbit.frequency * np.arange(turning.shape[1]) * turning).sum(axis=1).real,
        ]
    )

    def end(y):
        return solve_ivp(rates, (0, orbit.period), y, rtol=1e-10, atol=1e-12).y[:, -1]

    columns = [(end(here + 1e-5 * e) - end(here - 1e-5 * e)) / 2e-5 for e in np.eye(2 * count)]
    exact = np.linalg.eigvals(np.transpose(columns))
    largest = exact[np.argmax(np.abs(exact))]
    assert orbit.stable is False
    assert abs(orbit.multipliers[0] - largest) < 1e-4 * abs(largest)
