"""Chains that are stored by coordinate, so that what works on one of them takes the memory of one."""

from dataclasses import dataclass

import numpy as np

from bayesperiodic.sampling.proposals import AffineTransform, parts


@dataclass(frozen=True)
class Points:
    """Points (points, dimension) of which only slices are arrays; `columns` are the coordinates (points,)."""

    columns: list[np.ndarray]

    def __len__(self) -> int:
        return len(self.columns[0])

    def __getitem__(self, part: slice) -> np.ndarray:
        return np.stack([column[part] for column in self.columns], axis=-1)


class StoredChains:
    """Chains (ensembles, steps, walkers, coordinates) of which only coordinates are arrays, ``chains[..., k]``.

    `columns` are the coordinates (steps, walkers of all ensembles). If a transform is given, they are whitened, and
    what is returned is computed from all of them.
    """

    def __init__(self, columns: list[np.ndarray], ensembles: int, transform: AffineTransform | None = None):
        steps, walkers = columns[0].shape
        self.shape = ensembles, steps, walkers // ensembles, len(columns)
        self.points, self._transform = Points([column.reshape(-1) for column in columns]), transform

    @classmethod
    def of(cls, values: np.ndarray) -> "StoredChains":
        """Return chains that are copies of an array (ensembles, steps, walkers, coordinates)."""
        ensembles, steps, walkers, count = values.shape
        return cls([values[..., k].swapaxes(0, 1).reshape(steps, ensembles * walkers) for k in range(count)], ensembles)

    def __getitem__(self, place: tuple) -> np.ndarray:
        """Return a coordinate (ensembles, steps, walkers) at a place (..., k)."""
        column = self.points.columns[place[1]]
        if self._transform is not None:
            column, scratch = np.full(column.shape, self._transform.origin[place[1]]), np.empty(column.shape)
            for factor, other in zip(self._transform.axes[place[1]], self.points.columns, strict=True):
                column += np.multiply(factor, other, out=scratch)
        return self.by_ensemble(column)

    def by_ensemble(self, values: np.ndarray) -> np.ndarray:
        """Return values (points,), or by step and walker, as (ensembles, steps, walkers)."""
        ensembles, steps, walkers, _ = self.shape
        return values.reshape(steps, ensembles, walkers).swapaxes(0, 1)

    def unwhitened(self, part: slice) -> np.ndarray:
        """Return some points (points, coordinates)."""
        points = self.points[part]
        return points if self._transform is None else self._transform.unwhiten(points)

    def unwhiten(self) -> None:
        """Replace the whitened coordinates."""
        for part in parts(len(self.points)):
            for column, values in zip(self.points.columns, self.unwhitened(part).T, strict=True):
                column[part] = values
        self._transform = None

    def with_columns(self, columns: list[np.ndarray]) -> "StoredChains":
        """Return chains of other coordinates (ensembles, steps, walkers)."""
        return StoredChains([c.swapaxes(0, 1).reshape(self.shape[1], -1) for c in columns], self.shape[0])

    def thinned(self, most: int) -> np.ndarray:
        """Return about as many points (ensembles, points, coordinates), at equal distances."""
        count = self.shape[-1]
        each = max(1, len(self.points) // most)
        return np.stack([self[..., k].reshape(self.shape[0], -1)[:, ::each] for k in range(count)], axis=-1)

    def pop(self, k: int) -> np.ndarray:
        """Return a coordinate, and give its memory back when it is no longer used."""
        column = self[..., k]
        self.points.columns[k] = np.empty(0)
        return column
