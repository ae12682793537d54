"""Condensed models with internal states: closed forms, symbolic models, and harmonic balance with exact friction."""

import tracemalloc
from functools import cache

import numpy as np
import pytest
import scipy.optimize

import bayesperiodic as bp
from bayesperiodic.models.hysteresis import MICROSLIP, Hysteretic
from bayesperiodic.periodic import condensed, condensed_batch, condensed_solution
from bayesperiodic.periodic.batch import Anchor
from bayesperiodic.periodic.condensed import CondensedEquations, Preconditioner
from bayesperiodic.periodic.condensed_batch import CondensedBatch
from bayesperiodic.periodic.harmonics import harmonics, on_grid, resized
from tests.periodic.test_condensed import errors_with_flexibility_and_without

Element = bp.elements.Element
FREQUENCY, SAMPLES = 0.06, 64
LINEAR = {"k": 1.0, "alpha": 0.02, "beta": 0.01}
FRICTION = {"joint_stiffness": 1.0, "joint_limit": 0.1}
VALUES = {
    "jenkins": LINEAR | FRICTION,
    "bouc_wen": LINEAR | FRICTION | {"joint_exponent": 2.0, "joint_shape": 0.7},
    "dahl": LINEAR | FRICTION | {"spring_k3": 0.5},
    "iwan": LINEAR | FRICTION | {"joint_chi": -0.5, "joint_beta": 0.5},
}


def force(samples=SAMPLES):
    return 0.05 + 0.2 * np.cos(2 * np.pi * np.arange(samples) / samples)


def chain(count):
    """Return the stiffness of masses in a chain that is held at one end."""
    springs = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    springs[-1, -1] = 1
    return springs


@cache
def model(count, kind, condensed=True):
    """Return a chain with a joint to the ground at its free end, for "dahl" also with a spring at the other one."""
    joints = {
        "jenkins": [Element("joint", bp.elements.jenkins, count - 1, {"width": 0.1})],
        "bouc_wen": [Element("joint", bp.elements.bouc_wen, count - 1)],
        "dahl": [Element("joint", bp.elements.dahl, count - 1), Element("spring", bp.elements.cubic, 0)],
        "iwan": [
            Element("joint", bp.elements.iwan, count - 1, {"names": bp.elements.iwan_states("joint", 4), "width": 0.2})
        ],
    }
    return bp.Model.from_matrices(
        "chain", mass=np.eye(count), stiffness={"k": chain(count)},
        damping={"alpha": np.eye(count), "beta": chain(count)}, forces={"force": count - 1}, condensed=condensed,
        outputs={"x": (count - 1, "displacement"), "a": (0, "acceleration")}, elements=joints[kind],
    )  # fmt: skip


@cache
def solved(count, kind):
    return bp.solve_periodic(model(count, kind), VALUES[kind], {"force": force()}, frequency=FREQUENCY, samples=SAMPLES)


@cache
def symbolic(count, kind):
    """Return the solution of the symbolic model on a fine grid."""
    how = {"frequency": FREQUENCY, "samples": 1024, "scheme": "central4"}
    return bp.solve_periodic(model(count, kind, False), VALUES[kind], {"force": force(1024)}, **how)


def equations_of(count, kind, frequency=FREQUENCY):
    built = CondensedEquations.build(model(count, kind), {"force": force()}, frequency=frequency, samples=SAMPLES)
    return built, np.array([VALUES[kind][n] for n in built.model.parameters])


def largest(difference, of):
    return np.abs(difference).max() / np.abs(of).max()


