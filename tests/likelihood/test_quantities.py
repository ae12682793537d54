"""Amplitudes, phases and sizes as data: densities against SciPy, derivatives by finite differences."""

import warnings
from functools import partial

import numpy as np
import pytest
from scipy import optimize, stats

import bayesperiodic as bp
from bayesperiodic.data.measurements import Amplitude, PeakToPeak, Phase, RootMeanSquare
from bayesperiodic.estimation.table_tests import serial_correlation
from bayesperiodic.likelihood.quantities import likeliest_amplitude

N = 32
AT = 2 * np.pi * np.arange(N) / N
U = 0.7 * np.cos(AT)
# A lag, a cubic output that has a third harmonic, and one with an even part.
MODEL = bp.Model(
    "shaper", states=["w"], inputs=["u"], parameters=["a", "b"], equations=["b*dw + w - u"],
    outputs={"y": "a*w", "cubic": "w + a*w**3", "uneven": "w + a*w**2 + 0.3*b*w**3"},
)  # fmt: skip
THETA = {"a": 1.3, "b": 0.2}
FREQUENCY = 0.8
PRIORS = {"a": bp.LogNormal(1.0, 1.0), "b": bp.LogNormal(0.3, 1.0)}


def run(*measurements, name="run", frequency=FREQUENCY, outputs=None):
    return bp.Experiment(name, frequency, outputs or {}, {"u": U}, samples=N, measurements=measurements)


def problem(*runs, **more):
    return bp.Problem(MODEL, runs, priors=PRIORS, scheme="fourier", input_noise="exact", **more)


def waves(theta=THETA, frequency=FREQUENCY):
    """Return the outputs on a fine grid, by the closed form of the lag."""
    at = 2 * np.pi * np.arange(4096) / 4096
    w = np.real(0.7 * np.exp(1j * at) / (1.0 + 2j * np.pi * frequency * theta["b"]))
    a, b = theta["a"], theta["b"]
    return {"y": a * w, "cubic": w + a * w**3, "uneven": w + a * w**2 + 0.3 * b * w**3}


def harmonic(values, h):
    return 2.0 * np.fft.rfft(values)[h] / values.size


@pytest.mark.parametrize("ratio", [0.05, 0.9, np.sqrt(2.0), 1.6, 4.0, 30.0, 3000.0])
@pytest.mark.parametrize("value", [0.01, 0.5, 1.4, 2.5, 10.0, 300.0, 3200.0])
def test_density_of_an_amplitude_is_that_of_rice(ratio, value):
    sd = abs(harmonic(waves()["y"], 1)) / ratio
    here = problem(run(Amplitude("y", value * sd, sd=sd)))
    expected = stats.rice.logpdf(value, ratio) - np.log(sd) if abs(value - ratio) < 30 else np.nan
    if np.isfinite(expected):
        value = here.log_likelihood(THETA, {}) + here.likelihood.blocks[0].log_scale - 0.5 * np.log(2 * np.pi)
        assert value == pytest.approx(expected, abs=1e-7)


def test_likeliest_amplitude_maximises_the_density_of_rice():
    for measured in (0.5, 1.3, 1.5, 3.0, 50.0):
        density = partial(stats.rice.logpdf, measured)
        best = optimize.minimize_scalar(lambda v, f=density: -f(v), bounds=(1e-9, 60.0), method="bounded")
        assert likeliest_amplitude(measured) == pytest.approx(best.x, abs=2e-4)


