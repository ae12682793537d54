"""A further kind of data, one class and one registration: measured amplitudes of an output beside its time history."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy import stats

import bayesperiodic as bp
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.block import Block, common
from bayesperiodic.likelihood.kinds import KINDS
from tests.known import formula_model, grid

MODEL = formula_model("gain", ["a", "b"], lambda p, u, s: {"y": p.a * u.x, "z": p.a * p.b * u.dx})
PRIORS = {"a": bp.Normal(1.0, 2.0), "b": bp.Normal(1.0, 2.0)}
TRUTH = {"a": 1.5, "b": 0.8}
POINTS, FREQUENCY, SD = 32, 0.25, 0.02


@dataclass(frozen=True)
class WithAmplitude(Experiment):
    """An experiment of which also the amplitude of z was measured, by another instrument."""

    amplitude: float = field(default=0.0, kw_only=True)


@dataclass(frozen=True, eq=False)
class Amplitude(Block):
    """Modulus of the first harmonic of z, in units of its standard deviation."""

    value: float = 0.0

    @classmethod
    def of(cls, experiment, model):
        """Return one block of experiments with an amplitude."""
        if not isinstance(experiment, WithAmplitude):
            return []
        return [cls(count=0.0, size=1, value=experiment.amplitude, **common(experiment, "amplitude", 1))]

    def _harmonic(self, values: np.ndarray) -> np.ndarray:
        return np.fft.rfft(values[..., self.place], axis=-1)[..., 1] * 2.0 / self.points

    def compare(self, predicted, difference):
        """Return measured minus predicted amplitude."""
        return (self.value - np.abs(self._harmonic(predicted.values)))[..., None] / SD

    def changes(self, predicted, directions):
        """Return the derivative of the modulus."""
        here = self._harmonic(predicted.values)
        return np.real(self._harmonic(directions.values) * np.conj(here) / np.abs(here))[..., None] / SD

    def add_vjp(self, predicted, weights, total):
        """Add the transposed derivative."""
        here, turn = self._harmonic(predicted.values), np.exp(-2j * np.pi * grid(self.points))
        total.values[:, self.place] += (
            weights[0] / SD * np.real(turn * np.conj(here) / np.abs(here)) * 2.0 / self.points
        )


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    """Register the kind during a test."""
    KINDS.append(Amplitude)
    yield
    KINDS.remove(Amplitude)


def experiment(amplitude: float | None = 2 * np.pi * FREQUENCY * 1.2 + 0.01) -> Experiment:
    """Return y = a·x and z = a·b·ẋ with noise, and the amplitude of z, 2π·frequency·a·b + 0.01."""
    tau = grid(POINTS)
    x, noise = np.cos(2 * np.pi * tau), np.random.default_rng(1).standard_normal((2, POINTS))
    outputs = {
        "y": 1.5 * x + 0.05 * noise[0],
        "z": -2 * np.pi * FREQUENCY * 1.2 * np.sin(2 * np.pi * tau) + 2.0 * noise[1],
    }
    given = {"name": "run", "frequency": FREQUENCY, "outputs": outputs, "inputs": {"x": x}, "samples": POINTS}
    return Experiment(**given) if amplitude is None else WithAmplitude(**given, amplitude=amplitude)


def problem(**changes) -> bp.Problem:
    return bp.Problem(MODEL, [experiment(**changes)], priors=PRIORS, scheme="fourier", input_noise="exact")


def test_the_further_kind_adds_its_normal_density():
    theta, noise = {"a": 1.4, "b": 0.9}, {"variance[y]": 0.01, "variance[z]": 4.0}
    added = problem().log_likelihood(theta, noise) - problem(amplitude=None).log_likelihood(theta, noise)
    off = 2 * np.pi * FREQUENCY * (1.2 - 1.4 * 0.9) + 0.01
    assert added == pytest.approx(stats.norm.logpdf(off, 0.0, SD) - stats.norm.logpdf(0.0, 0.0, SD), rel=1e-9)


@pytest.mark.parametrize("forward", [True, False])
def test_its_gradient_equals_differences(forward):
    density = problem().density()
    point = np.array([1.4, 0.9])
    noise = np.array([0.01, 4.0])
    _, found, _, _ = density.value_and_gradient_at(point, noise, forward=forward)
    for i, step in enumerate(1e-5 * np.eye(2)):
        ends = [density.at((point + s * step)[None], noise[None]).log_prob[0] for s in (1, -1)]
        assert found[i] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-5)


def test_estimate_and_prediction_use_it():
    """Without the amplitude b follows from z alone, whose noise is large; with it the sd of b is SD/(2π·f·a)."""
    own = problem()
    fit, without = (bp.map_estimate(p, starts=1, progress=False) for p in (own, problem(amplitude=None)))
    assert fit.sd["b"] == pytest.approx(SD / (2 * np.pi * FREQUENCY * 1.5), rel=0.3)
    assert without.sd["b"] > 10.0 * fit.sd["b"]
    assert abs(fit.theta["b"] - TRUTH["b"]) < 4.0 * fit.sd["b"]
    posterior = bp.sample(own, fit, seed=1, ensembles=2, max_steps=400, progress=False)
    prediction = bp.predict(own, posterior, draws=20)
    assert {(e, c) for e, c in zip(prediction.table.experiment, prediction.table.channel, strict=True)} == {
        ("run", "y"), ("run", "z"), ("all", "all")
    }  # fmt: skip


def test_experiments_without_its_data_are_as_before():
    plain = replace(experiment(None), name="plain")
    blocks = bp.Problem(MODEL, [plain, experiment()], priors=PRIORS).likelihood.blocks
    assert [(b.experiment, b.channel) for b in blocks] == [
        ("plain", "y"), ("plain", "z"), ("run", "y"), ("run", "z"), ("run", "amplitude")
    ]  # fmt: skip
