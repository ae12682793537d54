"""Response periods in drive periods, of oscillators whose periods are known and of measured ones."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.data import response_period

DATA = Path(os.environ.get("BAYESPERIODIC_DATA", "data"))
RATE, SEEDS = 50, 400
# Amplitude of the force, and response period in drive periods, of x'' + 0.3 x' - x + x³ = a cos 1.2 t (None: chaos).
TWO_WELLS = {0.2: 1, 0.28: 2, 0.29: 4, 0.37: 5, 0.5: None}


def bits(signal, noise, generator):
    """Return a signal with relative noise, as an 8-bit recorder of 1.2 times its range stores it."""
    noisy = signal + noise * signal.std() * generator.standard_normal(signal.size)
    step = 1.2 * np.ptp(noisy) / 256
    return np.round(noisy / step) * step


@pytest.fixture(scope="module")
def motions():
    """Return the displacement over 100 drive periods after 300, (100·RATE + 1, amplitudes)."""
    force, step = np.array([*TWO_WELLS]), 2 * np.pi / 1.2 / RATE

    def slope(phase, z):
        return np.stack([z[1], force * np.cos(phase) - 0.3 * z[1] + z[0] - z[0] ** 3])

    z, found = np.full((2, force.size), 0.1), []
    for n in range(400 * RATE + 1):
        found.append(z[0])
        phase, half = 2 * np.pi * n / RATE, np.pi / RATE
        a = slope(phase, z)
        b = slope(phase + half, z + 0.5 * step * a)
        c = slope(phase + half, z + 0.5 * step * b)
        d = slope(phase + 2 * half, z + step * c)
        z = z + step / 6 * (a + 2 * b + 2 * c + d)
    return dict(zip(TWO_WELLS, np.array(found[-100 * RATE - 1 :]).T, strict=True))


def recorded(motion, seed):
    """Return 15 to 50 drive periods of 1 Hz with 1 to 3 % noise, from a random time on."""
    generator = np.random.default_rng(seed)
    cycles = int(generator.integers(15, 51))
    first = int(generator.integers(0, (99 - cycles) * RATE))
    time = np.arange(cycles * RATE) / RATE
    x = bits(motion[first : first + time.size], generator.uniform(0.01, 0.03), generator)
    force = bits(np.cos(2 * np.pi * (time + first / RATE)), 0.01, generator)
    return bp.Recording.from_arrays(time, {"x": x}, {"force": force}, name="run")


@pytest.mark.parametrize("given", [1.0, None], ids=["given frequency", "estimated frequency"])
@pytest.mark.parametrize(("force", "periods"), [(f, p) for f, p in TWO_WELLS.items() if p])
def test_response_period_of_two_wells_is_found(motions, force, periods, given):
    found = [recorded(motions[force], seed).fold(64, periods="auto", frequency=given) for seed in range(5)]
    assert [e.periods for e in found] == 5 * [periods]
    assert all(e.frequency == pytest.approx(1.0, abs=2e-3) for e in found)


def test_chaos_is_refused_with_what_to_do(motions):
    for seed in range(10):
        with pytest.raises(ValueError, match=r"^recording: must be periodic, got 'run', in which no .* `find_orbits`"):
            recorded(motions[0.5], seed).fold(64, periods="auto", frequency=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["white", "slow", "drift"])
def test_false_alarm_rate_is_the_nominal_one(noise):
    """Of 400 recordings of period 1 at most 9 have another one (binomial, 99 % at 1 %), also with 20 % of drift."""
    wrong = 0
    for seed in range(SEEDS):
        generator = np.random.default_rng(seed)
        cycles = int(generator.integers(12, 51))
        time = np.arange(1500) * cycles / 1500
        error = generator.standard_normal(time.size)
        error = np.cumsum(error) / 30 if noise == "slow" else error
        y = np.cos(2 * np.pi * time) + 0.3 * np.cos(4 * np.pi * time + 1)
        y = y * (1 + 0.2 * time / cycles * (noise == "drift")) + 0.02 * error
        wrong += response_period.response_period(time, y[None], ("y",), 1.0)[0] != 1
    assert wrong <= stats.binom.ppf(0.99, SEEDS, 0.01)


def test_quantisation_that_repeats_after_three_periods_is_no_response_period():
    """83 1/3 samples a period: without dither the errors have period 3."""
    time = 30 * np.arange(2500) / 2500
    for phase in np.linspace(0, 1, 20):
        y = np.round(10 * np.cos(2 * np.pi * time + phase)) / 10
        assert response_period.response_period(time, y[None], ("y",), 1.0)[0] == 1


def test_evidence_is_kept_printed_and_saved(motions, tmp_path):
    e = recorded(motions[0.28], 1).fold(64, periods="auto", frequency=1.0)
    assert e.period_test.verdict.tolist()[:4] == ["not periodic", "chosen", "not periodic", "adds no lines"]
    assert e.period_test.p[1] < 1e-6
    assert "response period 2 drive periods, chosen of 1 to" in repr(e)
    e.save(tmp_path / "run.h5")
    assert bp.load(tmp_path / "run.h5").period_test.verdict.tolist() == e.period_test.verdict.tolist()


def test_transient_before_the_motion_is_left_out(motions):
    run = recorded(motions[0.28], 5)
    late = np.exp(-run.time / 2) * np.sin(9 * run.time)
    e = bp.Recording.from_arrays(run.time, {"x": run.outputs["x"] + 4 * late}, run.inputs).fold(
        64, periods="auto", frequency=1.0
    )
    assert e.periods == 2


def test_drive_period_needs_an_input_or_a_frequency():
    time = np.arange(1000) / 50
    run = bp.Recording.from_arrays(time, {"x": np.cos(2 * np.pi * time)})
    with pytest.raises(ValueError, match=r"^frequency: must be given for periods='auto'"):
        run.fold(64, periods="auto")
    assert run.fold(64, periods="auto", frequency=1.0).periods == 1


@pytest.mark.filterwarnings("ignore:recording. only the last")
@pytest.mark.parametrize(("per_cycle", "cycles"), [(40, 3), (40, 4), (40, 6)])
def test_few_steady_cycles_are_all_used(per_cycle, cycles):
    """Cycles before the later half have the noise of the others: at most 2 % of 50 recordings lose one."""
    time, lost = np.arange(cycles * per_cycle) / per_cycle, 0
    for seed in range(50):
        error = 0.02 * np.random.default_rng(seed).standard_normal(time.size)
        lost += (
            bp.Recording.from_arrays(time, {"x": np.cos(2 * np.pi * time) + error}).fold(32, frequency=1.0).cycles
            != cycles
        )
    assert lost <= 1


@pytest.mark.skipif(not (DATA / "rl_diode").is_dir(), reason="needs the records of the RL-diode circuit")
def test_response_periods_of_an_rl_diode_circuit():
    """Period doubling from 120 kHz, period 3 from 210 kHz with its doubling, period 4 at 350 kHz, doubled; or chaos."""
    known = {
        110: 1,
        120: 2,
        170: 2,
        185: None,
        210: 3,
        225: 3,
        250: 6,
        285: None,
        295: None,
        370: 8,
        410: None,
        550: None,
    }
    stored = np.load(DATA / "rl_diode" / "rl_diode_run_1.npz")
    for row in np.flatnonzero(np.isin(stored["frequency_Hz"].round(), 1e3 * np.array([*known]))):
        frequency = float(stored["frequency_Hz"][row])
        run = bp.Recording.from_arrays(
            stored["interval_s"][row] * np.arange(2500),
            {"resistor": stored["resistor_V"][row]},
            {"source": stored["source_V"][row]},
        )
        expected = known[round(frequency / 1e3)]
        if expected is None:
            with pytest.raises(ValueError, match="recording: must be periodic"):
                run.fold(100, frequency=frequency, periods="auto")
        else:
            e = run.fold(100, frequency=frequency, periods="auto")
            assert (e.periods, e.cycles) == (
                expected,
                int(2500 * stored["interval_s"][row] * frequency / expected + 1e-6),
            )
