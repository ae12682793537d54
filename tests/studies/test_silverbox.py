import contextlib
import io
import json

import numpy as np
import pytest

import bayesperiodic as bp
from studies import common
from studies.__main__ import main
from studies.silverbox import run as silverbox

REAL = common.find_data(None, silverbox.FILE)
real_data = pytest.mark.skipif(REAL is None, reason="the measured file is missing, see studies/silverbox/run.py")
NAMES = ("c", "k1", "k2", "k3", "g", "u0")


def run(folder, *arguments):
    assert main(["silverbox", "--out", str(folder), *arguments]) == 0
    return json.loads((folder / "results.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def steady_period():
    """Return a period of drive and response, integrated once."""
    return silverbox.steady_period()


@pytest.fixture(scope="module")
def quick(steady_period, tmp_path_factory):
    """Return the folder, the results and the printed account of a quick run on synthetic silverbox."""
    folder = tmp_path_factory.mktemp("silverbox")
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.setattr(common, "find_data", lambda *_: None)
        patch.setattr(silverbox, "steady_period", lambda: steady_period)
        # The third, "circulant", takes a minute; the campaign on the measured file has it.
        patch.setattr(silverbox, "NOISES", silverbox.NOISES[:2])
        results = run(folder, "--quick")
    return folder, results, printed.getvalue()


def has_the_promised_keys(results, noises=silverbox.NOISES):
    for by_noise in (results["sd"], results["robust_sd"], results["estimates"]):
        assert set(by_noise) == set(noises)
        assert all(set(values) == set(NAMES) for values in by_noise.values())
    assert set(results["map"]) == set(NAMES) and set(results["whiteness"]) == set(noises)
    assert set(results["noise_split"]) == {"measurement", "model"}
    assert set(results) > {"data", "seed", "frequency", "cycles", "seconds", "versions", "units"}
    return True


@pytest.mark.slow
def test_synthetic_data_are_labelled_and_the_truth_is_recovered(quick):
    folder, results, printed = quick
    assert "SYNTHETIC" in printed and silverbox.SHA256 in printed and "nonlinearbenchmark.org" in printed
    assert results["data"] == {"path": "generated", "sha256": None, "synthetic": True}
    assert has_the_promised_keys(results, silverbox.NOISES[:2])
    for noise in silverbox.NOISES[:2]:
        for name, true in silverbox.TRUE.items():
            assert abs(results["estimates"][noise][name] - true) < 5 * results["sd"][noise][name], (noise, name)
    assert sorted(path.name for path in folder.glob("*.png")) == ["estimates.png", "spectrum.png"]


@pytest.mark.slow
def test_residual_of_synthetic_data_is_their_noise(quick):
    _, results, _ = quick
    assert results["residual_fraction"] == pytest.approx(0.0017, rel=0.1)
    assert results["discretisation_error_fraction"] < results["discretisation_allowed"]
    assert min(results["whiteness"].values()) > 0.01
    assert results["repetition"]["repeats"] < 0.5 * results["repetition"]["does_not"]


@pytest.mark.slow
def test_another_start_leads_to_the_same_estimates_and_stalls_are_overcome(quick):
    _, results, _ = quick
    assert results["other_start"]["status"] == "converged"
    assert max(map(abs, results["other_start"]["shift"].values())) < 0.01
    assert [point["status"] for point in results["from_rest"]] == ["converged"] * 3
    assert results["from_rest"][-1]["found_by"] != "newton"
    assert len(results["seconds"]["from_rest"]) == 3


def test_same_seed_same_recording_and_another_second_part(monkeypatch, steady_period):
    monkeypatch.setattr(silverbox, "steady_period", lambda: steady_period)
    (first, second), (again, _) = (silverbox.generate(seed) for seed in (1, 1))
    assert first.synthetic and np.array_equal(first.outputs["response"], again.outputs["response"])
    assert not np.array_equal(first.inputs["drive"], second.inputs["drive"])


def test_error_found_by_doubling_is_that_against_time_integration(steady_period):
    drive, response = steady_period
    time = np.arange(3 * drive.size) / silverbox.SAMPLING_RATE
    recording = bp.Recording.from_arrays(time, {"response": np.tile(response, 3)}, {"drive": np.tile(drive, 3)})
    experiment = silverbox.fold(recording, 4096, response=335)
    grid = silverbox.discretisation(recording, experiment, silverbox.TRUE)
    solution = silverbox.solve(silverbox.TRUE, experiment)
    true = np.sqrt(np.mean((solution.outputs["response"][::4] - response) ** 2)) / response.std()
    assert grid.fraction == pytest.approx(true, rel=0.15)
    assert grid.difference.size == 4096


@pytest.mark.campaign
@real_data
def test_the_measured_silverbox(tmp_path, capsys):
    results = run(tmp_path)
    printed = capsys.readouterr().out
    assert results["data"]["sha256"] == silverbox.SHA256 and not results["data"]["synthetic"]
    assert has_the_promised_keys(results)
    assert results["cycles"] == 9 and results["input_harmonics"] == 335
    assert results["residual_fraction"] <= 0.007
    assert results["discretisation_error_fraction"] < results["discretisation_allowed"] < 2e-4
    assert max(abs(s) for shifts in results["doubling_shift"].values() for s in shifts.values()) < 0.1
    assert set(results["status"].values()) == {"converged"}
    assert "ABOVE" not in printed and "SYNTHETIC" not in printed
    assert results["noise_split"]["model"] > results["noise_split"]["measurement"] > 0.0
    repeat = results["repetition"]
    assert repeat["repeats"] ** 2 + repeat["does_not"] ** 2 == pytest.approx(results["rms"] ** 2, rel=0.05)
    assert repeat["repeats"] > 5 * repeat["does_not"]
    assert results["beyond_drive"]["share_of_residual_power"] > 0.5
    every, in_drive = (choice["harmonics"] for choice in results["response_harmonics"]["choices"])
    assert every > in_drive == 335
    assert all(path.stat().st_size <= 200_000 for path in tmp_path.glob("*.png"))


@pytest.mark.slow
@real_data
@pytest.mark.filterwarnings("ignore:The noise of the measured inputs")
def test_estimates_of_the_measured_silverbox_by_an_independent_route():
    """Mean of the cycles by plain averaging, a Runge-Kutta march for two periods, and scipy's least squares."""
    import numba
    from scipy.optimize import least_squares

    (recording, _), _ = silverbox.read_steady_parts(None, 1)
    experiment = silverbox.fold(recording, silverbox.SAMPLES)
    fit = bp.map_estimate(silverbox.problem(experiment), checks=False, progress=False)
    drive, response = (
        np.reshape(signal, (silverbox.PERIODS, -1)).mean(axis=0)
        for signal in (recording.inputs["drive"], recording.outputs["response"])
    )
    lines = np.fft.rfft(drive)
    lines[336:] = 0.0
    points = 16_384
    fine = np.fft.irfft(lines, 2 * points) * (2 * points / drive.size)
    kept = experiment.harmonics["response"] + 1
    h = 1.0 / (silverbox.FREQUENCY * points)

    @numba.njit
    def march(c, k1, k2, k3, g, u0):
        y, v, path = 0.0, 0.0, np.empty(points)
        w = silverbox.W0
        for step in range(2 * points):
            i = step % points
            path[i] = y
            dy, dv, ys, vs = 0.0, 0.0, y, v
            for stage in range(4):
                u = fine[(2 * i + (stage + 1) // 2) % (2 * points)]
                a = w * w * (g * u + u0 - c * vs / w - k1 * ys - k2 * ys**2 - k3 * ys**3)
                weight = 1.0 / 6.0 if stage in (0, 3) else 1.0 / 3.0
                dy, dv = dy + weight * vs, dv + weight * a
                reach = h if stage == 2 else 0.5 * h
                ys, vs = y + reach * vs, v + reach * a
            y, v = y + h * dy, v + h * dv
        return path

    def residual(theta):
        predicted = np.fft.rfft(march(*theta))[:kept] / points
        difference = predicted - np.fft.rfft(response)[:kept] / response.size
        return 1e4 * np.concatenate([difference.real[:1] / np.sqrt(2.0), difference[1:].real, difference[1:].imag])

    found = least_squares(residual, [0.1, 1.1, 0.0, 4.0, 1.1, 0.0], x_scale=[0.1, 1.0, 1.0, 4.0, 1.0, 0.01])
    offset = (found.x - list(fit.theta.values())) / list(fit.sd.values())
    assert np.abs(offset).max() < 0.25
