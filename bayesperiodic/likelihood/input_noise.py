"""Noise of measured inputs: its covariance, its effect on the outputs, and what it adds to the log-likelihood.

The measured Fourier amplitudes of an input are those of the true one plus errors with a known normal distribution; the
prior of the true ones is flat. Let η be independent standard normal errors of the input, η̂ an estimate of them, and
the loadings L the derivatives of the predicted components by the input along η, less the errors of the outputs that go
with η. The periodic problem is solved with the input less η̂, and what η̂ causes in the prediction is taken from the
measured outputs. To first order the residual is then e − L·η, e being the other errors of the outputs, with the
variances D(φ) of the noise model. With the true input integrated out it has the covariance D(φ) + L·Lᵀ. η̂ and L are
computed at an estimate, again until they do not change, and are then fixed, so that the density depends on the
parameters alone. For a static model the estimate is that of orthogonal distance regression (W. A. Fuller, Measurement
Error Models, Wiley, 1987). If L followed the parameters, the determinant of the covariance would draw the estimate
towards models that pass on less of the input's noise.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
import sympy as sp

from bayesperiodic import _checks, _fourier
from bayesperiodic._io import Storable
from bayesperiodic._linalg import asymmetric_entry
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.noise_spectrum import NoiseSpectrum
from bayesperiodic.models.model import Model
from bayesperiodic.models.names import DERIVATIVES
from bayesperiodic.priors.single import Normal

EXACT, FROM_CYCLES, JOINT = "exact", "measured", "joint"
# Measured noise in whatever number of cycles, to be compared with the residual where the inputs are taken as exact.
ROUGH = "rough"
# Cycles from which on the variances of an input's amplitudes are measured; intervals contain how well.
FEWEST_CYCLES = 2
# Variance of combined errors, relative to that of the outputs' errors, up to which they are left out; and squares of
# singular values that are zero but for rounding, relative to the largest.
NEGLIGIBLE, ROUNDED_SQUARE = 1e-3, 1e-18
InputNoise = str | Mapping[str, Any]


@dataclass(frozen=True)
class InputErrors(Storable):
    """Errors of the inputs of one experiment, and last of its frequency, linearised about an estimate."""

    expected: np.ndarray  # (errors,), η̂
    loadings: np.ndarray  # (components of all blocks, errors), L
    caused: np.ndarray  # (components of all blocks,), what η̂ causes in the predicted components

    def parts(self, sizes: Sequence[int]) -> list[np.ndarray]:
        """Return what the expected errors cause, one array (size,) a block."""
        return np.split(self.caused, np.cumsum(sizes)[:-1])


def same(one: Mapping[str, InputErrors], other: Mapping[str, InputErrors]) -> bool:
    """Return whether two linearisations are equal."""
    return one.keys() == other.keys() and all(
        np.array_equal(a, b) for name in one for a, b in zip(astuple(one[name]), astuple(other[name]), strict=True)
    )


def noisy_inputs(experiment: Experiment, noise: InputNoise) -> list[str]:
    """Return the inputs of an experiment whose noise is known: measured, in enough cycles, or given."""
    if isinstance(noise, Mapping):
        return [name for name in experiment.inputs if name in noise]
    known = noise == ROUGH or (noise == FROM_CYCLES and experiment.cycles >= FEWEST_CYCLES)
    return [name for name in experiment.inputs if known and name in experiment.amplitude_variance]


def true_inputs(experiment: Experiment, noise: InputNoise, errors: InputErrors | None) -> dict[str, np.ndarray]:
    """Return the measured inputs (points,) less their expected errors."""
    result = {name: np.array(values) for name, values in experiment.inputs.items()}
    if errors is not None:
        where, waves = error_waves(experiment, noise)
        signals = _fourier.on_grid(waves, experiment.samples * experiment.periods)
        for name, error, signal in zip(where, errors.expected[: len(where)], signals, strict=True):
            result[name] -= error * signal
    return result


def checked(given: InputNoise, inputs: Sequence[str], experiments: Sequence[Experiment]) -> InputNoise:
    """Return a valid argument `input_noise`, an array for each covariance, or raise a ValueError."""
    if isinstance(given, str):
        _checks.one_of("input_noise", given, (EXACT, FROM_CYCLES, JOINT))
        return given if any(noisy_inputs(e, FROM_CYCLES) for e in experiments) else EXACT
    if not isinstance(given, Mapping):
        raise ValueError(f"input_noise: must be 'exact', 'measured', 'joint' or a mapping of inputs, got {given!r}.")
    for name in given:
        _checks.one_of("input_noise", name, inputs)
    return {name: _checked(name, value, experiments) for name, value in given.items()}


def _checked(name: str, value: Any, experiments: Sequence[Experiment]) -> Any:
    """Return a standard deviation, or a covariance of the size that the harmonics of each experiment need."""
    argument = f"input_noise[{name!r}]"
    if np.ndim(value) == 0:
        sd = _checks.finite_number(argument, value)
        if sd < 0.0:
            raise ValueError(f"{argument}: must be at least 0, got {sd:g}.")
        return sd
    matrix = np.array(value, dtype=float)
    for e in experiments:
        size = 2 * kept(e, name) + 1
        if matrix.shape != (size, size) or not np.isfinite(matrix).all() or asymmetric_entry(matrix):
            raise ValueError(
                f"{argument}: must be a symmetric covariance ({size}, {size}) of mean, cosines and sines of "
                f"{kept(e, name)} harmonics for experiment {e.name!r}, got shape {matrix.shape}."
            )
    least = float(np.linalg.eigvalsh(matrix).min())
    if least < -1e-9 * float(np.abs(matrix).max()):
        raise ValueError(f"{argument}: must be positive semidefinite, got the eigenvalue {least:.3g}.")
    return matrix


def kept(experiment: Experiment, name: str) -> int:
    """Return the number of harmonics of an input."""
    highest = _fourier.highest_harmonic(experiment.samples * experiment.periods)
    return min(experiment.harmonics.get(name, highest), highest)


def with_errors_as_parameters(
    model: Model, experiments: Sequence[Experiment]
) -> tuple[Model, dict[str, Normal], dict[str, dict[str, float]]]:
    """Return the model of measured inputs less errors, and priors or fixed values of the errors, by experiment.

    The parameters are the errors' amplitudes in the unit of the input, ``force_mean``, ``force_cos1``, ``force_sin1``,
    ….
    """
    if len(periods := {e.periods for e in experiments}) > 1:
        raise ValueError(
            f"input_noise: must be 'measured' or 'exact' for experiments of {sorted(periods)} periods, got 'joint'."
        )
    if correlated := next((e for e in experiments if e.error_slopes), None):
        raise ValueError(
            f"input_noise: must be 'measured' where errors of inputs and outputs correlate, as in {correlated.name!r}, "
            "got 'joint'."
        )
    tau, frequency = model.time_symbols["tau"], model.time_symbols["frequency"]
    phase, other, changed = 2 * sp.pi * tau / periods.pop(), copy(model), {}
    priors: dict[str, Normal] = {}
    fixed: dict[str, dict[str, float]] = {}
    for name in model.inputs:
        noisy = [e for e in experiments if name in noisy_inputs(e, FROM_CYCLES)]
        if not noisy:
            continue
        orders = range(1, 1 + max(kept(e, name) for e in noisy))
        waves = {f"{name}_mean": sp.Integer(1)} | {f"{name}_cos{h}": sp.cos(h * phase) for h in orders}
        waves |= {f"{name}_sin{h}": sp.sin(h * phase) for h in orders}
        symbols = {label: sp.Symbol(f"p_{label}", real=True) for label in waves}
        other.parameters += tuple(waves)
        other.parameter_symbols = other.parameter_symbols | symbols
        other.units = other.units | dict.fromkeys(waves, model.units.get(name, ""))
        error = sum((symbols[label] * wave for label, wave in waves.items()), sp.Integer(0))
        for order in DERIVATIVES:
            symbol = model.input_symbols[order + name]
            changed[symbol] = symbol - error
            error = sp.diff(error, tau) * frequency
        for e in experiments:
            sd = np.diag(_root(e, name, orders.stop - 1, FROM_CYCLES)) if e in noisy else np.zeros(len(waves))
            for label, value in zip(waves, sd.tolist(), strict=True):
                if value > 0.0:
                    priors[f"{label}[{e.name}]"] = Normal(0.0, value)
                else:
                    fixed.setdefault(label, {})[e.name] = 0.0
    other.equations = tuple(g.xreplace(changed) for g in model.equations)
    other.output_expressions = tuple(f.xreplace(changed) for f in model.output_expressions)
    _checks.identifiers("parameters", other.parameters)
    return other, priors, fixed


def error_waves(experiment: Experiment, noise: InputNoise) -> tuple[list[str], np.ndarray]:
    """Return which input each independent standard normal error belongs to, and by what that is off per unit.

    The latter are complex amplitudes (errors, harmonics + 1).
    """
    where: list[str] = []
    waves: list[np.ndarray] = []
    for name in noisy_inputs(experiment, noise):
        harmonics = kept(experiment, name)
        root = _root(experiment, name, harmonics, noise)
        for real in root.T:
            amplitude = real[: harmonics + 1].astype(complex)
            amplitude[1:] -= 1j * real[harmonics + 1 :]
            if amplitude.any():
                where.append(name)
                waves.append(amplitude)
    widest = max((wave.size for wave in waves), default=0)
    return where, np.array([np.pad(wave, (0, widest - wave.size)) for wave in waves]).reshape(len(waves), widest)


def _root(experiment: Experiment, name: str, harmonics: int, noise: InputNoise) -> np.ndarray:
    """Return a root of the covariance of mean, cosines and sines (2·harmonics + 1, errors)."""
    size = 2 * harmonics + 1
    if isinstance(noise, Mapping):
        if np.ndim(noise[name]) == 2:
            values, vectors = np.linalg.eigh(noise[name])
            return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
        # White noise has as much power in each of the components.
        return np.diag(float(noise[name]) * np.sqrt(np.r_[1.0, np.full(size - 1, 2.0)] / size))
    spectrum = NoiseSpectrum.of(experiment, name)
    variance = np.zeros(0) if spectrum is None else spectrum.variance[: harmonics + 1]
    variance = np.pad(variance, (0, harmonics + 1 - variance.size))
    return np.diag(np.sqrt(np.concatenate([variance[:1], 0.5 * variance[1:], 0.5 * variance[1:]])))


def directions(experiment: Experiment, names: Sequence[str], noise: InputNoise) -> np.ndarray:
    """Return changes of (u, u̇, ü) per unit of each error (errors, points, 3·inputs), inputs in the order of `names`."""
    where, waves = error_waves(experiment, noise)
    points, width = experiment.samples * experiment.periods, len(names)
    result = np.zeros((len(where), points, 3 * width))
    for order in range(3 if where else 0):
        rate = _fourier.derivative(waves, experiment.frequency / experiment.periods, order)
        for row, name, values in zip(result, where, _fourier.on_grid(rate, points), strict=True):
            row[:, order * width + names.index(name)] = values
    return result


def errors_of_outputs(experiment: Experiment, channels: Sequence[str], noise: InputNoise) -> np.ndarray:
    """Return the errors of measured outputs that go with a unit of each error of inputs (errors, points, channels)."""
    where, waves = error_waves(experiment, noise)
    points = experiment.samples * experiment.periods
    result = np.zeros((len(where), points, len(channels)))
    for i, (name, wave) in enumerate(zip(where, waves, strict=True)):
        for channel, slope in experiment.error_slopes.get(name, {}).items() if noise == FROM_CYCLES else ():
            size = min(slope.size, wave.size)
            result[i, :, channels.index(channel)] = _fourier.on_grid(slope[:size] * wave[:size], points)
    return result


def expected_errors(
    matrix: np.ndarray, r: Sequence[np.ndarray], p: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the expected errors given residuals r, their covariance, and L without what is negligible against e.

    p are the precisions (size,) of e, by block.
    """
    precision = np.concatenate([np.broadcast_to(part, own_r.shape) for part, own_r in zip(p, r, strict=True)])
    root = np.sqrt(precision)[:, None]
    vectors, values, axes = np.linalg.svd(root * matrix, full_matrices=False)
    covariance = np.eye(matrix.shape[1]) - (axes.T * (values**2 / (1.0 + values**2))) @ axes
    mean = -covariance @ (np.concatenate(r) @ (precision[:, None] * matrix))
    large = values**2 > NEGLIGIBLE
    loadings = (vectors[:, large] * values[large]) @ axes[large] / root
    return mean, covariance, loadings