@pytest.mark.parametrize(
    "measurement, expected",
    [
        (Amplitude("cubic", 0.01, harmonic=3), lambda w: abs(harmonic(w["cubic"], 3))),
        (Amplitude("uneven", 0.01, harmonic=2), lambda w: abs(harmonic(w["uneven"], 2))),
        (Phase("y", 0.3, to="u"), lambda w: np.angle(harmonic(w["y"], 1))),
        (Phase("y", 3.1, to="u"), lambda w: np.angle(harmonic(w["y"], 1))),
        (
            Phase("cubic", 0.3, to="uneven", harmonic=3),
            lambda w: np.angle(harmonic(w["cubic"], 3) / harmonic(w["uneven"], 3)),
        ),
        (PeakToPeak("uneven", 1.0), lambda w: np.ptp(w["uneven"])),
        (PeakToPeak("cubic", 1.0), lambda w: np.ptp(w["cubic"])),
        (RootMeanSquare("uneven", 1.0), lambda w: w["uneven"].std()),
    ],
)
def test_residual_is_measured_less_predicted_value(measurement, expected):
    here = problem(run(measurement), fixed={f"variance[{measurement.label}]": 1.0}).density()
    (residual,) = here.linearise(np.array([*THETA.values()])).residuals
    off = measurement.value - expected(waves())
    off = (off + np.pi) % (2 * np.pi) - np.pi if isinstance(measurement, Phase) else off
    assert residual == pytest.approx([off], abs=2e-6)


EVERY = (
    Amplitude("y", 0.5, sd=0.2), Phase("y", 0.2, to="u", sd=0.1), Phase("cubic", 0.3, to="uneven", sd=0.2),
    Phase("cubic", 0.3, to="uneven", sd=0.2, harmonic=3), PeakToPeak("uneven", 1.7, sd=0.1),
    RootMeanSquare("cubic", 0.4, sd=0.05),
)  # fmt: skip
UNKNOWN = (
    Amplitude("cubic", 0.9), Amplitude("cubic", 0.1, harmonic=3), PeakToPeak("uneven", 1.7), Phase("y", 0.0, to="u"),
)  # fmt: skip


def test_derivatives_are_those_by_finite_differences():
    noise = bp.noise.Independent(prior=bp.InverseGamma(3, 2))
    here = problem(run(*EVERY), run(*UNKNOWN, name="other", frequency=0.5), noise=noise).density()
    theta = np.array([*THETA.values()])
    at, step = here.linearise(theta), 1e-6
    for i, row in enumerate(np.eye(2)):
        up, down = (here.linearise(theta + sign * step * row).residuals for sign in (1, -1))
        for j, high, low in zip(at.jacobian, up, down, strict=True):
            assert -j[i] == pytest.approx((high - low) / (2 * step), rel=1e-5, abs=1e-6)


def test_experiments_that_are_compared_at_once_have_the_density_of_each_alone():
    """Frequencies, values, standard deviations and the input's phase are each experiment's."""
    runs = []
    for k, frequency in enumerate((0.4, 0.7, 1.1, 1.6)):
        force = 0.7 * np.cos(AT + 0.4 * k)
        given = [
            Amplitude("y", 0.4 + 0.1 * k, sd=0.1 + 0.02 * k), Phase("y", 0.3 - 0.2 * k, to="u", sd=0.1 + 0.03 * k),
            Phase("cubic", 0.1 * k, to="uneven", sd=0.2), PeakToPeak("uneven", 1.5 + 0.2 * k, sd=0.1 + 0.1 * k),
            RootMeanSquare("cubic", 0.4 + 0.1 * k, sd=0.05 + 0.01 * k),
        ]  # fmt: skip
        runs.append(bp.Experiment(f"{k}", frequency, {}, {"u": force}, samples=N, measurements=given))
    together = problem(*runs)
    each = [problem(one) for one in runs]
    expected = sum(one.log_likelihood(THETA, {}) for one in each)
    assert together.log_likelihood(THETA, {}) == pytest.approx(expected, rel=1e-12)
    assert np.ptp([one.log_likelihood(THETA, {}) for one in each]) > 1.0
    _, slopes = together.value_and_gradient(THETA, {})
    for name, slope in zip(together.names, slopes, strict=False):
        high, low = (together.log_posterior(THETA | {name: THETA[name] + s}, {}) for s in (1e-6, -1e-6))
        assert slope == pytest.approx((high - low) / 2e-6, rel=1e-5)


