import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from studies.__main__ import main
from studies.animations import film, newton, section

LARGEST = 2_000_000


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Return the folder and the results of a quick run."""
    folder = tmp_path_factory.mktemp("animations")
    assert main(["animations", "--quick", "--out", str(folder)]) == 0
    return folder, json.loads((folder / "results.json").read_text("utf-8"))


@pytest.fixture(scope="module")
def iterates():
    return newton.iterate()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["newton", "section"])
def test_animations_are_small_and_have_every_frame(quick, name):
    folder, results = quick
    path = folder / f"{name}.gif"
    assert path.stat().st_size == results[name]["bytes"] < LARGEST
    with Image.open(path) as picture:
        milliseconds = 0
        for number in range(picture.n_frames):
            picture.seek(number)
            milliseconds += picture.info["duration"]
    # Equal frames are stored once, with a longer duration.
    assert picture.n_frames > results[name]["frames"] / 2
    assert milliseconds * film.FRAMES_PER_SECOND / 1000 == pytest.approx(results[name]["frames"])


@pytest.mark.slow
def test_quick_runs_draw_every_eighth_frame(quick):
    _, results = quick
    assert results["section"]["frames"] == -(-section.FRAMES // 8)
    iterations = len(results["newton"]["residuals_n"]) - 1
    moving = iterations * (newton.MOVING + newton.WAITING) + 2 * newton.WAITING
    whole = moving + newton.PERIODS * newton.STEPS_PER_PERIOD + newton.LAST
    assert results["newton"]["frames"] == -(-whole // 8)


def test_the_committed_animations_are_small():
    for name in ("newton", "section"):
        assert 100_000 < Path(f"figures/animations/{name}.gif").stat().st_size < LARGEST


@pytest.mark.slow
def test_newton_decreases_the_residual_at_last_quadratically(iterates):
    residuals = iterates.residuals
    assert (np.diff(residuals) < 0.0).all() and residuals[-1] < newton.ACCURACY < 1e-9 * residuals[0]
    # The error is squared, times a constant of order 1, once it is small.
    small = np.flatnonzero((residuals[:-1] < 0.05) & (residuals[1:] > 1e-11))
    assert small.size and (residuals[small + 1] < 10.0 * residuals[small] ** 2).all()


@pytest.mark.slow
def test_velocities_are_the_derivative_of_displacements(iterates):
    omega = 2 * np.pi * newton.FREQUENCY
    expected = -omega * (1.8 * np.sin(newton.TAU - 2.7) + 0.75 * np.sin(5 * newton.TAU))
    assert np.allclose(iterates.rate[0], expected, atol=1e-12)


@pytest.mark.slow
def test_newton_ends_at_the_solution_of_the_package(quick):
    assert quick[1]["newton"]["difference_from_solve_periodic_m"] < 1e-9


@pytest.mark.slow
def test_the_integration_departs_by_the_multiplier(quick):
    results = quick[1]["newton"]
    assert results["multiplier"] > 1.5
    assert results["growth_per_period"] == pytest.approx(results["multiplier"], rel=0.2)
    distances = np.array(results["distances_m"])
    # From period 2, when the stable component has decayed, to period 8.
    assert (distances[8] / distances[2]) ** (1 / 6) == pytest.approx(results["multiplier"], rel=0.2)
    assert distances[0] < 1e-3 and distances[-1] > 1.0


@pytest.mark.slow
def test_the_two_other_solutions_are_stable(iterates):
    solutions = newton.stable_solutions()
    assert all(solution.converged and solution.stable for solution in solutions)
    low, high = sorted(np.ptp(solution.states["x"]) for solution in solutions)
    assert low < np.ptp(iterates.x[-1]) < high


@pytest.mark.slow
def test_points_of_the_section_follow_the_orbit_and_leave_it(quick):
    results = quick[1]["section"]
    spread = np.array(results["spread"])
    assert results["passages"] >= 3 and results["multiplier"] > 1.0
    assert spread[0] < section.NEAR and (spread[:2] < 3.0 * section.NEAR).all()
    assert spread[section.PERIOD] > 3.0 * spread[0] and spread[-1] > 10.0 * spread[0]
