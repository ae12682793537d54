import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bayesperiodic as bp
from studies import common
from studies.__main__ import main
from studies.diode import chaos, prediction, rig

REAL = common.find_data(None, rig.FILE)
# The mean of the source is not measured, and acts as V_f does.
VALUES = rig.TRUE | {"C_s": 0.0, "V_f": rig.TRUE["V_f"] - rig.MEAN}
FREQUENCY, MEAN, AMPLITUDE = 140e3, 0.1, 10.5


@pytest.mark.slow
def test_stroboscopic_values_are_those_of_an_adaptive_implicit_integration():
    p = VALUES | {"bypass": 0.14}

    def rates(t, y):
        i, v, q, m = np.array([1e-3, 1.0, 1e-9, 1e-9]) * y
        plus = 0.5 * (q + np.hypot(q, p["Q_0"]))
        source = MEAN + AMPLITUDE * np.cos(2 * np.pi * FREQUENCY * t)
        current = (source - v - p["V_f"] + (plus - q) / p["C_j"]) / (p["R"] + p["R_s"])
        flow = (plus - m) / p["transit"]
        rate = (
            (v - p["R_L"] * i) / p["L"], (current - i) / p["C_L"], current - flow,
            flow - m / p["lifetime"] - p["drift"] * i * m,
        )  # fmt: skip
        return np.array(rate) / np.array([1e-3, 1.0, 1e-9, 1e-9])

    periods = prediction.TRANSIENT + 4
    at = np.arange(prediction.TRANSIENT, periods) / FREQUENCY
    path = solve_ivp(rates, (0.0, at[-1]), np.zeros(4), "Radau", at, rtol=1e-8, atol=1e-8).y
    v, q, m = path[1], 1e-9 * path[2], 1e-9 * path[3]
    depleted = 0.5 * (np.hypot(q, p["Q_0"]) - q)
    current = (MEAN + AMPLITUDE - v - p["V_f"] + depleted / p["C_j"]) / (p["R"] + p["R_s"])
    expected = p["R"] * (current - p["bypass"] * (current - (depleted + q - m) / p["transit"]))
    # The second of five draws, of which four are integrated in one vector.
    draws = np.array([p[name] for name in prediction.ORDER])[:, None] * (1.0 + 0.05 * np.arange(-1.0, 4.0))
    found = np.empty((5, 4, prediction.PHASES))
    prediction._run(draws, FREQUENCY, MEAN, AMPLITUDE, np.zeros((4, 5)), prediction.TRANSIENT, found)
    assert np.allclose(found[1, :, 0], expected, atol=2e-3)


@pytest.mark.parametrize(
    ("values", "period"),
    [([2.0], 1), ([1.0, 2.0], 2), ([1.0, 2.0, 2.5], 3), ([1.0, 2.0, 1.2, 2.3], 4), ([1.0, 2.0, 1.01, 2.0], 2)],
)
def test_period_of_repeated_values(values, period):
    assert prediction.period_of(np.tile(values, 30)[:64, None]) == period


def test_values_of_the_logistic_map_in_chaos_have_no_period():
    x = [0.3]
    for _ in range(63):
        x.append(3.9 * x[-1] * (1.0 - x[-1]))
    assert prediction.period_of(np.array(x)[:, None]) is None


@pytest.fixture(scope="module")
def records():
    """Return synthetic records of period one and two, of the source's voltage without load."""
    share = VALUES["R_s"] / rig.RESISTOR
    return [rig.folded(f, rig.unloaded(rig.generate(f, seed=1), share)) for f in (100e3, FREQUENCY)]


def test_internal_resistance_follows_from_lines_that_the_source_does_not_have():
    under_load = rig.folded(FREQUENCY, rig.generate(FREQUENCY, seed=1)).experiment
    assert rig.internal_share([under_load]) == pytest.approx(VALUES["R_s"] / rig.RESISTOR, rel=0.01)


def test_an_orbit_is_found_from_the_current_of_a_synthetic_record_of_period_two(records):
    record = records[1]
    assert record.period == 2
    experiment, mean = rig.guessed(record.experiment, VALUES)
    solution = bp.solve_periodic(
        rig.MODEL, VALUES, experiment.inputs, frequency=FREQUENCY, periods=2, samples=rig.SAMPLES,
        guess=experiment.guess,
    )  # fmt: skip
    assert solution.status == "converged"
    assert rig.unexplained(experiment, solution) < 0.002
    assert rig.RESISTOR * mean == pytest.approx(solution.outputs["resistor"].mean(), rel=0.05)


