from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
import xarray as xr
from scipy import integrate, stats
from scipy.special import digamma, polygamma

import bayesperiodic as bp
from bayesperiodic.sampling import convergence
from bayesperiodic.sampling.chains import StoredChains
from bayesperiodic.sampling.draws import gather
from bayesperiodic.sampling.proposals import CallCount
from tests.known import (
    LINEAR,
    SADDLE_NODE,
    formula_model,
    grid,
    linear_experiment,
    linear_regressors,
    normal_posterior,
)

FIRST, SECOND = "run 7", "run 8, 14.5 Hz"
TRUTH = np.array([900.0, 40.0, 25.0])
PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.Normal(30.0, 20.0), "coulomb": bp.Normal(20.0, 10.0)}
FLAT = bp.Normal(0.0, 1e6)
QUIET = {"progress": False}
PAIR = QUIET | {"ensembles": 2}
REGRESSORS = linear_regressors(0.05, 2.0, grid(40))

# Two channels, of which an experiment may lack one.
TWO = formula_model(
    "two",
    {"k": "N/m", "c": "N s/m"},
    lambda p, u, s: {
        "force": p.k * u.x + p.c * u.dx,
        "rate": p.c * s.w,
        "time": p.k * sp.cos(2 * sp.pi * s.tau),
    },
    units={"x": "m", "force": "N", "rate": "m/s"},
)


def runs(coulombs=(25.0, 35.0), sd=3.0):
    return [
        linear_experiment(np.array([900.0, 40.0, coulomb]), sd, seed=seed, name=name)
        for seed, (name, coulomb) in enumerate(zip((FIRST, SECOND), coulombs, strict=True))
    ]


def drawn(problem, steps=12):
    """Return a posterior of chains that were made up, without any sampling."""
    density = problem.density()
    kept = 0.1 * np.random.default_rng(1).standard_normal((2, steps, 4, density.dimension))
    return gather(
        density,
        StoredChains.of(kept),
        kept.sum(axis=-1),
        CallCount(1),
        converged=True,
        reason="made up",
        acceptance=0.5,
        seed=0,
    ), kept


@pytest.fixture(scope="module")
def local():
    """Return a problem with a local parameter and known variances, its estimate and posterior."""
    problem = bp.Problem(LINEAR, runs(), priors=PRIORS, local=["coulomb"], fixed={"variance[force]": 9.0})
    fit = bp.map_estimate(problem, **QUIET)
    return problem, fit, bp.sample(problem, fit, seed=1, **PAIR)


def closed_form(experiments):
    """Return mean and covariance of (k, c, coulomb of each experiment) with variance 9 and the priors."""
    design = np.zeros((40 * len(experiments), 2 + len(experiments)))
    for i in range(len(experiments)):
        design[40 * i : 40 * (i + 1), :2] = REGRESSORS[:, :2]
        design[40 * i : 40 * (i + 1), 2 + i] = REGRESSORS[:, 2]
    count, data = len(experiments), np.concatenate([e.outputs["force"] for e in experiments])
    prior = np.diag([60.0, 20.0, *[10.0] * count]) ** 2
    return normal_posterior(design, data, 9.0, [800.0, 30.0, *[20.0] * count], prior)


def test_local_parameters_have_their_closed_form_within_monte_carlo_error(local):
    """Means and covariances within 4 Monte Carlo errors; the local parameters are coupled through the shared ones."""
    problem, _, posterior = local
    mean, covariance = closed_form(problem.experiments)
    assert posterior.converged
    assert posterior.names == problem.names == ("k", "c", f"coulomb[{FIRST}]", f"coulomb[{SECOND}]")
    draws = np.stack([posterior.draws(name) for name in posterior.names])
    sd, error = np.sqrt(np.diag(covariance)), 4 / np.sqrt(min(posterior.ess.values()))
    assert (draws.mean(axis=1) - mean) / sd == pytest.approx(np.zeros(4), abs=error)
    scale = np.outer(sd, sd)
    assert covariance[2, 3] / scale[2, 3] > 0.5
    assert np.cov(draws) / scale == pytest.approx(covariance / scale, abs=np.sqrt(2) * error)


