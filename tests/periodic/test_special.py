"""Folds and points of given phase against harmonic balance in SciPy, closed forms and differences of these."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.periodic.compiled import CONVERGED, OTHER_ORBIT, STALLED
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.special import SpecialEquations
from bayesperiodic.periodic.special_batch import SpecialAnchor, SpecialBatch
from bayesperiodic.periodic.special_start import find_special, fold_equations, phase_equations
from tests import harmonic_balance
from tests.known import grid

THETA = (1.0, 0.1, 1.0, 0.5)
FORCE, LEVEL_OMEGA = 0.2, 2 * np.pi * 0.2
VALUES = np.array(THETA)


def driven(frequency: float, force: float = FORCE, samples: int = 32, scheme: str = "fourier") -> PeriodicEquations:
    wave = force * np.cos(2 * np.pi * grid(samples))
    return PeriodicEquations.build(
        bp.models.duffing, {"force": wave}, frequency=frequency, samples=samples, scheme=scheme
    )


def fold_case(vary: str, direction: str):
    """Return the equations of a fold and the function of θ that gives its place, by harmonic balance."""
    if vary == "frequency":
        return (
            fold_equations(driven(0.2), vary, direction),
            lambda theta: np.array([harmonic_balance.fold(theta, FORCE, direction)]),
        )
    return (
        fold_equations(driven(0.2), vary, direction),
        lambda theta: np.array([harmonic_balance.fold(theta, FORCE, direction, omega=LEVEL_OMEGA) / FORCE]),
    )


def phase_case(kind: str):
    """Return the equations of a point of given phase and the function of θ that gives frequency and scale."""
    if kind == "level known":
        return (
            phase_equations(driven(0.2), "displacement", "force", np.pi / 2),
            lambda theta: np.array(harmonic_balance.phase_resonance(theta, FORCE)[:1]),
        )
    return (
        phase_equations(driven(0.18, 1.0), "displacement", "force", 1.2, amplitude=0.8),
        lambda theta: np.array(harmonic_balance.backbone(theta, 0.8, 1.2)),
    )


CASES = {
    "frequency up": fold_case("frequency", "up"),
    "frequency down": fold_case("frequency", "down"),
    "level up": fold_case("force", "up"),
    "level down": fold_case("force", "down"),
    "phase": phase_case("level known"),
    "backbone": phase_case("level unknown"),
}


def anchor_of(special: SpecialEquations, theta=VALUES) -> SpecialAnchor:
    solved = find_special(special, theta)
    assert solved.code == CONVERGED
    return SpecialAnchor.at(special, theta, solved.point, np.arange(4))


@pytest.mark.parametrize("case", CASES)
def test_special_points_are_those_of_harmonic_balance(case):
    special, reference = CASES[case]
    found = find_special(special, VALUES)
    assert found.code == CONVERGED
    np.testing.assert_allclose(found.point.values, reference(THETA), rtol=1e-7)


@pytest.mark.parametrize("case", CASES)
def test_derivatives_of_the_place_are_those_of_harmonic_balance(case):
    special, reference = CASES[case]
    slopes = anchor_of(special).sensitivities.point.values
    for i, one in enumerate(np.eye(4)):
        expected = (reference(tuple(VALUES + 1e-4 * one)) - reference(tuple(VALUES - 1e-4 * one))) / 2e-4
        np.testing.assert_allclose(slopes[i], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_derivatives_of_states_outputs_and_null_vector_are_differences_of_newton_solves(case):
    special, _ = CASES[case]
    anchor = anchor_of(special)
    row = special.row(anchor.point.vector) if special.is_fold else anchor.point.vector

    def at(theta):
        point = special.newton(anchor.point, theta, row).point
        return point, special.at(point.values).outputs(point.z, theta)

    for i, one in enumerate(1e-5 * np.eye(4)):
        (above, outputs_above), (below, outputs_below) = at(VALUES + one), at(VALUES - one)
        for slope, up, down in zip(anchor.sensitivities.point, above, below, strict=True):
            np.testing.assert_allclose(slope[i], (up - down) / 2e-5, atol=1e-6 * max(1.0, np.abs(slope[i]).max()))
        expected = (outputs_above - outputs_below) / 2e-5
        np.testing.assert_allclose(anchor.sensitivities.outputs[i], expected, atol=1e-6 * np.abs(expected).max() + 1e-9)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("spread", [0.01, 0.1])
def test_batches_agree_with_harmonic_balance_near_and_far_from_the_anchor(case, spread):
    special, reference = CASES[case]
    theta = VALUES * np.exp(spread * np.random.default_rng(2).standard_normal((6, 4)))
    solution = SpecialBatch([special], [anchor_of(special)]).solve(theta[None], 1)
    assert np.all(solution.status == CONVERGED)
    for values, parameters in zip(solution.values[0], theta, strict=True):
        np.testing.assert_allclose(values, reference(tuple(parameters)), rtol=1e-7)


def test_a_linear_oscillator_lags_by_90_degrees_at_its_natural_frequency_and_its_level_is_damping_times_velocity():
    m, c, k = 2.0, 0.3, 5.0
    theta, natural = np.array([m, c, k, 0.0]), np.sqrt(k / m) / (2 * np.pi)
    known = find_special(phase_equations(driven(0.3), "displacement", "force", np.pi / 2), theta)
    np.testing.assert_allclose(known.point.values, [natural], rtol=1e-9)
    backbone = phase_equations(driven(0.3, 1.0), "displacement", "force", np.pi / 2, amplitude=0.7)
    np.testing.assert_allclose(
        find_special(backbone, theta).point.values, [natural, c * np.sqrt(k / m) * 0.7], rtol=1e-9
    )


def test_a_lag_of_45_degrees_is_at_the_half_power_frequency():
    m, c, k = 2.0, 0.3, 5.0
    expected = (np.sqrt(c**2 + 4 * k * m) - c) / (2 * m) / (2 * np.pi)  # k − mω² = cω
    special = phase_equations(driven(0.25), "displacement", "force", np.pi / 4)
    np.testing.assert_allclose(find_special(special, np.array([m, c, k, 0.0])).point.values, [expected], rtol=1e-9)


def test_the_other_fold_is_another_orbit_and_a_linear_system_has_none():
    up, down = CASES["frequency up"][0], CASES["frequency down"][0]
    point = find_special(down, VALUES).point
    assert up.newton(point, VALUES, up.row(point.vector)).code == OTHER_ORBIT
    assert find_special(up, np.array([1.0, 0.1, 1.0, 0.0])).code == STALLED


def test_where_the_folds_have_vanished_the_status_is_not_converged():
    """With strong damping Duffing's resonance is single-valued: harmonic balance of one harmonic needs c < 0.144."""
    special = CASES["frequency up"][0]
    batch = SpecialBatch([special], [anchor_of(special)])
    theta = VALUES * np.array([[1.0, 1.0, 1.0, 1.0], [1.0, 3.0, 1.0, 1.0], [1.0, 1.0, 1.0, 0.05]])
    status = batch.solve(theta[None], 1).status[0]
    assert status[0] == CONVERGED and np.all(status[1:] != CONVERGED)


