"""Places of jumps, frequencies and amplitudes of resonances: densities against their formulas, and derivatives."""

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.likelihood.block import ComparedSignals
from bayesperiodic.likelihood.jump import Jump
from bayesperiodic.likelihood.resonance import Resonance
from tests.known import difference

MODEL = bp.models.duffing
NONE = np.empty(0)


def signals(frequency, scale=1.0, values=None) -> ComparedSignals:
    values = np.zeros((8, 0)) if values is None else values
    return ComparedSignals(values, NONE, np.asarray(frequency, dtype=float), np.asarray(scale, dtype=float))


def jump_block(**changes) -> Jump:
    given = {"direction": "up", "step": 0.01} | changes
    (block,) = Jump.of(bp.jump("jump", 0.5, {"force": 2.0}, **given), MODEL)
    return block


@pytest.mark.parametrize("direction, low, high", [("up", 0.49, 0.5), ("down", 0.5, 0.51)])
def test_the_density_of_a_fold_is_that_of_an_interval_before_the_first_point_after_the_jump(direction, low, high):
    block, sd = jump_block(direction=direction), 0.001
    places = np.linspace(low - 0.02, high + 0.02, 101)
    r = block.compare(signals(places), None)[..., 0]
    density = -0.5 * r**2 - 0.5 * np.log(2 * np.pi) + block.log_scale
    upper, lower = (high - places) / sd, (low - places) / sd
    with np.errstate(divide="ignore"):
        middle = np.log(stats.norm.cdf(upper) - stats.norm.cdf(lower))
    inside = (places > low - 0.005) & (places < high + 0.005)
    np.testing.assert_allclose(density[inside], middle[inside], atol=1e-9)
    # Far outside, the tail of the nearer end alone.
    tail = np.where(places < low, stats.norm.logsf(lower), stats.norm.logcdf(upper))
    np.testing.assert_allclose(density[~inside], tail[~inside], rtol=1e-9)
    assert np.all(np.diff(r) <= 0.0)


@pytest.mark.parametrize("given", [{}, {"direction": "down"}, {"step": None, "sd": 0.003}])
def test_the_derivative_of_a_jump_s_residual_is_its_difference(given):
    block, one = jump_block(**given), signals(np.ones(1))
    for place in (0.47, 0.488, 0.4903, 0.4948, 0.499, 0.5005, 0.5052, 0.53):
        numeric = -difference(lambda h, p=place: block.compare(signals(p + h), None)[0], 0.0, 1e-5)
        np.testing.assert_allclose(block.changes(signals(place), one)[0, 0], numeric, rtol=1e-5, atol=1e-6)


def test_the_derivative_in_the_middle_of_a_narrow_interval_is_finite_and_right():
    """A step of 10 standard deviations has the slope √(2·5·φ(5)/(2Φ(5) − 1))/s = 0.003856/s there."""
    block = jump_block()
    slope = block.changes(signals(0.495), signals(np.ones(1)))[0, 0]
    np.testing.assert_allclose(slope, np.sqrt(10 * stats.norm.pdf(5) / (2 * stats.norm.cdf(5) - 1)) / 0.001, rtol=1e-9)


def test_a_jump_in_the_level_is_compared_by_the_scale_of_its_input():
    block = jump_block(vary="force", step=None, sd=0.1)
    np.testing.assert_allclose(block.compare(signals(0.7, 1.2), None), [(1.0 - 1.2) / 0.05])
    np.testing.assert_allclose(block.changes(signals(0.7, 1.2), signals(np.array([3.0]), np.array([0.5]))), [[10.0]])


