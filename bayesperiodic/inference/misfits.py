"""Sums of squared residual components straight from a model's outputs: all that errors with a flat spectrum need."""

from collections.abc import Sequence

import numpy as np

from bayesperiodic.inference.observation import Observation
from bayesperiodic.parallel import available_cores, in_threads
from bayesperiodic.periodic.batch import Batch, BatchSolution

SMALLEST_SHARED = 100_000


class Misfits:
    """Experiments that are solved together and have their channels, whole periods, in common.

    Parameters
    ----------
    observations : sequence of Observation
        For which `possible` is true.
    """

    def __init__(self, observations: Sequence[Observation]):
        self._columns = np.array(observations[0].columns)
        self._data = np.stack([o.data for o in observations])
        self._kept = [np.array([o.layout[2 + c] for o in observations if o.layout]) for c in range(len(self._columns))]
        self._points = self._data.shape[1]
        self._weights = [self._parseval(kept) for kept in self._kept]
        self._whole = all(weights is None for weights in self._weights)

    @property
    def blocks(self) -> int:
        """The number of sums."""
        return len(self._data) * len(self._columns)

    @staticmethod
    def possible(observations: Sequence[Observation]) -> bool:
        """Return whether nothing but whole periods of the same channels is compared."""
        layouts = [o.layout for o in observations]
        return None not in layouts and len({layout[:2] for layout in layouts if layout}) == 1

    def solved(self, batch: Batch, parameters: np.ndarray, threads: int | None) -> tuple[np.ndarray, np.ndarray]:
        """Solve the experiments for many parameter vectors, and return sums of squares and how the solves ended.

        Parameters
        ----------
        batch : Batch
            Of these experiments.
        parameters : array (experiments, solves, parameters)
        threads : int or None
            By default one a core.

        Returns
        -------
        squares : array (experiments · channels, solves)
            Channels run fastest.
        status : int array (experiments, solves)
        """
        if self._whole:
            squares, status = batch.squares(parameters, self._data, self._columns, threads)
            return squares.transpose(0, 2, 1).reshape(self.blocks, -1), status
        found = batch.solve(parameters, threads)
        small = found.outputs.size < SMALLEST_SHARED
        return self.squares(found.outputs, 1 if small else threads or available_cores()), found.status

    def orbits(self, batch: Batch, parameters: np.ndarray) -> tuple[BatchSolution, np.ndarray]:
        """Solve the experiments for one parameter vector each; return the solution and sums of squares (blocks,).

        Parameters
        ----------
        batch : Batch
            Of these experiments.
        parameters : array (experiments, 1, parameters)
        """
        solved, squares = batch.orbits(parameters, self._data, self._columns)
        return solved, squares.reshape(-1) if self._whole else self.squares(solved.outputs, 1)[:, 0]

    def squares(self, outputs: np.ndarray, threads: int) -> np.ndarray:
        """Return the sums of squares (experiments · channels, solves), channels running fastest.

        Parameters
        ----------
        outputs : array (experiments, solves, points, channels)
            In the order of the model's outputs.
        threads : int
        """
        experiments, channels = len(outputs), len(self._columns)
        result = np.empty((experiments, channels, outputs.shape[1]))

        def one(part: slice) -> None:
            for c, column in enumerate(self._columns):
                difference = outputs[part, :, :, column] - self._data[part, None, :, c]
                result[part, c] = self._sums(difference, c, part)

        parts = min(threads, experiments)
        with np.errstate(over="ignore", invalid="ignore"):
            in_threads(
                one, [slice(experiments * k // parts, experiments * (k + 1) // parts) for k in range(parts)], threads
            )
        return result.reshape(experiments * channels, -1)

    def pulled(self, outputs: np.ndarray, by_square: np.ndarray) -> np.ndarray:
        """Return the derivatives of Σ by_square · squares by the outputs, (experiments, points, channels).

        Parameters
        ----------
        outputs : array (experiments, points, channels)
            Overwritten by the result.
        by_square : array (experiments · channels,)
            In the order of `squares`.
        """
        factors = 2.0 * by_square.reshape(len(outputs), -1)
        outputs[..., np.delete(np.arange(outputs.shape[-1]), self._columns)] = 0.0
        for c, column in enumerate(self._columns):
            own, kept = outputs[..., column], self._kept[c]
            own -= self._data[..., c]
            if self._weights[c] is not None:
                own[...] = self._within(own, kept)
            own *= (factors[:, c] * kept / self._points)[:, None]
        return outputs

    def _within(self, signals: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Return signals (experiments, points) within as many real components."""
        amplitudes = np.fft.rfft(signals, axis=-1)
        for own, size in zip(amplitudes, kept, strict=True):
            own[size // 2 + 1 :] = 0.0
        return np.fft.irfft(amplitudes, self._points, axis=-1)

    def _sums(self, difference: np.ndarray, channel: int, part: slice) -> np.ndarray:
        """Return the sums of squares (experiments, solves) of so many real components, by Parseval's theorem."""
        weights = self._weights[channel]
        if weights is None:
            return np.einsum("ebi,ebi->eb", difference, difference)
        amplitudes = np.fft.rfft(difference, axis=-1)[..., : weights.shape[1]]
        return np.einsum("ebh,eh->eb", amplitudes.real**2 + amplitudes.imag**2, weights[part])

    def _parseval(self, kept: np.ndarray) -> np.ndarray | None:
        """Return the weights (experiments, harmonics) of squared Fourier sums; None where all components are kept."""
        if (kept == self._points).all():
            return None
        weights = np.full((len(kept), kept.max() // 2 + 1), 2.0)
        weights[:, 0] = 1.0
        for own, size in zip(weights, kept, strict=True):
            own[(size + 1) // 2 :] = 0.0
            if size % 2 == 0:
                own[size // 2] = 1.0
            own *= size / self._points**2
        return weights
