"""Evidences of models against closed forms and quadratures written here, and against nested sampling."""

import re
from dataclasses import replace
from functools import cache

import dynesty
import numpy as np
import pytest
import xarray as xr
from scipy import stats
from scipy.special import logsumexp

import bayesperiodic as bp
from bayesperiodic.sampling import evidence as module
from tests import problems
from tests.sampling.test_targets import PAIR, QUIET, known, model, run

LINE = model("line", ["a"], lambda p: {"force": p.a})
WELLS = model("wells", ["a"], lambda p: {"force": (p.a - 2) ** 2})
SD = 0.1
OPTIMA = "ignore:. separate optima"


@cache
def data() -> tuple[bp.Experiment, np.ndarray, np.ndarray]:
    """Return 20 values of the force, 1.0 times x with white noise, and the same with x as arrays."""
    clean = run(force=1.0)
    x = clean.inputs["x"]
    y = x + np.sqrt(20) * SD * np.random.default_rng(4).standard_normal(20)
    return replace(clean, outputs={"force": y}), x, y


def sampled(problem: bp.Problem, **settings) -> bp.Posterior:
    return bp.sample(problem, bp.map_estimate(problem, **QUIET), **(PAIR | settings))


def line(prior: object, **changes) -> bp.Problem:
    arguments = {"priors": {"a": prior}, "fixed": known(force=SD)}
    return bp.Problem(LINE, [data()[0]], **(arguments | changes))


