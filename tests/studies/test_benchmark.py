import argparse
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import bayesperiodic as bp
from studies.__main__ import main
from studies.benchmark import contenders, peers, posteriors, problems, scaling, targets
from studies.benchmark import floor as benchmark_floor
from studies.benchmark import run as benchmark
from studies.benchmark.integration import (
    EQUILIBRIUM,
    PREDICTED,
    SHOOTING,
    STARTS,
    STEADY,
    Discretised,
    Method,
    loosest,
    refer,
)
from studies.benchmark.kernels import NUMPY, FirstOrder, dense, eliminate, signals, table
from studies.benchmark.problems import DUFFING_TRUTH, Setting, draws
from studies.damper import run as damper
from studies.gear import measured
from studies.timing import Action, interleaved, slope, spread

MODELS = ("landing_gear force", "landing_gear displacement", "duffing", "dahl", "pendulum", "silverbox")


@pytest.fixture(scope="module")
def setting():
    # A Duffing oscillator whose motion becomes steady within tens of cycles.
    samples, truth = 96, DUFFING_TRUTH | {"c": 0.2}
    wave = np.cos(2 * np.pi * np.arange(samples) / samples)
    experiments = measured(bp.models.duffing, truth, [(0.1, {"force": 0.4 * wave})], samples, 1)
    priors = {name: bp.LogNormal(truth[name], 0.5) for name in ("c", "k", "k3")}
    problem = bp.Problem(bp.models.duffing, experiments, priors=priors, fixed={"m": 1.0}, scheme="central4")
    fit = bp.map_estimate(problem, progress=False)
    return Setting("Duffing", problem, fit, draws(problem, fit, 2, 1), True, lambda *_: np.zeros(2))


@pytest.mark.parametrize("which", MODELS)
def test_the_first_order_form_satisfies_the_equations(which):
    name, _, drive = which.partition(" ")
    model = bp.models.landing_gear(drive) if drive else getattr(bp.models, name)
    first, generator = FirstOrder(model, tuple(model.parameters)), np.random.default_rng(3)
    y, u = generator.uniform(0.5, 1.5, first.size), generator.uniform(0.5, 1.5, 3 * len(model.inputs) + 1)
    p = generator.uniform(0.5, 1.5, len(model.parameters) + 1)
    rate, jacobian, shifted = np.empty(first.size), np.empty((first.size, first.size)), np.empty((2, first.size))
    first.function(NUMPY, first.rates)(y, u, p, rate)
    known = dict(zip(first.states, y, strict=True)) | dict(zip(model.parameter_symbols.values(), p, strict=False))
    known |= {model.time_symbols["tau"]: u[-1], model.time_symbols["frequency"]: p[-1]}
    known |= {model.input_symbols[d + n]: u[3 * i + k] for i, n in enumerate(model.inputs) for k, d in _orders()}
    for state, order in model.orders.items():
        below = first.states.index(model.state_symbols["d" * (order - 1) + state])
        known[model.state_symbols["d" * order + state]] = rate[below]
    for equation in model.equations:
        size = max(abs(float(term.subs(known))) for term in equation.as_ordered_terms())
        assert abs(float(equation.subs(known))) < 1e-12 * max(size, 1.0)
    first.function(NUMPY, first.by_states(first.rates))(y, u, p, jacobian)
    for j in range(first.size):
        step = 1e-5 * np.eye(first.size)[j]
        for row, sign in enumerate((1.0, -1.0)):
            first.function(NUMPY, first.rates)(y + sign * step, u, p, shifted[row])
        size = np.abs(jacobian).max() + np.abs(rate).max()
        assert jacobian[:, j] == pytest.approx((shifted[0] - shifted[1]) / 2e-5, abs=1e-6 * size)


def _orders():
    return enumerate(("", "d", "dd"))


