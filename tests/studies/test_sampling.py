import contextlib
import io
import json
import os
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy import integrate, stats

from studies.__main__ import main
from studies.common import row, table_of_rows
from studies.sampling import cost as sampling_cost
from studies.sampling import ridge as sampling_ridge
from studies.sampling import run as sampling


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Return the folder, the results and the printed account of one quick run."""
    folder = tmp_path_factory.mktemp("sampling")
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["sampling", "--quick", "--out", str(folder)]) == 0
    return folder, json.loads((folder / "results.json").read_text(encoding="utf-8")), printed.getvalue()


def found(results: dict, what: str) -> list[dict]:
    return [check for check in results["checks"] if what in check["what"]]


@pytest.mark.slow
def test_quick_run_meets_all_checks_of_the_ridge(done):
    _, results, printed = done
    cut = found(results, "ridge, default") + found(results, "ridge, natural") + found(results, "by quadrature")
    assert len(cut) >= 6 and all(check["met"] for check in cut)
    assert results["ridge"]["natural"]["converged"] is False
    assert "max_steps = 500 reached with" in results["ridge"]["natural"]["reason"]
    assert "Targets" in printed and "quadrature" in printed


@pytest.mark.slow
def test_every_row_has_a_value_or_a_reason(done):
    _, results, _ = done
    for check in results["checks"]:
        assert set(check) == {"what", "value", "low", "high", "met", "note"}
        assert check["value"] is not None or check["note"]
        assert check["met"] is not None or check["note"]
    assert results["quick"] is True and len(results["cost"]["load_average"]) == 3
    assert set(results["seconds"]) > {"ridge", "damper", "cost", "total"}
    assert {check["value"] for check in found(results, "wall time of a pool")} == {None}


@pytest.mark.slow
def test_samplers_are_compared_in_every_mean_and_sd(done):
    damper = done[1]["damper"]
    samplers, parameters = len(damper["samplers"]), 6
    assert samplers >= 2 and len(damper["differences"]) == 2 * parameters * samplers * (samplers - 1) / 2
    # The starts have twice the spread of the posterior, and 250 steps do not forget them: no verdict is tested here.
    for entry in damper["samplers"].values():
        assert entry["converged"] is False and "max_steps = 250" in entry["reason"]
        assert entry["ess_per_second"] == pytest.approx(entry["ess_min"] / entry["seconds"])
        assert entry["moments"]["Kx"]["mean"] > 0.0 and entry["moments"]["rho"]["sd_error"] > 0.0


def test_density_on_the_ridge_equals_a_double_integral():
    """By SciPy's adaptive quadrature over b, for the cut priors and the uncut ones."""
    for cut in (True, False):
        a, density = sampling_ridge.marginal(cut=cut)
        at = [0.3, 1.0, 1.7] if cut else [-0.7, 0.3, 1.0]

        def inner(x, cut=cut):
            def joint(b):
                return (
                    stats.norm.pdf(x, 1, 1) * stats.norm.pdf(b, 1, 1) * stats.norm.pdf(x * b, 1, sampling_ridge.WIDTH)
                )

            middle, width = 1 / x, 12 * sampling_ridge.WIDTH / abs(x)
            return integrate.quad(joint, max(0.0, middle - width) if cut else middle - width, middle + width)[0]

        ratios = [float(np.interp(x, a, density)) / inner(x) for x in at]
        assert ratios == pytest.approx([ratios[0]] * 3, rel=1e-5)
        assert density.sum() * (a[1] - a[0]) == pytest.approx(1.0)
    assert sampling_ridge.negative_mass() == pytest.approx(0.012, abs=5e-4)


def chain(generator: np.random.Generator, correlation: float, mean: float = 0.0) -> SimpleNamespace:
    """Return four ensembles of 8 walkers over 2000 steps, autoregressive with unit variance."""
    values = generator.standard_normal((4, 2000, 8))
    values[:, 1:] *= np.sqrt(1 - correlation**2)
    for i in range(1, 2000):
        values[:, i] += correlation * values[:, i - 1]
    values += mean
    return SimpleNamespace(
        names=("x",), draws=lambda name: values.ravel(), by_step=lambda draws: draws.reshape(values.shape)
    )