def test_an_orbit_of_period_one_doubles_where_its_multiplier_passes_minus_one(records):
    experiment = rig.guessed(records[0].experiment, VALUES)[0]
    at = prediction.doubling(VALUES, experiment, 130e3)
    least = []
    for frequency in (at - 300.0, at + 300.0):
        solution = bp.solve_periodic(
            rig.MODEL, VALUES, experiment.inputs, frequency=frequency, samples=rig.SAMPLES, guess=experiment.guess
        )
        least.append(solution.multipliers.real.min())
    assert least[0] > -1.0 > least[1]


@pytest.mark.campaign
@pytest.mark.skipif(REAL is None, reason="the measured file is missing, see studies/diode/rig.py")
def test_measured_records_are_fitted_to_their_noise_and_most_are_predicted(tmp_path, capsys):
    assert main(["diode", "--quick", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert len(found["records"]) == 41
    assert sum(row["used"] for row in found["records"]) == 6
    assert all(row["unexplained"] < 0.01 for row in found["records"] if row["used"])
    by_frequency = {row["frequency_Hz"] / 1e3: row for row in found["records"]}
    for frequency, period in {120: 2, 150: 2, 220: 3, 225: 3}.items():
        assert by_frequency[frequency]["predicted"].get(str(period), 0.0) > 0.5
    for frequency in (190, 285, 295, 470):
        assert by_frequency[frequency]["predicted"].get("chaos", 0.0) > 0.5
    assert "Most probable motion right" in capsys.readouterr().out


def test_the_passage_of_an_orbit_is_found_whatever_its_period_begins_with_and_its_mean():
    generator = np.random.default_rng(3)
    orbit = generator.standard_normal(2 * chaos.PHASES)
    values = generator.standard_normal(12 * chaos.PHASES)
    # Passed by from index 70 on, which is six phases after a maximum of the source, in its second period.
    values[70 : 70 + orbit.size] = np.roll(orbit, -(70 % chaos.PHASES) - chaos.PHASES) + 0.3
    far = chaos.passages(values, orbit)
    assert far.argmin() == 70
    assert far.min() < 1e-20
    assert np.sort(far)[1] > 0.01
    assert np.allclose(chaos.aligned(orbit, values, 70), values[70 : 70 + orbit.size])


def test_a_part_that_repeats_is_found():
    values = np.random.default_rng(4).standard_normal(14 * chaos.PHASES)
    values[100 + 3 * chaos.PHASES : 100 + 6 * chaos.PHASES] = values[100 : 100 + 3 * chaos.PHASES]
    (start, difference), *others = chaos.recurrences(values, 3)
    assert (start, difference) == (100, 0.0)
    assert min(other for _, other in others) > 0.1


def test_an_unstable_orbit_is_found_in_a_synthetic_record_of_chaos():
    """Its multiplier is that of a map: motions next to the orbit, integrated in time, leave it by that factor."""
    frequency, share = 300e3, VALUES["R_s"] / rig.RESISTOR
    record = rig.folded(frequency, rig.unloaded(rig.generate(frequency, seed=1), share))
    assert record.period is None
    values = VALUES | {"C_s": 0.0, "offset": 0.0}
    own = next(row for row in chaos.orbits(record, values) if row["period"] == 1)
    assert own["nearest"] < 0.01 < own["median"]
    mean, amplitude = prediction.source_of(record)
    guess = rig.guessed(chaos._part(record, own["index"] // chaos.PHASES * chaos.PHASES, 1), values)[0]
    solution = rig.solve(guess, frequency, values, guess.guess)
    numbers = np.array([[values[name]] for name in prediction.ORDER])
    start = np.array([solution.states[name][0] for name in ("i", "v", "q", "m")])
    found = np.empty((1, 1, prediction.PHASES))

    def after(state):
        states = np.array(state)[:, None]
        prediction._run(numbers, frequency, mean, amplitude, states, 0, found)
        return states[:, 0]

    scale = np.array([1e-3, 1.0, 1e-10, 1e-10])
    columns = [
        (after(start + 1e-4 * scale * unit) - after(start - 1e-4 * scale * unit)) / (2e-4 * scale)
        for unit in np.eye(4)
    ]  # fmt: skip
    multipliers = np.linalg.eigvals(np.stack(columns, axis=1))
    assert np.max(np.abs(multipliers)) == pytest.approx(abs(own["multiplier"]), rel=0.05)
