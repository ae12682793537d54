"""Faults of sensors that mean periods show: saturation, holds, heavy tails, and phases that are missing."""

import re
import warnings

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.data import sensors
from bayesperiodic.data.harmonics import fit_harmonics
from bayesperiodic.data.signals import Signals

RATE, CYCLES, NOISE = 50, 60, 0.01
TIME = np.arange(CYCLES * RATE) / RATE
EXACT = np.array([0.0, np.exp(0.4j), 0.0, 0.2 * np.exp(1j)])
CLEAN = np.cos(2 * np.pi * TIME + 0.4) + 0.2 * np.cos(6 * np.pi * TIME + 1.0)


def noise(seed, size=NOISE):
    return size * np.random.default_rng(seed).standard_normal(TIME.size)


def recorded(values):
    return bp.Recording.from_arrays(TIME, {"x": values}, name="run")


def scores(experiment):
    """Return |error|²/variance of the first and third amplitude."""
    found = np.fft.rfft(experiment.outputs["x"])[:4] / experiment.outputs["x"].size * [1, 2, 2, 2]
    return (np.abs(found - EXACT) ** 2 / experiment.amplitude_variance["x"][:4])[[1, 3]]


@pytest.mark.parametrize("share", [0.1, 0.2, 0.4])
@pytest.mark.parametrize("both", [False, True])
def test_saturation_before_the_noise_is_named_with_its_level_and_share_and_not_refused(share, both):
    level = np.quantile(CLEAN, 1.0 - share / (1 + both))
    limited = np.clip(CLEAN, -level if both else -np.inf, level)
    run = recorded(limited + noise(0))
    check = run.check(1.0)
    (finding,) = check.findings
    assert (finding.kind, finding.severity) == ("saturated", "serious")
    assert finding.share == pytest.approx(share, abs=0.03)
    named = [float(v) for v in re.findall(r"-?\d\.\d+", finding.text.split(" from ")[0])]
    assert named == pytest.approx([-level, level] if both else [level], abs=0.003)
    assert "Either a sensor or a stop limits it" in finding.text
    assert "or it is limited itself, as a force of friction or contact" in finding.text
    change = (np.fft.rfft(limited - CLEAN)[: 4 * CYCLES : CYCLES]) / TIME.size
    expected = np.sqrt(np.abs(change) ** 2 @ [1, 2, 2, 2]) / (NOISE / np.sqrt(TIME.size))
    assert finding.bias == pytest.approx(expected, rel=0.1)
    with pytest.warns(UserWarning, match="run: x stays at"):
        run.fold(64, frequency=1.0)


def stick():
    """Return a displacement that rests for a tenth of each half cycle, and leaves its rest at no velocity."""
    place = TIME % 1.0
    moved = np.minimum(2 * np.pi * (place % 0.5) / 0.8, np.pi)
    return np.where(place < 0.5, -np.cos(moved), np.cos(moved))


PHASE = 2 * np.pi * TIME
FLAT = {
    **{f"tanh {a}": np.tanh(a * np.cos(PHASE)) for a in (1.5, 3.0, 10.0, 50.0)},
    "Coulomb friction": np.sign(np.cos(PHASE + 0.1)) + 0.3 * np.cos(PHASE),
    "contact": np.maximum(np.cos(PHASE) + 0.3, 0.0),
    "stick": stick(),
    "maximally flat": np.cos(PHASE) - np.cos(3 * PHASE) / 9,
    "pulse": np.exp(-0.5 * ((TIME % 1.0 - 0.5) / 0.05) ** 2),
}


@pytest.mark.parametrize("size", [0.0, 0.003, 0.01, 0.05])
@pytest.mark.parametrize("values", FLAT.values(), ids=[*FLAT])
def test_flat_tops_of_the_motion_itself_have_no_serious_findings(values, size):
    assert recorded(values + noise(1, size)).check(1.0).severity == "harmless"


def test_a_level_without_noise_is_no_refused_fault_of_a_sensor():
    """Without noise, a force that a valve limits is not told from a clipped sensor; with noise on the others it is."""
    limited = np.clip(np.cos(PHASE), -0.7, 0.7)
    with pytest.warns(UserWarning, match="Either a sensor or a stop limits it, .* or it is limited itself"):
        e = recorded(limited).fold(64, frequency=1.0)
    assert e.findings[0].kind == "saturated"
    with pytest.raises(ValueError, match="is clipped at -0.7 and 0.7"):
        recorded(np.clip(np.cos(PHASE) + noise(0), -0.7, 0.7)).fold(64, frequency=1.0)


@pytest.mark.parametrize(("length", "count", "step"), [(3, 20, 0.0), (5, 1, 0.0), (5, 100, 0.0), (8, 100, 0.002)])
def test_short_holds_are_found_and_left_out(length, count, step):
    """At least 95 % of the held samples are found, and 5 % of those found are chance at most."""
    values, held = CLEAN + noise(2), np.zeros(TIME.size, dtype=bool)
    values = step * np.round(values / step) if step else values
    for first in 8 + 24 * np.random.default_rng(0).choice(120, count, replace=False):
        values[first : first + length] = values[first]
        held[first : first + length] = True
    run = recorded(values)
    found = np.isin(np.arange(TIME.size), run.check(1.0).bad["x"]["stuck"])
    assert np.count_nonzero(found & held) >= 0.95 * np.count_nonzero(held)
    assert np.count_nonzero(found & ~held) <= max(0.05 * np.count_nonzero(found), 1)
    assert np.all(scores(run.without(stuck=True, frequency=1.0).fold(64, frequency=1.0)) < 12.0)


