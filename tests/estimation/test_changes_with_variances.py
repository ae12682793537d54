"""Changes of information and trace with unknown and measured variances, against derivatives of the dense covariance."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.estimation import covariance
from bayesperiodic.estimation.check import at_estimate
from bayesperiodic.estimation.noise_changes import NoiseChange, changes_by_measured, changes_by_variance
from bayesperiodic.likelihood.noise_spectrum import NoiseSpectrum
from tests.known import formula_model, grid

POINTS = 24
MODEL = formula_model("static", ["a", "b"], lambda p, u, s: {"y": p.a * u.x + p.b * u.dx, "z": p.b * u.x})
PRIORS = {"a": bp.Normal(1.0, 3.0), "b": bp.Normal(0.2, 3.0)}
STEP = 1e-4
SPECTRA = {
    "y": np.array([4.0, 2.0, 1.0, 0.5, 0.4]) * 1e-4, "z": np.array([1.0, 3.0, 2.5]) * 1e-4,
    "x": np.array([3.0, 4.0, 2.1, 1.3]) * 1e-4,
}  # fmt: skip
FREEDOM = {"y": np.array([11.0, 30.0, 28.0, 20.0, 15.0]), "x": np.array([12.0, 25.0, 30.0, 18.0])}


def run_of(name="run", seed=1, spectra=SPECTRA, **changes):
    """Return an experiment whose channels have noise of measured spectra; z has the freedom of its cycles."""
    generator, tau = np.random.default_rng(seed), grid(POINTS)
    x = np.cos(2 * np.pi * tau) + 0.6 * np.sin(4 * np.pi * tau + 0.4) + 0.3 * np.cos(6 * np.pi * tau)
    amplitudes = np.fft.rfft(x) * 2j * np.pi * 0.1 * np.arange(POINTS // 2 + 1)
    outputs = {"y": x + 0.2 * np.fft.irfft(amplitudes, POINTS), "z": 0.2 * x}
    kept = {"x": 3, "y": 4, "z": 2}
    for channel, values in outputs.items():
        spectrum = np.fft.rfft(values + 0.03 * generator.standard_normal(POINTS))
        spectrum[kept[channel] + 1 :] = 0.0
        outputs[channel] = np.fft.irfft(spectrum, POINTS)
    given = {"amplitude_variance": spectra, "amplitude_freedom": FREEDOM, "cycles": 14, "harmonics": kept}
    given["independent"] = {"y": 9.0, "z": 5.0}
    return bp.Experiment(name, 0.1, outputs, {"x": x}, samples=POINTS, **(given | changes))


def solved(runs, **settings):
    problem = bp.Problem(MODEL, runs, priors=PRIORS, scheme="fourier", **settings)
    fit = bp.map_estimate(problem, starts=1, checks=False, progress=False)
    objective, peak = at_estimate(problem, fit)
    return objective.density.problem, peak


def dense(problem, peak, noise=None, spectra=None, scale=1.0):
    """Return the covariance of all components of each experiment, with other measured spectra if given."""
    likelihood, noise = problem.likelihood, peak.noise if noise is None else noise
    given = {e.name: e for e in problem.experiments}
    result = {}
    for name, e in given.items():
        other = e if spectra is None else replace(e, amplitude_variance=e.amplitude_variance | spectra)
        diagonal, owner = [], []
        for block in (b for b in likelihood.blocks if b.experiment == name):
            values = noise[[likelihood.names.index(n) for n in likelihood.model.parameter_names(block)]]
            now, changed = (NoiseSpectrum.of(one, block.channel) for one in (e, other))
            measured = block.spectrum_measured
            if measured.size:
                measured = measured * (changed.variance / now.variance)[block.harmonic]
            one = replace(block, spectrum_measured=measured, measured=block.measured * scale)
            diagonal.append(np.broadcast_to(likelihood.model.spectrum(one, values)[0], block.size) / block.weight)
            owner += [block.channel] * block.size
        matrix = np.diag(np.concatenate(diagonal))
        if name in likelihood.loadings:
            now, changed = (NoiseSpectrum.of(one, "x").variance for one in (e, other))
            order = np.r_[np.arange(4), np.arange(1, 4)]
            moved = likelihood.loadings[name] * np.sqrt(changed / now)[order]
            matrix = matrix + moved @ moved.T
        result[name] = matrix
    return result


def expected_change(problem, peak, ends):
    """Return the change by central differences of the covariance; `weight` values count for each component."""
    total = NoiseChange(np.zeros((2, 2)), np.zeros((2, 2)), 0.0, 0.0)
    here, (up, down) = dense(problem, peak), ends
    for name, matrix in here.items():
        members = [b for b, block in enumerate(problem.likelihood.blocks) if block.experiment == name]
        jacobian = np.concatenate([peak.here.jacobian[b] for b in members], axis=1)
        inverse = np.linalg.inv(matrix)
        once = inverse @ (up[name] - down[name]) / (2 * STEP)
        total = total + NoiseChange(
            jacobian @ once @ inverse @ jacobian.T, jacobian @ once @ once @ inverse @ jacobian.T,
            float(np.trace(once)), float(np.trace(once @ once)),
        )  # fmt: skip
    return total


def assert_same(change, expected):
    size = np.abs(expected.information).max()
    assert change.information == pytest.approx(expected.information, rel=1e-5, abs=1e-6 * size)
    assert change.doubled == pytest.approx(expected.doubled, rel=1e-5, abs=1e-6 * np.abs(expected.doubled).max())
    assert change.trace == pytest.approx(expected.trace, rel=1e-5)
    assert change.square == pytest.approx(expected.square, rel=1e-5)


@pytest.mark.parametrize("input_noise", ["exact", "measured"])
def test_measured_variances_change_the_covariance_as_differences_show(input_noise):
    """Each measured variance of a harmonic of y, z and, if its errors are not neglected, x, one after the other.

    The spectra are smooth, so that the weights with which neighbours are averaged are constant.
    """
    problem, peak = solved([run_of()], noise="measured", input_noise=input_noise, fixed={"variance[z]": 2e-5})
    assert bool(problem.likelihood.loadings) == (input_noise == "measured")
    channels = ["y", "z"] + ["x"] * (input_noise == "measured")
    wanted = []
    for channel in channels:
        freedom = FREEDOM.get(channel, 13.0 * np.array([1.0, 2.0, 2.0]))
        for h, size in enumerate(SPECTRA[channel]):
            ends = []
            for sign in (1.0, -1.0):
                moved = SPECTRA[channel].copy()
                moved[h] = size * np.exp(sign * STEP)
                ends.append(dense(problem, peak, spectra={channel: moved}))
            wanted.append((expected_change(problem, peak, ends), freedom[h]))
    listed = [*changes_by_measured(problem, peak.here.jacobian, peak.noise)]
    assert len(listed) == len(wanted)
    for (change, freedom), (expected, values) in zip(listed, wanted, strict=True):
        assert_same(change, expected)
        assert freedom == pytest.approx(values)
    parts = covariance.variance_parts(problem, peak, np.eye(2), 1.0)
    numbered = [parts[str(number)] for number in range(len(wanted))]
    for part, (expected, values) in zip(numbered, wanted, strict=True):
        size = np.abs(expected.information).max()
        assert part.once == pytest.approx(expected.information, rel=1e-5, abs=1e-5 * size)
        assert part.freedom == pytest.approx(values) and part.left == pytest.approx(max(values, 1.0))


def test_scatter_alone_has_the_degrees_of_freedom_of_its_cycles():
    """Of 14 cycles 13 are free, times the independent values of a cycle; of one cycle the scatter is known."""
    settings = {"amplitude_variance": {}, "amplitude_freedom": {}, "scatter": {"y": 0.05, "z": 0.04}}
    settings["independent"] = {"y": 7.0, "z": 5.0}
    problem, peak = solved([run_of(**settings)], noise="measured")
    listed = [*changes_by_measured(problem, peak.here.jacobian, peak.noise)]
    assert [freedom for _, freedom in listed] == pytest.approx([13 * 7.0, 13 * 5.0])
    ends = [dense(problem, peak, scale=np.exp(sign * STEP)) for sign in (1.0, -1.0)]
    both = listed[0][0] + listed[1][0]
    expected = expected_change(problem, peak, ends)
    assert both.information == pytest.approx(expected.information, rel=1e-5, abs=1e-6 * expected.information.max())
    # Channel z does not depend on a.
    assert both.information[0, 0] == pytest.approx(listed[0][0].information[0, 0])
    once, _ = solved([run_of(**(settings | {"cycles": 1}))], noise="measured")
    assert [*changes_by_measured(once, peak.here.jacobian, peak.noise)] == []


def test_other_noise_models_have_no_measured_variances_of_outputs():
    problem, peak = solved([run_of()], noise="independent", input_noise="measured")
    assert len([*changes_by_measured(problem, peak.here.jacobian, peak.noise)]) == SPECTRA["x"].size
    problem, peak = solved([run_of()], noise="independent", input_noise={"x": 0.01})
    assert problem.likelihood.loadings and [*changes_by_measured(problem, peak.here.jacobian, peak.noise)] == []


@pytest.mark.parametrize("input_noise", ["exact", "measured"])
@pytest.mark.parametrize("kind", ["independent", "measured"])
def test_unknown_variances_change_the_covariance_as_differences_show(kind, input_noise):
    """Two experiments share the variance of each channel, whose changes are added."""
    runs = [run_of(), run_of("second", 2)]
    problem, peak = solved(runs, noise=kind, input_noise=input_noise)
    peak = SimpleNamespace(here=peak.here, noise=np.maximum(peak.noise, 2e-4))
    listed = changes_by_variance(problem, peak.here.jacobian, peak.noise)
    assert [*listed] == ["variance[y]", "variance[z]"]
    for name, change in listed.items():
        one = np.array(problem.likelihood.names) == name
        ends = [dense(problem, peak, noise=peak.noise * np.exp(sign * STEP * one)) for sign in (1.0, -1.0)]
        expected = expected_change(problem, peak, ends)
        if kind == "independent" and input_noise == "exact":
            # Of components that stand for fewer or more values these count.
            assert change.trace == pytest.approx(problem.likelihood.counts[name])
        assert change.information == pytest.approx(
            expected.information, rel=1e-5, abs=1e-6 * expected.information.max()
        )
        assert change.doubled == pytest.approx(expected.doubled, rel=1e-5, abs=1e-6 * expected.doubled.max())


def test_variances_with_a_thousandth_of_those_of_the_components_are_left_out():
    """Of model errors beside measured noise, by the mean share; all are listed on demand."""
    problem, peak = solved([run_of()], noise="measured", input_noise="exact")
    measured = problem.likelihood.blocks[0].spectrum_measured
    for factor, names in ((0.9, ["variance[z]"]), (1.1, ["variance[y]", "variance[z]"])):
        noise = peak.noise.copy()
        noise[:] = 1.0
        # The mean of v/(v + measured) is 1/1000.
        low, high = 0.0, 1.0
        for _ in range(80):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if np.mean(middle / (middle + measured)) < 1e-3 * factor else (low, middle)
        noise[problem.likelihood.names.index("variance[y]")] = low
        assert [*changes_by_variance(problem, peak.here.jacobian, noise)] == names
        assert [*changes_by_variance(problem, peak.here.jacobian, noise, least=0.0)] == ["variance[y]", "variance[z]"]
