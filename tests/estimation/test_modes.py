"""Separate optima of the log-posterior: which are found, their masses, and what is said of them."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

import bayesperiodic as bp
from bayesperiodic.estimation import modes
from bayesperiodic.estimation.modes import default_starts, found_from, missed_by
from tests.known import SADDLE_NODE, grid
from tests.problems import duffing, duffing_run
from tests.sampling.test_targets import known, model, run

QUIET = {"progress": False}


def measured(force, value: float, sd: float, **priors) -> bp.Problem:
    """Return the problem of one number that is a function of the parameters, measured with an error of this sd."""
    one = model("modes", list(priors), lambda p: {"force": force(p)})
    return bp.Problem(one, [run(force=value)], priors=priors, fixed=known(force=sd))


def quietly(problem: bp.Problem, **settings) -> bp.MapEstimate:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*separate optima|The data do not change")
        return bp.map_estimate(problem, **QUIET, **settings)


def test_both_roots_of_a_square_are_found_by_default_and_named():
    """(a − 2)² = 1 with a flat prior: a = 1 and a = 3 are equal."""
    problem = measured(lambda p: (p.a - 2) ** 2, 1.0, 0.01, a=bp.Uniform(0.001, 5.0))
    with pytest.warns(UserWarning, match=r"2 separate optima fit the data: the estimate, with 50% .* a = "):
        fit = bp.map_estimate(problem, **QUIET)
    assert sorted(fit.modes["a"]) == pytest.approx([1.0, 3.0], rel=1e-6)
    assert fit.modes["mass"].tolist() == pytest.approx([0.5, 0.5])
    assert np.ptp(fit.modes["objective"]) < 1e-6
    assert "Another optimum: a = " in repr(fit) and len(fit.starts) == 8


def test_masses_are_those_of_quadrature():
    """a³ − 3a = 1 ± 0.05 at three values of different slopes, with the prior N(0.5, 2); Laplace is off by 0.1 %."""
    problem = measured(lambda p: p.a**3 - 3 * p.a, 1.0, 0.05, a=bp.Normal(0.5, 2.0))
    fit = quietly(problem)

    def density(a):
        return np.exp(-0.5 * ((a**3 - 3 * a - 1.0) / 0.05) ** 2 - 0.125 * (a - 0.5) ** 2)

    roots = np.sort(np.roots([1.0, 0.0, -3.0, -1.0]).real)
    mass = np.array([quad(density, root - 0.3, root + 0.3, points=[root])[0] for root in roots])
    modes = fit.modes.sort_values("a")
    assert modes["a"].to_numpy() == pytest.approx(roots, abs=1e-3)
    assert modes["mass"].to_numpy() == pytest.approx(mass / mass.sum(), rel=0.01)


@pytest.mark.parametrize(
    ("force", "value", "priors", "expected"),
    [
        (lambda p: p.a**2, 1.0, {"a": bp.Normal(0.5, 2.0)}, {(1,), (-1,)}),
        (lambda p: p.a**2 * p.b, 2.0, {"a": bp.Normal(0.5, 2.0), "b": bp.Normal(2.0, 0.01)}, {(1, 2), (-1, 2)}),
        (
            lambda p: (p.a - p.b) ** 2,
            1.0,
            {"a": bp.Normal(1.0, 0.1), "b": bp.Normal(1.0, 0.1)},
            {(1.5, 0.5), (0.5, 1.5)},
        ),
    ],
    ids=["sign", "sign of one of two", "exchange"],
)
def test_images_under_signs_and_exchanges_are_found_from_one_start(force, value, priors, expected):
    problem = measured(force, value, 0.001, **priors)
    start = dict(zip(priors, next(iter(expected)), strict=True))
    fit = quietly(problem, start=start)
    assert len(fit.starts) == 1
    assert {tuple(np.round(row, 1)) for row in fit.modes[list(priors)].to_numpy()} == expected


def test_mass_of_the_mirrored_optimum_is_that_of_its_prior():
    """a² = 1 with the prior N(0.5, 2): the ratio is exp(−(1.5² − 0.5²)/8)."""
    fit = quietly(measured(lambda p: p.a**2, 1.0, 0.001, a=bp.Normal(0.5, 2.0)), start={"a": 1.0})
    assert fit.modes["a"].to_numpy() == pytest.approx([1.0, -1.0], rel=1e-5)
    assert fit.modes["mass"][1] / fit.modes["mass"][0] == pytest.approx(np.exp(-0.25), rel=1e-4)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [0.05, 1.0])
def test_one_optimum_is_not_counted_twice(value):
    """A value near zero has one optimum that covers both signs; one at 1 ± 0.1 has none at −1."""
    fit = bp.map_estimate(measured(lambda p: p.a, value, 0.1, a=bp.Normal(0.0, 2.0)), **QUIET)
    assert fit.other_modes == () and fit.modes["mass"].tolist() == [1.0]
    assert "Another optimum" not in repr(fit)


@pytest.mark.filterwarnings("error")
def test_starts_without_an_orbit_are_silent():
    """Equilibria √a exist for a > 0 only, and half of the draws of the prior are below."""
    wave = 0.1 * np.cos(2 * np.pi * grid(64))
    truth = bp.solve_periodic(SADDLE_NODE, {"a": 1.0}, {"u": wave}, frequency=0.1, samples=64, scheme="central4")
    noisy = truth.outputs["x"] + 1e-3 * np.random.default_rng(1).standard_normal(64)
    experiment = bp.Experiment("run", 0.1, {"x": noisy}, {"u": wave}, samples=64)
    problem = bp.Problem(SADDLE_NODE, [experiment], priors={"a": bp.Normal(0.5, 1.0)}, scheme="central4")
    fit = bp.map_estimate(problem, start={"a": 0.8}, starts=8, **QUIET)
    assert fit.converged and abs(fit.theta["a"] - 1.0) < 5 * fit.sd["a"]
    assert any(np.isneginf(start["objective"]) for start in fit.starts)


def test_number_of_starts_follows_from_the_number_of_unknowns():
    """200 points are cheap, 8 runs of 200 as well; 100 runs, or 1600 points of a dense scheme, are not."""
    runs = [duffing_run(f"run {i}", seed=i) for i in range(8)]
    assert default_starts(duffing(runs[0])) == default_starts(duffing(*runs)) == (8, 8)
    assert default_starts(duffing(*runs, *(duffing_run(f"more {i}") for i in range(8)))) == (5, 5)
    assert default_starts(duffing(*runs[:2], scheme="fourier")) == (8, 8)
    assert default_starts(duffing(*runs, scheme="fourier")) == (2, 2)
    assert default_starts(duffing(*(duffing_run(f"run {i}") for i in range(50)))) == (1, 1)
    # A response of eight periods has eight times as many unknowns.
    problem = duffing(runs[0])
    long = SimpleNamespace(
        experiments=[SimpleNamespace(samples=1000, periods=8)], scheme="central4", model=problem.model
    )
    states = len(problem.model.states)
    assert default_starts(long)[0] == int(np.clip(16_000 / (states * 8000), 1, 8)) == 2


def test_a_given_start_is_the_only_one():
    problem = duffing(duffing_run(), scheme="central4")
    assert len(bp.map_estimate(problem, start={"c": 0.2, "k": 1.0, "k3": 0.5}, **QUIET).starts) == 1
    assert len(bp.map_estimate(problem, **QUIET).starts) == 8


def test_modes_are_saved_with_the_estimate(tmp_path):
    fit = quietly(measured(lambda p: p.a**2, 1.0, 0.01, a=bp.Normal(0.5, 2.0)))
    fit.save(tmp_path / "fit.h5")
    again = bp.load(tmp_path / "fit.h5")
    assert again.modes.equals(fit.modes) and repr(again) == repr(fit)


def test_the_stated_probability_to_miss_an_optimum_is_that_of_the_draws():
    """Seven of eight starts are draws; 0.9⁷ = 0.478 of such sets have none in a tenth of the prior (4 sd: 0.014)."""
    assert missed_by(8) == "one that a tenth of the prior leads to is missed with a probability of 0.48"
    without = np.all(np.random.default_rng(1).random((20_000, 7)) > 0.1, axis=1)
    assert np.mean(without) == pytest.approx(0.478, abs=0.014)
    assert found_from(1) == "found from 1 start (others were not looked for)"


@pytest.mark.slow
def test_thirty_parameters_of_ten_masses_are_estimated_while_images_are_counted(monkeypatch, capsys):
    """Masses, dampers and springs of a chain driven at its end, from linear algebra; chi-square of the truth.

    The squared distance of the estimates from the truth has the chi-square distribution with 30 degrees of freedom: the
    false-alarm rate is 1e-3 in all (seed fixed). There are 435 exchanges of two parameters.
    """
    monkeypatch.setattr(modes, "SHOWN_AFTER", 0.0)
    masses, random = range(1, 11), np.random.default_rng(3)
    nominal = {f"{kind}{i}": value for kind, value in (("m", 1.0), ("c", 0.05), ("k", 1.0)) for i in masses}
    truth = {name: value * np.exp(0.1 * random.standard_normal()) for name, value in nominal.items()}
    links = [np.eye(10)[i] - (np.eye(10)[i - 1] if i else 0.0) for i in range(10)]
    parts = {kind: {f"{kind}{i}": np.outer(links[i - 1], links[i - 1]) for i in masses} for kind in "ck"}
    parts["m"] = {f"m{i}": np.diag(np.eye(10)[i - 1]) for i in masses}
    model = bp.Model.from_matrices(
        "chain_of_ten", mass=parts["m"], damping=parts["c"], stiffness=parts["k"], forces={"u": 9},
        outputs={f"x{i}": (i - 1, "displacement") for i in masses},
    )  # fmt: skip
    samples, frequency = 32, 0.025
    tau = np.arange(samples) / samples
    u = sum(np.cos(2 * np.pi * (h * tau + h * (h - 1) / 30)) for h in range(1, 15))
    mass, damping, stiffness = (sum(truth[name] * a for name, a in parts[kind].items()) for kind in "mck")
    omega, force = 2 * np.pi * frequency * np.arange(samples // 2 + 1), np.fft.rfft(u)
    lines = [
        np.linalg.solve(stiffness - w**2 * mass + 1j * w * damping, np.eye(10)[9] * f)
        for w, f in zip(omega, force, strict=True)
    ]
    clean = np.fft.irfft(np.transpose(lines), samples)
    outputs = {
        f"x{i}": x + 0.01 * x.std() * random.standard_normal(samples) for i, x in zip(masses, clean, strict=True)
    }
    run = bp.Experiment("run", frequency, outputs, {"u": u}, samples=samples)
    priors = {name: bp.LogNormal(value, 0.3) for name, value in nominal.items()}
    noise = {f"variance[x{i}]": (0.01 * x.std()) ** 2 for i, x in zip(masses, clean, strict=True)}
    problem = bp.Problem(model, [run], priors=priors, fixed=noise, scheme="fourier", input_noise="exact")
    fit = bp.map_estimate(problem, starts=1, checks=False)
    assert fit.converged and fit.other_modes == ()
    off = problem.vector(fit.theta) - problem.vector(truth)
    assert off @ np.linalg.solve(fit.covariance.to_numpy(), off) < stats.chi2.ppf(0.999, 30)
    assert "image" in capsys.readouterr().err