@pytest.mark.parametrize("step", [0.0, 0.002, 0.01, 0.02])
def test_quantised_noise_has_no_short_holds(step):
    """Twenty recordings; each has one by chance with a probability of 0.001."""
    for seed in range(20):
        values = CLEAN + noise(seed)
        values = step * np.round(values / step) if step else values
        assert recorded(values).check(1.0).bad["x"]["stuck"].size == 0


@pytest.mark.parametrize("freedom", [2.0, 3.0])
def test_heavy_tails_are_noise_that_biases_nothing(freedom):
    """Student's t: the mean of 60 squares of unit size is at most 1.5 without a bias."""
    squares, kinds = [], set()
    for seed in range(30):
        error = NOISE * np.random.default_rng(seed).standard_t(freedom, TIME.size)
        e = recorded(CLEAN + error).fold(64, frequency=1.0, harmonics=3)
        squares.append(scores(e))
        kinds |= {(finding.kind, finding.severity) for finding in e.findings}
    assert np.mean(squares) < 1.5
    assert ("outliers", "serious") not in kinds and ("outliers", "ruinous") not in kinds
    assert freedom > 2.0 or ("heavy tails", "harmless") in kinds


def test_clipped_samples_are_left_out_with_their_phases_so_that_noise_does_not_select():
    """Of 20 recordings with a tenth of the samples at each end clipped, the squares of errors are of unit size."""
    squares = []
    for seed in range(20):
        run = recorded(np.clip(CLEAN + noise(seed), -1.04, 1.04)).without(clipped=True, frequency=1.0)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            squares.append(scores(run.fold(64, frequency=1.0, harmonics=3)))
    assert np.mean(squares) < 2.0


def test_harmonics_that_missing_phases_do_not_determine_are_named_with_the_share():
    run = recorded(np.clip(CLEAN + noise(0), -0.74, 0.74)).without(clipped=True, frequency=1.0)
    with pytest.raises(ValueError, match=r"must have samples at all phases of its period, .* none are at 4\d% of each"):
        run.fold(64, frequency=1.0)


def test_long_runs_at_the_limit_are_clipped_and_not_stuck():
    time = np.arange(60 * 200) / 200
    values = np.cos(2 * np.pi * time) + NOISE * np.random.default_rng(0).standard_normal(time.size)
    check = bp.Recording.from_arrays(time, {"x": np.minimum(values, 0.5)}).check(1.0)
    assert [finding.kind for finding in check.findings] == ["clipped"]


def test_a_stuck_stretch_beside_clipping_is_found():
    values = np.clip(CLEAN + noise(0), -1.04, 1.04)
    values[1003:1018] = values[1003]
    check = recorded(values).check(1.0)
    assert check.bad["x"]["stuck"].tolist() == [*range(1003, 1018)]


@pytest.mark.parametrize("share, left_out", [(0.019, False), (0.021, True)])
def test_others_at_a_phase_are_left_out_if_two_percent_of_them_are_clipped(share, left_out):
    """Of 1000 samples at each of ten phases, whose intervals they fill."""
    phase = np.repeat(np.arange(1000), 10) + np.tile(np.arange(10) / 10, 1000)
    clipped = 10 * np.arange(round(1000 * share)) + 3
    beside = sensors._same_phases(phase, clipped)
    assert beside.tolist() == (10 * np.arange(1000) + 3).tolist() * left_out


def example(highest):
    """Return signals whose phases lie in the first 0.6 of each cycle, with this highest harmonic, and a fit of two."""
    time = (np.arange(50)[:, None] + np.arange(60) / 100).ravel() / 4.0
    values = 2.0 + np.cos(8 * np.pi * time) + 0.5 * np.cos(8 * np.pi * highest * time + 0.3)
    values = values + 1e-3 * np.random.default_rng(1).standard_normal(time.size)
    used = Signals("run", time, ("x",), values[None], 0)
    return used, fit_harmonics(time, values[None], 4.0, 2)


def test_harmonics_that_are_shown_and_not_determined_are_named_with_share_period_and_channel():
    used, fit = example(3)
    text = sensors.undetermined(used, fit, 9)
    assert text.startswith(
        "recording: must have samples at all phases of its period, got 'run', in which none are at 40% of"
    )
    assert (
        "each period of 0.25 s: the others determine 2 harmonics, and 'x' has 3 at least. Record again without" in text
    )
    one = fit_harmonics(used.time, used.values, 4.0, 1)
    assert "the others determine 1 harmonic, and 'x' has" in sensors.undetermined(used, one, 9)
    assert sensors.undetermined(used, fit, 2) == ""  # no more are resolved
    assert sensors.undetermined(*example(2), 9) == "" == sensors.undetermined(*example(1), 9)
