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
@pytest.mark.parametrize("noise", ["white", "slow", "drift", "wander", "bits"])
def test_false_alarm_rate_is_the_nominal_one(noise):
    """Of 400 recordings of period 1 at most 9 have another one (binomial, 99 % at 1 %).

    Also with 20 % of drift, and with amplitude and phase that wander by 3 % and 2°.
    """
    wrong = 0
    for seed in range(SEEDS):
        generator = np.random.default_rng(seed)
        cycles = int(generator.integers(12, 51))
        time = np.arange(1500) * cycles / 1500
        error = generator.standard_normal(time.size)
        error = np.cumsum(error) / 30 if noise == "slow" else error
        y = np.cos(2 * np.pi * time) + 0.3 * np.cos(4 * np.pi * time + 1)
        if noise == "wander":
            size, turn = (np.cumsum(generator.standard_normal(time.size)) / np.sqrt(time.size) for _ in range(2))
            y = (1 + 0.05 * size) * np.cos(2 * np.pi * time + 0.06 * turn) + 0.3 * np.cos(
                4 * np.pi * time + 0.12 * turn
            )
        y = y * (1 + 0.2 * time / cycles * (noise == "drift")) + 0.02 * error
        y = np.round(30 * y) / 30 if noise == "bits" else y
        wrong += response_period.response_period(time, y[None], ("y",), 1.0)[0] != 1
    assert wrong <= stats.binom.ppf(0.99, SEEDS, 0.01)


def test_quantisation_that_repeats_after_three_periods_is_no_response_period():
    """83 1/3 samples a period: without dither the errors have period 3."""
    time = 30 * np.arange(2500) / 2500
    for phase in np.linspace(0, 1, 20):
        y = np.round(10 * np.cos(2 * np.pi * time + phase)) / 10
        assert response_period.response_period(time, y[None], ("y",), 1.0)[0] == 1


def subharmonic(share, order, per_cycle=40, cycles=60, noise=0.003):
    """Return times, the drive, and a response with a line at 1/order of 1 Hz that has this share of its variance."""
    time = np.arange(cycles * per_cycle) / per_cycle
    y = np.cos(2 * np.pi * time) + 0.3 * np.cos(4 * np.pi * time + 1)
    y += np.sqrt(2 * share * y.var() / (1 - share)) * np.cos(2 * np.pi * time / order + 2)
    generator = np.random.default_rng(order)
    return time, np.cos(2 * np.pi * time), y + noise * generator.standard_normal(time.size)


def found(time, drive, y, **arguments):
    return bp.Recording.from_arrays(time, {"x": y}, {"force": drive}, name="run").fold(32, periods="auto", **arguments)


@pytest.mark.parametrize("order", [2, 3, 5])
def test_subharmonic_above_the_least_share_is_the_response_period(order):
    e = found(*subharmonic(3e-4, order))
    row = e.period_test.set_index("periods").loc[order]
    assert (e.periods, row.verdict) == (order, "chosen")
    assert row.share == pytest.approx(3e-4, rel=0.1)
    assert f"chosen of 1 to 8: lines at 1/{order} of the drive's frequency in 'x' have " in repr(e)


@pytest.mark.parametrize("order", [2, 3, 5])
def test_subharmonic_below_the_least_share_is_named_with_how_to_keep_it(order):
    e = found(*subharmonic(3e-5, order))
    row = e.period_test.set_index("periods").loc[order]
    assert (e.periods, row.verdict) == (1, "lines too small")
    assert row.share == pytest.approx(3e-5, rel=0.1)
    assert f"lines at 1/{order} of the drive's frequency in 'x' have {row.share:.1e} of its variance" in repr(e)
    assert f"a share of 1e-04 is needed, or fold with periods={order}" in repr(e)


@pytest.mark.filterwarnings("ignore:run. only the last")
def test_rounded_times_are_no_response_period():
    """At 64 Hz, times in ms modulate the phase at 8 Hz: beside a drive of 16 Hz, at half of it."""
    time, exact = np.round(np.arange(4096) / 64, 3), np.arange(4096) / 64
    noise = 1e-3 * np.random.default_rng(1).standard_normal(time.size)
    y = np.cos(2 * np.pi * 16 * exact + 0.3) + noise
    for frequency in (None, 16.0):
        e = found(time, np.cos(2 * np.pi * 16 * exact), y, frequency=frequency)
        assert e.periods == 1
        assert e.period_test.share.max() < 1e-6