@pytest.mark.parametrize(("count", "kind"), [(2, "jenkins"), (3, "bouc_wen"), (4, "dahl"), (2, "iwan")])
def test_outputs_sensitivities_and_multipliers_are_those_of_the_symbolic_model(count, kind):
    """Both grids have an error of order two at kinks, derivatives and multipliers one of order one."""
    ours, other = solved(count, kind), symbolic(count, kind)
    every = len(other.tau) // SAMPLES
    assert ours.status == other.status == "converged" and ours.residual < 1e-10
    assert ours.stable and not set(ours.states) & {"joint", "joint_1"}
    for name, values in ours.outputs.items():
        assert largest(values - other.outputs[name][::every], values) < 3e-5
        for parameter, slope in other.sensitivities[name].items():
            assert largest(ours.sensitivities[name][parameter] - slope[::every], slope) < 1.5e-2
    for value in other.multipliers[:4]:
        assert np.abs(ours.multipliers - value).min() < 1e-2
    assert len(ours.multipliers) == len(other.multipliers)


@cache
def viscoelastic(scaled=False):
    """Return a chain of twelve with a linear element of two internal states, which depend on each other."""

    def damper(v, s, name, names, k, a):
        first, second = s[names[0]], s[names[1]]
        slopes = s["d" + names[0]], s["d" + names[1]]
        rates = v - a * first + 0.3 * second, first - 0.5 * second
        if scaled:
            return Hysteretic(
                k * first, (2 * slopes[0] - slopes[1] - 2 * rates[0] + rates[1], 3 * (slopes[1] - rates[1]))
            )
        return Hysteretic(k * first, (slopes[0] - rates[0], slopes[1] - rates[1]))

    return bp.Model.from_matrices(
        "viscoelastic", mass=np.eye(12), stiffness=chain(12), damping={"alpha": np.eye(12)}, forces={"force": 11},
        outputs={"x": (11, "displacement")}, elements=[Element("soft", damper, 11, {"names": ("w1", "w2")})],
    )  # fmt: skip


VISCOELASTIC = {"alpha": 0.02, "soft_k": 0.7, "soft_a": 0.4}


def viscoelastic_response(values, rate):
    """Return the displacement of the end for a unit force."""
    inner = np.array([[-values["soft_a"], 0.3], [1.0, -0.5]])
    added = values["soft_k"] * np.linalg.solve(1j * rate * np.eye(2) - inner, [1j * rate, 0])[0]
    matrix = chain(12) + (1j * rate * values["alpha"] - rate**2) * np.eye(12)
    matrix[-1, -1] += added
    return np.linalg.inv(matrix)[-1, -1]


def viscoelastic_multipliers():
    zero, one = np.zeros((12, 12)), np.eye(12)
    matrix = np.zeros((26, 26))
    matrix[:24, :24] = np.block([[zero, one], [-chain(12), -VISCOELASTIC["alpha"] * one]])
    matrix[23, 24], matrix[24, 23] = -VISCOELASTIC["soft_k"], 1.0
    matrix[24:, 24:] = [[-VISCOELASTIC["soft_a"], 0.3], [1.0, -0.5]]
    return np.exp(np.linalg.eigvals(matrix) / FREQUENCY)


@pytest.mark.parametrize("scaled", [False, True])
def test_linear_element_of_two_states_has_its_response_its_derivatives_and_its_multipliers(scaled):
    solution = bp.solve_periodic(
        viscoelastic(scaled), VISCOELASTIC, {"force": force()}, frequency=FREQUENCY, samples=SAMPLES
    )
    wave = np.exp(2j * np.pi * solution.tau)

    def exact(values, frequency):
        still, turning = (viscoelastic_response(values, r) for r in (0.0, 2 * np.pi * frequency))
        return 0.05 * still.real + 0.2 * (turning * wave).real

    assert largest(solution.outputs["x"] - exact(VISCOELASTIC, FREQUENCY), solution.outputs["x"]) < 1e-6
    for name in (*VISCOELASTIC, "frequency"):
        ends = []
        for sign in (1, -1):
            changed = {"frequency": FREQUENCY} | VISCOELASTIC
            changed[name] *= 1 + 1e-5 * sign
            ends.append(
                exact(changed, changed.pop("frequency")) / (2e-5 * (VISCOELASTIC | {"frequency": FREQUENCY})[name])
            )
        assert largest(solution.sensitivities["x"][name] - (ends[0] - ends[1]), ends[0] - ends[1]) < 1e-5
    multipliers = viscoelastic_multipliers()
    for value in multipliers[np.abs(multipliers) > 1e-6]:
        assert np.abs(solution.multipliers - value).min() < 5e-6