def test_inputs_are_interpolated_trigonometrically():
    samples, time = 32, np.arange(512) / 512
    experiment = bp.Experiment(
        "run", 0.5, {"displacement": np.arange(32.0)}, {"force": _wave(samples)}, samples=samples
    )
    values = table(experiment, ["force"], 512)
    assert values[:, 0] == pytest.approx(np.cos(2 * np.pi * time) + 0.3 * np.sin(4 * np.pi * time), abs=1e-12)
    exact = np.pi * (-np.sin(2 * np.pi * time) + 0.6 * np.cos(4 * np.pi * time))
    assert values[:, 1] == pytest.approx(exact, abs=1e-11) and values[:, 3] == pytest.approx(time)
    found = np.empty(4)
    signals(values, 7.3, found)
    assert found[0] == pytest.approx(np.cos(0.6 * np.pi) + 0.3 * np.sin(1.2 * np.pi), abs=1e-8)


def _wave(samples):
    angle = 2 * np.pi * np.arange(samples) / samples
    return np.cos(angle) + 0.3 * np.sin(2 * angle)


def test_elimination_uses_pivoting():
    generator = np.random.default_rng(1)
    matrix, right = generator.standard_normal((3, 3)), generator.standard_normal(3)
    matrix[0, 0] = 0.0
    exact = np.linalg.solve(matrix, right)
    eliminate(matrix, right)
    assert right == pytest.approx(exact, rel=1e-12)


@pytest.mark.slow
def test_integration_shooting_and_scipy_agree_on_the_orbit(setting):
    case = setting.cases[0]
    p, one = case.estimate, Discretised(case, 400)
    ends = []
    for kind in (STEADY, SHOOTING):
        for start in STARTS:
            assert Method(one, 1e-10, kind, start).run(p) > 0
            ends.append(one.orbit)
    assert np.ptp(ends, axis=0) == pytest.approx(0.0, abs=1e-8)
    found = solve_ivp(
        case.compiled.rates_in_time, (0.0, case.period), ends[0], "DOP853", rtol=1e-12, atol=1e-12,
        args=(p, case.table(16_384), case.period),
    )  # fmt: skip
    assert found.y[:, -1] == pytest.approx(ends[0], abs=1e-8)


def test_the_runge_kutta_method_and_its_dense_output_are_of_fourth_order(setting):
    case, orbits, between = setting.cases[0], [], []
    for steps in (50, 100, 1600):
        one = Discretised(case, steps)
        assert one.shoot(case.estimate, PREDICTED, 1e-11)
        orbits.append(one.orbit)
        at, out = 2 * np.pi * np.arange(steps + 1) / steps, np.empty((64, 1))
        dense(np.sin(at)[:, None], np.cos(at)[:, None], 2 * np.pi / steps, out)
        between.append(np.abs(out[:, 0] - np.sin(2 * np.pi * np.arange(64) / 64)).max())
    errors = [np.abs(orbit - orbits[2]).max() for orbit in orbits[:2]]
    assert 3.5 < np.log2(errors[0] / errors[1]) < 4.6
    assert between[0] < 1e-6 and 3.5 < np.log2(between[0] / between[1]) < 4.6


@pytest.mark.filterwarnings("ignore")
def test_log_posteriors_with_cut_harmonics_equal_those_of_the_package():
    experiment = damper.generate(1).fold(400)
    problem = bp.Problem(bp.models.dahl, [experiment], priors=damper.PRIORS)
    fit = bp.map_estimate(problem, progress=False)
    made = Setting("damper", problem, fit, draws(problem, fit, 2, 1), True, lambda *_: np.zeros(1))
    outputs, _ = problem.outputs(made.theta)
    (case,) = made.cases
    for k, theta in enumerate(made.theta):
        own = made.log_prior(theta) + case.log_likelihood(outputs[experiment.name]["force"][k][:, None])
        assert own == pytest.approx(float(problem.log_posterior(theta, made.noise)), abs=1e-8)