def test_times_that_jitter_are_kept_where_they_are_right():
    even = np.arange(4000) / 40
    time = even + np.random.default_rng(1).uniform(-0.4, 0.4, even.size) / 40
    wave = np.cos(2 * np.pi * time)
    assert response_period.even_times(time, wave[None], 1.0) is time
    assert np.ptp(response_period.even_times(time, np.cos(2 * np.pi * even)[None], 1.0) - even) < 1e-3


@pytest.mark.parametrize(("drive", "rate"), [(7.5, 512.0), (8.0, 64.0)], ids=["50 Hz", "60 Hz, as 4 Hz"])
def test_hum_of_the_mains_is_no_response_period(drive, rate):
    """50 Hz are 20/3 of 7.5 Hz; 60 Hz sampled at 64 Hz are 4 Hz, half of 8 Hz."""
    time = np.arange(20 * rate) / rate
    hum = 50 if drive == 7.5 else 60
    y = np.cos(2 * np.pi * drive * time) + 0.03 * np.cos(2 * np.pi * hum * time)
    y += 1e-3 * np.random.default_rng(2).standard_normal(time.size)
    e = found(time, np.cos(2 * np.pi * drive * time), y)
    assert e.periods == 1
    assert "mains or alias" in e.period_test.verdict.tolist()
    assert "may be those of the mains" in repr(e)


@pytest.mark.filterwarnings("ignore:run. only the last")
def test_harmonics_above_half_of_the_sampling_rate_are_no_response_period():
    """Harmonic 4 of 9.6 Hz, sampled at 64 Hz, is at 25.6 Hz, 8/3 of the drive; harmonic 2 is stronger."""
    time = np.arange(1280) / 64
    y = sum(0.3**h * np.cos(2 * np.pi * 9.6 * (h + 1) * time + h) for h in range(5))
    y += 1e-3 * np.random.default_rng(3).standard_normal(time.size)
    e = found(time, np.cos(2 * np.pi * 9.6 * time), y)
    assert e.periods == 1
    assert e.period_test.verdict[2] == "mains or alias"


def test_transient_at_a_part_of_the_drive_fades():
    time, drive, y = subharmonic(0.0, 3)
    e = found(time, drive, y + 0.1 * np.exp(-time / 30) * np.cos(2 * np.pi * time / 3))
    assert e.periods == 1
    assert e.period_test.verdict[2] == "lines fade"
    assert "they fade, to " in repr(e)


def test_error_of_a_chaotic_recording_names_no_lines(motions):
    with pytest.raises(ValueError, match=r"between the lines of its spectrum\. A chaotic"):
        recorded(motions[0.5], 1).fold(64, periods="auto", frequency=1.0)


@pytest.mark.skipif(not (DATA / "harvester" / "periodic").is_dir(), reason="needs the records of the harvester")
def test_records_of_a_harvester_repeat_with_the_drive():
    paths = sorted((DATA / "harvester" / "periodic").glob("*.csv"))
    assert paths
    for path in paths:
        columns = np.loadtxt(path, delimiter=",").T
        frequency = float(path.stem.split("_")[1].removesuffix("Hz"))
        run = bp.Recording.from_arrays(columns[0], {"v": columns[3], "u": columns[5]}, {"a": columns[1]})
        for given in (None, frequency):
            assert run.fold(64, periods="auto", frequency=given).periods == 1


def test_evidence_is_kept_printed_and_saved(motions, tmp_path):
    e = recorded(motions[0.28], 1).fold(64, periods="auto", frequency=1.0)
    assert e.period_test.verdict.tolist()[:4] == ["not periodic", "chosen", "not periodic", "adds no lines"]
    assert e.period_test.p[1] < 1e-6
    assert "response period 2 drive periods, chosen of 1 to" in repr(e)
    assert e.period_test.remark[1] in repr(e)
    e.save(tmp_path / "run.h5")
    assert bp.load(tmp_path / "run.h5").period_test.remark.tolist() == e.period_test.remark.tolist()


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