def test_forces_of_a_linear_element_are_those_of_its_frequency_response_whatever_the_motion():
    """From rest, and from the states of another motion; the second state begins at 0 with rate 0."""
    given = viscoelastic()
    equations = CondensedEquations.build(given, {"force": force()}, frequency=FREQUENCY, samples=SAMPLES)
    theta, random = np.array([VISCOELASTIC[name] for name in given.parameters]), np.random.default_rng(1)
    inner = np.array([[-VISCOELASTIC["soft_a"], 0.3], [1.0, -0.5]])
    turning = 1j * equations.rates(512)[:5]
    response = [VISCOELASTIC["soft_k"] * np.linalg.solve(r * np.eye(2) - inner, [r, 0])[0] for r in turning]
    before = None
    for _ in range(40):
        d = np.zeros((256, 1), dtype=complex)
        d[:5, 0] = random.standard_normal(5) + 1j * np.append(0.0, random.standard_normal(4))
        exact = d[:5, 0] * response
        forces = equations.forces(d, theta)
        for near in (forces, before and equations.forces(d * (1 + 1e-15), theta, before)):
            if near is not None:
                assert np.abs(harmonics(near.values)[:5, 0] - exact).max() < 1e-6 * np.abs(exact).max()
        before = forces


@pytest.mark.parametrize("kind", [*VALUES])
def test_derivatives_are_those_of_the_formula(kind):
    """By d, parameters and frequency on 64 points: finite differences of the harmonics, and Newton's matrix."""
    equations, theta = equations_of(3, kind)
    count, random = equations.count, np.random.default_rng(0)
    d, change = random.standard_normal((2, 32, count)) + 1j * random.standard_normal((2, 32, count))
    d *= 0.05 / np.arange(1, 33)[:, None]
    d[0], change[0] = d[0].real, change[0].real
    assert np.abs(equations.forces(d, theta).memory.states[:, count]).max() > 0.5

    def residual(at):
        response = equations.matrices(theta, 64)[0].d_f
        return at + (response @ harmonics(equations.forces(at, theta).values)[..., None])[..., 0]

    slope = (residual(d + 1e-6 * change) - residual(d - 1e-6 * change)) / 2e-6
    inverse = Preconditioner(equations.forces(d, theta), equations.rates(64), equations.matrices(theta, 64)[0].d_f, 32)
    np.testing.assert_allclose(inverse(slope), change, atol=1e-4)
    for number in range(theta.size + 1):
        ends = []
        for sign in (1, -1):
            moved = np.append(theta, equations.frequency)
            moved[number] *= 1 + 1e-6 * sign
            there = equations.at_frequency(moved[-1])
            response, load = there.matrices(moved[:-1], 64)[0], there.input_harmonics(64)
            f = harmonics(there.forces(d, moved[:-1]).values)
            ends.append((response.d_u @ load[..., None] - response.d_f @ f[..., None])[..., 0])
        difference = (ends[0] - ends[1]) / (2e-6 * np.append(theta, equations.frequency)[number])
        ours = equations.slopes(d, theta, [number])[2][0]
        assert largest(ours - difference, difference) < 1e-5


def test_sensitivities_are_central_differences_of_solutions_on_the_same_points():
    equations, theta = equations_of(30, "jenkins")
    z = equations.find(theta, None)[0].z[::4]
    z = equations.solve(theta, z).z
    ours = equations.parameter_sensitivities(z, theta)
    for number in range(theta.size + 1):
        ends, step = [], 1e-6
        for sign in (1, -1):
            moved = np.append(theta, equations.frequency)
            moved[number] *= 1 + step * sign
            there = equations.at_frequency(moved[-1])
            ends.append(there.outputs(there.solve(moved[:-1], z).z, moved[:-1]))
        difference = (ends[0] - ends[1]) / (2 * step * np.append(theta, equations.frequency)[number])
        assert largest(ours.outputs[number] - difference, difference) < 1e-4


