"""Size of the error of a model: how far its predicted periods are from the true ones, with an interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import chdtr, gammaincinv

from bayesperiodic._linalg import TINY, column_space
from bayesperiodic.data.experiment import Experiment, LeftOut
from bayesperiodic.density.log_posterior import Linearisation
from bayesperiodic.density.problem import Problem
from bayesperiodic.estimation.adequacy import ALL, Whitened, measured_freedom

if TYPE_CHECKING:
    import pandas as pd

MODEL_ERROR = ("model_error", "model_error_low", "model_error_high")
# Column of the highest harmonic that the error contains.
UP_TO = "model_error_up_to"
# Probability beyond each end of the interval.
TAIL_PROBABILITY = 0.05
# Values tried of a noise variance that is itself estimated.
NOISE_SCALES = 25


class ErrorPart(NamedTuple):
    """Sum of squares of the residual components of a block, and the noise in it.

    `noise` is the part of the sum that is expected of the noise, known to a factor with `freedom` degrees of freedom,
    `variance` the variance of that part; `along` is the variance of the noise in the direction of the residual, known
    to a factor with `few` degrees of freedom.
    """

    square: float
    noise: float
    variance: float
    along: float
    freedom: float
    few: float

    def below(self, error: float, square: float) -> float:
        """Return the probability of a sum of squares below a value, for an error of the model of this sum of squares.

        The sum of squares of error and noise is noncentral χ², here by two moments (P. B. Patnaik, Biometrika 36 (1949)
        202-232), averaged over the unknown size of the noise.
        """
        levels = (np.arange(NOISE_SCALES) + 0.5) / NOISE_SCALES
        scale, beside = (
            np.ones(1) if np.isinf(freedom) else 0.5 * freedom / gammaincinv(0.5 * freedom, levels)
            for freedom in (self.freedom, self.few)
        )
        mean = error + scale[:, None] * self.noise
        freedom = 2.0 * mean**2 / (scale[:, None] ** 2 * self.variance + 4.0 * error * beside * self.along)
        return float(np.mean(chdtr(freedom, freedom * square / mean)))

    def error(self) -> tuple[float, float, float]:
        """Return the sum of squares of the error of the model, and the ends of its 90 % interval.

        A residual that is smaller than the noise says no more than one of the size of the noise.
        """
        if self.noise == 0.0:
            return self.square, self.square, self.square
        most = max(self.square, self.noise)
        return (
            max(self.square - self.noise, 0.0),
            _root(lambda error: self.below(error, self.square) - (1.0 - TAIL_PROBABILITY), self.square),
            _root(lambda error: self.below(error, most) - TAIL_PROBABILITY, most),
        )


@dataclass(frozen=True)
class Residual:
    """Residual components of a block, with the variances of the noise in them.

    `left` are the components (size,), `variances` those of their noise (size,), with degrees of freedom `each` (size,),
    `freedom` those of the sum of all variances, 0 if they are unknown. The components are `dependent` times as many
    as independent values.
    """

    left: np.ndarray
    variances: np.ndarray
    each: np.ndarray
    freedom: float
    dependent: float

    def with_harmonics(self, size: int, amplitudes: np.ndarray, without: LeftOut) -> Residual:
        """Return the same with complex amplitudes of further harmonics, scaled as components of a block of this size.

        The real and imaginary parts of an amplitude share a variance.
        """
        left = np.sqrt(0.5 * size) * np.concatenate([amplitudes.real, amplitudes.imag])
        variances, each = 0.25 * size * np.tile(without.variance, 2), np.tile(0.5 * without.freedom, 2)
        freedom = self.freedom
        if freedom > 0.0:
            known = float(self.variances.sum())
            # The sum of independent estimates of variances by Satterthwaite.
            uncertain = known**2 / freedom + float(np.sum(variances**2 / each))
            freedom = (known + float(variances.sum())) ** 2 / uncertain if uncertain > 0.0 else np.inf
        pairs = (self.left, left), (self.variances, variances), (self.each, each)
        values, noise, known_by = (np.concatenate(pair) for pair in pairs)
        return Residual(values, noise, known_by, freedom, self.dependent)

    def error(self, values: float) -> tuple[float, float, float]:
        """Return the sum of squares of the error of the model and the ends of its interval.

        `values` is the number of independent ones that the parameters leave.
        """
        square = float(self.left @ self.left)
        if self.freedom > 0.0:
            # Fewer independent values than components make sums of squares more variable.
            parts = self.variances * self.left**2
            along = self.dependent * float(parts.sum()) / max(square, TINY)
            # A few harmonics may hold all of the error, whose noise is known less well than that of all.
            uncertain = float(np.sum(parts**2 / self.each))
            few = float(parts.sum()) ** 2 / uncertain if uncertain > 0.0 else np.inf
            variance = 2.0 * self.dependent * float(self.variances @ self.variances)
            return ErrorPart(square, float(self.variances.sum()), variance, along, self.freedom, few).error()
        if values < 1.0:
            return np.nan, 0.0, np.inf
        return np.nan, 0.0, 0.5 * square * values / float(gammaincinv(0.5 * values, TAIL_PROBABILITY))


def _root(falling: Callable[[float], float], scale: float) -> float:
    """Return where a falling function of a positive number is zero; 0 if it is negative there."""
    from scipy.optimize import brentq

    if falling(0.0) <= 0.0:
        return 0.0
    high = scale
    while falling(high) > 0.0:
        high *= 2.0
    return float(brentq(falling, 0.0, high, xtol=1e-9 * scale))


def model_errors(problem: Problem, here: Linearisation, noise: np.ndarray) -> pd.DataFrame:
    """Return the error of the model in units of the measured rms and its 90 % interval, by experiment and channel.

    It is the rms of the difference between the true period and that of the model with the parameters that fit all
    experiments best, relative to the rms of the measured period about its mean. Harmonics that the recording resolves
    but the experiment does not keep are in it: each may be too weak to be noticed, but not all of them together. The
    noise is the one measured between cycles, or a given one, that of the inputs included; if it is unknown, there is
    only an upper end, for which all of the residual may be error of the model. `noise` are parameters of the noise
    model (noise_names,).
    """
    import pandas as pd

    if problem.likelihood.correlated:
        return pd.DataFrame(columns=[*MODEL_ERROR])
    white, likelihood = Whitened(problem, here, noise), problem.likelihood
    experiments = {e.name: e for e in problem.experiments}
    blocks = likelihood.blocks
    weights = [
        np.broadcast_to(one, (block.size,))
        for one, block in zip(likelihood.precisions(range(len(blocks)), noise), blocks, strict=True)
    ]
    root = np.sqrt(np.concatenate(weights))
    jacobian, residual = (np.concatenate(parts, axis=-1) for parts in (here.jacobian, here.residuals))
    if not (np.isfinite(jacobian).all() and np.isfinite(residual).all()):
        return pd.DataFrame(columns=[*MODEL_ERROR])
    basis = column_space(jacobian * root)
    left = residual - basis @ (basis.T @ (residual * root)) / root
    sources = [_noise_variances(white, i, weights[i], experiments[block.experiment]) for i, block in enumerate(blocks)]
    spread = np.concatenate([variances for variances, *_ in sources])
    after = _after_projection(basis, spread * root**2) / root**2 + _of_inputs(likelihood, blocks, basis, root)
    ends = np.cumsum([block.size for block in blocks])
    rows: dict[str, Any] = {}
    above = here.left_out()
    for block, (_, freedom, each), end in zip(blocks, sources, ends, strict=True):
        if block.counted and block.timed:
            place, e = slice(end - block.size, end), experiments[block.experiment]
            part = Residual(left[place], after[place], each, freedom, max(block.size / block.count, 1.0))
            used, up_to = float(np.sum(basis[place] ** 2)), np.nan
            if block.spectral:
                up_to = float(block.harmonic.max())
            if block.spectral and block.channel in e.left_out:
                without = e.left_out[block.channel]
                part = part.with_harmonics(block.size, above[block.experiment][block.channel], without)
                up_to = float(without.harmonic.max())
            error = part.error(min(block.count, block.size) + part.left.size - block.size - used)
            rms = float(np.std(e.outputs[block.channel][e.measured_points]))
            relative = np.sqrt(np.array(error) / block.size) / rms if rms > 0.0 else np.full(3, np.nan)
            values = dict(zip(MODEL_ERROR, relative.tolist(), strict=True)) | {UP_TO: up_to}
            rows[f"{block.experiment} {block.channel}"] = values
    return pd.DataFrame.from_dict(rows, orient="index", columns=[*MODEL_ERROR, UP_TO])


def with_model_error(table: pd.DataFrame, errors: pd.DataFrame) -> pd.DataFrame:
    """Return the table of `Prediction` with the columns of `model_errors`, the largest in the row "all"."""
    import pandas as pd

    if errors.empty or not np.isfinite(errors[MODEL_ERROR[2]]).all():
        return table.join(errors)
    errors = errors.astype(float)
    largest = errors.iloc[[int(np.argmax(errors[MODEL_ERROR[2]]))]].set_axis([ALL])
    return table.join(pd.concat([errors, largest]))


def in_words(sizes: Sequence[float], up_to: float, tolerance: float | None) -> str:
    """Return an error of the model, the ends of its interval and how it compares with a tolerance, in words.

    `up_to` is the highest harmonic that the error contains, NaN where values at points are compared.
    """
    error, low, high = sizes
    where = "at the measured points" if np.isnan(up_to) else f"up to harmonic {up_to:.0f}"
    if np.isnan(error):
        size = (
            f"the model is wrong by at most {high:.2%} of the rms {where} (95 %), if all of the residual is its error"
        )
    else:
        size = f"the model is wrong by {error:.2%} of the rms {where} (90 %: {100 * low:.3g} to {100 * high:.3g} %)"
    if tolerance is None:
        return size
    relation = "below" if high < tolerance else "above" if low > tolerance else "not shown to be below"
    return f"{size}, {relation} the tolerance of {100 * tolerance:.3g} %"


def _noise_variances(
    white: Whitened, index: int, weights: np.ndarray, experiment: Experiment
) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the variances of the noise in the components of a block (size,), and degrees of freedom, 0 if unknown.

    Degrees of freedom are those of all together and of each (size,).

    They are those measured between cycles, harmonic by harmonic where possible, or those of the noise model if given.
    """
    block = white.blocks[index]
    freedom = measured_freedom(experiment, block.channel)
    if (spectrum := white.spectrum(index)) is not None:
        pairs = np.bincount(block.harmonic)[block.harmonic]  # components that share a variance
        return spectrum[0][block.harmonic], freedom, spectrum[1][block.harmonic] / pairs
    if block.measured > 0.0:
        return np.full(block.size, block.measured), freedom, np.full(block.size, freedom)
    if white.groups[index] in white.known:
        return block.weight / weights, np.inf, np.full(block.size, np.inf)
    return np.zeros(block.size), 0.0, np.zeros(block.size)


def _after_projection(basis: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """Return the variances (size,) of independent components less their part along an orthonormal basis."""
    taken = np.sum(basis**2, axis=1)
    moved = basis @ (basis.T @ (variances[:, None] * basis))
    return np.maximum(variances * (1.0 - 2.0 * taken) + np.sum(moved * basis, axis=1), 0.0)


def _of_inputs(likelihood: Any, blocks: Any, basis: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return the variances (size,) that the noise of the inputs leaves in all components."""
    ends, result = np.cumsum([block.size for block in blocks]), np.zeros(root.size)
    for shared in likelihood.shared:
        moved = np.zeros((root.size, shared.parts[0].shape[1]))
        for b, part in zip(shared.members, shared.parts, strict=True):
            moved[ends[b] - blocks[b].size : ends[b]] = part * root[ends[b] - blocks[b].size : ends[b], None]
        result += np.sum((moved - basis @ (basis.T @ moved)) ** 2, axis=1) / root**2
    return result
