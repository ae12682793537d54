"""The variance of independent errors is that of one measured sample, whatever a run averages and keeps.

White noise of variance v, averaged over M samples, gives the complex amplitude of each harmonic ≥ 1 two independent
parts of variance 2v/M, and the mean the variance v/M.
"""

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from tests.known import grid

POINTS = 64
OSCILLATOR = {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 1.0}
WEAK = [(0.02, 0.10 + 0.02 * i) for i in range(16)]
STRONG = (2.0, 0.11)
SD, AVERAGED, DATA_SETS = 0.002, 6000, 200
BAND = stats.binom.ppf([0.005, 0.995], DATA_SETS, 0.9)


def response(amplitude: float, frequency: float) -> tuple[np.ndarray, np.ndarray]:
    force = amplitude * np.cos(2 * np.pi * grid(POINTS))
    solution = bp.solve_periodic(
        bp.models.duffing, OSCILLATOR, {"force": force}, frequency=frequency, samples=POINTS, scheme="fourier"
    )
    return force, solution.outputs["displacement"]


def run(
    name: str, force: np.ndarray, exact: np.ndarray, frequency: float, harmonics: int, averaged: int, seed: list[int]
) -> bp.Experiment:
    """Return a mean period of white noise and the exact response, its highest harmonics cut."""
    generator = np.random.default_rng(seed)
    spectrum = np.fft.rfft(exact) / POINTS
    parts = generator.standard_normal((2, harmonics + 1)) * SD / np.sqrt(averaged)
    # numpy's coefficients of a real signal are half the complex amplitudes.
    noise = (parts[0] + 1j * parts[1]) / np.sqrt(2.0)
    noise[0] = parts[0, 0]
    spectrum[: harmonics + 1] += noise
    spectrum[harmonics + 1 :] = 0.0
    outputs = {"displacement": np.fft.irfft(spectrum * POINTS, POINTS)}
    kept = {"displacement": harmonics, "force": 1}
    return bp.Experiment(
        name, frequency, outputs, {"force": force}, samples=POINTS, harmonics=kept, cycles=20, averaged=averaged
    )


def problem(experiments: list[bp.Experiment]) -> bp.Problem:
    priors = {name: bp.LogNormal(OSCILLATOR[name], 0.5) for name in ("c", "k", "k3")}
    return bp.Problem(bp.models.duffing, experiments, priors=priors, fixed={"m": 1.0}, scheme="fourier")


def test_density_is_that_of_amplitudes_under_white_sensor_noise():
    """Runs with 1 and 9 harmonics of 500 and 6,000 samples, at two points: normal densities of the amplitudes."""
    runs = [(*WEAK[0], 1, 500), (*STRONG, 9, 6000)]
    experiments = []
    for i, (amplitude, frequency, harmonics, averaged) in enumerate(runs):
        force, exact = response(amplitude, frequency)
        experiments.append(run(f"run {i}", force, exact, frequency, harmonics, averaged, [1, i]))
    stated = problem(experiments)

    def expected(theta: dict[str, float], v: float) -> float:
        total = 0.0
        for e, (_, _, harmonics, averaged) in zip(experiments, runs, strict=True):
            solved = stated.solve(theta)[e.name].outputs["displacement"]
            error = np.fft.rfft(e.outputs["displacement"] - solved)[: harmonics + 1] / POINTS
            amplitudes = np.array([error[0].real, *2.0 * error[1:].real, *2.0 * error[1:].imag])
            sd = np.sqrt(np.where(np.arange(amplitudes.size) == 0, 1.0, 2.0) * v / averaged)
            total += float(np.sum(stats.norm.logpdf(amplitudes, 0.0, sd)))
        return total

    first, second = ({"c": 0.2, "k": 1.0, "k3": 1.0}, SD**2), ({"c": 0.201, "k": 1.002, "k3": 0.99}, 1.7 * SD**2)
    difference = stated.log_likelihood(first[0], {"displacement": first[1]}) - stated.log_likelihood(
        second[0], {"displacement": second[1]}
    )
    assert float(difference) == pytest.approx(expected(*first) - expected(*second), rel=1e-6)


def test_density_is_that_of_equation_6_where_every_sample_is_a_value():
    force, exact = response(*STRONG)
    noisy = exact + SD * np.random.default_rng(2).standard_normal(POINTS)
    experiment = bp.Experiment("run", STRONG[1], {"displacement": noisy}, {"force": force}, samples=POINTS)
    stated, theta, v = problem([experiment]), {"c": 0.2, "k": 1.0, "k3": 1.0}, 3.0 * SD**2
    error = noisy - stated.solve(theta)["run"].outputs["displacement"]
    expected = -0.5 * (POINTS * np.log(v) + error @ error / v)
    assert float(stated.log_likelihood(theta, {"displacement": v})) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("harmonics", [3, 31])
def test_estimated_variance_is_that_of_one_sample(harmonics):
    """The mean of 40 estimates by eq. (7), of 2H + 1 − 3 degrees of freedom each, within four standard errors."""
    force, exact = response(*STRONG)
    found = []
    for seed in range(40):
        e = run("run", force, exact, STRONG[1], harmonics, AVERAGED, [3, harmonics, seed])
        start = {name: OSCILLATOR[name] for name in ("c", "k", "k3")}
        found.append(bp.map_estimate(problem([e]), start=start, progress=False).variances["displacement"])
    assert np.mean(found) == pytest.approx(SD**2, rel=4.0 * np.sqrt(2.0 / (40 * (2 * harmonics - 2))))


@pytest.mark.slow
def test_intervals_have_nominal_coverage_with_different_numbers_of_harmonics():
    """16 weak runs keep one harmonic, a strong one ten: 200 data sets, 99 % binomial band for each of 3 parameters."""
    exact = [response(*one) for one in (*WEAK, STRONG)]
    covered = dict.fromkeys(("c", "k", "k3"), 0)
    for seed in range(DATA_SETS):
        experiments = [
            run(f"run {i}", force, x, frequency, 10 if (amplitude, frequency) == STRONG else 1, AVERAGED, [4, seed, i])
            for i, ((force, x), (amplitude, frequency)) in enumerate(zip(exact, (*WEAK, STRONG), strict=True))
        ]
        start = {name: OSCILLATOR[name] for name in covered}
        fit = bp.map_estimate(problem(experiments), start=start, checks=False, progress=False)
        interval = fit.interval(0.9)
        for name, (low, high) in interval.items():
            covered[name] += low < OSCILLATOR[name] < high
    assert all(BAND[0] <= count <= BAND[1] for count in covered.values()), covered


def test_message_tells_runs_with_few_values_to_share_their_noise():
    force, exact = response(*WEAK[0])
    experiment = run("run", force, exact, WEAK[0][1], 1, AVERAGED, [5])
    with pytest.raises(ValueError, match="got only 3. Share it among experiments \\(per='channel'\\), fix"):
        bp.Problem(
            bp.models.duffing, [experiment], priors={n: bp.LogNormal(1.0, 1.0) for n in ("c", "k", "k3")},
            fixed={"m": 1.0}, noise=bp.noise.Independent(per="experiment"),
        )  # fmt: skip
