"""Harmonics that were not measured are no data: against SciPy's least squares of the numbers that were."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares

import bayesperiodic as bp
from bayesperiodic.estimation.unexplained import Unexplained
from bayesperiodic.likelihood.block import ComparedSignals
from bayesperiodic.likelihood.kinds import blocks_of

OMEGA = np.linspace(0.6, 1.4, 8)
TRUTH = np.array([1.0, 0.1, 1.0])
MODEL = bp.Model(
    "oscillator",
    states=["x"],
    inputs=["force"],
    parameters=["m", "c", "k"],
    equations=["m*ddx + c*dx + k*x - force"],
    outputs={"x": "x"},
)
PRIORS = {"m": bp.LogNormal(1, 2), "c": bp.LogNormal(0.1, 2), "k": bp.LogNormal(1, 2)}
QUIET = {"progress": False, "starts": 1}


def receptance(theta):
    m, c, k = theta
    return 1.0 / (k - m * OMEGA**2 + 1j * c * OMEGA)


def table(seed, mean=None):
    generator = np.random.default_rng(seed)
    amplitudes = receptance(TRUTH) + 0.01 * (generator.standard_normal((2, 8)).T @ [1.0, 1j])
    runs = [
        bp.Experiment.from_harmonics(
            f"{w:.3f}", w / (2 * np.pi), {"x": [mean, amplitude]}, {"force": [0, 1.0]}, samples=16
        )
        for w, amplitude in zip(OMEGA, amplitudes, strict=True)
    ]
    return amplitudes, bp.Problem(MODEL, runs, priors=PRIORS, scheme="fourier")


@pytest.mark.parametrize("mean", [None, 0.0])
def test_a_stepped_sine_is_fitted_as_by_least_squares_of_its_amplitudes(mean):
    amplitudes, problem = table(0, mean)
    assert problem.counted == 16
    fit = bp.map_estimate(problem, **QUIET)
    split = lambda z: np.r_[z.real, z.imag]  # noqa: E731
    found = least_squares(lambda q: split(receptance(q) - amplitudes), TRUTH, xtol=1e-12, ftol=1e-12)
    sd = np.sqrt(2 * found.cost / (16 - 3) * np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    assert list(fit.theta.values()) == pytest.approx(found.x, rel=1e-4)
    assert list(fit.sd.values()) == pytest.approx(sd, rel=0.01)
    assert list(fit.robust_sd.values()) == pytest.approx(sd, rel=0.5)
    assert "MapEstimate (converged)" in str(fit)
    posterior = bp.sample(problem, fit, seed=1, progress=False, ensembles=2, walkers=8, max_steps=100)
    prediction = bp.predict(problem, posterior, draws=20)
    assert prediction.verdict == "adequate"


@pytest.mark.slow
def test_intervals_from_a_stepped_sine_have_nominal_coverage():
    """Two values for three parameters in each run; 200 data sets, 99 % binomial bands: a false alarm in 6 %."""
    held = np.zeros((2, 3))
    for seed in range(200):
        fit = bp.map_estimate(table(seed)[1], **QUIET)
        for robust in (False, True):
            low, high = np.transpose(list(fit.interval(0.9, robust=robust).values()))
            held[int(robust)] += (low < TRUTH) & (TRUTH < high)
    band = stats.binom.ppf([0.005, 0.995], 200, 0.9)
    assert np.all((held >= band[0]) & (held <= band[1]))


@pytest.mark.parametrize(
    ("points", "harmonics", "without"), [(16, 3, [0]), (16, 4, [2, 4]), (8, None, [0, 3]), (9, None, [1])]
)
def test_components_are_the_measured_harmonics(points, harmonics, without):
    """By an explicit discrete Fourier transform; the transpose and the signal of components belong to it."""
    generator = np.random.default_rng(1)
    signal = generator.standard_normal(points)
    kept = {} if harmonics is None else {"x": harmonics}
    highest = points // 2 if harmonics is None else harmonics
    run = bp.Experiment("run", 1.0, {"x": signal}, {}, samples=points, harmonics=kept, unmeasured={"x": without})
    (block,) = blocks_of(run, MODEL)
    lines = [h for h in range(highest + 1) if h not in without]
    tau = 2 * np.pi * np.arange(points) / points
    rows = [np.cos(h * tau) for h in lines]
    rows += [np.sin(h * tau) for h in lines if 0 < h and 2 * h < points]
    basis = np.array(rows) / np.linalg.norm(rows, axis=1)[:, None]
    size = len(basis)
    assert (block.size, run.independent["x"]) == (size, size)
    compared = lambda y: ComparedSignals(y[..., None], np.empty(0), np.empty(0))  # noqa: E731
    components = block.components(compared(signal))
    assert np.mean(components**2) == pytest.approx(np.sum((basis @ signal) ** 2) / points)
    assert run.project("x", signal) == pytest.approx(basis.T @ (basis @ signal), abs=1e-12)
    weights = generator.standard_normal(size)
    assert block.spread(weights) @ signal == pytest.approx(weights @ components)
    errors = np.zeros((1, points, 1))
    block.simulate(weights[None], errors)
    assert block.components(compared(errors[..., 0]))[0] == pytest.approx(weights)


def test_the_mean_of_an_alternating_sensor_does_not_move_the_estimate():
    """Data with any mean give the estimate of data without one; the independent values are one fewer."""
    amplitudes, _ = table(3)
    tau = 2 * np.pi * np.arange(16) / 16
    fits = []
    for offset in (0.0, 0.7):
        runs = [
            bp.Experiment(
                f"{w:.3f}",
                w / (2 * np.pi),
                {"x": offset + (a * np.exp(1j * tau)).real},
                {"force": np.cos(tau)},
                samples=16,
                harmonics={"x": 1},
            )
            for w, a in zip(OMEGA, amplitudes, strict=True)
        ]
        runs = [replace(run, unmeasured={"x": [0]}) for run in runs]
        assert runs[0].independent == {"x": 2}
        fits.append(bp.map_estimate(bp.Problem(MODEL, runs, priors=PRIORS, scheme="fourier"), **QUIET))
    for name, value in fits[0].theta.items():
        assert fits[1].theta[name] == pytest.approx(value, rel=1e-9)
        assert fits[1].sd[name] == pytest.approx(fits[0].sd[name], rel=1e-6)


def test_gradient_with_unmeasured_harmonics_is_that_of_differences():
    _, problem = table(1)
    density = problem.density(coordinates="natural")
    theta, noise = np.array([1.01, 0.11, 0.98]), np.array([1e-4])
    gradient = density.value_and_gradient_at(theta, noise)[1]
    for i, step in enumerate(1e-6 * theta):
        ends = [density.value_and_gradient_at(theta + s * np.eye(3)[i] * step, noise)[0] for s in (-1, 1)]
        assert gradient[i] == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-5)


def test_unmeasured_harmonics_are_saved_printed_and_checked(tmp_path):
    run = bp.Experiment.from_harmonics("run", 1.0, {"x": [None, 1.0, None, 0.1j]}, samples=16)
    assert run.unmeasured == {"x": (0, 2)} and run.independent == {"x": 4}
    assert "x without harmonics 0, 2" in str(run)
    run.save(tmp_path / "run.h5")
    assert bp.load(tmp_path / "run.h5").unmeasured == {"x": (0, 2)}
    objects = np.array([None, 1.0], dtype=object)
    assert bp.Experiment.from_harmonics("run", 1.0, {"x": objects}, samples=16).unmeasured == {"x": (0,)}
    with pytest.raises(ValueError, match=r"outputs\['x'\]: must have an amplitude that is not zero or None"):
        bp.Experiment.from_harmonics("run", 1.0, {"x": [None, 0.0]}, samples=16)
    with pytest.raises(ValueError, match=r"unmeasured\['x'\]: must be some of .*got \[0\] and a mask"):
        replace(run, mask=np.arange(16) < 8, unmeasured={"x": [0]})
    with pytest.raises(ValueError, match=r"unmeasured\['x'\]: must be some of the harmonics 0 … 3 .*got \[5\]"):
        replace(run, unmeasured={"x": [5]})
    with pytest.raises(ValueError, match="unmeasured: must be"):
        replace(run, unmeasured={"u": [0]})


def test_a_mean_that_is_matched_to_rounding_is_not_tested():
    """Otherwise the harmonic with the noise would stand out of one without noise."""
    noisy = np.array([0.0, 1.2, -0.7])
    found = Unexplained(noisy, np.array([[0.0, 1.0, 0.0]]), np.array([0, 1, 1]))
    assert (found.freedom, list(found.harmonics)) == (1, [1])
    assert np.isnan(found.harmonic_content()[0]) and found.square == pytest.approx(0.49)
    acting = Unexplained(noisy, np.array([[0.5, 1.0, 0.0]]), np.array([0, 1, 1]))
    assert acting.freedom == 2