@pytest.mark.parametrize(("prior", "spent"), [("jeffreys", 1), ("flat", 3)])
def test_variances_of_each_experiment_follow_their_closed_form(prior, spent):
    """With a local parameter and a flat prior M/v is χ² in every experiment independently."""
    problem = bp.Problem(
        LINEAR,
        runs(),
        priors={"coulomb": FLAT},
        fixed={"k": 900.0, "c": 40.0},
        local=["coulomb"],
        noise=bp.noise.Independent(per="experiment", prior=prior),
    )
    assert problem.free_noise == (f"variance[force, {FIRST}]", f"variance[force, {SECOND}]")
    posterior = bp.sample(problem, bp.map_estimate(problem, **QUIET), seed=2, max_steps=250, **PAIR)
    degrees, error = 40 - spent, 4 / np.sqrt(min(posterior.ess.values()))
    scores = []
    for e, name in zip(problem.experiments, problem.free_noise, strict=True):
        moment = profiled(e.outputs["force"] - REGRESSORS[:, :2] @ TRUTH[:2], REGRESSORS[:, 2:], np.eye(40))[1]
        scores.append((moment / posterior.draws(name) - degrees) / np.sqrt(2 * degrees))
    assert np.mean(scores, axis=1) == pytest.approx([0.0, 0.0], abs=error)
    assert np.cov(scores) == pytest.approx(np.eye(2), abs=2 * error)


def test_the_scale_of_a_covariance_follows_its_closed_form():
    """M/scale is χ², at the points of a mask."""
    (first, _), at = runs(), np.arange(40) % 2 == 0
    covariance = 4.0 * 0.5 ** np.abs(np.subtract.outer(np.arange(20), np.arange(20)))
    experiment = replace(first, mask=at, covariance=covariance, independent={})
    problem = bp.Problem(LINEAR, [experiment], priors={"coulomb": FLAT}, fixed={"k": 900.0, "c": 40.0})
    posterior = bp.sample(problem, bp.map_estimate(problem, **QUIET), seed=5, max_steps=250, **PAIR)
    data = (first.outputs["force"] - REGRESSORS[:, :2] @ TRUTH[:2])[at]
    moment, error = profiled(data, REGRESSORS[at, 2:], covariance)[1], 4 / np.sqrt(posterior.ess["scale"])
    scores = (moment / posterior.draws("scale") - 19) / np.sqrt(2 * 19)
    assert scores.mean() == pytest.approx(0.0, abs=error)
    assert scores.std() == pytest.approx(1.0, abs=2 * error)


def profiled(data, design, matrix):
    """Return the generalised least squares estimate, its M, and ln|C| + ln|XᵀC⁻¹X|."""
    solved = np.linalg.solve(matrix, design)
    estimate = np.linalg.solve(design.T @ solved, solved.T @ data)
    residual = data - design @ estimate
    logs = np.linalg.slogdet(matrix)[1] + np.linalg.slogdet(design.T @ solved)[1]
    return estimate, residual @ np.linalg.solve(matrix, residual), logs


def circulant(lengthscale):
    """Return the correlation of 40 points with the exponential kernel's spectrum."""
    harmonic = np.minimum(np.arange(40), 40 - np.arange(40))
    spectrum = 1 / (1 + (2 * np.pi * harmonic * lengthscale) ** 2)
    waves = np.exp(2j * np.pi * np.outer(np.arange(40), np.arange(40)) / 40)
    return (waves * spectrum / spectrum.mean() @ waves.conj().T).real / 40