def slid(z, travel, width):
    """Return the force of a Jenkins element, as a part of its limit, after a displacement of `travel` springs."""
    sign, z, left = np.sign(travel), z * np.sign(travel), abs(travel)
    parts = ((0.0, 0.0), (1 - width, MICROSLIP), (1.0, (1 - MICROSLIP * (1 - width)) / width))
    for end, decay in parts:  # dz/dd = 1 below 0, 1 − decay·z up to the elastic limit, and falling to 0 at 1
        if z < end and left > 0.0:
            if end == 1.0:
                return sign * (1 - (1 - z) * np.exp(-decay * left))
            here = 1 - decay * z
            needed = end - z if decay == 0.0 else -np.log((1 - decay * end) / here) / decay
            used = min(left, needed)
            z = z + used if decay == 0.0 else (1 - here * np.exp(-decay * used)) / decay
            left -= used
    return sign * z


def test_many_degrees_of_freedom_rub_as_in_an_independent_harmonic_balance():
    """Of 40 harmonics, with exact friction between 2048 points, whose error is of the order of 1e-5."""
    count, values, points, kept = 30, VALUES["jenkins"], 2048, 40
    rates = 2 * np.pi * FREQUENCY * np.arange(kept + 1)
    damping = values["alpha"] * np.eye(count) + values["beta"] * chain(count)
    response = np.linalg.inv(
        chain(count) - rates[:, None, None] ** 2 * np.eye(count) + 1j * rates[:, None, None] * damping
    )
    load = np.zeros(kept + 1)
    load[:2] = 0.05, 0.1
    travel = values["joint_limit"] / values["joint_stiffness"]

    def balance(vector):
        d = np.append(vector[0], vector[1 : kept + 1] + 1j * vector[kept + 1 :])
        path = np.diff(np.fft.irfft(d, points), append=np.fft.irfft(d, points)[0]) * points / travel
        z, friction = 0.0, np.empty(points)
        for _ in range(2):
            for n in range(points):
                friction[n], z = z, slid(z, path[n], 0.1)
        f = values["joint_limit"] * np.fft.rfft(friction)[: kept + 1] / points
        return d - response[:, -1, -1] * (load - f), response[:, :, -1] * (load - f)[:, None]

    def residual(vector):
        error = balance(vector)[0]
        return np.concatenate([error.real, error.imag[1:]])

    ours = solved(count, "jenkins")
    start = np.zeros(2 * kept + 1)
    root = scipy.optimize.newton_krylov(residual, start, f_tol=1e-8)
    x = balance(root)[1]
    wave = np.exp(2j * np.pi * np.outer(ours.tau, np.arange(kept + 1)))
    for name, amplitudes in {"x": x[:, -1], "a": -(rates**2) * x[:, 0]}.items():
        exact = 2 * (wave @ amplitudes).real - amplitudes[0].real
        assert largest(ours.outputs[name] - exact, exact) < 1e-4
    assert np.ptp(ours.outputs["x"]) > 4 * travel


