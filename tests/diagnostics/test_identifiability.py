from types import SimpleNamespace

import numpy as np
import pytest
import sympy as sp
from scipy import integrate, stats

import bayesperiodic as bp
from bayesperiodic.diagnostics import identifiability
from bayesperiodic.diagnostics.design import FurtherExperiment, Information, _added, rank_candidates
from bayesperiodic.diagnostics.identifiability import cumulative_jensen_shannon, power_scaling, structure_of
from tests.known import GEAR, LINEAR, grid, linear_experiment, linear_regressors
from tests.pendulum import PENDULUM
from tests.problems import cycle_run, pendulum_run
from tests.sampling.test_targets import known, model, run

QUIET = {"progress": False}
SHORT = QUIET | {"seed": 1, "ensembles": 2, "max_steps": 250}
TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.LogNormal(800.0, 0.2), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)}
WIDE = bp.Normal(0.0, 2.0)
CUT = bp.TruncatedNormal(1.0, 1.0, 0.0, np.inf)


@pytest.fixture(scope="module")
def linear():
    problem = bp.Problem(LINEAR, [linear_experiment(TRUTH, 3.0, seed=1)], priors=PRIORS, fixed={"variance[force]": 9.0})
    return problem, bp.map_estimate(problem, **QUIET)


def one(force, value: float, sd: float, **priors) -> tuple[bp.Problem, bp.MapEstimate]:
    """Return the problem of one number, measured with an error of this sd, and its estimate."""
    problem = bp.Problem(
        model("one", list(priors), lambda p: {"force": force(p)}), [run(force=value)], priors=priors,
        fixed=known(force=sd),
    )  # fmt: skip
    return problem, bp.map_estimate(problem, start={name: 0.8 for name in priors}, **QUIET)


def verdicts(problem: bp.Problem, fit: bp.MapEstimate, **changes) -> dict[str, str]:
    posterior = bp.sample(problem, fit, **(SHORT | changes))
    return bp.identifiability(problem, fit, posterior).verdicts


def test_information_equals_that_of_the_regression(linear):
    """In ln k, c and coulomb: sds with all others known and unknown, in prior sds, from XᵀX/9."""
    problem, fit = linear
    found = Information.of(problem, fit)
    slopes = np.array([fit.theta["k"], 1.0, 1.0])
    design = linear_regressors(0.05, 2.0, grid(40)) * slopes
    matrix = design.T @ design / 9.0
    assert found.matrix == pytest.approx(matrix, rel=1e-8)
    assert found.prior_sd == pytest.approx([0.2, 20.0, 10.0], rel=1e-9)
    assert found.alone == pytest.approx(np.diag(matrix) ** -0.5 / [0.2, 20.0, 10.0], rel=1e-8)
    assert found.together == pytest.approx(np.sqrt(np.diag(np.linalg.inv(matrix))) / [0.2, 20.0, 10.0], rel=1e-8)
    assert found.collinearity == pytest.approx(found.together / found.alone)
    scaled = matrix * np.outer([1.0, 20.0, 10.0], [1.0, 20.0, 10.0])
    assert found.spectrum == pytest.approx(np.linalg.eigvalsh(scaled)[::-1], rel=1e-8)
    assert found.condition == pytest.approx(np.linalg.cond(scaled), rel=1e-8)


@pytest.mark.parametrize(("moved", "left"), [(1e-5, 0.01), (0.1, np.inf)])
def test_undetermined_direction_counts_for_the_parameters_it_moves(moved, left):
    """The direction (moved, 1, 1) is undetermined; k is otherwise known to 0.01 prior sds."""
    nothing = np.array([moved, 1.0, 1.0])
    directions = np.linalg.qr(np.column_stack([nothing, [1.0, 0.0, 0.0], [0.0, 1.0, -1.0]]))[0]
    matrix = directions @ np.diag([0.0, 1e4, 4.0]) @ directions.T
    found = Information(("k", "c", "shift"), np.zeros(3), np.zeros(3, dtype=bool), matrix, np.ones(3))
    assert found.together[0] == pytest.approx(left, rel=1e-3)
    assert np.isinf(found.together[1:]).all()