@pytest.mark.parametrize(
    "noise",
    [
        bp.noise.Independent(prior=bp.InverseGamma(3, 2)),
        "relative",
        bp.noise.Independent(per="experiment", prior=bp.InverseGamma(3, 2)),
    ],
)
def test_gradient_is_that_by_finite_differences(noise):
    here = problem(run(*EVERY), run(*UNKNOWN, name="other", frequency=0.5), noise=noise)
    variances = {name: 0.02 + 0.01 * i for i, name in enumerate(here.noise_names)}
    value, slopes = here.value_and_gradient(THETA, variances)
    for name, slope in zip(here.names, slopes, strict=False):
        high, low = (here.log_posterior(THETA | {name: THETA[name] + s}, variances) for s in (1e-6, -1e-6))
        assert slope == pytest.approx((high - low) / 2e-6, rel=1e-5)


def test_all_amplitudes_of_a_channel_share_one_unknown_variance():
    runs = [run(Amplitude("y", 0.5 + 0.1 * k), name=f"{k}", frequency=0.3 + 0.1 * k) for k in range(4)]
    here = problem(*runs)
    assert here.free_noise == ("variance[amplitude of y]",)
    predicted = [abs(harmonic(waves(frequency=r.frequency)["y"], 1)) for r in runs]
    expected = stats.norm.logpdf([0.5, 0.6, 0.7, 0.8], predicted, np.sqrt(0.02)).sum() + 2.0 * np.log(2 * np.pi)
    assert here.log_likelihood(THETA, {"amplitude of y": 0.02}) == pytest.approx(expected, abs=1e-8)


def test_relative_noise_is_proportional_to_the_amplitude():
    values = (0.5, 1.0, 2.0)
    runs = [run(Amplitude("y", value), name=f"{value}") for value in values]
    predicted = abs(harmonic(waves()["y"], 1))
    expected = stats.norm.logpdf(values, predicted, 0.1 * np.array(values)).sum() + 1.5 * np.log(2 * np.pi)
    here = problem(*runs, noise="relative")
    assert here.log_likelihood(THETA, {"relative": 0.01}) == pytest.approx(expected, abs=1e-8)


def test_replicates_have_the_mean_and_spread_of_rice():
    """False-alarm rate 1e-4 for each of the six comparisons (mean and spread by four standard errors)."""
    signal = np.tile(U[:, None], (20000, 1, 1))
    for ratio in (0.0, 2.0, 31.0):
        sd = 0.7 / ratio if ratio else 1.0
        here = problem(run(Amplitude("y", 1.0, sd=sd))).observations["run"].blocks[0]
        scaled = signal if ratio else 0.0 * signal
        drawn = here.replicate(scaled, np.random.default_rng(3).standard_normal((20000, 1)))[:, 0] / sd
        mean, variance = stats.rice.stats(ratio, moments="mv")
        assert drawn.mean() == pytest.approx(mean, abs=4 * np.sqrt(variance / 20000))
        assert drawn.var() == pytest.approx(variance, rel=4 * np.sqrt(2.2 / 20000))


