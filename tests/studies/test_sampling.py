import contextlib
import io
import json
import os
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy import integrate, stats

import bayesperiodic as bp
from studies.__main__ import main
from studies.common import row, table_of_rows
from studies.sampling import cost as sampling_cost
from studies.sampling import efficiency
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
    """The second branch with few steps, and samplers that are too short, have no verdict on their draws."""
    _, results, printed = done
    cut = found(results, "ridge, natural") + found(results, "by quadrature") + found(results, "against quadrature")
    assert len(cut) >= 7 and all(check["met"] is not False for check in cut)
    own = found(results, "ridge, bp.sample: sd(a) against quadrature")[0]
    assert own["met"] and own["value"] > 0.0
    assert "max_steps = 150 reached with" in results["ridge"]["natural"]["reason"]
    assert "Targets" in printed and "quadrature" in printed


@pytest.mark.slow
def test_every_row_has_a_value_or_a_reason(done):
    _, results, _ = done
    for check in results["checks"]:
        assert set(check) == {"what", "value", "low", "high", "met", "note"}
        assert check["value"] is not None or check["note"]
        assert check["met"] is not None or check["note"]
    assert results["quick"] is True and len(results["cost"]["load_average"]) == 3
    assert set(results["seconds"]) > {"branches", "ridge", "damper", "cost", "total"}
    assert {check["value"] for check in found(results, "wall time of a pool")} == {None}


@pytest.mark.slow
def test_every_contender_has_a_run_or_a_reason(done):
    cases = done[1]["efficiency"]
    assert set(cases) == {"damper", "ridge"}
    for case in cases.values():
        assert set(case["samplers"]) | set(case["without"]) == set(efficiency.CONTENDERS)
        assert not set(case["samplers"]) & set(case["without"]) and all(case["without"].values())
        for entry in case["samplers"].values():
            assert entry["ess_per_second"] == pytest.approx(entry["ess_min"] / entry["seconds"])
            assert entry["ess_per_1000"] == pytest.approx(1000 * entry["ess_min"] / entry["evaluations"])
    damper = cases["damper"]["samplers"]
    # Steps of 4 ensembles of 32 walkers, and their start points.
    assert damper["emcee"]["evaluations"] == 128 * 201
    assert damper["bp.sample"]["converged"] is False and "max_steps = 150" in damper["bp.sample"]["reason"]
    assert damper["emcee"]["moments"]["Kx"]["mean"] > 0.0 and damper["emcee"]["moments"]["rho"]["sd_error"] > 0.0
    assert found(done[1], "over emcee's default move")[0]["value"] > 1.0


@pytest.fixture(scope="module")
def ridge():
    with pytest.warns(UserWarning, match="do not change under a"):
        return efficiency.Case(sampling_ridge.ridge_problem(sampling_ridge.CUT))


def test_every_sampler_evaluates_the_same_density(ridge):
    """In natural coordinates it differs from that in logarithms by the Jacobian determinant a·b."""
    log, natural = efficiency.Target(ridge), efficiency.Target(ridge, "natural")
    points = ridge.starts(5, np.random.default_rng(1))
    assert np.all(points > 0.0)
    assert log(np.log(points)) - natural(points) == pytest.approx(np.log(points).sum(axis=1), rel=1e-8, abs=1e-8)
    theirs = ridge.problem.log_posterior(points, ridge.problem.noise_values({}))
    assert natural(points) == pytest.approx(theirs, rel=1e-12)
    assert (log.calls, natural.calls) == (5, 10)


def test_effective_sample_size_is_that_of_the_posterior(ridge):
    posterior = bp.sample(ridge.problem, ridge.fit, seed=1, max_steps=100, progress=False)
    run = efficiency.CONTENDERS["bp.sample"].run(ridge, 1, 100)
    assert run.ess == pytest.approx(min(posterior.ess.values()), rel=1e-12)
    assert run.calls == posterior.log_posterior_calls and run.reason == posterior.reason


def test_moments_of_weighted_draws_are_those_of_the_weights():
    """Draws 0 and 4 with weights 3/4 and 1/4; errors are the sds among the replicas."""
    values, weights = np.array([[0.0], [4.0]]), np.array([0.75, 0.25])
    replicas = (values, weights), (values, weights[::-1])
    run = efficiency.Run(values[None, :, None], 10, 2.0, "", True, weights, replicas)
    root = np.sqrt(3.0)
    assert run.moments(["x"])["x"] == pytest.approx({"mean": 1.0, "sd": root, "mean_error": 1.0, "sd_error": 0.0})
    assert run.ess == pytest.approx(1.6) and run.account(["x"])["ess_per_1000"] == pytest.approx(160.0)
    assert run.length == np.inf and replace(run, converged=False).length == 0.0


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


def chain(generator: np.random.Generator, correlation: float, mean: float = 0.0) -> efficiency.Run:
    """Return four ensembles of 8 walkers over 2000 steps, autoregressive with unit variance."""
    values = generator.standard_normal((4, 2000, 8, 1))
    values[:, 1:] *= np.sqrt(1 - correlation**2)
    for i in range(1, 2000):
        values[:, i] += correlation * values[:, i - 1]
    return efficiency.Run(values + mean, values.size, 1.0, "")