class Shared:
    """Errors of the inputs of one experiment, which its blocks share, and what they add to the log-likelihood.

    `members` are the indices of the blocks, `parts` the loadings L of each, (size, errors). With the variances 1/p of
    the components r, S = 1 + Lᵀ·p·L, b = Lᵀ·p·r, and the estimated errors η̂ = S⁻¹·b, the logarithm of the determinant
    is ln|S| − Σ ln p, and the sum of squares Σ p·(r − L·η̂)² + η̂·η̂. This is r·p·r − b·S⁻¹·b (Woodbury), but has no
    difference of large numbers where errors explain r. The precisions p (…, size) may be (…, 1) where all are the same.
    """

    def __init__(self, members: Sequence[int], sizes: Sequence[int], matrix: np.ndarray):
        vectors, values, _ = np.linalg.svd(matrix, full_matrices=False)
        large = values**2 > ROUNDED_SQUARE * np.max(values**2, initial=0.0)
        self.members = tuple(members)
        self.parts = np.split(vectors[:, large] * values[large], np.cumsum(sizes)[:-1])
        self._grams = [part.T @ part for part in self.parts]
        # Unit vectors of the components that errors move, and whether these are all components.
        self._axes, self._complete = np.ascontiguousarray(vectors[:, large]), int(large.sum()) == len(vectors)
        # Lᵀ·L of all blocks together, a diagonal matrix.
        self._squares = values[large] ** 2

    def mean(self, factors: np.ndarray) -> float:
        """Return the mean of factors (all blocks,) over these blocks, weighted by their sizes."""
        return float(np.average(factors[list(self.members)], weights=[len(part) for part in self.parts]))

    @property
    def covariances(self) -> list[np.ndarray]:
        """L·Lᵀ of each block."""
        return [part @ part.T for part in self.parts]

    def caused(self, p: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the mean variance (…,) of the components of each block that errors cause, given the data."""
        inverse = np.linalg.inv(self._system([np.zeros(len(part)) for part in self.parts], p)[0])
        return [
            np.sum(inverse * gram, axis=(-2, -1)) / len(part)
            for part, gram in zip(self.parts, self._grams, strict=True)
        ]

    def _system(self, r: Sequence[np.ndarray], p: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return S (…, errors, errors) and b (…, errors), point by point: products must not depend on their number."""
        matrix, vector = np.eye(self.parts[0].shape[1]), np.zeros(())
        for part, gram, block, precision in zip(self.parts, self._grams, r, p, strict=True):
            even = precision.shape[-1] == 1
            added = gram * precision[..., None] if even else part.T @ (precision[..., None] * part)
            matrix = matrix + added
            vector = vector + (part.T @ (precision * block)[..., None])[..., 0]
        return matrix, vector

    def _diagonal(self, p: Sequence[np.ndarray]) -> np.ndarray | None:
        """Return the diagonal of S (…, errors) if S is diagonal: one block, the same precision of all components."""
        return 1.0 + p[0] * self._squares if len(p) == 1 and p[0].shape[-1] == 1 else None

    def log_likelihood(self, r: Sequence[np.ndarray], p: Sequence[np.ndarray], factor: float) -> np.ndarray:
        """Return −½ (sum of squares + ln|S|) (…,), the logarithm multiplied by a factor; NaN if not finite."""
        if (diagonal := self._diagonal(p)) is not None:
            along = (self._axes.T @ r[0][..., None])[..., 0]
            total = np.add.reduce(factor * np.log(diagonal) + along * along * (p[0] / diagonal), axis=-1)
            if not self._complete:
                left = r[0] - (self._axes @ along[..., None])[..., 0]
                total = total + p[0][..., 0] * np.add.reduce(left * left, axis=-1)
            return -0.5 * total
        matrix, vector = self._system(r, p)
        logarithms, errors = np.linalg.slogdet(matrix)[1], np.linalg.solve(matrix, vector[..., None])
        square = np.sum(errors[..., 0] ** 2, axis=-1)
        for part, block, precision in zip(self.parts, r, p, strict=True):
            square = square + np.sum(precision * (block - (part @ errors)[..., 0]) ** 2, axis=-1)
        return -0.5 * (square + factor * logarithms)

    def gradients(
        self, r: Sequence[np.ndarray], p: Sequence[np.ndarray], factor: float
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the derivatives of what is added by r and by the logarithms of p, (size,) a block."""
        diagonal, (matrix, vector) = self._diagonal(p), self._system(r, p)
        inverse = np.linalg.inv(matrix) if diagonal is None else matrix
        by_residual, by_logarithm = [], []
        for part, block, precision in zip(self.parts, r, p, strict=True):
            weighted = part @ inverse if diagonal is None else part / diagonal
            explained, taken = weighted @ vector, np.sum(weighted * part, axis=1)
            by_residual.append(precision * explained)
            by_logarithm.append(precision * (explained * block - 0.5 * explained**2 - 0.5 * factor * taken))
        return by_residual, by_logarithm

    def whitening(self, p: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return U (…, components, errors) and s² (…, errors) of the covariance 1 + U·s²·Uᵀ of r·√p.

        The columns of U are orthonormal.
        """
        if self._diagonal(p) is not None:
            return self._axes, p[0] * self._squares
        scaled = [np.sqrt(precision)[..., None] * part for precision, part in zip(p, self.parts, strict=True)]
        vectors, values, _ = np.linalg.svd(np.concatenate(scaled, axis=-2), full_matrices=False)
        return vectors, values**2

    def whitened(self, vectors: Sequence[np.ndarray], p: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return vectors (…, size) in units of 1/√p, times the symmetric root of the inverse of that covariance."""
        axes, squares = self.whitening(p)
        joined = np.concatenate(vectors, axis=-1)
        shrunk = 1.0 - 1.0 / np.sqrt(1.0 + squares)
        joined = joined - ((joined @ axes) * shrunk) @ axes.T
        return np.split(joined, np.cumsum([len(part) for part in self.parts])[:-1], axis=-1)