def test_correlated_errors_have_the_posterior_of_a_quadrature_over_the_correlation_length():
    """Flat θ and Jeffreys' v are integrated out in closed form, with dense covariances; one integral is left."""
    noise = 3.0 * np.linalg.cholesky(circulant(0.05)) @ np.random.default_rng(3).standard_normal(40)
    clean = linear_experiment(TRUTH, 0.0, seed=0)
    experiment = replace(clean, outputs={"force": clean.outputs["force"] + noise})
    problem = bp.Problem(
        LINEAR,
        [experiment],
        priors={"k": FLAT},
        fixed={"c": 40.0, "coulomb": 25.0},
        noise=bp.noise.Circulant(kernel="exponential"),
    )
    fit = bp.map_estimate(problem, **QUIET)
    posterior = bp.sample(problem, fit, seed=3, max_steps=250, **PAIR)
    assert posterior.names == ("k", "variance[force]", "lengthscale[force]")

    data = experiment.outputs["force"] - REGRESSORS[:, 1:] @ TRUTH[1:]
    logs = np.linspace(np.log(1e-4), np.log(10.0), 400)
    rows = [profiled(data, REGRESSORS[:, :1], circulant(np.exp(x))) for x in logs]
    k, moment, determinant = np.array([r[0][0] for r in rows]), np.array([r[1] for r in rows]), [r[2] for r in rows]
    density = -0.5 * (np.array(determinant) + 39 * np.log(moment)) - 0.5 * ((logs - np.log(0.03)) / 1.5) ** 2
    weights = np.exp(density - density.max())
    weights /= weights.sum()
    log_variance = np.log(moment / 2) - digamma(39 / 2)
    expected = {"lengthscale[force]": (logs, 0.0), "variance[force]": (log_variance, polygamma(1, 39 / 2))}
    for name, (values, inner) in expected.items():
        mean = weights @ values
        sd = np.sqrt(weights @ (values - mean) ** 2 + inner)
        error = 4 / np.sqrt(posterior.ess[name])
        draws = np.log(posterior.draws(name))
        assert (draws.mean() - mean) / sd == pytest.approx(0.0, abs=error), name
        assert draws.std() / sd == pytest.approx(1.0, abs=2 * error), name
    draws = posterior.draws("k")
    assert (draws.mean() - weights @ k) / draws.std() == pytest.approx(0.0, abs=4 / np.sqrt(posterior.ess["k"]))


def test_model_error_above_measured_noise_follows_its_closed_form():
    """M/(measured + v) is χ² cut off where v would be negative."""
    (first, _) = runs()
    problem = bp.Problem(
        LINEAR,
        [replace(first, scatter={"force": 6.0}, cycles=9)],
        priors={"coulomb": FLAT},
        fixed={"k": 900.0, "c": 40.0},
        noise="measured",
    )
    posterior = bp.sample(problem, bp.map_estimate(problem, **QUIET), seed=4, max_steps=250, **PAIR)
    moment = profiled(first.outputs["force"] - REGRESSORS[:, :2] @ TRUTH[:2], REGRESSORS[:, 2:], np.eye(40))[1]
    chi = stats.chi2(39)
    mass = chi.cdf(moment / 4.0)
    assert 0.5 < mass < 1.0
    mean, square = (
        integrate.quad(lambda x, p=power: x**p * chi.pdf(x) / mass, 0.0, moment / 4.0)[0] for power in (1, 2)
    )
    sd, error = np.sqrt(square - mean**2), 4 / np.sqrt(min(posterior.ess.values()))
    scores = (moment / (4.0 + posterior.draws("variance[force]")) - mean) / sd
    assert scores.mean() == pytest.approx(0.0, abs=error)
    assert scores.std() == pytest.approx(1.0, abs=np.sqrt(2) * error)


def two_channels(noise, fixed=(), second=("force",), **changes):
    tau = grid(40)
    signals = {"force": np.cos(2 * np.pi * tau), "rate": np.sin(2 * np.pi * tau)}
    first = bp.Experiment(FIRST, 2.0, signals, {"x": np.cos(2 * np.pi * tau)}, samples=40)
    other = replace(first, name=SECOND, outputs={c: signals[c] for c in second}, independent={}, **changes)
    return bp.Problem(
        TWO,
        [first, other],
        priors={"k": bp.Normal(1.0, 1.0), "c": bp.LogNormal(1.0, 1.0)},
        fixed=dict(fixed),
        local=["c"],
        noise=noise,
    )


