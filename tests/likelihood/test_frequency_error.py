"""The error of a measured frequency: against recordings folded at other frequencies, and closed forms of resonances."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

import bayesperiodic as bp
from bayesperiodic.estimation.covariance import input_loadings

QUIET = {"progress": False}
STATES = ["q", "r"]
INPUTS = bp.Model(
    "input", states=STATES, inputs=["F"], parameters=["c", "k"],
    equations=["ddq + c*dq + k*q + 3*q**3 - F - 0.2*dF", "dr + 4*r - q*dq"], outputs={"q": "q + 0.1*ddq", "r": "r"},
)  # fmt: skip
EXPLICIT = bp.Model(
    "explicit", states=STATES, parameters=["c", "k"],
    equations=["ddq + c*dq + k*q + 3*q**3 - cos(2*pi*tau) - 0.3*sin(4*pi*tau)", "dr + 4*r - q*dq"],
    outputs={"q": "q + 0.1*ddq", "r": "r + 0.1*frequency*cos(2*pi*tau)"},
)  # fmt: skip
BOTH = bp.Model(
    "both", states=STATES, inputs=["F"], parameters=["c", "k"],
    equations=["ddq + c*dq + k*q + 3*q**3 - cos(2*pi*tau) - F", "dr + 4*r - q*dq"], outputs={"q": "q", "r": "r"},
)  # fmt: skip
TRUTH, FREQUENCY = {"c": 0.4, "k": 5.0}, 0.31


def force(tau):
    """Return a signal of two forcing periods."""
    return np.cos(2 * np.pi * tau - 0.4) + 0.4 * np.sin(6 * np.pi * tau) + 0.3 * np.sin(np.pi * tau)


def recorded(model: bp.Model, periods: int, starts: int, cycles: int = 12) -> list[bp.Recording]:
    """Return steady noise-free recordings that start at several phases, from a periodic solution on a fine grid."""
    samples = 256
    inputs = {name: force(np.arange(samples * periods) / samples) for name in model.inputs}
    solution = bp.solve_periodic(
        model, TRUTH, inputs, frequency=FREQUENCY, samples=samples, periods=periods, scheme="fourier"
    )
    length = periods / FREQUENCY
    recordings = []
    for start in 3.0 + length * np.arange(starts) / starts:
        time, at = start + length * np.arange(int(cycles * 41.3)) / 41.3, {}
        for name, signal in (inputs | solution.outputs).items():
            amplitudes = np.fft.rfft(signal)[:64] * 2.0 / signal.size
            amplitudes[0] *= 0.5
            at[name] = np.real(np.exp(2j * np.pi * np.multiply.outer(time / length, np.arange(64))) @ amplitudes)
        recordings.append(
            bp.Recording.from_arrays(time, {n: at[n] for n in model.outputs}, {n: at[n] for n in model.inputs})
        )
    return recordings


def folded(recording: bp.Recording, frequency: float, periods: int, origin: float) -> bp.Experiment:
    kept = {name: 7 for name in (*recording.inputs, *recording.outputs)}
    run = recording.fold(32, frequency=frequency, periods=periods, harmonics=kept, origin=origin, name="run")
    return replace(run, frequency_se=1e-5)


def residual(problem: bp.Problem, theta: dict[str, float]) -> np.ndarray:
    density = problem.anchored(theta).density(coordinates="natural")
    return np.concatenate(density.linearise(problem.vector(theta)).residuals)


@pytest.mark.parametrize(
    ("model", "periods", "settings"),
    [
        pytest.param(INPUTS, 2, {}, marks=pytest.mark.slow),
        pytest.param(EXPLICIT, 1, {}, marks=pytest.mark.slow),
        (BOTH, 2, {"fixed": {"shift": 0.3}}),
    ],
)
def test_the_direction_of_the_error_is_that_of_folding_at_other_frequencies(model, periods, settings):
    """Outside reference: the same recordings folded at f ± δ, and residuals of the model there.

    What leaks from harmonic to harmonic, by less than 1/cycles of their noise, averages out over the start phases.
    """
    # Of a common shift of all signals only what it does to the residual is left out: nothing at the true parameters.
    theta = TRUTH if model is INPUTS else {"c": 0.45, "k": 5.2}
    priors = {"c": bp.LogNormal(0.4, 1.0), "k": bp.LogNormal(5.0, 1.0)}
    step, differences, along = 2e-6 * FREQUENCY, [], []
    for recording in recorded(model, periods, starts=20):
        low, here, high = (
            bp.Problem(model, [folded(recording, frequency, periods, 8 / FREQUENCY)], priors=priors,
                       scheme="fourier", input_noise="exact", **settings)
            for frequency in (FREQUENCY - step, FREQUENCY, FREQUENCY + step)
        )  # fmt: skip
        differences.append((residual(high, theta) - residual(low, theta)) / (2.0 * step))
        at = here.vector(theta)
        solutions = here.anchored(theta).density().solver.solutions(at)
        (loadings,) = input_loadings(here, at, solutions, "exact").values()
        along.append(-loadings[:, 0] / here.experiments[0].frequency_se)
    expected = np.mean(differences, axis=0)
    assert np.mean(along, axis=0) == pytest.approx(expected, abs=5e-3 * np.abs(expected).max())


# A lightly damped oscillator: y = H(f) F with H = 1/(k − ω² + iωc).
RESONANCE = bp.Model(
    "resonance", states=["q"], inputs=["F"], parameters=["c", "k"], equations=["ddq + c*dq + k*q - F"],
    outputs={"y": "q", "v": "dq"},
)  # fmt: skip
LIGHT = {"c": 2 * np.pi / 100, "k": 4 * np.pi**2}
PRIORS = {"c": bp.Uniform(0.0, 1.0), "k": bp.Uniform(10.0, 100.0)}


def receptance(theta: np.ndarray, frequency: float) -> np.ndarray:
    omega = 2 * np.pi * frequency
    q = 1.0 / (theta[1] - omega**2 + 1j * omega * theta[0])
    return np.array([q, 1j * omega * q])


def test_estimates_and_frequencies_are_those_of_least_squares_with_the_frequency_as_an_unknown():
    """Closed-form amplitudes, SciPy's least squares over c, k and the frequency that has an error."""
    sd, se, random = np.array([0.01, 0.07]), 1e-3, np.random.default_rng(2)
    runs, data = [], []
    for name, true, measured in (("exact", 1.003, 1.003), ("uncertain", 0.998, 0.998 + 1.1 * se)):
        y = receptance(np.array([*LIGHT.values()]), true)
        y = y + sd * np.sqrt(2.0 / 16.0) * (random.standard_normal(2) + 1j * random.standard_normal(2))
        data.append((measured, y))
        runs.append(
            bp.Experiment.from_harmonics(
                name, measured, {"y": [0.0, y[0]], "v": [0.0, y[1]]}, {"F": [0.0, 1.0]}, samples=16,
                frequency_se=se if name == "uncertain" else 0.0,
            )
        )  # fmt: skip

    def errors(x: np.ndarray) -> np.ndarray:
        off = [
            (receptance(x[:2], f + d) - y) / (sd * np.sqrt(2.0 / 16.0))
            for (f, y), d in zip(data, (0, x[2]), strict=True)
        ]
        return np.concatenate([part(one) for one in off for part in (np.real, np.imag)] + [[x[2] / se]])

    best = least_squares(errors, [*LIGHT.values(), 0.0], x_scale=[1e-2, 1.0, 1e-3], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    spread = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    known = {f"variance[{n}]": v**2 for n, v in zip("yv", sd, strict=True)}
    problem = bp.Problem(RESONANCE, runs, priors=PRIORS, fixed=known, scheme="fourier")
    fit = bp.map_estimate(problem, start=LIGHT, **QUIET)
    assert np.abs((np.array([*fit.theta.values()]) - best.x[:2]) / spread[:2]).max() < 0.02
    assert [*fit.sd.values()] == pytest.approx(spread[:2], rel=0.01)
    assert fit.frequencies.index.tolist() == ["uncertain"]
    row = fit.frequencies.loc["uncertain"]
    assert row["estimate"] == pytest.approx(row["measured"] + best.x[2], abs=0.02 * spread[2])
    assert row["sd"] == pytest.approx(spread[2], rel=0.01) and row["sd"] < 0.5 * se
    assert "Frequencies by data and model: " in repr(fit)
    exact = [replace(run, frequency_se=0.0) for run in runs]
    alone = bp.map_estimate(problem.replace(experiments=exact), start=LIGHT, **QUIET)
    assert abs(alone.theta["k"] - fit.theta["k"]) > 3.0 * alone.sd["k"]


def test_a_known_frequency_has_no_error_and_a_negligible_one_drops_out():
    random = np.random.default_rng(1)
    time = np.arange(400) / 20.3
    y = np.real(receptance(np.array([*LIGHT.values()]), 1.0)[0] * np.exp(2j * np.pi * time))
    y += 0.005 * random.standard_normal(400)
    force = np.cos(2 * np.pi * time) + 0.02 * random.standard_normal(400)
    recording = bp.Recording.from_arrays(time, {"y": y}, {"F": force})
    run = recording.fold(16, harmonics={"y": 3, "F": 1}, frequency=1.0)
    assert run.frequency_se == 0.0 and run.phase_diffusion == 0.0
    given = recording.fold(16, harmonics={"y": 3, "F": 1}, frequency=(1.0, 2e-9))
    assert given.frequency_se == 2e-9 and np.array_equal(given.outputs["y"], run.outputs["y"])
    for noise in ("exact", "measured"):
        fits = []
        for one in (run, given):
            problem = bp.Problem(RESONANCE, [one], priors=PRIORS, scheme="fourier", input_noise=noise)
            fits.append(bp.map_estimate(problem, start=LIGHT, checks=False, **QUIET))
        exact, tiny = fits
        assert exact.frequencies.empty and tiny.frequencies["sd"].tolist() == pytest.approx([2e-9])
        for name in LIGHT:
            assert tiny.interval(0.9)[name] == pytest.approx(exact.interval(0.9)[name], rel=1e-8)
        assert noise == "measured" or not tiny.input_errors


def test_the_frequency_of_an_autonomous_model_is_data_and_no_error_beside():
    guess = {"x": 2.0 * np.cos(2 * np.pi * np.arange(64) / 64)}
    orbit = bp.solve_periodic(
        bp.models.van_der_pol, {"mu": 0.5, "omega": 2.0}, {}, frequency=0.3, samples=64, guess=guess
    )
    noisy = {name: x + 0.1 * np.random.default_rng(0).standard_normal(64) for name, x in orbit.outputs.items()}
    run = bp.Experiment("free", orbit.frequency, noisy, samples=64, frequency_se=1e-3, guess=orbit.states)
    problem = bp.Problem(
        bp.models.van_der_pol, [run], priors={"omega": bp.LogNormal(2.0, 0.3)},
        fixed={"mu": 0.5, "variance[displacement]": 1e-2},
    )  # fmt: skip
    fit = bp.map_estimate(problem, start={name: 2.0 if name == "omega" else 0.0 for name in problem.names}, **QUIET)
    assert problem.frequency_errors == {} and fit.input_errors == {}
    # f is proportional to omega, and nothing else tells omega.
    assert fit.sd["omega"] == pytest.approx(2.0 * 1e-3 / orbit.frequency, rel=0.02)
    assert fit.frequencies.loc["free", "sd"] == pytest.approx(1e-3, rel=0.02)


def test_correlated_points_of_a_mask_need_an_exact_frequency():
    tau = np.arange(16) / 16
    run = bp.Experiment(
        "run", 1.0, {"y": np.cos(2 * np.pi * tau)}, {"F": np.cos(2 * np.pi * tau)}, samples=16, mask=tau < 0.7,
        frequency_se=1e-3,
    )  # fmt: skip
    with pytest.raises(ValueError, match="frequency_se of experiment 'run': must be 0 for points of a mask with 'circ"):
        bp.Problem(RESONANCE, [run], priors=PRIORS, noise="circulant")
    assert bp.Problem(RESONANCE, [run], priors=PRIORS).frequency_errors["run"].se == 1e-3


@pytest.mark.parametrize("error", [-1e-3, np.nan, np.inf])
def test_an_impossible_standard_error_is_refused(error):
    with pytest.raises(ValueError, match="^frequency_se: must be (finite|a finite number, at least 0)"):
        bp.Experiment.from_harmonics("run", 1.0, {"y": [0, 1]}, samples=8, frequency_se=error)


def resonant(
    seed: int, quality: float, cycles: int, frequency: object = None
) -> tuple[bp.Experiment, dict[str, float]]:
    """Return a recording at resonance with noise of 2 %, folded at an estimated frequency, and the truth."""
    random, time = np.random.default_rng([seed, 5]), np.arange(cycles * 20 + 8) / 20.3
    truth = {"c": 2 * np.pi / quality, "k": LIGHT["k"]}
    response = receptance(np.array([*truth.values()]), 1.0)[0]
    y = np.real(response * np.exp(2j * np.pi * time)) + 0.02 * abs(response) * random.standard_normal(time.size)
    force = np.cos(2 * np.pi * time) + 0.02 * random.standard_normal(time.size)
    recording = bp.Recording.from_arrays(time, {"y": y}, {"F": force})
    return recording.fold(16, harmonics={"y": 3, "F": 1}, frequency=frequency), truth


@pytest.mark.slow
def test_intervals_cover_where_the_error_of_the_frequency_is_the_largest():
    """60 recordings, Q = 200, 20 cycles: 90 % intervals of k, 99.9 % band 0.75 to 1; a third if it is ignored."""
    covered = {True: 0, False: 0}
    for seed in range(60):
        run, truth = resonant(seed, 200, 20)
        for kept in covered:
            one = run if kept else replace(run, frequency_se=0.0)
            priors = {name: bp.LogNormal(value, 1.0 if name == "c" else 0.3) for name, value in truth.items()}
            problem = bp.Problem(RESONANCE, [one], priors=priors, scheme="fourier")
            low, high = bp.map_estimate(problem, start=truth, checks=False, **QUIET).interval(0.9)["k"]
            covered[kept] += low < truth["k"] < high
    assert covered[True] >= 45 and covered[False] < 35


def test_an_error_of_the_frequency_alone_stands_beside_measured_noise_of_inputs():
    """The second experiment has no measured noise of its input, but an error of its frequency that counts."""
    recording = recorded(INPUTS, 1, 1)[0]
    generator, runs = np.random.default_rng(6), []
    for name, error in (("noisy", 1e-7), ("exact", 1e-3)):
        run = folded(recording, FREQUENCY, 1, 0.0)
        outputs = {c: y + 1e-3 * y.std() * generator.standard_normal(y.size) for c, y in run.outputs.items()}
        variance = {"F": np.full(8, 1e-6)} if name == "noisy" else {}
        runs.append(replace(run, name=name, outputs=outputs, amplitude_variance=variance, frequency_se=error))
    priors = {name: bp.Normal(value, 0.3) for name, value in TRUTH.items()}
    problem = bp.Problem(INPUTS, runs, priors=priors)
    fit = bp.map_estimate(problem, start=TRUTH, checks=False, **QUIET)
    assert fit.converged and fit.input_errors["exact"].loadings.any() and fit.input_errors["noisy"].loadings.any()
    assert all(abs(fit.theta[n] - TRUTH[n]) < 4 * fit.sd[n] and fit.degrees_of_freedom[n] > 1.0 for n in TRUTH)


@pytest.mark.parametrize("sensors", [{}, {"F": bp.Sensor(gain=bp.Normal(1.0, 0.1))}])
def test_stored_inputs_are_those_of_the_stored_orbits(sensors):
    """Where time is explicit, an error of the frequency turns the inputs: outputs follow from them by the equations."""
    run = folded(recorded(BOTH, 2, 1)[0], FREQUENCY * (1 + 2e-4), 2, 3.0)
    noise = np.random.default_rng(3)
    outputs = {c: y + 1e-3 * noise.standard_normal(y.size) for c, y in run.outputs.items()}
    run = replace(run, outputs=outputs, frequency_se=1e-4)
    priors = {name: bp.LogNormal(value, 0.5) for name, value in TRUTH.items()}
    problem = bp.Problem(BOTH, [run], priors=priors, scheme="fourier", sensors=sensors)
    fit = bp.map_estimate(problem, checks=False, **QUIET)
    (solution,) = fit.solutions.values()
    assert abs(fit.frequencies.loc["run", "estimate"] - run.frequency) > 0.5 * run.frequency_se
    again = bp.solve_periodic(
        BOTH, {name: fit.theta[name] for name in TRUTH}, solution.inputs, frequency=solution.frequency, samples=32,
        periods=2, scheme="fourier", guess=solution.states,
    )  # fmt: skip
    assert again.outputs["q"] == pytest.approx(solution.outputs["q"], abs=1e-8)
    np.testing.assert_allclose(fit.inputs["run"]["F"], solution.inputs["F"], atol=1e-12)
