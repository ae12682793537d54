import numpy as np
import pytest

from bayesperiodic.orbits.return_map import Atlas, ReturnMap

MATRIX = np.array([[1.2, -0.4], [0.3, 0.8]])
BEND = 0.7


def image(points):
    return points @ MATRIX.T + BEND * np.stack([points[:, 0] ** 2, points[:, 0] * points[:, 1]], axis=-1)


@pytest.fixture(scope="module")
def quadratic():
    """Return local maps of a quadratic map on the unit square, without noise, and their atlas."""
    points = np.random.default_rng(1).uniform(0.0, 1.0, (4000, 2))
    maps = ReturnMap(points, image(points) - points, np.full(2, np.inf), True, np.zeros(2))
    return maps, Atlas(maps, 72)


def test_a_quadratic_map_is_reproduced_between_the_centres(quadratic):
    _, atlas = quadratic
    points = np.random.default_rng(2).uniform(0.1, 0.9, (200, 2))
    found, jacobian, bandwidth = atlas.at(points)
    assert found == pytest.approx(image(points), abs=1e-9)
    slopes = MATRIX + BEND * np.stack(
        [np.stack([2 * points[:, 0], 0 * points[:, 0]], -1), np.stack([points[:, 1], points[:, 0]], -1)], axis=1
    )
    assert jacobian == pytest.approx(slopes, abs=1e-7)
    assert np.isfinite(bandwidth).all()


def test_exact_fits_agree_with_the_atlas(quadratic):
    _, atlas = quadratic
    points = np.random.default_rng(3).uniform(0.1, 0.9, (50, 2))
    for one, other in zip(atlas.at(points)[:2], atlas.exactly(points)[:2], strict=True):
        assert one == pytest.approx(other, abs=1e-7)


def test_map_is_undefined_far_from_the_data(quadratic):
    _, atlas = quadratic
    assert np.isinf(atlas.at(np.array([[3.0, 3.0]]))[2]).all()