def test_each_quantity_is_one_variable_with_the_dims_of_its_names():
    posterior, kept = drawn(two_channels(bp.noise.Circulant(per="experiment")))
    group = posterior.tree["posterior"].to_dataset()
    chain = ("chain", "draw")
    assert {str(name): values.dims for name, values in group.data_vars.items()} == {
        "k": chain,
        "c": (*chain, "experiment"),
        "variance": (*chain, "channel", "experiment"),
        "lengthscale": (*chain, "channel", "experiment"),
        "floor": (*chain, "channel", "experiment"),
    }
    assert group["experiment"].values.tolist() == [FIRST, SECOND]
    assert group["channel"].values.tolist() == ["force", "rate"]
    assert len(posterior.names) == 3 + 3 * 3
    for i, name in enumerate(posterior.names):
        values = kept[..., i] if name == "k" else np.exp(kept[..., i])
        assert np.array_equal(posterior.by_step(posterior.draws(name)), values), name
    there = group["variance"].sel(channel="rate", experiment=FIRST)
    assert np.array_equal(there.values.ravel(), posterior.draws(f"variance[rate, {FIRST}]"))
    assert np.isnan(group["variance"].sel(channel="rate", experiment=SECOND)).all()
    with pytest.raises(ValueError, match=r"name: must be .*got 'variance\[rate, run 8, 14.5 Hz\]'.*Did you mean"):
        posterior.draws(f"variance[rate, {SECOND}]")
    with pytest.raises(ValueError, match=r"name: must be one of 'k', 'c\[run 7\]', .*got 'c'"):
        posterior.draws("c")


def test_known_values_are_kept_beside_the_sampled_ones():
    """A local parameter that is fixed in one experiment, and a known variance."""
    problem = two_channels("independent", {"c": {SECOND: 2.5}, "variance[rate]": 4.0})
    posterior, _ = drawn(problem)
    assert posterior.names == ("k", f"c[{FIRST}]", "variance[force]")
    group = posterior.tree["posterior"].to_dataset()
    assert group["variance"].dims == ("chain", "draw", "channel")
    assert set(posterior.draws("variance[rate]")) == {4.0} and set(posterior.draws(f"c[{SECOND}]")) == {2.5}
    assert np.ptp(posterior.draws(f"c[{FIRST}]")) > 0.0
    assert posterior.derive({"twice": "2*c"}, experiment=SECOND).loc["twice", "mean"] == 5.0
    assert list(posterior.summary().index) == list(posterior.names)


def test_the_scale_of_a_covariance_has_no_channel():
    """Next to an experiment with its own variances; the variance of an absent channel is NaN."""
    covariance = np.eye(80) + 0.1
    for per, name, dims in (("channel", "scale", ()), ("experiment", f"scale[{SECOND}]", ("experiment",))):
        problem = two_channels(bp.noise.Independent(per=per), second=("force", "rate"), covariance=covariance)
        posterior, _ = drawn(problem)
        group = posterior.tree["posterior"].to_dataset()
        assert group["scale"].dims == ("chain", "draw", *dims)
        assert name in posterior.names and posterior.draws(name).shape == (8 * 12,)


def test_units_and_the_noise_model_are_attributes():
    tau = grid(40)
    experiment = bp.Experiment("a", 2.0, {"rate": np.sin(2 * np.pi * tau)}, {"x": np.cos(2 * np.pi * tau)}, samples=40)
    priors = {"k": bp.Normal(1.0, 1.0), "c": bp.Normal(1.0, 1.0), "shift": bp.Normal(0.0, 1.0)}
    group = drawn(bp.Problem(TWO, [experiment], priors=priors, noise="circulant"))[0].tree["posterior"].to_dataset()
    units, support = ("N/m", "s"), [-np.inf, np.inf]
    names = ("k", "shift[a]")
    expected = [{"units": u, f"support of {n}": support} for n, u in zip(names, units, strict=True)]
    assert [group[name].attrs for name in ("k", "shift")] == expected
    assert group["variance"].attrs == {"noise": "circulant", "units of rate": "(m/s)²"}
    assert group["floor"].attrs == group["lengthscale"].attrs == {"noise": "circulant"}


