from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
from studies import shooting
from tests.pendulum import GENTLE, PENDULUM, SAMPLES, measured, rates_and_angles, section_problem

PHI = {"phi": "angle"}


@pytest.fixture(scope="module")
def polished() -> bp.Orbit:
    return bp.polish_orbits(bp.models.pendulum, [measured(GENTLE[2])], PENDULUM, samples=400)[0]


def test_section_points_are_compared_once_a_forcing_period(polished):
    run = polished.experiment(samples=200)
    assert (run.periods, run.winding, run.samples) == (4, {"phi": 4}, 200) and run.synthetic
    assert np.flatnonzero(run.mask).tolist() == [0, 200, 400, 600]
    values = np.stack([run.outputs["angle"][run.mask], run.outputs["rate"][run.mask]], axis=-1)
    assert values == pytest.approx(polished.points) and run.covariance == pytest.approx(polished.covariance)
    assert section_problem([run], "l", "k3").noise_names == ("scale",)


def test_the_first_solve_starts_from_the_solution_or_from_the_measured_cycle(polished):
    exact = rates_and_angles(GENTLE[2], 200)[:, 0]
    for run, off in ((polished.experiment(samples=200), 1e-6), (polished.experiment(samples=200, states=PHI), 0.02)):
        turns = 2 * np.pi * np.round((run.guess["phi"] - exact)[0] / (2 * np.pi))
        assert run.guess["phi"] - turns == pytest.approx(exact, abs=off)
    unpolished = measured(GENTLE[2]).experiment(samples=200, states=PHI)
    assert unpolished.winding == 4 and unpolished.guess["phi"] == pytest.approx(run.guess["phi"])


def test_a_search_without_orbits_says_what_to_try():
    assert repr(bp.Orbits(())).startswith("Orbits(none, 0 rejected): try more periods, sections at several phases")


def test_the_residual_of_exact_points_vanishes():
    """With exact points the log-likelihood at scale 1 is that of no residual, whatever the turns of the angle."""
    exact = measured(GENTLE[2], noise=1e-9)
    run = bp.polish_orbits(bp.models.pendulum, [exact], PENDULUM)[0].experiment()
    run = replace(run, covariance=np.diag(np.tile([1e-6, 1e-4], 4)))
    problem = section_problem([run], "l")
    assert float(problem.log_likelihood({"l": 0.3}, {"scale": 1.0})) == pytest.approx(0.0, abs=1e-6)


def test_unstable_eigenvalues_keep_their_covariance_with_the_points(polished):
    joint = polished.joint_covariance.copy()
    joint[-2, :8] = joint[:8, -2] = 1e-6
    run = replace(polished, joint_covariance=joint).experiment(samples=200, multipliers=True)
    assert run.multipliers == pytest.approx([-7.0688], abs=1e-4)
    assert run.covariance.shape == (9, 9) and run.covariance == pytest.approx(joint[:9, :9])


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"joint_covariance": np.diag([*np.ones(8), np.nan, np.nan])}, "not estimated"),
        ({"eigenvalue_bias": np.array([0.011, 0.0])}, "its bias exceeds half its standard deviation"),
        ({"eigenvalues": np.array([2.0 + 1.0j, 2.0 - 1.0j])}, "complex"),
    ],
)
def test_unusable_eigenvalues_are_left_out_with_a_warning(polished, change, why):
    with pytest.warns(UserWarning, match=f"The eigenvalue .* is left out: it is .*{why}"):
        run = replace(polished, **change).experiment(samples=200, multipliers=True)
    assert run.multipliers is None and run.covariance.shape == (8, 8)


def test_a_stable_eigenvalue_is_left_out_without_a_warning(polished):
    stable = replace(polished, eigenvalues=np.array([0.5, 0.1]))
    assert stable.experiment(samples=200, multipliers=True).multipliers is None


def test_the_whole_cycle_is_compared_at_its_measured_points(polished):
    run = polished.experiment(samples=2 * SAMPLES, whole=True, multipliers=True)
    assert run.covariance is None and np.flatnonzero(run.mask).tolist() == list(range(0, 800, 2))
    assert run.outputs["rate"][::2] == pytest.approx(polished.cycle["rate"])
    assert run.multiplier_sd == pytest.approx([0.02])
    fit = bp.map_estimate(section_problem([run], "l"), start={"l": 0.35}, progress=False)
    assert abs(fit.theta["l"] - 0.3) < 4 * fit.sd["l"] < 1e-3


def test_missing_information_raises():
    bare = measured(shooting.UNSTABLE[0], cycle=False)
    with pytest.raises(ValueError, match="winding: must be known, got None for .* Use polish_orbits"):
        bare.experiment()
    with pytest.raises(ValueError, match="states: must name the coordinate .*, got None; .* is not polished"):
        measured(GENTLE[0]).experiment()
    with pytest.raises(ValueError, match="states: must be one of 'angle', 'rate', got 'rat'"):
        measured(GENTLE[0]).experiment(states={"phi": "rat"})
    polished = bp.polish_orbits(bp.models.pendulum, [bare], PENDULUM, samples=400)[0]
    with pytest.raises(ValueError, match="whole: must be False, got True; .* has no measured cycle"):
        polished.experiment(whole=True)
    with pytest.raises(ValueError, match="samples: must be a multiple of the cycle's 100 a forcing period, got 150"):
        measured(GENTLE[0]).experiment(samples=150, whole=True, states=PHI)