def log_density(a: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return ln p(y|a, variance) of the 20 values at sizes a and variances that broadcast."""
    _, x, y = data()
    squares = y @ y - 2 * a * (x @ y) + a**2 * (x @ x)
    return -10 * np.log(2 * np.pi * variance) - squares / (2 * variance)


def log_integral(log_f: np.ndarray, *axes: np.ndarray) -> float:
    """Return ln ∫ f over equidistant axes, f zero at their ends."""
    return float(logsumexp(log_f) + sum(np.log(axis[1] - axis[0]) for axis in axes))


GRID = np.linspace(-3.0, 8.0, 200_001)
LOGS = np.linspace(-7.0, 3.0, 2001)


@pytest.mark.filterwarnings("ignore:The estimate of 'a'.*lies at the end")
@pytest.mark.parametrize(
    ("prior", "density"),
    [
        (bp.TruncatedNormal(0.5, 0.3, 0.95, 2.0), stats.truncnorm(1.5, 5.0, loc=0.5, scale=0.3)),
        (bp.Uniform(0.0, 0.9), stats.uniform(0.0, 0.9)),
        (bp.LogNormal(2.0, 0.5), stats.lognorm(0.5, scale=2.0)),
        (stats.gamma(3.0, scale=0.5), stats.gamma(3.0, scale=0.5)),
    ],
    ids=["truncated", "uniform", "lognormal", "gamma of scipy"],
)
def test_evidence_of_one_parameter_is_the_quadrature(prior, density):
    problem = line(prior)
    found = bp.evidence(problem, sampled(problem))
    with np.errstate(divide="ignore"):
        truth = log_integral(log_density(GRID, 20 * SD**2) + density.logpdf(GRID), GRID)
    assert found.log == pytest.approx(truth, abs=0.02) and found.log_error < 0.02
    assert not found.improper and found.data == {"run: force": 20.0}


def test_evidence_of_a_normal_model_is_the_closed_form():
    """The quadrature of the other tests is that closed form too."""
    _, x, y = data()
    problem = line(bp.Normal(0.7, 0.5))
    found = bp.evidence(problem, sampled(problem))
    closed = stats.multivariate_normal(0.7 * x, 20 * SD**2 * np.eye(20) + 0.25 * np.outer(x, x)).logpdf(y)
    assert log_integral(log_density(GRID, 20 * SD**2) + stats.norm(0.7, 0.5).logpdf(GRID), GRID) == pytest.approx(
        closed
    )
    assert found.log == pytest.approx(closed, abs=0.02) and found.log_error < 0.02
    assert not found.improper and found.data == {"run: force": 20.0}


@pytest.mark.parametrize(
    ("prior", "log_prior"),
    [
        (bp.LogNormal(0.5, 0.8), stats.norm(np.log(0.5), 0.8).logpdf(LOGS)),
        (bp.InverseGamma(2.0, 0.3), stats.invgamma(2.0, scale=0.3).logpdf(np.exp(LOGS)) + LOGS),
        ("jeffreys", np.zeros(LOGS.size)),
        ("flat", LOGS),
    ],
    ids=["lognormal", "inverse gamma", "jeffreys", "flat"],
)
def test_evidence_with_an_unknown_variance_is_the_quadrature(prior, log_prior):
    """Jeffreys' prior is 1/v and the flat one 1, without a constant, and the evidence says so."""
    problem = line(bp.Normal(0.7, 0.5), noise=bp.noise.Independent(prior=prior), fixed=None)
    found = bp.evidence(problem, sampled(problem))
    a = np.linspace(-3.0, 5.0, 1001)
    at = log_density(a[:, None], np.exp(LOGS)) + stats.norm(0.7, 0.5).logpdf(a)[:, None] + log_prior
    assert found.log == pytest.approx(log_integral(at, a, LOGS), abs=0.02) and found.log_error < 0.02
    improper = isinstance(prior, str)
    assert list(found.improper) == (["variance[force]"] if improper else [])
    assert improper == any("unknown constant" in note for note in found.notes)


@cache
def plane() -> tuple[bp.Problem, bp.Posterior, float]:
    """Return two coupled sizes and a variance with a proper prior, and their evidence, the sizes in closed form."""
    experiment, x, y = data()
    x2 = np.sqrt(2.0) * np.cos(2 * np.pi * np.arange(20) / 20)
    two = bp.Model(
        "plane",
        states=["w"],
        inputs=["x", "z"],
        parameters=["a", "b"],
        equations=lambda s, p, u: [s.dw + s.w - u.x],
        outputs=lambda s, p, u: {"force": p.a * u.x + p.b * u.z},
    )
    mean, covariance = np.array([0.8, 0.1]), np.array([[0.2, 0.12], [0.12, 0.1]])
    given = replace(experiment, inputs={"x": x, "z": x2})
    noise = bp.noise.Independent(prior=bp.LogNormal(0.5, 0.8))
    problem = bp.Problem(two, [given], priors={("a", "b"): bp.MultivariateNormal(mean, covariance)}, noise=noise)
    design = np.stack([x, x2], axis=1)

    def at(log_v: float) -> float:
        spread = design @ covariance @ design.T + np.exp(log_v) * np.eye(20)
        return stats.multivariate_normal(design @ mean, spread).logpdf(y) + stats.norm(np.log(0.5), 0.8).logpdf(log_v)

    axis = np.linspace(-6.0, 3.0, 301)
    return problem, sampled(problem), log_integral(np.array([at(v) for v in axis]), axis)


def test_evidence_of_two_coupled_parameters_and_a_variance_is_the_quadrature():
    problem, posterior, truth = plane()
    found = bp.evidence(problem, posterior)
    assert found.log == pytest.approx(truth, abs=0.02) and found.log_error < 0.02


def test_evidence_of_a_tied_parameter_is_that_of_the_free_one():
    _, x, y = data()
    tied = model("tied", ["a", "b"], lambda p: {"force": p.a + p.b})
    problem = bp.Problem(tied, [data()[0]], priors={"a": bp.Normal(0.2, 0.3)}, tied={"b": "2*a"}, fixed=known(force=SD))
    closed = stats.multivariate_normal(0.6 * x, 20 * SD**2 * np.eye(20) + 0.81 * np.outer(x, x)).logpdf(y)
    assert bp.evidence(problem, sampled(problem)).log == pytest.approx(closed, abs=0.02)


def wells() -> tuple[bp.Problem, float]:
    """Return y = (a − 2)² x with modes near 1 and 3, and its evidence by quadrature."""
    problem = bp.Problem(WELLS, [data()[0]], priors={"a": bp.Normal(1.5, 2.0)}, fixed=known(force=SD))
    at = log_density((GRID - 2) ** 2, 20 * SD**2) + stats.norm(1.5, 2.0).logpdf(GRID)
    return problem, log_integral(at, GRID)


@pytest.mark.filterwarnings(OPTIMA)
def test_evidence_of_two_modes_is_the_quadrature():
    problem, truth = wells()
    found = bp.evidence(problem, sampled(problem))
    assert found.log == pytest.approx(truth, abs=0.02) and found.log_error < 0.02


SIZE, LENGTH, FLOOR = 0.3, 0.02, 0.1


def covariance(points: np.ndarray, harmonics: int) -> np.ndarray:
    """Return the covariance at points of 200 of Matérn noise over a floor, with some of its harmonics."""
    harmonic = np.arange(-99, 101)
    power = (3 + (2 * np.pi * harmonic * LENGTH) ** 2) ** -2.0
    power = (power / power.mean() + FLOOR) / (1 + FLOOR)
    kept = np.abs(harmonic) <= harmonics
    lag = (points[:, None] - points)[..., None] / 200
    return SIZE / 200 * np.sum(power[kept] * np.cos(2 * np.pi * harmonic[kept] * lag), axis=-1)


def data_density(case: str, problem: bp.Problem, theta: np.ndarray) -> float:
    """Return the log-density of the data under the noise above, from residuals in time."""
    e, predicted = problem.experiments[0], problem.outputs(theta[None])[0]
    residuals = {channel: values - predicted[e.name][channel][0] for channel, values in e.outputs.items()}
    if "angle" in residuals:
        residuals["angle"] = np.mod(residuals["angle"] + np.pi, 2 * np.pi) - np.pi
    of_variance = stats.norm(0.0, np.sqrt(SIZE)).logpdf
    solution = problem.solve(theta)[e.name]
    if case == "section and multiplier":
        growth = np.log(np.abs(e.multipliers[0] / solution.multipliers[0]))
        values = [residuals["angle"][0], residuals["rate"][0], growth]
        conditional = e.covariance[2, :2] @ np.linalg.inv(e.covariance[:2, :2])
        spread = np.sqrt(e.covariance[2, 2] - conditional @ e.covariance[:2, 2])
        section = stats.multivariate_normal(np.zeros(2), SIZE * e.covariance[:2, :2]).logpdf(values[:2])
        return section + stats.norm(conditional @ values[:2], spread).logpdf(growth)
    if case == "masked, correlated":
        at = np.flatnonzero(problems.POINTS)
        noise = stats.multivariate_normal(np.zeros(at.size), covariance(at, 100))
        growth = np.log(np.abs(e.multipliers[0] / solution.multipliers[0]))
        return sum(noise.logpdf(r[at]) for r in residuals.values()) + stats.norm(0.0, 0.1).logpdf(growth)
    if case == "circulant":
        r = np.fft.irfft(np.fft.rfft(residuals["displacement"])[:10], 19) * 19 / 200
        return stats.multivariate_normal(np.zeros(19), covariance(np.arange(19) * 200 / 19, 9)).logpdf(r)
    if case == "harmonics kept, tied":
        r = np.fft.irfft(np.fft.rfft(residuals["displacement"])[:8], 15) * 15 / 200
        return stats.norm(0.0, np.sqrt(SIZE * 15 / 200)).logpdf(r).sum()
    if case == "measured":
        return stats.norm(0.0, np.sqrt(0.2**2 / 9 + SIZE)).logpdf(residuals["displacement"]).sum()
    density = sum(of_variance(r).sum() for r in residuals.values())
    if case == "autonomous":
        density += stats.norm(e.frequency, e.frequency_se).logpdf(solution.frequency)
    return density


@pytest.mark.parametrize("case", [name for name in problems.CASES if name != "local and delayed"])
def test_constants_make_the_likelihood_a_density_of_the_data(case):
    problem, theta = problems.CASES[case]()
    sizes = {"lengthscale": LENGTH, "floor": FLOOR}
    noise = np.array([sizes.get(name.partition("[")[0], SIZE) for name in problem.noise_names])
    found = float(problem.log_likelihood(theta, noise)) + module._constant(problem)
    assert found == pytest.approx(data_density(case, problem, np.array(theta)), rel=1e-6)


@pytest.mark.slow
def test_evidence_is_the_same_from_every_sampler_and_in_all_coordinates():
    noise = bp.noise.Independent(prior="jeffreys")
    problem = line(bp.LogNormal(0.7, 0.5), noise=noise, fixed=None)
    settings = {}, {"coordinates": "natural"}, {"variances": "collapsed"}, {"sampler": "nuts"}
    found = [bp.evidence(problem, sampled(problem, **changes)) for changes in settings]
    assert np.ptp([e.log for e in found]) < 0.02 and max(e.log_error for e in found) < 0.02


class Given:
    """A density of the user's own, a multiple of that of N(0.7, 0.5)."""

    support = (-np.inf, np.inf)

    def __init__(self, factor: float):
        self.factor, self.normal = factor, bp.Normal(0.7, 0.5)

    def log_prob(self, x):  # noqa: D102
        return self.normal.log_prob(x) + np.log(self.factor)

    def gradient(self, x):  # noqa: D102
        return self.normal.gradient(x)

    def curvature(self, x):  # noqa: D102
        return self.normal.curvature(x)

    def quantile(self, probability):  # noqa: D102
        return self.normal.quantile(probability)

    def sample(self, size, generator):  # noqa: D102
        return self.normal.sample(size, generator)

    def __repr__(self) -> str:
        return f"Given({self.factor})"


class Flat(Given):
    """An improper prior: the same everywhere."""

    def log_prob(self, x):  # noqa: D102
        return np.zeros_like(x)

    def gradient(self, x):  # noqa: D102
        return np.zeros_like(x)

    curvature = gradient


def test_a_prior_that_is_not_normalised_is_refused():
    good, doubled, flat = (line(prior) for prior in (Given(1.0), Given(2.0), Flat(1.0)))
    with pytest.raises(ValueError, match=r"priors\['a'\]: must be normalised .* with the integral 2\. "):
        bp.evidence(doubled, sampled(doubled, max_steps=50))
    with pytest.raises(ValueError, match="An improper prior leaves the evidence undefined; give a proper one"):
        bp.evidence(flat, sampled(flat, max_steps=50))
    posterior = replace(sampled(good, max_steps=250), converged=True)
    closed = log_integral(log_density(GRID, 20 * SD**2) + stats.norm(0.7, 0.5).logpdf(GRID), GRID)
    assert bp.evidence(good, posterior).log == pytest.approx(closed, abs=0.02)


def test_a_phase_that_is_not_integrated_is_refused():
    autonomous = problems.CASES["autonomous"]()[0]
    module._check_phases(autonomous)
    fixed = bp.Problem(
        bp.models.van_der_pol,
        autonomous.experiments,
        priors={"mu": bp.LogNormal(1.5, 0.3), "omega": bp.Normal(1.0, 0.2)},
        fixed={"shift": 0.0},
    )
    with pytest.raises(ValueError, match=r"'shift\[cycle\]' must have a uniform prior over one period"):
        module._check_phases(fixed)


def test_posterior_of_another_problem_is_refused():
    problem, posterior, _ = plane()
    with pytest.raises(ValueError, match="posterior: must be a result of this problem, got one of a problem"):
        bp.evidence(line(bp.Normal(0.7, 0.5)), posterior)
    with pytest.raises(ValueError, match="problem: must be a Problem"):
        bp.evidence(posterior, problem)


def test_evidence_is_saved_and_loaded(tmp_path):
    problem, posterior, _ = plane()
    found = bp.evidence(problem, posterior)
    found.save(tmp_path / "evidence.h5")
    assert bp.load(tmp_path / "evidence.h5") == found and found.fingerprint == posterior.fingerprint
    text = repr(found)
    assert text.startswith(f"Evidence: ln p(data) = {found.log:.2f} ± ") and "a density over 20 independent" in text


def with_draws(posterior: bp.Posterior, steps: np.ndarray, seed: int = 1) -> bp.Posterior:
    """Return a posterior with other draws of a, (ensembles, steps, walkers), as if it had converged."""
    tree, (chains, count, walkers) = posterior.tree.copy(), steps.shape
    step, walker = (i.ravel() for i in np.indices((count, walkers)))
    flat, index = steps.reshape(chains, -1), {"step": ("draw", step), "walker": ("draw", walker)}
    group = tree["posterior"].to_dataset().isel(draw=np.zeros(step.size, dtype=int))
    tree["posterior"] = xr.DataTree(group.assign({"a": (("chain", "draw"), flat)}).assign_coords(index))
    best = np.arange(flat.size) == np.argmin(np.abs(flat - posterior.draws("a")[0]))
    lp = (("chain", "draw"), best.astype(float).reshape(flat.shape))
    tree["sample_stats"] = xr.DataTree(xr.Dataset({"lp": lp}))
    return replace(posterior, tree=tree, converged=True, seed=seed)


@pytest.mark.filterwarnings(OPTIMA)
def test_draws_that_have_missed_a_mode_in_some_ensembles_bring_a_warning():
    problem, _ = wells()
    posterior = sampled(problem, max_steps=50)
    steps = 0.05 * np.random.default_rng(1).standard_normal((2, 300, 32))
    with pytest.warns(UserWarning, match="The evidence is unreliable: .*overlap") as seen:
        found = bp.evidence(problem, with_draws(posterior, steps + np.array([1.0, 3.0])[:, None, None]))
    assert any(re.search(r"misses 99\.\d% of the other half", str(w.message)) for w in seen)
    assert found.overlap < 0.01 and found.missed > 0.9 and sum(n.startswith("Unreliable") for n in found.notes) >= 2


def test_draws_that_have_not_converged_bring_a_warning():
    problem, posterior, _ = plane()
    short = replace(posterior, converged=False, reason="max_steps = 250 reached")
    with pytest.warns(UserWarning, match="the draws have not converged \\(max_steps = 250 reached\\)"):
        bp.evidence(problem, short)


@pytest.mark.campaign
@pytest.mark.filterwarnings(OPTIMA, "ignore:The estimate of 'a'.*lies at", "ignore:The evidence is unreliable. the two")
@pytest.mark.parametrize(("case", "count"), [("two modes", 400), ("edge of a prior", 60)])
def test_errors_of_the_evidence_cover(case, count):
    """Fifty runs of known draws, autocorrelated along the walkers (0.9 a step): many of two modes, few of a cut one.

    Of 50 95 % intervals at least 42 cover with a probability of 0.9962 (binomial), and the mean square of the errors in
    their standard errors is between 0.49 and 1.73 with a probability of 0.998 (χ²): 0.6 % of false alarms.
    """
    if case == "two modes":
        problem, truth = wells()
        at = log_density((GRID - 2) ** 2, 20 * SD**2) + stats.norm(1.5, 2.0).logpdf(GRID)
    else:
        problem = line(bp.Uniform(0.0, 0.9))
        at = np.where((GRID > 0.0) & (GRID < 0.9), log_density(GRID, 20 * SD**2) - np.log(0.9), -np.inf)
        truth = log_integral(at, GRID)
    posterior = sampled(problem, max_steps=250)
    middle, cumulative = GRID + 0.5 * (GRID[1] - GRID[0]), np.cumsum(np.exp(at - at.max()))
    scores = []
    for seed in range(50):
        z = np.random.default_rng(seed).standard_normal((2, count, 32))
        for step in range(1, count):
            z[:, step] = 0.9 * z[:, step - 1] + np.sqrt(1 - 0.81) * z[:, step]
        draws = np.interp(stats.norm.cdf(z) * cumulative[-1], cumulative, middle)
        draws = np.minimum(draws, 0.9 - 1e-9) if case != "two modes" else draws
        found = bp.evidence(problem, with_draws(posterior, draws, seed))
        scores.append((found.log - truth) / found.log_error)
    assert np.sum(np.abs(scores) < 1.96) >= 42
    assert 0.49 < np.mean(np.square(scores)) < 1.73


def test_errors_cover_where_the_mixture_is_too_narrow():
    """A normal posterior, three times as wide as the mixture, with draws autocorrelated by 0.9 a step.

    The mean square of 100 errors in their standard errors is between 0.62 and 1.49 with a probability of 0.998 (χ²).
    """
    wide, narrow = stats.norm(0.0, 3.0), stats.norm(0.0, 1.0)
    scores = []
    for seed in range(100):
        generator = np.random.default_rng(seed)
        z = generator.standard_normal((2, 200, 8))
        for step in range(1, 200):
            z[:, step] = 0.9 * z[:, step - 1] + np.sqrt(1 - 0.81) * z[:, step]
        draws, others = 3.0 * z, generator.standard_normal(2000)
        found = module._estimate(
            wide.logpdf(draws) - narrow.logpdf(draws), wide.logpdf(others) - narrow.logpdf(others), 0
        )
        scores.append(found.log / found.error)
    assert 0.62 < np.mean(np.square(scores)) < 1.49


def nested(problem: bp.Problem, seed: int = 1) -> tuple[float, float]:
    """Return the log-evidence and its error by dynesty, for whole periods with a proper prior of the variance."""
    priors = [*problem.joint_prior.marginals.values(), *(problem.noise.prior for _ in problem.free_noise)]
    values, size = problem.counted, len(problem.names)

    def likelihood(x: np.ndarray) -> float:
        free = x[size:] if size < x.size else np.array([*problem.likelihood.fixed.values()])
        return max(float(problem.log_likelihood(x[:size], free)) - 0.5 * values * np.log(2 * np.pi), -1e300)

    def transform(u: np.ndarray) -> np.ndarray:
        return np.array([float(prior.quantile(p)) for prior, p in zip(priors, u, strict=True)])

    sampler = dynesty.NestedSampler(
        likelihood, transform, len(priors), nlive=400, rstate=np.random.default_rng(seed), sample="rwalk"
    )
    sampler.run_nested(dlogz=0.05, print_progress=False)
    return float(sampler.results.logz[-1]), float(sampler.results.logzerr[-1])


PROPER = bp.noise.Independent(prior=bp.LogNormal(1e-3, 2.0))


def oscillator() -> bp.Problem:
    """Return a Duffing oscillator with two unknown stiffnesses and damping."""
    force = {"force": np.cos(2 * np.pi * np.arange(64) / 64)}
    truth = {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 0.5}
    x = bp.solve_periodic(bp.models.duffing, truth, force, frequency=0.1, samples=64).outputs["displacement"]
    noisy = x + 0.05 * np.random.default_rng(2).standard_normal(64)
    priors = {"c": bp.LogNormal(0.2, 0.5), "k": bp.LogNormal(1.0, 0.5), "k3": bp.LogNormal(0.5, 1.0)}
    given = bp.Experiment("run", 0.1, {"displacement": noisy}, force, samples=64)
    return bp.Problem(bp.models.duffing, [given], priors=priors, fixed={"m": 1.0}, noise=PROPER)


def damper() -> bp.Problem:
    """Return a Dahl damper with six unknowns, its variance included."""
    x = {"displacement": 0.01 * np.cos(2 * np.pi * np.arange(100) / 100)}
    truth = {"Kx": 40.0, "K": 800.0, "F0": 1.0, "Kw": 25.0, "rho": 800.0}
    force = bp.solve_periodic(bp.models.dahl, truth, x, frequency=1.0, samples=100).outputs["force"]
    noisy = force + 1.0 * np.random.default_rng(3).standard_normal(100)
    priors = {
        "Kx": bp.Normal(40.0, 40.0),
        "K": bp.Normal(800.0, 400.0),
        "F0": bp.Normal(0.0, 5.0),
        "Kw": bp.LogNormal(25.0, 0.5),
        "rho": bp.LogNormal(800.0, 0.7),
    }
    given = bp.Experiment("run", 1.0, {"force": noisy}, x, samples=100)
    noise = bp.noise.Independent(prior=bp.LogNormal(1.0, 2.0))
    return bp.Problem(bp.models.dahl, [given], priors=priors, noise=noise)


@pytest.mark.campaign
@pytest.mark.filterwarnings(OPTIMA, "ignore:.*:DeprecationWarning")
@pytest.mark.parametrize("make", [lambda: wells()[0], oscillator, damper], ids=["two modes", "duffing", "damper"])
def test_evidence_agrees_with_nested_sampling(make):
    """Within three of both errors together: false-alarm rate 0.3 % each."""
    problem = make()
    found, (log, error) = bp.evidence(problem, sampled(problem)), nested(problem)
    assert abs(found.log - log) < 3.0 * np.hypot(error, found.log_error) and found.log_error < 0.02