def test_solutions_do_not_depend_on_the_company_or_the_number_of_threads():
    special = fold_equations(driven(0.21), "frequency", "up")
    batch = SpecialBatch([special] * 2, [anchor_of(special)] * 2)
    theta = VALUES * np.exp(0.05 * np.random.default_rng(3).standard_normal((16, 4)))
    every = np.stack([theta, theta[::-1]])
    one, two = batch.solve(every, 1), batch.solve(every, 2)
    alone = SpecialBatch([special], [anchor_of(special)]).solve(theta[None, 7:8], 1)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)
    for part, single in zip(one, alone, strict=True):
        np.testing.assert_array_equal(part[0, 7], single[0, 0])
        np.testing.assert_array_equal(part[1, 8], single[0, 0])


def test_a_batch_is_exact_whatever_its_anchor():
    special, reference = CASES["frequency up"]
    other = anchor_of(special, VALUES * np.array([1.0, 0.8, 1.1, 1.3]))
    solution = SpecialBatch([special], [other]).solve(VALUES[None, None], 1)
    np.testing.assert_allclose(solution.values[0, 0], reference(THETA), rtol=1e-7)


def test_an_input_of_known_level_stays_as_it_is_where_another_is_scaled():
    model = bp.Model(
        "two_forces",
        states=["x"],
        inputs=["f", "g"],
        parameters=["c", "k"],
        equations=lambda s, p, u: [s.ddx + p.c * s.dx + p.k * s.x - u.f - u.g],
        outputs=lambda s, p, u: {"x": s.x},
    )
    wave = np.cos(2 * np.pi * grid(32))
    equations = PeriodicEquations.build(
        model, {"f": wave, "g": 0.1 * wave}, frequency=0.2, samples=32, scheme="fourier"
    )
    special = phase_equations(equations, "x", "f", np.pi / 2, amplitude=2.0)
    found = find_special(special, np.array([0.2, 1.0]))
    assert found.code == CONVERGED
    np.testing.assert_allclose(found.point.values, [0.5 / np.pi, 2.0 * 0.2 - 0.1], rtol=1e-8)
