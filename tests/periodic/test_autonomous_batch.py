"""Orbits of unknown frequency that are followed together: against dense algebra, closed forms, solves one by one."""

import numpy as np
import pytest
import sympy as sp

import bayesperiodic as bp
from bayesperiodic.periodic.batch import Anchor, AutonomousBatch, phase_bordered
from bayesperiodic.periodic.compiled import CONVERGED, kernels
from bayesperiodic.periodic.equations import PeriodicEquations
from tests.known import grid
from tests.periodic.test_factors import SCHEMES, dense

# Van der Pol's oscillator with a frequency-dependent spring, so that ∂g/∂f has every term.
ODD = bp.Model(
    "odd_oscillator",
    states=["x"],
    parameters=["mu", "c"],
    equations=lambda s, p, u: [s.ddx - p.mu * (1 - s.x**2) * s.dx + (1 + p.c * s.frequency) * s.x],
    outputs=lambda s, p, u: {"x": s.x, "rate": s.dx},
)
TURNING = bp.Model(
    "turning",
    states=["phi"],
    parameters=["w", "a"],
    angles=["phi"],
    equations=lambda s, p, u: [s.dphi - p.w + p.a * sp.sin(s.phi)],
    outputs=lambda s, p, u: {"rate": s.dphi},
)


def built(model, frequency, samples, scheme, winding=0):
    return PeriodicEquations.build(model, {}, frequency=frequency, samples=samples, scheme=scheme, winding=winding)


def solved(mu, c=0.3, samples=40, scheme="central4"):
    guess = {"x": 2 * np.cos(2 * np.pi * grid(samples))}
    return bp.solve_periodic(ODD, {"mu": mu, "c": c}, frequency=0.16, samples=samples, scheme=scheme, guess=guess)


def anchor_of(solution, scheme="central4"):
    equations = built(ODD, solution.frequency, solution.samples, scheme)
    z = np.ascontiguousarray(solution.states["x"][:, None])
    return equations, Anchor.at(equations, np.array(list(solution.parameters.values())), z)


def batch(scheme="central4", *mus):
    return AutonomousBatch(*zip(*(anchor_of(solved(mu, scheme=scheme), scheme) for mu in mus), strict=True))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_bordered_solve_and_orientation_agree_with_dense_algebra(scheme):
    """At an orbit, where ∂g/∂z is nearly singular, and away from it; ∂g/∂f by central differences."""
    solution, generator, signs = solved(0.8, samples=21, scheme=scheme), np.random.default_rng(1), set()
    for spread in (0.0, *[1.0] * 12):
        z = solution.states["x"][:, None] + spread * generator.standard_normal((21, 1))
        theta, f, h = np.array([0.8, 0.3]), solution.frequency, 1e-5
        equations = built(ODD, f, 21, scheme)
        bordered, row = phase_bordered(equations, theta, z), equations.phase_row(z)
        above, below = (built(ODD, f + sign * h, 21, scheme).residual_jacobian(z, theta)[:, 0] for sign in (1, -1))
        matrix = dense(equations, equations.residual_jacobian(z, theta))
        whole = np.block([[matrix, (above - below)[:, None] / (2 * h)], [row.reshape(1, -1), np.zeros((1, 1))]])
        flow = equations.states(z)[:, 1:2]
        assert row == pytest.approx(flow / np.linalg.norm(flow), abs=1e-12)
        assert bordered.orientation == np.linalg.slogdet(whole)[0]
        right = generator.standard_normal(22)
        x, change = bordered.solve_bordered(right[None, :21, None], right[None, 21:])
        expected = np.linalg.solve(whole, right)
        found = np.append(x, change)
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-6 * np.abs(expected).max())
        signs.add(bordered.orientation)
    assert signs == {-1.0, 1.0}


def test_steps_near_an_anchor_converge_with_its_factors_alone():
    equations, anchor = anchor_of(solved(1.0))
    factors, row = phase_bordered(equations, anchor.parameters, anchor.z), equations.phase_row(anchor.z)
    target, theta, z = np.sum(row * anchor.z), anchor.parameters + np.array([0.01, 0.0]), anchor.z.copy()
    close, steps, frequency = kernels("autonomous", 1, equations.grid.stencil).broyden(
        equations.functions, equations.grid.packed, equations.setting(theta), factors.band, factors.pivots,
        factors.border, target, z, equations.states(z), z.copy(),
    )  # fmt: skip
    assert close and 2 <= steps <= 5
    assert frequency == pytest.approx(solved(1.01).frequency, rel=1e-9)
    assert equations.at_frequency(frequency).scaled_residual(z, theta) < 1e-9
    assert np.sum(row * z) == pytest.approx(target, abs=1e-12)