def test_monte_carlo_errors_of_an_autoregressive_chain_agree_with_the_closed_form():
    """Known: tau = (1 + r)/(1 − r), for squares with r². Twenty batches know it to 16 %; allowed is four times that."""
    generator = np.random.default_rng(1)
    moments = sampling.moments(chain(generator, 0.8))["x"]
    draws = 32 * 2000
    assert moments["mean_error"] == pytest.approx(np.sqrt(1.8 / 0.2 / draws), rel=0.65)
    assert moments["sd_error"] == pytest.approx(np.sqrt(0.5 * 1.64 / 0.36 / draws), rel=0.65)


def test_sampler_with_a_bias_of_a_tenth_sd_is_detected():
    """The false-alarm rate of the limit is 1 %; the difference is six Monte Carlo errors of both together or more."""
    generator = np.random.default_rng(2)
    right, same, off = (chain(generator, 0.8, mean) for mean in (0.0, 0.0, 0.1))
    limit = sampling.limit(2, 4)
    assert max(d["errors"] for d in sampling.compare_all({"one": right, "other": same})) < limit
    assert max(d["errors"] for d in sampling.compare_all({"one": right, "other": off})) > limit


def test_missed_second_branch_passes_only_without_claimed_convergence():
    mass = {"found": 0.0, "by_quadrature": 0.0122, "monte_carlo_error": 0.001}
    run = {"sd": 0.6, "converged": True, "tau": {"a": 8.0}, "reason": "stop rule passed", "negative_mass": mass}
    ridge = {name: run for name in ("default", "natural", "uncut")}
    ridge |= {"sd_by_quadrature": {"cut": 0.5953, "uncut": 0.6411}, "uncut_prior": run | {"converged": False}}
    claimed, honest = (r for r in sampling_ridge.rows(ridge) if "second branch" in r["what"])
    assert claimed["met"] is False and honest["met"] is True and "not called converged" in honest["note"]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux holds a process on one core")
def test_overhead_of_a_worker_is_measured():
    found = sampling_cost.pool_overhead(1, ("process",), 1e-5)
    assert found["ratios"]["process"]["median"] > 0.0 and found["ratios"]["process"]["processor_time"] > 0.0
    assert found["log_posteriors"]["piece"] == 100 and found["log_posteriors"]["run"] >= 2000


def test_gain_has_no_verdict_if_a_plain_loop_gains_nothing():
    drive = {"gain": 1.2, "plain": 1.3, "ratio": 0.95, "ratio_quartiles": [0.9, 1.0]}
    cost = {
        "pools": None,
        "without_pools": "why",
        "vectorised": {"cores": 2, "force": drive, "displacement": drive | {"plain": 1.9}},
    }
    pool, dask, force, displacement = sampling_cost.rows(cost)
    assert pool["met"] is None and dask["met"] is None
    assert force["met"] is None and "not measurable" in force["note"] and force["value"] == 0.95
    assert displacement["met"] is True
    assert sampling_cost.loaded({"load_average": [0.1, 0, 0], "cores": 2}) == ""
    assert "busy" in sampling_cost.loaded({"load_average": [3.0, 0, 0], "cores": 2})


def test_rows_compare_values_with_their_limits():
    assert [row("x", value, 0.9, 1.1)["met"] for value in (0.8, 1.0, 1.2, None)] == [False, True, False, None]
    assert row("x", 5.0, 0.9, None)["met"] is True
    text = table_of_rows([row("x", 5.0, 0.9, None, "why"), row("y", None, 0.0, 1.0, "because")])
    assert "≥ 0.9" in text and "(2) because" in text


@pytest.mark.slow
def test_figures_are_there_small_and_not_empty(done):
    folder, _, printed = done
    figures = sorted(folder.glob("*.png"))
    assert [path.name for path in figures] == ["costs.png", "ridge.png", "samplers.png"]
    for path in figures:
        assert str(path) in printed
        assert path.stat().st_size <= 200_000
        with Image.open(path) as picture:
            assert len(picture.convert("RGB").getcolors(1 << 20)) > 5