def test_frequency_and_amplitude_of_a_resonance_are_in_units_of_their_standard_deviations():
    point = bp.resonance_point(
        "point", 0.5, {"displacement": 0.3}, {"force": 1.0}, frequency_sd=0.01, amplitude_sd=0.02, samples=16
    )
    (block,) = Resonance.of(point, MODEL)
    wave = 0.34 * np.cos(2 * np.pi * np.arange(16) / 16 - 1.0) + 0.1
    residual = block.compare(signals(0.47, values=wave[:, None]), None)
    np.testing.assert_allclose(residual, [3.0, -2.0])
    assert block.log_scale == pytest.approx(-np.log(0.01) - np.log(0.02))
    generator = np.random.default_rng(1)
    moved = generator.standard_normal((16, 1))
    along = block.changes(signals(0.47, values=wave[:, None]), signals(np.array([0.3]), values=moved[None]))[0]
    numeric = -difference(
        lambda h: block.compare(signals(0.47 + 0.3 * h, values=wave[:, None] + h * moved), None), 0.0, 1e-4
    )
    np.testing.assert_allclose(along, numeric, rtol=1e-7)
    weights, total = np.array([0.7, -1.3]), signals(np.zeros(()), values=np.zeros((16, 1)))
    block.add_vjp(signals(0.47, values=wave[:, None]), weights, total)
    expected = weights @ along
    np.testing.assert_allclose(np.sum(total.values * moved) + 0.3 * total.frequency, expected, rtol=1e-9)


def test_the_amplitude_is_no_data_where_it_determines_the_level():
    point = bp.resonance_point("point", 0.5, {"displacement": 0.3}, {"force": None}, frequency_sd=0.01)
    (block,) = Resonance.of(point, MODEL)
    np.testing.assert_allclose(block.compare(signals(0.52, values=np.ones((400, 1))), None), [-2.0])
    phase = np.angle(np.fft.rfft(point.outputs["displacement"])[1])
    assert phase == pytest.approx(-np.pi / 2) and np.ptp(point.outputs["displacement"]) == pytest.approx(0.6)


@pytest.mark.parametrize(
    "call, text",
    [
        (lambda: bp.jump("j", 0.5, {"force": 1.0}, direction="both", step=0.1), "direction: must be"),
        (lambda: bp.jump("j", 0.5, {"force": 1.0}, direction="up"), "step: must be given, or sd"),
        (lambda: bp.jump("j", 0.5, {"force": 1.0}, direction="up", step=0.1, sd=0.1), "step: must be given, or sd"),
        (lambda: bp.jump("j", 0.5, {"force": 1.0}, direction="up", step=0.5), "step: must be less than"),
        (lambda: bp.jump("j", 0.5, {"force": 1.0}, direction="up", vary="x", sd=0.5), "vary: must be"),
        (lambda: bp.jump("j", 0.5, {"force": 0.0}, direction="up", vary="force", sd=0.5), "must not be zero"),
        (lambda: bp.jump("j", 0.5, {"force": "1"}, direction="up", sd=-0.5), "sd: must be"),
        (lambda: bp.jump("j", 0.5, 1.0, direction="up", sd=0.5), "inputs: must be a mapping"),
        (
            lambda: bp.jump("j", 0.5, {"force": 1.0}, direction="up", sd=0.5, samples="64"),
            "samples: must be an integer",
        ),
        (lambda: bp.resonance_point("r", 0.5, 1.0, {"force": None}, frequency_sd=0.1), "amplitude: must be a mapping"),
        (lambda: bp.resonance_point("r", 0.5, {"x": 1.0}, ["force"], frequency_sd=0.1), "inputs: must be a mapping"),
        (lambda: bp.resonance_point("r", 0.5, {}, {"force": 1.0}, frequency_sd=0.1), "amplitude: must be"),
        (lambda: bp.resonance_point("r", 0.5, {"x": 1.0}, {"force": 1.0}, frequency_sd=0.1), "amplitude_sd: must be"),
        (lambda: bp.resonance_point("r", 0.5, {"x": 1.0}, {}, frequency_sd=0.1), "inputs: must have"),
        (
            lambda: bp.resonance_point("r", 0.5, {"x": 1.0}, {"force": None}, frequency_sd=0.1, amplitude_sd=0.1),
            "amplitude_sd: must be 0",
        ),
        (
            lambda: bp.resonance_point("r", 0.5, {"x": 1.0}, {"f": None}, frequency_sd=0.1, harmonic=9, samples=16),
            "samples: must be at least 19",
        ),
        (
            lambda: bp.resonance_point("r", 0.5, {"x": 1.0}, {"f": 1.0, "g": None}, frequency_sd=0.1),
            "inputs: must have known levels",
        ),
    ],
)
def test_impossible_special_points_are_refused(call, text):
    with pytest.raises(ValueError, match=text):
        call()