def test_contraction_equals_that_of_the_normal_posterior(linear):
    """With draws and without; the draws' within four of the Monte Carlo errors that are stated with it."""
    problem, fit = linear
    table = bp.identifiability(problem, fit, profile=False).table
    design = linear_regressors(0.05, 2.0, grid(40))
    posterior = np.linalg.inv(design.T @ design / 9.0 + np.diag([0.0, 20.0**-2, 10.0**-2]))
    expected = 1.0 - np.diag(posterior)[1:] / [20.0**2, 10.0**2]
    assert table.loc[["c", "coulomb"], "contraction"].to_numpy() == pytest.approx(expected, abs=2e-3)
    drawn = bp.identifiability(problem, fit, bp.sample(problem, fit, **SHORT), profile=False).table
    off = drawn.loc[["c", "coulomb"], "contraction"].to_numpy() - expected
    assert np.all(np.abs(off) < 4 * drawn.loc[["c", "coulomb"], "contraction_mcse"] + 2e-3)
    assert set(drawn["verdict"]) == {"determined"} and not any(drawn["remedy"])


@pytest.mark.filterwarnings("ignore:The data do not change under")
@pytest.mark.parametrize(
    ("force", "prior", "combination"),
    [(lambda p: p.a * p.b, CUT, "a*b"), (lambda p: p.a + p.b, WIDE, "a + b"), (lambda p: p.a / p.b**2, CUT, "a/b**2")],
    ids=["product", "sum", "power"],
)
def test_ridges_are_named(force, prior, combination):
    problem, fit = one(force, 1.0, 0.02, a=prior, b=prior)
    found = bp.identifiability(problem, fit)
    assert found.verdicts == {"a": "only in combination", "b": "only in combination"}
    assert found.directions.loc[0, "combinations"] == combination
    assert found.directions.loc[0, "gain"] == pytest.approx(0.0, abs=1e-6) and found.condition > 1e9
    assert f"fix one of a, b, or report {combination}" in repr(found)
    assert verdicts(problem, fit) == found.verdicts


@pytest.mark.parametrize(
    ("value", "sd", "prior", "verdict"),
    [
        (1.0, 0.05, WIDE, "determined"),
        (0.05, 0.1, WIDE, "sign undetermined"),
        (-0.9, 0.1, WIDE, "determined"),
        (1.0, 0.25, bp.LogNormal(1.0, 0.1), "only with the prior"),
        (1.0, 5.0, bp.LogNormal(1.0, 0.1), "not determined"),
        (-0.1, 0.1, CUT, "only with the prior"),
    ],
    ids=["positive", "small", "negative", "sharp prior", "hardly measured", "cut off"],
)
def test_directly_measured_parameter_is_determined(value, sd, prior, verdict):
    """The probability of the wrong sign is Φ(−value/sd), within four Monte Carlo errors."""
    problem, fit = one(lambda p: p.a, value, sd, a=prior)
    assert bp.identifiability(problem, fit).verdicts == {"a": verdict}
    posterior = bp.sample(problem, fit, **SHORT)
    found = bp.identifiability(problem, fit, posterior)
    assert found.verdicts == {"a": verdict}
    row = found.table.loc["a"]
    if prior is WIDE:
        exact = stats.norm.cdf(-value / sd, scale=1.0)
        assert row["p_negative"] == pytest.approx(exact, abs=4 * row["p_negative_mcse"] + 2e-3)
    else:
        assert np.isnan(row["p_negative"])


def test_sign_that_the_data_do_not_determine_is_reported():
    """Only a² is measured; the remedy is no further experiment."""
    problem, fit = one(lambda p: p.a**2, 1.0, 0.1, a=WIDE)
    posterior = bp.sample(problem, fit, **SHORT, start="prior")
    found = bp.identifiability(problem, fit, posterior, profile=False)
    assert found.verdicts == {"a": "sign undetermined"}
    assert "both signs fit the data" in found.table.loc["a", "remedy"]