def test_measurements_and_a_time_history_of_another_channel_are_one_experiment():
    w = waves()
    history = w["y"][:: 4096 // N] + 0.01 * np.random.default_rng(0).standard_normal(N)
    here = problem(run(PeakToPeak("uneven", np.ptp(w["uneven"]), sd=1e-3), outputs={"y": history}))
    fit = bp.map_estimate(here, progress=False)
    assert fit.converged and set(fit.rms) == {"y", "peak-to-peak value of uneven"}
    assert fit.theta == pytest.approx(THETA, abs=0.02)


@pytest.mark.parametrize("sd", [0.01, None])
def test_estimate_and_draws_from_phases_and_amplitudes_alone(sd, tmp_path):
    """With this seed the 99.9 % intervals contain the truth."""
    rng, runs = np.random.default_rng(4), []
    for k, f in enumerate(np.linspace(0.2, 1.2, 8)):
        c = harmonic(waves(frequency=f)["y"], 1) + 0.01 * (rng.standard_normal() + 1j * rng.standard_normal())
        phase = Phase("y", np.angle(c), to="u", sd=sd and sd / abs(c))
        runs.append(run(Amplitude("y", abs(c), sd=sd), phase, name=f"{k}", frequency=f))
    here = problem(*runs)
    fit = bp.map_estimate(here, progress=False)
    assert all(abs(fit.theta[name] - value) < 3.3 * fit.sd[name] for name, value in THETA.items())
    posterior = bp.sample(here, fit, seed=1, progress=False)
    assert np.std(posterior.draws("a")) == pytest.approx(fit.sd["a"], rel=0.35)
    assert bp.predict(here, posterior).table.loc["all", "verdict"] != "misspecified"
    posterior.save(tmp_path / "draws.h5")
    assert bp.load(tmp_path / "draws.h5").draws("b").size == posterior.draws("b").size
    runs[0].save(tmp_path / "run.h5")
    assert bp.load(tmp_path / "run.h5").measurements == runs[0].measurements


def test_serial_correlation_has_its_false_alarm_rate_and_sees_smooth_residuals():
    """The share of p below 0.05 in 400 white residuals is within 0.013 and 0.087 with a probability of 99.9 %."""
    rng = np.random.default_rng(5)
    jacobian = np.stack([np.ones(20), np.linspace(0, 1, 20), np.linspace(0, 1, 20) ** 2])
    p = np.array([serial_correlation(rng.standard_normal(20), jacobian) for _ in range(400)])
    assert 0.013 < np.mean(p < 0.05) < 0.087
    assert serial_correlation(np.sin(np.linspace(0, 9, 20)), jacobian) < 0.01
    assert np.isnan(serial_correlation(rng.standard_normal(5), np.eye(5)[:3]))


def test_a_wrong_model_of_a_table_is_misspecified():
    runs = []
    for k, f in enumerate(np.linspace(0.1, 2.0, 16)):
        a = 1.3 * 0.7 / (1.0 + (0.2 * 2 * np.pi * f) ** 1.5) * (1 + 1e-4 * (-1) ** k)
        runs.append(run(Amplitude("y", a), name=f"{k}", frequency=f))
    assert "amplitude of y: the residual is not white" in bp.map_estimate(problem(*runs), progress=False).misfit


def test_amplitudes_as_small_as_their_unknown_noise_are_warned_of():
    rng, runs = np.random.default_rng(6), []
    for k, f in enumerate(np.geomspace(0.2, 30.0, 12)):
        c = harmonic(waves(frequency=f)["y"], 1) + 0.02 * (rng.standard_normal() + 1j * rng.standard_normal())
        runs.append(run(Amplitude("y", abs(c)), name=f"{k}", frequency=f))
    with pytest.warns(UserWarning, match="The smallest amplitude of y, .*, is .* times the rms of the residuals"):
        bp.map_estimate(problem(*runs), progress=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bp.map_estimate(problem(*runs[:6]), progress=False)


@pytest.mark.parametrize(
    "given, message",
    [
        ((Amplitude("y", 0.1), Amplitude("y", 0.2)), "measurements: must be of different quantities, got"),
        ((Amplitude("y", 0.1), Amplitude("y", 0.2, sd=1.0, harmonic=2)), "measurements: must all have an sd or none"),
        (("amplitude",), "measurements: must be a list such as"),
        ((Amplitude("y", 0.1, harmonic=16),), "samples of experiment 'run': must be at least 33"),
        ((Amplitude("z", 0.1),), "outputs of experiment 'run': must be one of"),
        ((Phase("y", 0.1, to="u", harmonic=3, sd=1.0),), "must be phases against an input that has harmonic 3"),
    ],
)
def test_measurements_that_cannot_be_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        problem(run(*given))


def test_measurements_of_a_channel_with_a_time_history_are_refused():
    with pytest.raises(ValueError, match="measurements: must be of channels without a time history, got the amplitude"):
        run(Amplitude("y", 0.1), outputs={"y": U})


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: Amplitude("y", 0.0), "value: must be > 0"),
        (lambda: Amplitude("y", np.nan), "value: must be finite"),
        (lambda: Amplitude("y", 0.1, sd=0.0), "sd: must be > 0"),
        (lambda: Amplitude("y", 0.1, harmonic=0), "harmonic: must be an integer .* 1"),
        (lambda: Phase("y", 0.1, to="y"), "to: must be another channel than 'y'"),
    ],
)
def test_impossible_measurements_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