def test_energy_of_a_cycle_is_that_of_the_closed_form():
    """A given motion d = X cos(ωt) with X = 20 travels; the error is of order two in the points."""
    equations, theta = equations_of(2, "jenkins")
    limit, travel, amplitude, errors = 0.1, 0.1, 2.0, []
    exact = 4 * limit * (amplitude - travel * (1 + 0.1**2 / 4))
    for points in (512, 4096):
        d = np.zeros((points // 2, 1), dtype=complex)
        d[1] = amplitude / 2
        v = on_grid(1j * equations.rates(points)[:, None] * d, points)
        f = equations.forces(d, theta).values
        errors.append(abs(np.mean(f * v) / FREQUENCY / exact - 1))
    assert errors[1] < 2e-4 and errors[0] < 2e-2


def test_error_of_the_outputs_is_as_small_as_the_points_are_doubled_for():
    """Against twice the most points; the doubling ends below them, and the estimates cover the errors."""
    for kind in VALUES:
        equations, theta = equations_of(3, kind)
        z = equations.find(theta, None)[0].z
        d = harmonics(z)
        finer = equations.solve(theta, on_grid(resized(d, 8192), 8192))
        exact, ours = equations.outputs(finer.z, theta), equations.outputs(z, theta)
        error = (np.abs(ours - exact) / np.abs(exact).max(axis=0)).max()
        assert len(z) < condensed.MOST_ELEMENT_POINTS
        assert error < condensed.RESOLVED_CHANGE_OF_MEMORY
        assert error < 2 * equations.error_bound(z, theta) < 2e-4


def test_order_of_convergence_at_kinks_is_two():
    """Mean slope of the logarithm of the error of the displacements from 64 to 1024 points."""
    equations, theta = equations_of(3, "jenkins")
    finest = equations.solve(theta, on_grid(resized(harmonics(equations.find(theta, None)[0].z), 16384), 16384)).z
    exact, errors, every = equations.outputs(finest, theta), [], (64, 128, 256, 512, 1024)
    for points in every:
        z = equations.solve(theta, finest[:: 16384 // points]).z
        errors.append(np.abs(equations.outputs(z, theta) - exact).max())
    assert 1.7 < -np.polyfit(np.log(every), np.log(errors), 1)[0] < 3.0


def test_multipliers_have_an_error_as_stated():
    """Against sixteen times the steps, of the same orbit."""
    for count, kind in ((2, "jenkins"), (3, "bouc_wen")):
        equations, theta = equations_of(count, kind)
        z = equations.find(theta, None)[0].z
        values, error = condensed_solution.modal_multipliers(equations, theta, z)
        motion = condensed_solution._Linearised(equations, theta, harmonics(z), 16)
        fine = np.abs(np.linalg.eigvals(motion.monodromy(32768))).max()
        assert abs(abs(values[0]) - fine) < error < 5e-3
        alone, missing = condensed_solution.modal_multipliers(equations, theta, z, error=False)
        assert np.array_equal(alone, values) and np.isnan(missing)


def test_modes_left_out_bend_statically(monkeypatch):
    """In 4 of 12 modes, the largest multiplier with a viscoelastic element is nearer with their flexibility."""
    how = {"inputs": {"force": force()}, "frequency": FREQUENCY, "samples": SAMPLES}
    errors = errors_with_flexibility_and_without(
        monkeypatch, 4, lambda: bp.solve_periodic(viscoelastic(), VISCOELASTIC, **how).multipliers[0],
        viscoelastic_multipliers(),
    )  # fmt: skip
    assert errors[0] < 0.2 * errors[1]


@pytest.mark.parametrize("kind", ["jenkins", "iwan"])
def test_batch_has_the_solutions_of_single_solves(kind):
    equations, theta = equations_of(12, kind)
    z = equations.find(theta, None)[0].z
    moving = np.arange(theta.size)
    anchor = Anchor.of(equations, theta, z, equations.sensitivities_along(z, theta, np.eye(theta.size)), moving)
    every = theta * np.exp(0.03 * np.random.default_rng(0).standard_normal((6, theta.size)))
    batch = CondensedBatch([equations], [anchor])
    result = batch.solve(every, keep=True, polish=True)
    assert result.status.tolist() == [[0] * 6]
    weights = np.random.default_rng(1).standard_normal(result.outputs[:, 0].shape)
    for number, parameters in enumerate(every):
        single = equations.solve(parameters, result.z[0, number])
        assert largest(result.outputs[0, number] - equations.outputs(single.z, parameters), result.outputs) < 1e-8
        fresh = equations.find(parameters, None)[0]
        assert largest(result.outputs[0, number] - equations.outputs(fresh.z, parameters), result.outputs) < 5e-5
    gradient = batch.vjp(every[:1], result.z[:, 0], weights, tuple(moving))[0]
    slopes = equations.sensitivities_along(result.z[0, 0], every[0], np.eye(theta.size)).outputs
    np.testing.assert_allclose(gradient, np.einsum("dnc,nc->d", slopes, weights[0]))


def test_memory_of_a_batch_does_not_grow_with_its_vectors(monkeypatch):
    """They are solved in parts, with the values of one part; only outputs and states of all are kept."""
    equations, theta = equations_of(12, "jenkins")
    z = equations.find(theta, None)[0].z
    anchor = Anchor.of(
        equations, theta, z, equations.sensitivities_along(z, theta, np.eye(theta.size)), np.arange(theta.size)
    )
    batch = CondensedBatch([equations], [anchor])
    every = theta * np.exp(0.002 * np.random.default_rng(0).standard_normal((60, theta.size)))
    left_out = np.arange(60)[None] == 31
    whole = batch.solve(every, keep=True, without=left_out)
    monkeypatch.setattr(condensed_batch, "MOST_RESPONSE_NUMBERS", 8 * len(z))
    parts = batch.solve(every, keep=True, without=left_out)
    for one, other in zip(whole, parts, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
    peaks = []
    for count in (60, 300):
        tracemalloc.start()
        outputs = batch.solve(np.tile(every, (count // 60, 1))).outputs
        peaks.append(tracemalloc.get_traced_memory()[1] - 3 * outputs.nbytes)
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0]


def test_branch_over_a_resonance_passes_the_solutions_of_the_symbolic_model():
    start = bp.solve_periodic(
        model(3, "jenkins"), VALUES["jenkins"], {"force": force()}, frequency=0.05, samples=SAMPLES
    )
    branch = bp.continue_periodic(model(3, "jenkins"), start, "frequency", until=0.09, progress=False)
    assert branch.complete
    (there,) = bp.solutions_at(model(3, "jenkins"), branch, 0.07)
    other = bp.solve_periodic(
        model(3, "jenkins", False), VALUES["jenkins"], {"force": force(1024)}, frequency=0.07, samples=1024,
        scheme="central4",
    )  # fmt: skip
    assert largest(there.outputs["x"] - other.outputs["x"][::16], there.outputs["x"]) < 5e-5


def element(force, **constants):
    return bp.Model.from_matrices(
        "odd", mass=np.eye(12), stiffness=chain(12), damping={"alpha": np.eye(12)}, forces={"force": 11},
        outputs={"x": (11, "displacement")}, elements=[Element("part", force, 11, constants)],
    )  # fmt: skip


def test_internal_state_whose_mean_is_arbitrary_is_no_solution():
    """A spring written as the integral of its velocity."""
    made = element(lambda v, s, name, k: Hysteretic(k * s[name], (s["d" + name] - v,)))
    solution = bp.solve_periodic(
        made, {"alpha": 0.1, "part_k": 1.0}, {"force": force()}, frequency=FREQUENCY, samples=SAMPLES
    )
    assert not solution.converged


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (lambda v, s, name, k: Hysteretic(k * s[name], (s["d" + name] ** 3 - v,)), "linear in their first derivatives"),
        (lambda v, s, name, k: Hysteretic(k * s[name], (s[name] - v,)), "linear in their first derivatives"),
        (lambda v, s, name, k: Hysteretic(k * s[name], ()), "must have one equation per internal state"),
        (lambda v, s, name, k: Hysteretic(k * s["d" + name], (s["d" + name] - v,)), "must have forces of d, v"),
    ],
)
def test_internal_states_that_cannot_be_condensed_are_refused(given, message):
    with pytest.raises(ValueError, match=f"elements: .*{message}"):
        element(given)


@pytest.mark.parametrize("points", [400, 51])
def test_motion_of_elements_on_any_grid_is_that_on_the_next_power_of_two(points):
    """The motion is a harmonic series of few terms, whose values are known everywhere."""
    model = bp.Model.from_matrices(
        "two", mass=np.eye(2), stiffness=chain(2), forces={"force": 0}, outputs={"x": (1, "displacement")},
        elements=[Element("joint", bp.elements.jenkins, (1, 0), {"width": 0.1})], condensed=True,
    )  # fmt: skip

    def motion(count):
        tau = 2 * np.pi * np.arange(count)[:, None] / count
        return 0.3 + np.cos(tau) * [1.0, 2.0] + np.sin(3 * tau) * [0.5, -0.2]

    equations = CondensedEquations.build(model, {"force": force(points)}, frequency=0.1, samples=points)
    finer = motion(1 << (points - 1).bit_length())
    np.testing.assert_allclose(equations.reduced(motion(points))[:, 0], finer[:, 1] - finer[:, 0], atol=1e-13)


def test_estimate_with_noisy_force_on_400_points_is_that_of_the_symbolic_model():
    """Both see one recording; a tenth of a standard deviation is more than the grids differ by."""
    stiffness = 1e4 * chain(2)
    joint = Element("joint", bp.elements.jenkins, (1, 0), {"width": 0.1})
    true = {"beta": 2e-3, "joint_stiffness": 5e3, "joint_limit": 3.0}
    fits = []
    for condensed_too in (False, True):
        model = bp.Model.from_matrices(
            "frame", mass=np.diag([2.0, 1.0]), stiffness=stiffness, damping={"beta": stiffness}, forces={"force": 0},
            outputs={"stretch": ((1, 0), "displacement")}, elements=[joint], condensed=condensed_too,
        )  # fmt: skip
        if not condensed_too:
            load = {"force": 40 * np.cos(2 * np.pi * np.arange(64) / 64)}
            noise = {"stretch": 1e-4, "force": 2.0}
            run = bp.simulate(model, true, load, frequency=7, duration=4, sampling_rate=1000, noise=noise, seed=1)
        priors = {name: bp.LogNormal(value, 1) for name, value in true.items()}
        problem = bp.Problem(model, [run.between(2, 4).fold(400)], priors=priors)
        fits.append(bp.map_estimate(problem, start=true, progress=False))
    symbolic, other = fits
    assert symbolic.converged and other.converged and set(symbolic.input_errors) == set(other.input_errors)
    for name, sd in symbolic.sd.items():
        assert abs(other.theta[name] - symbolic.theta[name]) < 0.1 * sd
        assert other.sd[name] == pytest.approx(sd, rel=0.03)


@pytest.mark.parametrize("limit", [1.0, 100.0])
@pytest.mark.parametrize("frequency", [0.05, 0.09])
def test_derivatives_exist_while_a_joint_sticks_and_are_those_of_a_spring(frequency, limit):
    """The joint hardly forgets then, and corrections of the derivatives end in its rounding errors.

    Closed form: a spring in place of the joint, whose force is at most a twentieth of its limit.
    """
    wave, w = 0.01 * np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES), 2 * np.pi * frequency
    values = LINEAR | {"joint_stiffness": 0.5, "joint_limit": limit}
    solved = bp.solve_periodic(model(3, "jenkins"), values, {"force": wave}, frequency=frequency, samples=SAMPLES)
    assert solved.converged

    def amplitude(stiffness):
        springs = LINEAR["k"] * chain(3)
        damping = LINEAR["alpha"] * np.eye(3) + LINEAR["beta"] * chain(3)
        springs[2, 2] += stiffness
        return np.linalg.solve(springs + 1j * w * damping - w**2 * np.eye(3), [0, 0, 0.01])[2]

    step = 1e-4
    slope = (amplitude(0.5 + step) - amplitude(0.5 - step)) / (2 * step)
    ours = solved.sensitivities["x"]["joint_stiffness"]
    exact = (slope * np.exp(2j * np.pi * np.arange(SAMPLES) / SAMPLES)).real
    np.testing.assert_allclose(ours - ours.mean(), exact, atol=1e-3 * np.abs(exact).max())