def test_gradient_by_shooting_equals_differences_of_its_value(setting):
    case, sd = setting.cases[0], np.array(list(setting.fit.sd.values()))
    one, theta = Discretised(case, 200), setting.theta[0]
    _, gradient = one.value_and_gradient(setting.parameters(theta, case)[0], 1e-11)
    method = Method(one, 1e-11)
    for k in range(theta.size):
        step = 0.01 * sd[k] * np.eye(theta.size)[k]
        up, down = (method(setting.parameters(theta + sign * step, case)[0]) for sign in (1.0, -1.0))
        assert gradient[k] * sd[k] == pytest.approx((up - down) / 0.02, rel=1e-4, abs=1e-4)


def test_every_contender_is_accurate_before_it_is_timed(setting):
    reference = refer(setting)
    assert reference.uncertainty < 1e-6
    contest = contenders.Contest(reference)
    scheme = contenders.add_own(contest)
    contenders.add_compiled(contest)
    peers.add_scipy(contest)
    contest.add("wrong", 0.02, Action(lambda: pytest.fail("timed")))
    found = contenders.measured(contest, scheme, 2)
    rows = {row["name"]: row for row in found["rows"]}
    assert rows["wrong"]["milliseconds"] is None and "not accurate enough" in rows["wrong"]["note"]
    for row in found["rows"]:
        assert (row["milliseconds"] is None) == (row["error"] is None or row["error"] > found["allowed"])
    timed = {name for name, row in rows.items() if row["milliseconds"]}
    assert {f"{kind} {start}" for kind in (STEADY, SHOOTING) for start in STARTS} < timed
    assert {f"{name} {EQUILIBRIUM}" for name in ("LSODA", "Radau", "solve_bvp")} < timed
    assert scheme is not None and rows[f"this package, warm, {scheme}"]["ratio"]["median"] == 1.0
    assert rows[f"this package, value and gradient, {scheme}"]["gradient_error"] < 1e-6
    json.dumps(found)


def test_timings_are_interleaved_and_ratios_taken_within_a_repeat():
    order = []
    actions = {
        "a": Action(lambda: order.append("a")),
        "b": Action(lambda: order.append("b") or 6.0, of=3),
        "once": Action(lambda: order.append("once"), most=1),
    }
    times = interleaved(actions, 2)
    assert order == ["a", "b", "a", "b", "once", "a", "b"]
    assert times["b"].tolist() == [2.0, 2.0] and np.isnan(times["once"][1])
    found = spread(np.array([2.0, 9.0, np.nan]) / np.array([1.0, 3.0, 1.0]))
    assert found == {"median": 2.5, "least": 2.0, "largest": 3.0}
    assert slope([1, 2, 4], [3, 12, 48]) == pytest.approx(2.0)


def test_targets_are_reported_as_met_or_missed():
    def entry(name, value):
        return {"name": name, "ratio": value and {"median": value}, "note": "never right", "gradient_error": None}

    rows = [entry("LSODA from equilibrium", 101.0), entry("solve_bvp from equilibrium", 19.0)]
    rows += [entry("Radau from equilibrium", None)]
    found = {"problems": {"damper": {"rows": rows, "scheme": None, "gradient_ratio": None}}, "floor": {}}
    met = {row["what"].split()[1]: row["met"] for row in targets.rows(found)}
    assert met == {"LSODA": True, "Radau": None, "solve_bvp": False}


