"""Noise of measured inputs: its covariance, its effect on the outputs, and what it adds to the log-likelihood.

The measured Fourier amplitudes of an input are those of the true one plus errors with a known normal distribution; the
prior of the true ones is flat. Let η be independent standard normal errors of the input, η̂ an estimate of them, and
the loadings L the derivatives of the predicted components by the input along η. The periodic problem is solved with the
input less η̂, and what η̂ causes, L·η̂, is taken from the measured outputs. To first order the residual is then
e − L·η, e being the error of the outputs, with the variances D(φ) of the noise model. With the true input integrated
out it has the covariance D(φ) + L·Lᵀ. η̂ and L are computed at an estimate, again until they do not change, and are then
fixed, so that the density depends on the parameters alone. For a static model the estimate is that of orthogonal
distance regression (W. A. Fuller, Measurement Error Models, Wiley, 1987). If L followed the parameters, the determinant
of the covariance would draw the estimate towards models that pass on less of the input's noise.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesperiodic import _checks, _fourier
from bayesperiodic.data.experiment import Experiment

EXACT, MEASURED = "exact", "measured"
# Cycles from which on the variances of an input's amplitudes are known well enough.
FEWEST_CYCLES = 5
# Neighbouring harmonics on each side that the variance of one is averaged with.
NEIGHBOURS = 2
# Singular values of loadings, relative to the largest, that are left out.
NEGLIGIBLE = 1e-9
InputNoise = str | Mapping[str, Any]


@dataclass(frozen=True)
class InputErrors:
    """Errors of the inputs of one experiment, linearised about an estimate."""

    expected: np.ndarray  # (errors,), η̂
    loadings: np.ndarray  # (components of all blocks, errors), L

    def parts(self, sizes: Sequence[int]) -> list[np.ndarray]:
        """Return L·η̂, what the expected errors cause, one array (size,) a block."""
        return np.split(self.loadings @ self.expected, np.cumsum(sizes)[:-1])


def same(one: Mapping[str, InputErrors], other: Mapping[str, InputErrors]) -> bool:
    """Return whether two linearisations are equal."""
    return one.keys() == other.keys() and all(
        np.array_equal(own.expected, other[name].expected) and np.array_equal(own.loadings, other[name].loadings)
        for name, own in one.items()
    )


def true_inputs(experiment: Experiment, noise: InputNoise, errors: InputErrors | None) -> dict[str, np.ndarray]:
    """Return the measured inputs (points,) less their expected errors."""
    result = {name: np.array(values) for name, values in experiment.inputs.items()}
    if errors is not None:
        where, waves = error_waves(experiment, noise)
        signals = _fourier.on_grid(waves, experiment.samples * experiment.periods)
        for name, error, signal in zip(where, errors.expected, signals, strict=True):
            result[name] -= error * signal
    return result


def checked(given: InputNoise, inputs: Sequence[str], experiments: Sequence[Experiment]) -> InputNoise:
    """Return a valid argument `input_noise`, an array for each covariance, or raise a ValueError."""
    if isinstance(given, str):
        _checks.one_of("input_noise", given, (EXACT, MEASURED))
        if given == MEASURED:
            for e in experiments:
                missing = [name for name in inputs if name not in e.amplitude_variance]
                if missing or (inputs and e.cycles < FEWEST_CYCLES):
                    what = f"no amplitude_variance of {missing[0]!r}" if missing else f"only {e.cycles} cycles"
                    raise ValueError(
                        f"input_noise: must be 'exact' or a mapping where less than {FEWEST_CYCLES} cycles were "
                        f"folded, got 'measured'; experiment {e.name!r} has {what}."
                    )
        return given
    if not isinstance(given, Mapping):
        raise ValueError(f"input_noise: must be 'exact', 'measured' or a mapping of inputs, got {given!r}.")
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
        if matrix.shape != (size, size) or not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T):
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


def pooled(variance: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Return variances of amplitudes (harmonics + 1,), averaged over neighbours by their degrees of freedom.

    The mean value, which slow noise moves, keeps its own.
    """
    result = variance.copy()
    window = np.ones(2 * NEIGHBOURS + 1)
    middle = slice(NEIGHBOURS, NEIGHBOURS + variance.size - 1)
    weighted, weight = (np.convolve(own[1:], window)[middle] for own in (variance * freedom, freedom))
    result[1:] = np.divide(weighted, weight, out=variance[1:].copy(), where=weight > 0.0)
    return result


def error_waves(experiment: Experiment, noise: InputNoise) -> tuple[list[str], np.ndarray]:
    """Return which input each independent standard normal error belongs to, and by what that is off per unit.

    The latter are complex amplitudes (errors, harmonics + 1).
    """
    where: list[str] = []
    waves: list[np.ndarray] = []
    for name in experiment.inputs:
        if noise == EXACT or name not in (noise if isinstance(noise, Mapping) else experiment.amplitude_variance):
            continue
        harmonics = kept(experiment, name)
        root = _root(experiment, name, harmonics, noise)
        for real in root.T:
            amplitude = real[: harmonics + 1].astype(complex)
            amplitude[1:] -= 1j * real[harmonics + 1 :]
            if amplitude.any():
                where.append(name)
                waves.append(amplitude)
    widest = max((own.size for own in waves), default=0)
    return where, np.array([np.pad(own, (0, widest - own.size)) for own in waves]).reshape(len(waves), widest)


