import contextlib
import hashlib
import io
import json
import os
from pathlib import Path

import numpy as np
import pytest

import bayesperiodic as bp
from studies import common
from studies.__main__ import main
from studies.damper import run as damper

REAL = common.find_data(None, damper.FILE)
real_data = pytest.mark.skipif(REAL is None, reason="the measured file is missing, see studies/damper/run.py")


def run(folder: Path, *arguments: str) -> dict:
    assert main(["damper", "--out", str(folder), *arguments]) == 0
    return json.loads((folder / "results.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def short_recording():
    """Return a short synthetic damper recording, integrated once."""
    return damper.generate(seed=1).between(0.0, 12.0)


@pytest.fixture
def synthetic(monkeypatch, short_recording):
    monkeypatch.setattr(common, "find_data", lambda *_: None)
    monkeypatch.setattr(damper, "generate", lambda seed: short_recording)


def test_without_a_name_the_studies_are_listed(capsys):
    assert main([]) == 0
    assert "damper       A measured magneto-rheological damper" in capsys.readouterr().out


@pytest.fixture(scope="module")
def quick(short_recording, tmp_path_factory):
    """Return the folder, the results and the words of a quick run on synthetic data."""
    folder, printed = tmp_path_factory.mktemp("quick"), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setattr(common, "find_data", lambda *_: None)
        patch.setattr(damper, "generate", lambda seed: short_recording)
        return folder, run(folder, "--quick"), printed.getvalue()


@pytest.mark.slow
def test_synthetic_data_are_labelled_and_the_truth_is_recovered(quick):
    folder, results, printed = quick
    assert "SYNTHETIC" in printed and damper.SHA256 in printed and "github.com/labcontrol-data" in printed
    assert results["data"] == {"path": "generated", "sha256": None, "synthetic": True}
    for name in ("Kx", "Kw"):
        assert abs(results["map"][name] - damper.PUBLISHED[name]) < 4 * results["laplace_sd"][name]
    assert results["map"]["rho"] == pytest.approx(damper.PUBLISHED["rho"], rel=0.1)
    figures = sorted(path.name for path in folder.glob("*.png"))
    assert figures == ["corner.png", "fit.png", "harmonics.png", "loops.png", "missing_terms.png", "traces.png"]
    assert all(name in printed.splitlines()[-3] for name in figures)
    assert results["missing_terms"] == []


@pytest.mark.slow
def test_same_seed_same_results_but_for_seconds_and_versions(quick, synthetic, tmp_path):
    folder, first, _ = quick
    kept = [{k: v for k, v in r.items() if k not in ("seconds", "versions")} for r in (first, run(tmp_path, "--quick"))]
    assert json.dumps(kept[0]) == json.dumps(kept[1])
    for name in ("corner", "fit", "harmonics", "loops", "missing_terms", "traces"):
        assert (folder / f"{name}.png").read_bytes() == (tmp_path / f"{name}.png").read_bytes()


@pytest.mark.slow
def test_quick_run_converges(quick):
    results = quick[1]
    assert results["converged"] is True and "stop rule passed" in results["reason"]
    assert "not converged" not in results["comparison"].values()


def test_errors_are_one_line_with_an_exit_status(tmp_path, capsys):
    assert main(["damper", "--data", "nowhere.csv", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err == "error: --data: must be an existing file, got 'nowhere.csv'.\n"
    assert main(["dampper"]) == 2
    (tmp_path / "bad.csv").write_text("time_s,displacement_mm,force_N\n0,1,2\n0.1,2,x\n")
    assert main(["damper", "--data", str(tmp_path / "bad.csv"), "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err.count("\n") == 2


@pytest.mark.campaign
@real_data
def test_the_measured_damper(tmp_path, capsys):
    results = run(tmp_path)
    printed = capsys.readouterr().out
    assert results["data"]["sha256"] == damper.SHA256
    assert results["converged"] and not results["data"]["synthetic"]
    assert results["fvu"] <= 0.008
    assert results["rhat_max"] <= 1.01
    assert results["ess_min"] >= 1000
    assert 0.15 <= results["acceptance"] <= 0.7
    assert results["whiteness"]["p"] < 0.01 and "deviations above are therefore too small" in printed
    tried = results["harmonics"]
    assert [one["kept"] for one in tried] == [7, 11, 16, 22, 28, 56] and "rho runs from" in printed
    assert all(one["unexplained"] <= one["unexplained_exact"] <= 0.008 for one in tried)
    assert tried[-1]["rho"] - tried[0]["rho"] < 0.8 * (tried[-1]["rho_exact"] - tried[0]["rho_exact"])
    first, second = results["missing_terms"]
    assert (first["term"], first["place"]) == ("w*displacement**2", "force")
    assert second["unexplained"] < 0.6 * first["unexplained"] < 0.15 * results["fvu"]
    assert all(step["evidence_gain"] > np.log(80) for step in (first, second))
    assert "·w*displacement**2 in force" in printed
    assert all(path.stat().st_size <= 200_000 for path in tmp_path.glob("*.png"))


@real_data
@pytest.mark.filterwarnings("ignore:The noise of the measured inputs")
def test_map_of_the_measured_damper_by_an_independent_route():
    """Folding by plain least squares, Dahl's equation by an integrating factor in scipy, and scipy's least squares."""
    from scipy.integrate import cumulative_trapezoid
    from scipy.optimize import least_squares

    path = REAL[0]
    recording = damper.read_recording(None, 1)[0]
    experiment = recording.fold()
    fit = bp.map_estimate(bp.Problem(bp.models.dahl, [experiment], priors=damper.PRIORS, input_noise="exact"))
    time, x, _, force = np.loadtxt(path, delimiter=",", skiprows=1).T
    f = experiment.frequency
    steady = recording.steady().time
    used = (time >= steady[0]) & (time <= steady[-1])
    order = np.arange(1, 59)

    def design(t):
        angle = 2 * np.pi * f * t[:, None] * order
        return np.hstack([np.ones((t.size, 1)), np.cos(angle), np.sin(angle)])

    cx, cf = (np.linalg.lstsq(design(time[used]), s[used], rcond=None)[0] for s in (1e-3 * x, force))
    for c, kept in ((cx, experiment.harmonics["displacement"]), (cf, experiment.harmonics["force"])):
        c[1 + kept : 59] = c[59 + kept :] = 0.0
    points = 20_000
    t = np.arange(points) / points / f
    rate = 2 * np.pi * f * order
    x, y = design(t) @ cx, design(t) @ cf
    v = design(t) @ np.concatenate([[0.0], rate * cx[59:], -rate * cx[1:59]])
    travel = np.append(cumulative_trapezoid(np.abs(v), t, initial=0.0), 0.0)
    travel[-1] = travel[-2] + np.abs(v[-1]) * (t[1] - t[0])

    def residual(theta):
        kx, k, f0, kw, rho = theta * scale
        # w(t) = e^{−ρs}(w0 + ρ∫ v e^{ρs} dt), s the distance travelled; two periods forget w0.
        w, decay = np.zeros(points), np.exp(-rho * np.diff(travel))
        gain = np.sign(v) * (1.0 - decay)
        state = 0.0
        for sweep in range(2):
            for i in range(points):
                if sweep:
                    w[i] = state
                state = state * decay[i] + gain[i]
        predicted = kx * v + k * x + f0 + kw * w
        spectrum = np.fft.rfft(predicted)
        spectrum[experiment.harmonics["force"] + 1 :] = 0
        return (np.fft.irfft(spectrum, points) - y)[::20]

    scale = np.array(list(fit.theta.values()))
    best = least_squares(residual, np.full(5, 1.2), diff_step=1e-4).x * scale
    offset = (best - scale) / np.array(list(fit.sd.values()))
    assert np.abs(offset).max() < 0.25
    assert os.path.basename(path) == "mr_damper_4.1.csv"
    assert hashlib.sha256(Path(path).read_bytes()).hexdigest() == damper.SHA256
