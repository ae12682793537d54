"""Hopf points, the cycles that emerge there, and the solutions of a branch at one value."""

from dataclasses import replace

import numpy as np
import pytest

import bayesperiodic as bp
from studies.flutter.reference import RIG, SENSORS, hopf, settled

VALUES = RIG | SENSORS
# Where the published code finds the fold, in m/s.
FOLD = 14.936


@pytest.fixture(scope="module")
def branch():
    (point,) = bp.hopf_points(bp.models.flutter, VALUES, "U", between=(5.0, 25.0))
    first = bp.emerging_cycle(bp.models.flutter, point, amplitude={"alpha": 0.01}, samples=32, scheme="fourier")
    return bp.continue_periodic(bp.models.flutter, first, "U", until=14.0, step=1.0, progress=False)


def test_hopf_point_agrees_with_the_eigenvalues_of_the_published_matrices():
    (point,) = bp.hopf_points(bp.models.flutter, VALUES, "U", between=(5.0, 25.0))
    speed, frequency = hopf()
    assert point.value == pytest.approx(speed, rel=1e-9)
    assert point.frequency == pytest.approx(frequency, rel=1e-9)
    assert np.abs(point.mode).max() == pytest.approx(1.0)


def test_delays_and_sensors_of_an_estimate_do_not_move_the_hopf_point():
    """The oscillator's equilibrium is a centre at mu = 0, of the frequency omega/2π, in closed form."""
    estimate = {"mu": 0.8, "omega": 6.0, "shift[run 1]": 0.3, "gain[displacement]": 2.0, "shift": 0.1}
    (point,) = bp.hopf_points(bp.models.van_der_pol, estimate, "mu", between=(-1.0, 1.5))
    assert abs(point.value) < 1e-9 and point.frequency == pytest.approx(3.0 / np.pi, rel=1e-9)
    with pytest.raises(ValueError, match=r"parameters: must be one of .*, got 'mu\[run 1\]'"):
        bp.hopf_points(bp.models.van_der_pol, estimate | {"mu[run 1]": 0.8}, "mu", between=(-1.0, 1.5))


def test_equilibria_that_do_not_change_have_no_hopf_point():
    assert bp.hopf_points(bp.models.flutter, VALUES, "U", between=(5.0, 15.0)) == ()


def test_small_cycles_lead_back_to_the_hopf_point():
    """The speed falls with the square of the amplitude, as at every Hopf point (S. Strogatz, 1994, section 8.2)."""
    (point,) = bp.hopf_points(bp.models.flutter, VALUES, "U", between=(5.0, 25.0))
    below = []
    for amplitude in (0.001, 0.002):
        cycle = bp.emerging_cycle(
            bp.models.flutter, point, amplitude={"alpha": amplitude}, samples=32, scheme="fourier"
        )
        assert cycle.converged and not cycle.stable
        assert 2 * abs(np.fft.rfft(cycle.states["alpha"])[1]) / 32 == pytest.approx(amplitude, rel=1e-9)
        below.append(point.value - cycle.parameters["U"])
    assert below[0] > 0.0 and below[1] / below[0] == pytest.approx(4.0, rel=1e-2)


def test_flutter_is_subcritical_with_the_published_fold(branch):
    assert branch.folds[0].parameters["U"] == pytest.approx(FOLD, abs=1e-3)
    assert branch.complete and len(branch.folds) == 1
    inner, outer = bp.solutions_at(bp.models.flutter, branch, 16.0)
    assert (inner.stable, outer.stable) == (False, True)
    assert np.ptp(inner.states["alpha"]) < 0.6 * np.ptp(outer.states["alpha"])


@pytest.mark.parametrize("speed", [15.6, 16.5, 17.3])
def test_stable_cycles_agree_with_time_integration(branch, speed):
    (orbit,) = (s for s in bp.solutions_at(bp.models.flutter, branch, speed) if s.stable)
    frequency, states = settled(speed)
    assert orbit.frequency == pytest.approx(frequency, rel=1e-7)
    for values, state in zip(states, ("h", "alpha", "w"), strict=True):
        found = np.abs(np.fft.rfft(orbit.states[state]))[1:4] / 32
        assert found == pytest.approx(np.abs(np.fft.rfft(values))[1:4] / values.size, rel=1e-5, abs=1e-9)


def test_error_for_a_value_without_an_orbit_names_the_fold(branch):
    with pytest.raises(ValueError, match=r"got U = 14.5 m/s; the nearest orbit is at its fold at"):
        bp.solutions_at(bp.models.flutter, branch, 14.5)
    with pytest.raises(ValueError, match=r"got U = 20 m/s; the nearest orbit is at its end at 18.07"):
        bp.solutions_at(bp.models.flutter, branch, 20.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": bp.models.pendulum}, "model: must be autonomous, got 'pendulum', which is driven"),
        ({"vary": "V"}, "vary: must be .*got 'V'"),
        ({"between": (20.0, 10.0)}, "between: must be in ascending order, got .20.0, 10.0."),
        ({"parameters": {"b": 0.15}}, "parameters: "),
    ],
)
def test_bad_arguments_of_hopf_points_are_refused(changes, message):
    given = {"model": bp.models.flutter, "parameters": VALUES, "vary": "U", "between": (5.0, 25.0)} | changes
    with pytest.raises(ValueError, match=message):
        bp.hopf_points(given["model"], given["parameters"], given["vary"], between=given["between"])


def test_bad_amplitudes_are_refused():
    (point,) = bp.hopf_points(bp.models.flutter, VALUES, "U", between=(5.0, 25.0))
    for amplitude, message in (({"beta": 1.0}, "got 'beta'"), ({}, "must be that of one state")):
        with pytest.raises(ValueError, match=message):
            bp.emerging_cycle(bp.models.flutter, point, amplitude=amplitude)
    still = replace(point, mode=np.array([1.0, 0.0, 0.5j]))
    with pytest.raises(ValueError, match=r"must be of a state that the oscillation moves, \['h', 'w'\], got 'alpha'"):
        bp.emerging_cycle(bp.models.flutter, still, amplitude={"alpha": 0.01})
    with pytest.raises(ValueError, match="must be 'flutter', as of the point"):
        bp.emerging_cycle(bp.models.van_der_pol, point, amplitude={"x": 1.0})
