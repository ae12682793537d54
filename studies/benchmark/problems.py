"""Posterior densities of the benchmark, and the draws at which every method must be accurate.

The draws are those of the Laplace approximation at the MAP estimate, and as many at three times its standard
deviations. Variances are fixed at their estimates, so that log-posteriors differ by the periodic states alone.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies.benchmark.kernels import Integrators, integrators, misfit, table
from studies.damper import run as damper
from studies.gear import FINE, GEAR, SAMPLES, gear_at_rest, gear_problem, measured
from studies.silverbox import run as silverbox_data

FORCE, DISPLACEMENT, DUFFING, DAMPER, SILVERBOX = (
    "landing gear, force given", "landing gear, displacement given", "Duffing, damping ratio 0.5 %", "damper",
    "Silverbox",
)  # fmt: skip
SCHEMES = ("central2", "central4")
WIDE = 3.0
DUFFING_TRUTH = {"m": 1.0, "c": 0.01, "k": 1.0, "k3": 0.5}
# [Hz] and [N]: below the resonance, where only one motion is stable.
DUFFING_RUNS = ((0.075, 0.2), (0.1, 0.15), (0.125, 0.1))
DUFFING_SAMPLES, DUFFING_HARMONICS = 160, 12
# Appended to the names of problems with folded recordings whose harmonics are cut.
FOLDED = ", folded"
SILVERBOX_SAMPLES = 20_480
# At 800 points, and at 8192 of the Silverbox, the scheme is too coarse for the accuracy asked for.
DAMPER_SAMPLES = 1600


@dataclass(frozen=True)
class Case:
    """One experiment of a problem in the form of the integrators."""

    experiment: bp.Experiment
    model: Any
    moving: tuple[str, ...]  # The model's parameters that move with θ
    slopes: np.ndarray  # (moving, names): Their derivatives by θ at the estimate
    estimate: np.ndarray  # (parameters + 1,): At the MAP estimate, the frequency last
    variances: np.ndarray  # (channels,)
    start: np.ndarray  # (size,): Static equilibrium
    first: np.ndarray  # (size,): About y(0) at the estimate
    scale: np.ndarray  # (size,): Of the states

    @property
    def period(self) -> float:
        """Period of the orbit [s]."""
        return self.experiment.periods / self.experiment.frequency

    @property
    def compiled(self) -> Integrators:
        """The compiled integrators of the model."""
        return integrators(self.model, self.moving)

    def table(self, points: int) -> np.ndarray:
        """Return the inputs at equidistant points of a period."""
        return table(self.experiment, self.model.inputs, points)

    @cached_property
    def signals(self) -> np.ndarray:
        """The inputs at the samples."""
        return self.table(self.experiment.samples)

    @cached_property
    def times(self) -> np.ndarray:
        """The times of the samples [s]."""
        return np.arange(self.experiment.samples) * (self.period / self.experiment.samples)

    @cached_property
    def data(self) -> np.ndarray:
        """The outputs measured (samples, channels)."""
        return np.ascontiguousarray(np.stack([self.experiment.outputs[c] for c in self.model.outputs], axis=-1))

    @cached_property
    def _kept(self) -> np.ndarray:
        """Which harmonics of each channel are compared (samples // 2 + 1, channels)."""
        samples = self.experiment.samples
        counts = [self.experiment.harmonics.get(channel, samples) for channel in self.model.outputs]
        return np.arange(samples // 2 + 1)[:, None] <= counts

    @cached_property
    def _whole(self) -> bool:
        return bool(self._kept.all())

    @cached_property
    def _counts(self) -> np.ndarray:
        return np.array([float(self.experiment.independent[c]) for c in self.model.outputs])

    @cached_property
    def weights(self) -> np.ndarray:
        """Weights of the squared residuals: half the independent values per sample over the variance."""
        return 0.5 * self._counts / (self.experiment.samples * self.variances)

    @cached_property
    def spectral_weights(self) -> np.ndarray:
        """Weights of the squared Fourier sums of the residuals (samples // 2 + 1, channels), zero beyond those kept."""
        samples = self.experiment.samples
        twice = 2.0 * self._kept
        twice[[0, -1] if samples % 2 == 0 else [0]] /= 2.0
        return twice * self.weights / samples

    @cached_property
    def constant(self) -> float:
        """Part of the log-likelihood that is independent of the outputs."""
        return -0.5 * float(self._counts @ np.log(self.variances))

    def log_likelihood(self, outputs: np.ndarray) -> float:
        """Return the log-likelihood of this experiment, eq. (6), from outputs (samples, channels)."""
        if self._whole:
            return self.constant - misfit(self.data, outputs, self.weights)
        return self.constant - float(self.weights @ (self._residuals(outputs) ** 2).sum(axis=0))

    def log_likelihood_of(self, p: np.ndarray, states: np.ndarray) -> float:
        """Return the same from states (samples, size)."""
        outputs = np.empty_like(self.data)
        self.compiled.outputs(p, self.signals, np.ascontiguousarray(states), outputs)
        return self.log_likelihood(outputs)

    def weighted_residuals(self, outputs: np.ndarray) -> np.ndarray:
        """Return the derivatives of the log-likelihood by the outputs (samples, channels)."""
        return 2.0 * (self.data - outputs if self._whole else self._residuals(outputs)) * self.weights

    def _residuals(self, outputs: np.ndarray) -> np.ndarray:
        """Return data minus outputs within the harmonics kept."""
        return np.fft.irfft(np.fft.rfft(self.data - outputs, axis=0) * self._kept, len(outputs), axis=0)


@dataclass(frozen=True)
class Setting:
    """A posterior density and the points at which methods must be accurate."""

    name: str
    problem: bp.Problem  # With the scheme `FINE`
    fit: bp.MapEstimate
    theta: np.ndarray  # (draws, names): Half at the posterior's standard deviations, then half at three times these
    synthetic: bool
    start: Callable[[bp.Experiment, Mapping[str, float]], np.ndarray]  # Static equilibrium y of an experiment with p

    @cached_property
    def cases(self) -> tuple[Case, ...]:
        """The experiments."""
        return tuple(self._case(experiment) for experiment in self.problem.experiments)

    @property
    def near(self) -> np.ndarray:
        """The draws at the posterior's standard deviations."""
        return self.theta[: len(self.theta) // 2]

    @property
    def noise(self) -> np.ndarray:
        """The estimates of the noise parameters."""
        return np.array(list(self.fit.noise.values()))

    @property
    def estimate(self) -> np.ndarray:
        """The MAP estimate, (names,)."""
        return self.problem.vector(self.fit.theta)

    def schemed(self, scheme: str) -> bp.Problem:
        """Return the problem with another scheme, anchored at the estimate."""
        stated = self.problem
        other = bp.Problem(
            stated.model, stated.experiments, priors=stated.priors, fixed=stated.fixed, tied=stated.tied,
            noise=stated.noise, scheme=scheme, input_noise="exact",
        )  # fmt: skip
        guesses = {name: solution.states for name, solution in self.fit.solutions.items()}
        return other.anchored(self.fit.theta, guesses)

    def parameters(self, theta: np.ndarray, case: Case) -> np.ndarray:
        """Return p (draws, parameters + 1) of an experiment from θ (draws, names)."""
        values = self.problem.parameters(np.atleast_2d(theta), case.experiment.name)
        return np.column_stack([values, np.full(len(values), case.experiment.frequency)])

    def log_prior(self, theta: np.ndarray) -> float:
        """Return the log-prior at one θ."""
        return float(self.problem.log_prior(theta))

    def _case(self, experiment: bp.Experiment) -> Case:
        stated, names = self.problem, tuple(self.problem.model.parameters)
        slopes = stated.parameter_maps[experiment.name].slopes(self.estimate)[: len(names)]
        at = np.flatnonzero(slopes.any(axis=1))
        values = stated.parameters(self.estimate[None], experiment.name)[0]
        by_name = dict(zip(names, map(float, values), strict=True))
        given = dict(zip(stated.noise_names, self.noise, strict=True))
        states = self.fit.solutions[experiment.name].states
        scale, first = [], []
        for name, order in stated.model.orders.items():
            x, turning = states[name], 2 * np.pi * experiment.frequency
            scale += [float(np.abs(x).max()), turning * float(np.ptp(x))][:order]
            first += [x[0], (x[1] - x[-1]) * experiment.frequency * experiment.samples / 2][:order]
        return Case(
            experiment, stated.model, tuple(names[i] for i in at), slopes[at], np.append(values, experiment.frequency),
            np.array([given[f"variance[{c}]"] * experiment.independent[c] for c in stated.model.outputs])
            / (experiment.averaged or experiment.cycles * experiment.samples),
            self.start(experiment, by_name), np.array(first), np.array(scale),
        )  # fmt: skip


def draws(problem: bp.Problem, fit: bp.MapEstimate, count: int, seed: int) -> np.ndarray:
    """Return draws of the Laplace approximation, and as many at three times its standard deviations."""
    names = list(problem.names)
    factor = np.linalg.cholesky(np.asarray(fit.covariance.loc[names, names], dtype=float))
    white = np.random.default_rng(seed).standard_normal((2 * count, len(names)))
    white[count:] *= WIDE
    return problem.vector(fit.theta) + white @ factor.T


def _setting(
    name: str, problem: bp.Problem, count: int, seed: int, start: Any, guess: Any = None, synthetic: bool = True
) -> Setting:
    fit = bp.map_estimate(problem, start=guess, progress=False)
    if fit.status != "converged":
        raise RuntimeError(f"{name}: the MAP estimate ended {fit.status!r}.")
    return Setting(name, problem, fit, draws(problem, fit, count, seed), synthetic, start)


def gear(drive: str, count: int, seed: int, *, cut: bool = False) -> Setting:
    """Return the landing gear with one direction given."""
    problem = gear_problem(drive, seed, cut=cut)
    start = {name: GEAR[name] for name in problem.names}
    name = (FORCE if drive == "force" else DISPLACEMENT) + FOLDED * cut
    return _setting(name, problem, count, seed, gear_at_rest, start)


def duffing(count: int, seed: int, *, cut: bool = False) -> Setting:
    """Return the Duffing oscillator whose motion takes hundreds of cycles to become steady.

    With `cut` the experiments are folded recordings with `DUFFING_HARMONICS` harmonics on 800 points.
    """
    samples = SAMPLES if cut else DUFFING_SAMPLES
    wave, model = np.cos(2 * np.pi * np.arange(samples) / samples), bp.models.duffing
    runs = [(frequency, {"force": amplitude * wave}) for frequency, amplitude in DUFFING_RUNS]
    harmonics = dict.fromkeys(("force", "displacement"), DUFFING_HARMONICS) if cut else None
    experiments = measured(model, DUFFING_TRUTH, runs, samples, seed, harmonics=harmonics)
    priors = {name: bp.LogNormal(DUFFING_TRUTH[name], 0.5) for name in ("c", "k", "k3")}
    problem = bp.Problem(model, experiments, priors=priors, fixed={"m": 1.0}, scheme=FINE, input_noise="exact")
    guess = {name: DUFFING_TRUTH[name] for name in priors}
    return _setting(DUFFING + FOLDED * cut, problem, count, seed, lambda *_: np.zeros(2), guess)


def damped(data: Path | None, count: int, seed: int) -> Setting:
    """Return the measured damper, or a synthetic one."""
    recording, about = damper.read_recording(data, seed)
    problem = bp.Problem(
        bp.models.dahl, [recording.fold(DAMPER_SAMPLES)], priors=damper.PRIORS, scheme=FINE, input_noise="exact"
    )
    return _setting(DAMPER, problem, count, seed, lambda *_: np.zeros(1), synthetic=about["synthetic"])


def silverbox(data: Path | None, count: int, seed: int) -> Setting:
    """Return the measured Silverbox, or a synthetic one."""
    (recording, _), about = silverbox_data.read_steady_parts(data, seed)
    problem = silverbox_data.problem(silverbox_data.fold(recording, SILVERBOX_SAMPLES))
    return _setting(SILVERBOX, problem, count, seed, lambda *_: np.zeros(2), synthetic=about["synthetic"])