def test_channel_may_be_named_time():
    tau = grid(40)
    experiment = bp.Experiment("a", 2.0, {"time": np.sin(2 * np.pi * tau)}, {"x": np.cos(2 * np.pi * tau)}, samples=40)
    priors = {"k": bp.Normal(1.0, 1.0), "c": bp.Normal(1.0, 1.0)}
    data = drawn(bp.Problem(TWO, [experiment], priors=priors))[0].data
    assert data["observed_data"]["a time"].dims == ("a time [s]",)


def test_draws_of_several_experiments_are_read_back_and_accepted_by_arviz(tmp_path):
    posterior, _ = drawn(two_channels(bp.noise.Circulant(per="experiment"), {"c": {SECOND: 2.5}}), steps=50)
    posterior.save(tmp_path / "posterior.nc")
    read = bp.load(tmp_path / "posterior.nc")
    assert read.tree.identical(posterior.tree)
    assert read.names == posterior.names and read.summary().equals(posterior.summary())
    with xr.open_datatree(tmp_path / "posterior.nc", engine="h5netcdf") as tree:
        assert tree["posterior"]["c"].sel(experiment=FIRST).shape == (2, 200)
    with np.errstate(invalid="ignore"):
        table = convergence.arviz().summary(read.data)
    assert {*posterior.names, f"c[{SECOND}]"} <= {*table.index}


def test_expressions_use_the_local_parameters_of_one_experiment(local):
    problem, fit, posterior = local
    for name in (FIRST, SECOND):
        table = posterior.derive({"ratio": "coulomb/c", "k_again": "k"}, experiment=name)
        draws = posterior.draws(f"coulomb[{name}]") / posterior.draws("c")
        assert table.loc["ratio", ["mean", "sd"]].tolist() == pytest.approx([draws.mean(), draws.std(ddof=1)])
        linear = fit.derive({"sum": "2*coulomb + c"}, experiment=name)
        weights = np.array([0.0, 1.0, 2.0 * (name == FIRST), 2.0 * (name == SECOND)])
        assert linear.loc["sum", "value"] == pytest.approx(weights @ list(fit.theta.values()))
        assert linear.loc["sum", "sd"] == pytest.approx(np.sqrt(weights @ fit.covariance.to_numpy() @ weights))
    for result in (fit, posterior):
        assert list(result.derive({"rate": "k/c"}).index) == ["rate"]
        with pytest.raises(ValueError, match=r"got 'coulomb'.*own coulomb; derive\(…, experiment=…\)"):
            result.derive({"a": "2*coulomb"})
        with pytest.raises(ValueError, match="experiment: must be one of 'run 7', 'run 8, 14.5 Hz', got 'run 9'"):
            result.derive({"a": "2*coulomb"}, experiment="run 9")
        with pytest.raises(
            ValueError, match="expressions: must be neither reserved nor used elsewhere .*got 'coulomb'"
        ):
            result.derive({"coulomb": "2*k"})


def test_constants_and_ties_of_one_experiment_enter_an_estimate():
    """A local parameter is not treated as a constant, although each experiment has one value of it."""
    problem = bp.Problem(
        LINEAR,
        runs(),
        priors={"coulomb": PRIORS["coulomb"]},
        fixed={"k": {FIRST: 900.0, SECOND: 910.0}},
        tied={"c": "1.6*coulomb"},
        local=["coulomb"],
    )
    fit = bp.map_estimate(problem, **QUIET)
    at = fit.derive({"rate": "k/coulomb", "tie": "c"}, experiment=SECOND)
    coulomb, sd = (values[f"coulomb[{SECOND}]"] for values in (fit.theta, fit.sd))
    assert at.loc["rate"].tolist() == pytest.approx([910.0 / coulomb, 910.0 / coulomb**2 * sd])
    assert at.loc["tie", "value"] == pytest.approx(1.6 * coulomb) and np.isnan(at.loc["tie", "sd"])
    single = bp.Problem(LINEAR, runs()[:1], priors=PRIORS, local=["coulomb"])
    with pytest.raises(ValueError, match="got 'coulomb'"):
        bp.map_estimate(single, **QUIET).derive({"a": "coulomb"})