def test_monte_carlo_errors_of_an_autoregressive_chain_agree_with_the_closed_form():
    """Known: tau = (1 + r)/(1 − r), for squares with r². Twenty batches know it to 16 %; allowed is four times that."""
    run = chain(np.random.default_rng(1), 0.8)
    moments, draws = run.moments(["x"])["x"], 32 * 2000
    assert moments["mean_error"] == pytest.approx(np.sqrt(1.8 / 0.2 / draws), rel=0.65)
    assert moments["sd_error"] == pytest.approx(np.sqrt(0.5 * 1.64 / 0.36 / draws), rel=0.65)
    assert run.ess == pytest.approx(draws / 9.0, rel=0.25) and run.length == pytest.approx(2000 / 9.0, rel=0.25)


def test_sampler_with_a_bias_of_a_tenth_sd_is_detected():
    """The false-alarm rate of the limit is 1 %; the difference is six Monte Carlo errors of both together or more."""
    generator = np.random.default_rng(2)
    right, same, off = (chain(generator, 0.8, mean).moments(["x"]) for mean in (0.0, 0.0, 0.1))
    limit = sampling.limit(2)
    assert max(d["errors"] for d in sampling.compare_all({"one": right, "other": same})) < limit
    assert max(d["errors"] for d in sampling.compare_all({"one": right, "other": off})) > limit


def entry(sd: float, length: float = 80.0, converged: bool | None = True, ess_per_1000: float = 300.0) -> dict:
    moments = {"a": {"mean": 1.0, "sd": sd, "mean_error": 0.01, "sd_error": 0.01}}
    found = {"moments": moments, "length": length, "converged": converged, "reason": "why"}
    return found | {"ess_per_1000": ess_per_1000}


def test_wrong_spread_on_the_ridge_fails_unless_the_run_is_short():
    right, wrong, short = sampling.against_quadrature(
        {"right": entry(0.60), "wrong": entry(0.70), "short": entry(0.70, 12.0)}
    )
    assert right["met"] is True and wrong["met"] is False
    assert short["met"] is None and "only 12 tau" in short["note"]


def test_targets_of_efficiency_can_fail():
    samplers = {"bp.sample": entry(1.0), "NUTS": entry(1.0, converged=False), "emcee": entry(1.0, 12.0, None, 50.0)}
    worst = {"samplers": ["bp.sample", "NUTS"], "quantity": "sd of a", "errors": 9.0}
    case = {"samplers": samplers, "without": {"bp.sample, collapsed": "because"}, "compared": 2}
    own, collapsed, nuts, gain, largest = sampling.rows({"damper": case | {"largest_difference": worst}}, False)
    assert own["met"] is True and nuts["met"] is False and nuts["note"] == "why"
    assert collapsed["met"] is None and collapsed["note"] == "because"
    assert gain["value"] == pytest.approx(6.0) and gain["met"] is False
    assert largest["met"] is False and "shorter than 50 tau: emcee" in largest["note"]
    *_, largest = sampling.rows({"damper": case | {"largest_difference": None}}, True)
    assert largest["met"] is None and "no two long runs" in largest["note"]


def test_missed_second_branch_passes_only_without_claimed_convergence():
    mass = {"found": 0.0, "by_quadrature": 0.0122, "monte_carlo_error": 0.001}
    run = {"sd": 0.6, "converged": True, "tau": {"a": 8.0}, "reason": "stop rule passed", "negative_mass": mass}
    ridge = {name: run for name in ("natural", "uncut")}
    ridge |= {"sd_by_quadrature": {"cut": 0.5953, "uncut": 0.6411}, "uncut_prior": run | {"converged": False}}
    claimed, honest = (r for r in sampling_ridge.rows(ridge) if "second branch" in r["what"])
    assert claimed["met"] is False and honest["met"] is True and "not called converged" in honest["note"]


def test_wrong_spread_of_the_natural_chain_passes_only_without_claimed_convergence():
    for sd, converged, met in ((0.6, True, True), (0.5, True, False), (0.5, False, True)):
        mass = {"found": 0.0122, "by_quadrature": 0.0122, "monte_carlo_error": 0.001}
        run = {"sd": sd, "converged": converged, "reason": "why", "negative_mass": mass}
        ridge = {"natural": run, "uncut": run, "uncut_prior": run}
        ridge["sd_by_quadrature"] = {"cut": 0.5953, "uncut": 0.6411}
        assert [r["met"] for r in sampling_ridge.rows(ridge) if "natural" in r["what"]] == [met]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux holds a process on one core")
def test_overhead_of_a_worker_is_measured():
    found = sampling_cost.pool_overhead(1, ("process",), 1e-5)
    assert found["ratios"]["process"]["median"] > 0.0 and found["ratios"]["process"]["processor_time"] > 0.0
    assert found["log_posteriors"]["piece"] == 16 and found["log_posteriors"]["run"] >= 2000


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
    assert ">= 0.9" in text and "(2) because" in text


@pytest.mark.slow
def test_figures_are_there_small_and_not_empty(done):
    folder, _, printed = done
    figures = sorted(folder.glob("*.png"))
    assert [path.name for path in figures] == ["branches.png", "ridge.png", "samplers.png"]
    for path in figures:
        assert str(path) in printed
        assert path.stat().st_size <= 200_000
        with Image.open(path) as picture:
            assert len(picture.convert("RGB").getcolors(1 << 20)) > 5