@pytest.mark.slow
def test_a_quick_run_writes_table_and_figure(tmp_path, capsys, setting, monkeypatch):
    monkeypatch.setattr(benchmark, "problems", lambda options: {problems.FORCE: lambda: setting})
    monkeypatch.setattr(benchmark_floor, "with_all_free", lambda one, scheme: (one.schemed(scheme), one.theta[0]))
    assert main(["benchmark", "--quick", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    printed = capsys.readouterr().out
    assert "SYNTHETIC" in printed and "dgbtrf" in printed and "Targets" in printed
    assert (tmp_path / "benchmark.png").stat().st_size > 1000
    floor = results["floor"][problems.FORCE]["schemes"]["central4"]
    assert floor["same_grid_error"] < 1e-4 and floor["floor_us"]["sum"]["median"] > 0.0
    assert {row["what"].split(":")[0] for row in results["checks"]} >= {problems.FORCE}


def test_missing_peer_has_a_row_with_the_reason(setting, monkeypatch):
    monkeypatch.setattr(peers.importlib.util, "find_spec", lambda name: None)
    contest = contenders.Contest(refer(replace(setting, name=problems.DUFFING)))
    peers.add_peers(contest)
    rows = contenders.measured(contest, None, 1)["rows"]
    assert [row["name"] for row in rows] == [*peers.DIFFRAX_ROWS, peers.BALANCE]
    for row in rows:
        assert row["milliseconds"] is None and "is not installed (pip install" in row["note"]


@pytest.mark.parametrize("peer", ["diffrax", "harmonicbalance"])
def test_peers_give_accurate_results(setting, peer):
    pytest.importorskip(peer)
    case = setting.cases[0]
    one, p = Discretised(case, 800), setting.parameters(setting.theta, case)
    exact = np.array([Method(one, 1e-10)(row) for row in p])
    make, settings = {
        "diffrax": (peers.Integrated, peers.RELATIVE), "harmonicbalance": (peers.Balanced, peers.HARMONICS)
    }[peer]  # fmt: skip
    found = loosest(partial(make, one), settings, p, exact, 1e-3)
    assert found is not None and [found(row) for row in p] == pytest.approx(exact, abs=2e-3)


def test_the_density_of_the_peers_is_the_posterior_with_the_variance_integrated_out(setting):
    """∫ p(θ, log v) d log v is proportional to p(θ) M^(−n/2): compared by quadrature of the package's density."""
    methods = [Method(Discretised(case, 400), 1e-9) for case in setting.cases]
    density, warm = posteriors.collapsed(setting, methods), setting.problem.anchored(setting.fit.theta)
    logs = np.log(setting.noise) + np.linspace(-1.5, 1.5, 301)[:, None]
    found = []
    for theta in setting.theta:
        values = warm.log_posterior(np.tile(theta, (len(logs), 1)), np.exp(logs))
        found.append(np.log(np.exp(values - values.max()).sum()) + values.max() - density(theta))
    assert np.ptp(found) < 1e-3
    assert density(-setting.theta[0]) == -np.inf


def test_potential_in_jax_equals_the_density(setting):
    jax = pytest.importorskip("jax")
    pytest.importorskip("diffrax")
    methods = [Method(Discretised(case, 800), 1e-9) for case in setting.cases]
    tuned = [peers.Integrated(method.discretised, 1e-9) for method in methods]
    density = posteriors.collapsed(setting, methods)
    middle, factor = np.log(setting.estimate), posteriors._axes(setting)
    potential = jax.jit(posteriors._potential(setting, tuned, middle, factor))
    off = []
    for z in (np.zeros(3), np.array([0.5, -1.0, 0.3])):
        theta = np.exp(middle + factor @ z)
        off.append(float(potential(z)) + density(theta) + np.log(theta).sum())
    assert off[0] == pytest.approx(off[1], abs=1e-3)


def test_integration_leaves_an_unstable_orbit_at_the_rate_of_its_multiplier():
    """The upright equilibrium's perturbation grows; hanging at rest stays."""
    hanging = benchmark.distances(np.zeros(2))
    assert max(hanging) == 0.0
    upright = benchmark.distances(np.array([np.pi, 1e-9]))
    assert upright[0] > 1e-8 and max(upright) > benchmark.LEFT


def test_guard_compares_ratios_and_names_the_worse_ones(tmp_path):
    def spread(median, share):
        return {"median": median, "least": median * (1.0 - share), "largest": median * (1.0 + share)}

    def results(contender, over_floor, share=0.1):
        row = {"name": "shooting", "ratio": spread(contender, share), "milliseconds": {"median": 1e9}}
        floor = {"schemes": {"central4": {"ratio": {"near": spread(over_floor, share)}}}}
        own = {"name": "this package, cold", "ratio": {"median": 9.0}}
        return {"problems": {"damper": {"rows": [row, own]}}, "floor": {"gear": floor}}

    assert targets.worse(results(1.0, 0.5), results(1.5, 0.4)) == []
    lines = targets.worse(results(1.0, 0.5), results(2.0, 0.2))
    assert len(lines) == 2 and "shooting" in lines[0] and "floor" in lines[1]
    assert targets.worse(results(1.0, 0.5, 0.5), results(2.0, 0.2, 0.5)) == []
    kept = tmp_path / "results.json"
    with pytest.raises(FileNotFoundError, match="run the study with --publish first"):
        benchmark.read_kept(kept)
    kept.write_text(json.dumps(results(2.0, 0.5)), encoding="utf-8")
    with pytest.raises(RuntimeError, match="shooting"):
        benchmark.guard(results(1.0, 0.5), benchmark.read_kept(kept))


def test_guard_times_the_draws_of_the_full_run():
    def drawn(**given):
        options = argparse.Namespace(**{"quick": False, "guard": False, "seed": 3, "data": None} | given)
        return benchmark.problems(options)[problems.DUFFING]().theta

    np.testing.assert_array_equal(drawn(quick=True, guard=True), drawn())
    assert len(drawn(quick=True)) < len(drawn())


def test_exponents_of_power_laws_are_recovered():
    def seconds(size):
        return 1e-3 * size**1.5 * float(np.ones(1_000_000 * size).mean())

    sizes = (2, 4, 7)
    growth = scaling._fitted(sizes, [partial(seconds, size) for size in sizes], 3)
    assert growth["time_exponent"] == pytest.approx(1.5, abs=1e-12)
    assert growth["memory_exponent"] == pytest.approx(1.0, abs=1e-2)
    assert growth["seconds"] == pytest.approx([seconds(size) for size in sizes])


def test_memory_of_the_batched_call_grows_no_faster_than_the_walkers():
    calls = [scaling._batched(samples=200, experiments=2, walkers=walkers) for walkers in (64, 256)]
    peaks = [scaling._peak(call) for call in calls]
    assert slope([64, 256], peaks) < 1.2


def test_posterior_and_scaling_are_reported_with_verdicts():
    walked = {"ess_per_log_posterior": 0.02}
    own = {"ess_per_second": 100.0, "ess_per_log_posterior": 0.05, "seconds": 10.0, "log_posteriors": 20_000}
    samplers = {"sample, default": own, posteriors.NUMPYRO: {"note": "jax is not installed"}}
    around = {
        "shooting from equilibrium": {"ess_per_second": 50.0, "milliseconds": 0.4},
        "LSODA from equilibrium": {"ess_per_second": 0.02, "milliseconds": 1000.0},
    }
    split = posteriors._split(samplers, walked, around)
    assert split["against"]["shooting from equilibrium"] == pytest.approx({"ratio": 2.0, "sampler": 2.5, "solver": 0.8})
    posterior = {"samplers": samplers, "emcee": walked, "emcee_around": around, "split": split}
    growth = {"samples": {"time_exponent": 1.05, "memory_exponent": 1.3}}
    start = {"import_s": 0.5, "names_s": 0.9, "first_solve_s": 4.0, "empty_cache_s": 30.0, "from_cache_s": 0.2}
    start["peak_mb"] = 600.0
    found = {"problems": {}, "floor": {}, "posterior": posterior, "scaling": {"growth": growth, "start": start}}
    assert [row["met"] for row in targets.rows(found)] == [False, True, None, True, False, *4 * [True], False]
    assert "jax is not installed" in targets.posterior(posterior)
    assert scaling.account(found["scaling"]).endswith(" 600")
    assert len(benchmark.draw(found).axes) == 1