def test_a_posterior_becomes_the_prior_of_the_next_experiment(local):
    """In a linear model with normal priors the prior made from an estimate is exact."""
    problem, fit, posterior = local
    key = (f"coulomb[{SECOND}]", "k")
    prior = posterior.as_prior(key)
    draws = np.stack([posterior.draws(name) for name in key])
    assert prior.mean == pytest.approx(draws.mean(axis=1), rel=1e-12)
    assert prior.covariance == pytest.approx(np.cov(draws), rel=1e-9)
    assert posterior.as_prior(("k",)).covariance.shape == (1, 1)
    first, second = problem.experiments
    known = {"variance[force]": 9.0}
    before = bp.map_estimate(bp.Problem(LINEAR, [first], priors=PRIORS, fixed=known), **QUIET)
    names = ("c", "k", "coulomb")
    after = bp.Problem(LINEAR, [second], priors={names: before.as_prior(names)}, fixed=known)
    together = bp.map_estimate(bp.Problem(LINEAR, [first, second], priors=PRIORS, fixed=known), **QUIET)
    last = bp.map_estimate(after, **QUIET)
    assert last.theta == pytest.approx(together.theta, rel=1e-9)
    assert last.sd == pytest.approx(together.sd, rel=1e-6)
    shared = {("k", "c"): posterior.as_prior(("k", "c"))}
    assert (
        bp.Problem(LINEAR, [second], priors=shared | {"coulomb": PRIORS["coulomb"]}).priors[("k", "c")].dimension == 2
    )


def test_error_names_what_cannot_become_a_prior(solved, local):
    _, fit, posterior = solved
    for result in (fit, posterior):
        for names in ("k", ["k", "c"], ()):
            with pytest.raises(ValueError, match=r"names: must be a tuple of names.*got"):
                result.as_prior(names)
        with pytest.raises(ValueError, match="names: must be one of 'k', 'c', 'coulomb', got 'kk'. Did you mean 'k'"):
            result.as_prior(("kk", "c"))
        with pytest.raises(ValueError, match=r"names: must differ, got \('k', 'k'\)"):
            result.as_prior(("k", "k"))
        with pytest.raises(ValueError, match=r"names: must be .*got the noise parameter 'variance\[force\]'"):
            result.as_prior(("k", "variance[force]"))
    with pytest.raises(ValueError, match="must be one of 'k', 'c', 'coulomb.run 7.', .*got 'coulomb'"):
        local[2].as_prior(("coulomb",))
    with pytest.warns(UserWarning, match="The draws have not converged"):
        replace(posterior, converged=False).as_prior(("k",))
    with pytest.warns(UserWarning, match=r"The estimate has not converged \(stalled\)"):
        replace(fit, status="stalled").as_prior(("k",))
    assert "NOT CONVERGED: stalled; try another start" in repr(replace(fit, status="stalled"))
    with pytest.raises(
        ValueError,
        match="names: must be parameters with a finite standard deviation, got 'k', 'c', which",
    ):
        replace(fit, covariance=fit.covariance * np.inf).as_prior(("k", "c"))


def test_local_parameters_are_compared_one_by_one(local):
    table = bp.compare(*local).table
    assert list(table.index) == list(local[0].names)
    assert set(table["verdict"]) == {"fine"}


def test_failed_solves_are_counted_by_cause():
    """Proposals in the part of the prior without an orbit fail and are counted."""
    run = bp.Experiment(
        "run", 1.0, {"x": 0.3 + 0.2 * np.random.default_rng(1).standard_normal(12)}, {"u": np.zeros(12)}, samples=12
    )
    problem = bp.Problem(SADDLE_NODE, [run], priors={"a": bp.Normal(0.1, 0.3)}, fixed={"variance[x]": 0.2})
    posterior = bp.sample(problem, bp.map_estimate(problem, progress=False), seed=1, max_steps=100, **PAIR)
    assert posterior.draws("a").min() > 0.0
    assert sum(posterior.failures.values()) > 0.05
    assert posterior.summary().attrs["failures"] == posterior.failures
    cause, share = next(iter(posterior.failures.items()))
    assert f"{share:.2%} {cause}" in repr(posterior)