@pytest.mark.filterwarnings("ignore:2 separate optima")
def test_sign_is_undetermined_without_draws_too():
    """a² = 1 ± 0.02 with the prior N(0.5, 2): the odds of the negative sign are exp(−(1.5² − 0.5²)/8)."""
    problem, fit = one(lambda p: p.a**2, 1.0, 0.02, a=bp.Normal(0.5, 2.0))
    found = bp.identifiability(problem, fit, profile=False)
    odds = np.exp(-0.25)
    assert found.verdicts == {"a": "sign undetermined"}
    assert found.table.loc["a", "p_negative"] == pytest.approx(odds / (1 + odds), abs=1e-3)
    assert "both signs fit the data" in found.table.loc["a", "remedy"]
    assert "No draws: the verdicts rest on the Laplace approximations at 2 optima" in repr(found)


@pytest.mark.filterwarnings("ignore:2 separate optima")
def test_parameter_with_two_values_is_not_determined():
    """(a − 2)² = 1: with draws from both optima and without, unless a single start has found one of them only."""
    two = model("two", ["a", "b"], lambda p: {"force": (p.a - 2) ** 2, "other": p.b})
    priors = {"a": bp.Uniform(0.001, 5.0), "b": bp.Normal(0.0, 5.0)}
    sds = known(force=0.02, other=0.02)
    problem = bp.Problem(two, [run(force=1.0, other=2.0)], priors=priors, fixed=sds)
    fit = bp.map_estimate(problem, **QUIET)
    found = bp.identifiability(problem, fit)
    assert found.verdicts == {"a": "several values", "b": "determined"}
    assert "at another optimum with more than 1 % of the mass" in found.table.loc["a", "evidence"]
    assert found.table.loc["b", "other_values"] == ""
    # Half the central 68 % of the prior is 1.71, and the sd of the mixture is 1.
    assert found.table.loc["a", "contraction"] == pytest.approx(1.0 - 1.0 / (0.5 * 0.6827 * 4.999) ** 2, abs=1e-3)
    posterior = bp.sample(problem, fit, **SHORT)
    assert 0.2 < np.mean(posterior.draws("a") > 2.0) < 0.8
    drawn = bp.identifiability(problem, fit, posterior, profile=False)
    assert drawn.verdicts == found.verdicts and "effective draws" in drawn.basis
    header, titles, a, b, determined, several, *_ = repr(found).split("\n")
    assert header.startswith("Identifiability of the parameters (data sd")
    assert titles.split() == ["verdict", "contraction", "P(negative)", "data", "sd", "others", "known", "profile"]
    assert a.startswith("a  several values") and b.startswith("b      determined       1.000")
    assert determined == "The data determine b."
    assert several == (
        f"a: several values, {found.table.loc['a', 'other_values']} at another optimum with more than 1 % of the mass. "
        "Recommendation: give a prior that excludes the other value, or measure an output that differs between them."
    )
    single = bp.identifiability(problem, bp.map_estimate(problem, start={"a": 2.9, "b": 2.0}, **QUIET), profile=False)
    assert single.verdicts["a"] == "determined"
    assert "at the only optimum found from 1 start (others were not looked for)" in repr(single)


def test_discrete_symmetry_of_the_equations_counts_where_the_search_has_missed_it():
    """Signs of five or more parameters are not changed in pairs; a·tanh(b) is the same for −a and −b."""
    names = ["a", "b", "c", "d", "e"]
    several = model(
        "several", names, lambda p: {"force": p.a * sp.tanh(p.b), "other": p.b**2, "c": p.c, "d": p.d, "e": p.e}
    )
    sizes = {"force": np.tanh(1.0), "other": 1.0, "c": 1.0, "d": 1.0, "e": 1.0}
    problem = bp.Problem(
        several, [run(**sizes)], priors=dict.fromkeys(names, WIDE), fixed=known(**dict.fromkeys(sizes, 0.01))
    )
    fit = bp.map_estimate(problem, start=dict.fromkeys(names, 0.9), **QUIET)
    found = bp.identifiability(problem, fit, profile=False)
    assert fit.other_modes == ()
    assert found.verdicts == {"a": "several values", "b": "several values"} | dict.fromkeys("cde", "determined")


def test_parameter_without_effect_is_not_determined():
    problem, fit = one(lambda p: p.a + 0 * p.b, 1.0, 0.05, a=WIDE, b=WIDE)
    assert bp.identifiability(problem, fit, profile=False).verdicts == {"a": "determined", "b": "not determined"}