def _root(experiment: Experiment, name: str, harmonics: int, noise: InputNoise) -> np.ndarray:
    """Return a root of the covariance of mean, cosines and sines (2·harmonics + 1, errors)."""
    size = 2 * harmonics + 1
    if isinstance(noise, Mapping):
        if np.ndim(noise[name]) == 2:
            values, vectors = np.linalg.eigh(noise[name])
            return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
        # White noise has as much power in each of the components.
        return np.diag(float(noise[name]) * np.sqrt(np.r_[1.0, np.full(size - 1, 2.0)] / size))
    variance = experiment.amplitude_variance[name][: harmonics + 1]
    freedom = experiment.amplitude_freedom.get(name)
    variance = variance if freedom is None else pooled(variance, freedom[: harmonics + 1])
    variance = np.pad(variance, (0, harmonics + 1 - variance.size))
    return np.diag(np.sqrt(np.concatenate([variance[:1], 0.5 * variance[1:], 0.5 * variance[1:]])))


def directions(experiment: Experiment, names: Sequence[str], noise: InputNoise) -> np.ndarray:
    """Return changes of (u, u̇, ü) per unit of each error (errors, points, 3·inputs), inputs in the order of `names`."""
    where, waves = error_waves(experiment, noise)
    points, width = experiment.samples * experiment.periods, len(names)
    result = np.zeros((len(where), points, 3 * width))
    for order in range(3 if where else 0):
        rate = _fourier.derivative(waves, experiment.frequency / experiment.periods, order)
        for own, name, values in zip(result, where, _fourier.on_grid(rate, points), strict=True):
            own[:, order * width + names.index(name)] = values
    return result


def expected_errors(
    matrix: np.ndarray, r: Sequence[np.ndarray], p: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (errors,) and the covariance of η given residuals r, p the precisions (size,) of e, by block."""
    precision = np.concatenate([np.broadcast_to(own, own_r.shape) for own, own_r in zip(p, r, strict=True)])
    weighted = matrix * precision[:, None]
    covariance = np.linalg.inv(np.eye(matrix.shape[1]) + matrix.T @ weighted)
    return -covariance @ (np.concatenate(r) @ weighted), covariance


class Shared:
    """Errors of the inputs of one experiment, which its blocks share, and what they add to the log-likelihood.

    `members` are the indices of the blocks, `parts` the loadings L of each, (size, errors). What is added to that of
    independent components r with variances 1/p is, summed over the blocks, ½·(b·S⁻¹·b − ln|S|), with
    S = 1 + Lᵀ·p·L and b = Lᵀ·p·r (Woodbury). The precisions p (…, size) may be (…, 1) where all are the same.
    """

    def __init__(self, members: Sequence[int], sizes: Sequence[int], matrix: np.ndarray):
        vectors, values, _ = np.linalg.svd(matrix, full_matrices=False)
        large = values > NEGLIGIBLE * values.max(initial=0.0)
        self.members = tuple(members)
        self.parts = np.split(vectors[:, large] * values[large], np.cumsum(sizes)[:-1])
        self._grams = [part.T @ part for part in self.parts]
        # Lᵀ·L of all blocks together, a diagonal matrix.
        self._squares = values[large] ** 2

    @property
    def covariances(self) -> list[np.ndarray]:
        """L·Lᵀ of each block."""
        return [part @ part.T for part in self.parts]

    def _system(self, r: Sequence[np.ndarray], p: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return S (…, errors, errors) and b (…, errors), point by point: products must not depend on their number."""
        matrix, vector = np.eye(self.parts[0].shape[1]), np.zeros(())
        for part, gram, own, precision in zip(self.parts, self._grams, r, p, strict=True):
            even = precision.shape[-1] == 1
            added = gram * precision[..., None] if even else part.T @ (precision[..., None] * part)
            matrix = matrix + added
            vector = vector + (part.T @ (precision * own)[..., None])[..., 0]
        return matrix, vector

    def log_likelihood(self, r: Sequence[np.ndarray], p: Sequence[np.ndarray], factor: float) -> np.ndarray:
        """Return what is added (…,), the logarithm of the determinant multiplied by a factor; NaN if not finite."""
        if len(r) == 1 and p[0].shape[-1] == 1:  # S is diagonal
            diagonal = 1.0 + p[0] * self._squares
            vector = p[0] * (self.parts[0].T @ r[0][..., None])[..., 0]
            return 0.5 * np.sum(vector**2 / diagonal - factor * np.log(diagonal), axis=-1)
        matrix, vector = self._system(r, p)
        wrong = ~(np.isfinite(matrix).all(axis=(-2, -1)) & np.isfinite(vector).all(axis=-1))
        if np.any(wrong):
            matrix = np.where(wrong[..., None, None], np.eye(matrix.shape[-1]), matrix)
        logarithms = np.log(np.diagonal(np.linalg.cholesky(matrix), axis1=-2, axis2=-1)).sum(axis=-1)
        squares = np.sum(vector * np.linalg.solve(matrix, vector[..., None])[..., 0], axis=-1)
        return np.where(wrong, np.nan, 0.5 * squares - factor * logarithms)

    def gradients(
        self, r: Sequence[np.ndarray], p: Sequence[np.ndarray], factor: float
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return the derivatives of what is added by r and by the logarithms of p, (size,) a block."""
        matrix, vector = self._system(r, p)
        inverse = np.linalg.inv(matrix)
        errors = inverse @ vector
        by_residual, by_logarithm = [], []
        for part, own, precision in zip(self.parts, r, p, strict=True):
            explained = part @ errors
            taken = np.einsum("ij,jk,ik->i", part, inverse, part)
            by_residual.append(precision * explained)
            by_logarithm.append(precision * (explained * own - 0.5 * explained**2 - 0.5 * factor * taken))
        return by_residual, by_logarithm

    def whitening(self, p: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return U (…, components, errors) and s² (…, errors) of the covariance 1 + U·s²·Uᵀ of r·√p.

        The columns of U are orthonormal.
        """
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
