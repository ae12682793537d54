import contextlib
import io
import json

import numpy as np
import pytest
from PIL import Image

from studies import shooting
from studies.__main__ import main
from studies.solver import run as solver


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Return the folder, the results and the printed account of one quick run."""
    folder = tmp_path_factory.mktemp("solver")
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["solver", "--quick", "--out", str(folder)]) == 0
    return folder, json.loads((folder / "results.json").read_text(encoding="utf-8")), printed.getvalue()


@pytest.mark.slow
def test_all_checks_of_the_study_are_met(done):
    _, results, printed = done
    assert len(results["checks"]) >= 20
    assert [check["what"] for check in results["checks"] if not check["met"]] == []
    account, cost = printed.split("\nCost\n")
    assert "\nTargets\n" in account and "NO " not in account
    assert len(results["cost"]["checks"]) >= 10 and cost.count("\n") > 10  # what is timed has no verdict here
    assert results["quick"] is True and "computed" in results["data"]
    assert set(results["seconds"]) > {"orders", "pendulum", "total"} and "numba" in results["versions"]


@pytest.mark.slow
def test_measured_orders_equal_those_of_the_schemes(done):
    forced = done[1]["orders"]["forced"]
    assert forced["backward2"]["order"] == pytest.approx(2.0, abs=0.05)
    assert forced["central2"]["order"] == pytest.approx(2.0, abs=0.05)
    assert forced["central4"]["order"] == pytest.approx(4.0, abs=0.1)
    assert forced["fourier"]["errors"][-1] < 1e-10 and forced["fourier"]["samples"][-1] == 64
    assert done[1]["orders"]["reference_error"] < 1e-12


def test_pendulum_of_the_study_has_the_parameters_of_the_shooting_tables():
    c = {name: solver.PENDULUM[f"k{i}"] / (0.1 * 0.3**2) for i, name in enumerate(("c1", "c2", "c3"), start=1)}
    assert {name: shooting.PENDULUM[name] for name in c} == pytest.approx(c)
    assert sorted({len(known.section) for known in solver.ORBITS}) == [3, 5]


@pytest.mark.slow
def test_the_pendulum_follows_its_cascade_and_comes_back_as_the_other_rotation(done):
    pendulum = done[1]["pendulum"]
    for periods, known in zip((1, 2, 4), shooting.DOUBLINGS, strict=True):
        assert pendulum["doublings"][str(periods)]["found"] == [pytest.approx(known.omega, abs=1e-4)]
    for periods, known in zip((1, 2, 4), shooting.UNSTABLE[:3], strict=True):
        assert pendulum["multipliers"][str(periods)]["multipliers"] == pytest.approx(known.multipliers, rel=1e-5)
    assert pendulum["below"]["fold"] == pytest.approx(shooting.FOLD.omega, abs=1e-4)
    assert pendulum["below"]["back_at"] == pytest.approx(9.09, abs=1e-12)
    second = pendulum["rotations"]["second"]["central4"]
    assert second["section"] == pytest.approx(shooting.UNSTABLE[3].section[0], rel=1e-8)


@pytest.mark.slow
def test_duffing_folds_agree_with_one_term_harmonic_balance(done):
    """(k − mω² + ¾k3A²)²A² + (cωA)² = F² has vertical tangents there, but for the third harmonic."""
    m, c, k, k3 = (solver.DUFFING[name] for name in ("m", "c", "k", "k3"))
    for entry in done[1]["duffing"]:
        square = np.linspace(1e-6, 0.05, 400_001)[1:] ** 2
        stiffness = k + 0.75 * k3 * square
        # m²W² − (2m·stiffness − c²)W + stiffness² − F²/A² = 0 in W = ω².
        half = stiffness / m - 0.5 * (c / m) ** 2
        root = half**2 - (stiffness**2 - entry["force"] ** 2 / square) / m**2
        inside = root >= 0.0
        turns = []
        for sign in (-1.0, 1.0):
            w = np.sqrt(np.maximum(half[inside] + sign * np.sqrt(root[inside]), 0.0)) / (2 * np.pi)
            w = w[w > 5.0]
            turns += [w[i] for i in range(1, len(w) - 1) if (w[i] - w[i - 1]) * (w[i + 1] - w[i]) < 0]
        assert sorted(entry["folds"]) == pytest.approx(sorted(turns), rel=5e-3)
        assert (entry["unstable_points"] > 0) == bool(entry["folds"])
        assert entry["complete"]


@pytest.mark.slow
def test_figures_are_there_small_and_not_empty(done):
    folder, _, printed = done
    figures = sorted(folder.glob("*.png"))
    assert [path.name for path in figures] == ["duffing.png", "orders.png", "pendulum.png"]
    for path in figures:
        assert str(path) in printed
        assert path.stat().st_size <= 200_000
        with Image.open(path) as picture:
            assert len(picture.convert("RGB").getcolors(1 << 20)) > 5