def test_candidate_experiment_adds_the_information_of_a_real_one(linear):
    """A repeated run doubles the information; with twice the amplitude each linear regressor counts four times."""
    problem, fit = linear
    information = Information.of(problem, fit)
    found = rank_candidates(
        problem, fit, information, [FurtherExperiment("run", 2.0, 1.0), FurtherExperiment("run", 2.0, 2.0)]
    )
    scale = information.prior_sd
    now = information.matrix * np.outer(scale, scale) + np.eye(3)
    again = found[found["scale"] == 1.0].iloc[0]
    twice = np.linalg.inv(now + information.matrix * np.outer(scale, scale))
    assert again["gain"] == pytest.approx(-0.5 * (np.linalg.slogdet(twice)[1] + np.linalg.slogdet(now)[1]), rel=1e-6)
    ratio = np.sqrt(np.diag(twice) / np.diag(np.linalg.inv(now)))
    assert again[list(problem.names)].astype(float).to_numpy() == pytest.approx(ratio, rel=1e-6)
    louder = found.iloc[0]
    assert louder["scale"] == 2.0 and louder["k"] < again["k"] and louder["c"] < again["c"]


@pytest.mark.parametrize(
    "noise", ["independent", "circulant", bp.noise.Independent(per="experiment", prior=bp.InverseGamma(2, 1e-4))]
)
@pytest.mark.parametrize("harmonics", [1, 3, 9])
def test_repeated_runs_add_exactly_their_present_information(harmonics, noise):
    """Duffing's third harmonic tells much about k3, but nothing where only the first is kept."""
    inputs, runs = {"force": 2.0 * np.cos(2 * np.pi * grid(64))}, []
    for name, frequency in (("slow", 0.07), ("fast", 0.11)):
        made = bp.solve_periodic(
            bp.models.duffing, {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 1.0}, inputs, frequency=frequency, samples=64,
            scheme="fourier",
        )  # fmt: skip
        noisy = made.outputs["displacement"] + 0.01 * np.random.default_rng(len(runs)).standard_normal(64)
        kept = {"displacement": harmonics, "force": 1}
        runs.append(bp.Experiment(name, frequency, {"displacement": noisy}, inputs, samples=64, harmonics=kept))
    priors = {"c": bp.LogNormal(0.2, 1.0), "k": bp.LogNormal(1.0, 1.0), "k3": bp.LogNormal(1.0, 1.0)}
    problem = bp.Problem(bp.models.duffing, runs, priors=priors, fixed={"m": 1.0}, scheme="fourier", noise=noise)
    fit = bp.map_estimate(problem, start={"c": 0.2, "k": 1.0, "k3": 1.0}, **QUIET)
    information = Information.of(problem, fit)
    added = sum(_added(problem, fit, run, FurtherExperiment(run.name, run.frequency, 1.0)) for run in runs)
    assert added == pytest.approx(information.matrix, rel=1e-6)


def test_without_candidates_the_verdicts_are_the_same(linear):
    problem, fit = linear
    bare = bp.identifiability(problem, fit, profile=False, candidates=[])
    assert bare.experiments.empty and "gain" in bare.experiments
    assert bare.verdicts == bp.identifiability(problem, fit, profile=False).verdicts


def test_given_candidates_are_ranked_and_unknown_runs_rejected(linear):
    problem, fit = linear
    found = bp.identifiability(problem, fit, profile=False, candidates=[("run", 1.0, 0.5), ("run", 3.0, 2.0)])
    assert list(found.experiments["frequency"]) == [3.0, 1.0]
    with pytest.raises(ValueError, match="candidates: must be .*got 'ran'"):
        bp.identifiability(problem, fit, profile=False, candidates=[("ran", 1.0, 0.5)])