@pytest.mark.parametrize("scheme", ["central4", "fourier"])
def test_orbits_followed_near_and_far_agree_with_single_solves(scheme):
    mus = np.array([0.2, 0.7, 0.99, 1.0, 1.02, 1.5, 2.0])
    theta = np.stack([mus, np.full(mus.size, 0.1)], axis=-1)
    found = batch(scheme, 1.0, 0.6).solve(theta, keep=True)
    assert np.all(found.status == CONVERGED)
    for i, mu in enumerate(mus):
        alone = solved(mu, 0.1, scheme=scheme)
        for e in range(2):
            assert found.frequency[e, i] == pytest.approx(alone.frequency, rel=1e-4)
            equations = built(ODD, found.frequency[e, i], 40, scheme)
            assert equations.scaled_residual(found.z[e, i], theta[i]) < 1e-8
            assert found.outputs[e, i] == pytest.approx(equations.outputs(found.z[e, i], theta[i]), abs=1e-12)
            expected = np.abs(np.fft.rfft(alone.states["x"]))[1:6]
            assert np.abs(np.fft.rfft(found.outputs[e, i, :, 0]))[1:6] == pytest.approx(expected, rel=1e-4, abs=1e-3)


def test_an_angle_that_turns_has_the_frequency_of_the_closed_form_until_it_locks():
    """φ̇ = w − a sin φ turns with √(w² − a²)/2π, and stands still from a = w on (S. Strogatz, 1994, section 4.3)."""
    start = built(TURNING, np.sqrt(0.75) / (2 * np.pi), 49, "fourier", winding=1)
    guess = {"phi": 2 * np.pi * grid(49) + 0.3 * np.cos(2 * np.pi * grid(49))}
    orbit = bp.solve_periodic(
        TURNING, {"w": 1.0, "a": 0.5}, frequency=0.15, samples=49, scheme="fourier", winding=1, guess=guess
    )
    z = (orbit.states["phi"] - 2 * np.pi * grid(49))[:, None]
    own = AutonomousBatch([start], [Anchor.at(start.at_frequency(orbit.frequency), np.array([1.0, 0.5]), z)])
    a = np.array([0.3, 0.51, 0.8, 1.05, 1.3])
    found = own.solve(np.stack([np.ones(5), a], axis=-1))
    assert (found.status[0] == CONVERGED).tolist() == [True, True, True, False, False]
    assert found.frequency[0, :3] == pytest.approx(np.sqrt(1 - a[:3] ** 2) / (2 * np.pi), rel=1e-6)


def test_results_do_not_depend_on_threads_or_on_the_other_points():
    theta = np.stack([np.linspace(-0.5, 2.5, 13), np.full(13, 0.3)], axis=-1)
    together = batch("central4", 1.0, 0.6)
    one, several = together.solve(theta, 1), together.solve(theta, 3)
    backwards, alone = together.solve(theta[::-1].copy(), 2), together.solve(theta[5:6], 1)
    for part, other, reverse, single in zip(one, several, backwards, alone, strict=True):
        assert np.array_equal(part, other) and np.array_equal(part, reverse[:, ::-1])
        assert np.array_equal(part[:, 5:6], single)


def test_loss_of_one_orbit_rejects_the_others_only_with_whole():
    """With −μ the cycle shrinks through the equilibrium."""
    theta = np.stack([[-0.5, 0.5, 1.2], [0.3, 0.3, 0.3]], axis=-1)
    together = batch("central4", 1.0, 0.6)
    apart, whole = together.solve(theta), together.solve(theta, whole=True)
    assert (apart.status == CONVERGED).tolist() == [[False, True, True]] * 2
    assert np.all(whole.status[:, 0] == apart.status[0, 0]) and whole.iterations[1, 0] == 0 < apart.iterations[1, 0]
    for part, other in zip(apart, whole, strict=True):
        assert np.array_equal(part[:, 1:], other[:, 1:])


def test_unconverged_anchor_near_the_orbit_gives_the_exact_solution():
    equations, anchor = anchor_of(solved(1.0))
    guess = AutonomousBatch([equations], [Anchor(anchor.parameters, anchor.z, anchor.frequency)])
    found = guess.solve(np.array([[1.05, 0.3]]))
    assert found.status[0, 0] == CONVERGED
    assert found.frequency[0, 0] == pytest.approx(solved(1.05).frequency, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-8])
def test_shrunk_and_repeated_orbits_are_detected(size):
    tau = grid(60)
    start = np.stack([np.cos(2 * np.pi * tau), np.sin(2 * np.pi * tau) ** 3], axis=-1)
    waves = [np.stack([np.cos(2 * np.pi * k * tau), np.sin(2 * np.pi * 2 * k * tau)], axis=-1) for k in (1, 2, 3)]
    repeated = [False, False, True, True, False, size < 1e-6]
    judge = kernels("border", 1, (2, 5, 4))
    for z, repeats in zip((start, *waves, waves[1] + waves[2], waves[1] + size * start), repeated, strict=True):
        z = size * z + 5.0
        assert judge.has_shrunk(z, start) == (size < 1e-6)
        assert judge.has_shorter_period(z) == repeats