def test_distance_of_weighted_draws_is_that_of_their_distributions():
    """N(0, 1) against N(½, 1), by quadrature up to the outermost draws; within 2 % at 200 000 draws."""
    draws = np.random.default_rng(1).standard_normal(200_000)
    weights = np.exp(0.5 * draws)

    def distance(low: float, high: float, mean: float) -> float:
        def against(x, first, second):
            own, other = stats.norm.cdf(x, first), stats.norm.cdf(x, second)
            return own * np.log2(2 * own / (own + other)) + (other - own) / (2 * np.log(2))

        def both(x):
            return stats.norm.cdf(x) + stats.norm.cdf(x, mean)

        parts = [integrate.quad(against, low, high, args=pair, limit=200)[0] for pair in ((0.0, mean), (mean, 0.0))]
        return np.sqrt(sum(parts) / integrate.quad(both, low, high, limit=200)[0])

    exact = max(distance(draws.min(), draws.max(), 0.5), distance(-draws.max(), -draws.min(), -0.5))
    assert cumulative_jensen_shannon(draws, weights / weights.sum()) == pytest.approx(exact, rel=0.02)
    assert cumulative_jensen_shannon(draws, np.full(draws.size, 1.0 / draws.size)) == pytest.approx(0.0, abs=1e-7)


def test_power_scaling_distinguishes_prior_from_likelihood(linear):
    """A posterior dominated by the prior depends on the power of the prior only, and likewise for the data."""
    problem, fit = one(lambda p: p.a, 1.0, 5.0, a=bp.LogNormal(1.0, 0.1))
    table = bp.identifiability(problem, fit, bp.sample(problem, fit, **SHORT), profile=False).table
    assert table.loc["a", "prior_sensitivity"] > 0.05 > table.loc["a", "likelihood_sensitivity"]
    problem, fit = one(lambda p: p.a, 1.0, 0.05, a=WIDE)
    table = bp.identifiability(problem, fit, bp.sample(problem, fit, **SHORT), profile=False).table
    assert table.loc["a", "likelihood_sensitivity"] > 0.05 > table.loc["a", "prior_sensitivity"]


def test_power_scaling_weights_each_draw_by_its_own_likelihood():
    """The density that is sampled contains the prior and, of a logarithmic coordinate, its change of variable."""
    problem, fit = one(lambda p: p.a, 1.0, 0.5, a=bp.LogNormal(1.0, 0.7))
    posterior = bp.sample(problem, fit, **SHORT)
    draws = posterior.draws("a")[:, None]
    likelihood = problem.log_likelihood(draws, {})
    expected = []
    for power in (0.8, 1.25):
        weights = np.exp((power - 1.0) * (likelihood - likelihood.max()))
        expected.append(cumulative_jensen_shannon(draws[:, 0], weights / weights.sum()) / np.log2(1.25))
    (_, found) = power_scaling(problem, posterior)["a"]
    assert found == pytest.approx(np.mean(expected), rel=1e-6)


def test_probability_of_a_sign_has_an_error_even_if_all_draws_have_it():
    """Of n independent draws, all negative, the rate is taken as that of one more of each kind."""
    problem, fit = one(lambda p: p.a, -1.0, 0.01, a=WIDE)
    draws = SimpleNamespace(draws=lambda _: np.full(100, -1.0), ess={"a": 98.0})
    share, error = identifiability._negative(problem, fit, draws, "a")
    assert share == 1.0 and error == pytest.approx(np.sqrt(0.99 * 0.01 / 98.0))
    draws.draws = lambda _: np.full(100, 1.0)
    assert identifiability._negative(problem, fit, draws, "a") == (0.0, pytest.approx(np.sqrt(0.99 * 0.01 / 98.0)))


def test_weak_motion_at_one_frequency_determines_stiffness_and_mass_only_in_combination():
    """If the mass is free too, it determines k − m·ω² and little more."""
    force, truth = {"force": 0.3 * np.cos(2 * np.pi * grid(32))}, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}
    noise = {"displacement": 0.03}
    recording = bp.simulate(
        bp.models.duffing, truth, force, frequency=0.1, duration=400, sampling_rate=4, noise=noise, seed=1
    )
    priors = {"m": bp.LogNormal(1, 0.5), "c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1, 0.5)}
    weak = recording.fold(32, harmonics=3)
    problem = bp.Problem(bp.models.duffing, [weak], priors=priors, scheme="fourier", fixed={"k3": 0.5})
    found = bp.identifiability(problem, bp.map_estimate(problem, **QUIET), profile=False)
    assert found.verdicts == {"m": "only in combination", "c": "determined", "k": "determined"}
    assert found.table.loc["m", "remedy"] == "fix one of m, k"


def test_result_is_saved_and_loaded(linear, tmp_path):
    found = bp.identifiability(*linear, profile=False)
    found.save(tmp_path / "verdict.h5")
    assert repr(bp.load(tmp_path / "verdict.h5")) == repr(found)


@pytest.mark.filterwarnings("ignore:The data do not change under")
def test_structural_symmetries_are_named_for_any_data():
    """In one rotation of the pendulum m, k1, k2 and k3 appear only as k/(m l²), and l is determined by the drive."""
    fixed = {name: PENDULUM[name] for name in ("a", "g", "v0")}
    free = {name: bp.LogNormal(PENDULUM[name], 0.5) for name in ("m", "l", "k1", "k2", "k3")}
    problem = bp.Problem(bp.models.pendulum, [pendulum_run()], priors=free, fixed=fixed, scheme="central4")
    fit = bp.map_estimate(problem, start={name: PENDULUM[name] for name in free}, **QUIET)
    found = bp.identifiability(problem, fit, profile=False)
    assert found.verdicts["l"] == "determined"
    assert {found.verdicts[name] for name in ("m", "k1", "k2", "k3")} == {"only in combination"}
    assert found.structure.combinations == ("k1/(m*l**2)", "k2/(m*l**2)", "k3/(m*l**2)")
    assert "fix one of m, k1, k2, k3, or report k1/(m*l**2), k2/(m*l**2), k3/(m*l**2)" in repr(found)
    known = bp.Problem(
        bp.models.pendulum, [pendulum_run()], priors={n: free[n] for n in ("l", "k2", "k3")}, scheme="central4",
        fixed=fixed | {"m": 0.1, "k1": PENDULUM["k1"]},
    )  # fmt: skip
    assert not structure_of(known).symmetries


def test_structural_analysis_uses_ties_and_fixed_zeros():
    """The temperature scaling of the landing gear ends with theta5 fixed, the shift with theta12 at zero."""
    gear = bp.models.landing_gear("displacement")
    wave = np.cos(2 * np.pi * grid(40))
    noise = np.random.default_rng(1).standard_normal((2, 40))
    run = bp.Experiment(
        "run", 0.1, {"force": 5e3 + noise[0], "pressure": 1e6 + noise[1]}, {"displacement": 0.12 + 0.05 * wave},
        samples=40,
    )  # fmt: skip

    def found(free: tuple[str, ...], tied: dict[str, str]) -> bp.Structure:
        priors = {name: bp.Normal(GEAR[name], 0.1 * abs(GEAR[name]) + 0.1) for name in free}
        fixed = {name: value for name, value in GEAR.items() if name not in (*free, *tied)}
        return structure_of(bp.Problem(gear, [run], priors=priors, fixed=fixed, tied=tied))

    assert not found(("theta4", "theta6", "theta16"), {"theta11": "-1e5*theta4"}).symmetries
    loose = found(("theta5", "theta15", "theta16", "theta17"), {})
    assert [s.parameters for s in loose.symmetries] == [("theta5", "theta15", "theta16", "theta17")]
    held = found(("theta5", "theta15", "theta16"), {"theta17": "-293*theta16/2"})
    assert not held.symmetries


def test_free_running_model_gets_no_advice_about_a_drive_and_no_verdict_about_the_sign_of_its_phase():
    problem = bp.Problem(
        bp.models.van_der_pol, [cycle_run()], priors={"mu": bp.LogNormal(1.5, 0.3), "omega": bp.LogNormal(1.0, 1e-4)}
    )
    found = bp.identifiability(problem, bp.map_estimate(problem, **QUIET), profile=False)
    phase = next(name for name in problem.names if name.startswith("shift"))
    assert not len(found.experiments) and "sign" not in found.verdicts[phase]
    assert np.isnan(found.table.loc[phase, "p_negative"])
    assert found.verdicts["omega"] == "only with the prior"
    assert found.table.loc["omega", "remedy"] == "report it with its prior, or fix it; or measure another output"
