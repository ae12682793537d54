"""Residual components block by block, those of alike blocks side by side, or the sums of their squares alone."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np


class Squares(NamedTuple):
    """What the likelihood needs of residual components whose errors have a flat spectrum.

    Attributes
    ----------
    squares : array (blocks, …)
        The sum of the squares of each block.
    """

    squares: np.ndarray


class Residuals(Sequence[np.ndarray]):
    """One array (…, size) of components a block.

    Parameters
    ----------
    stacks : sequence of array (members, …, size)
    places : sequence of (int, int)
        Stack and member of each block.
    """

    def __init__(self, stacks: Sequence[np.ndarray], places: Sequence[tuple[int, int]]):
        self._stacks, self._places = tuple(stacks), tuple(places)

    @classmethod
    def of(cls, blocks: Sequence[np.ndarray]) -> "Residuals":
        """Return the residuals of these blocks, as they are if they are residuals already."""
        if isinstance(blocks, cls):
            return blocks
        return cls([np.asarray(block)[None] for block in blocks], [(b, 0) for b in range(len(blocks))])

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, block: Any) -> Any:
        stack, member = self._places[block]
        return self._stacks[stack][member]

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self._stacks[stack][member] for stack, member in self._places)

    def at(self, index: int) -> "Residuals":
        """Return the components (size,) at one place of the middle axis (…,)."""
        return Residuals([stack[:, index] for stack in self._stacks], self._places)

    def like(self, blocks: Sequence[np.ndarray]) -> "Residuals":
        """Return other arrays, one a block, side by side as these are."""
        if isinstance(blocks, Residuals) and blocks._places == self._places:
            return blocks
        members: list[dict[int, np.ndarray]] = [{} for _ in self._stacks]
        for (stack, member), block in zip(self._places, blocks, strict=True):
            members[stack][member] = block
        return Residuals([np.stack([own[m] for m in range(len(own))]) for own in members], self._places)

    def scaled(self, factors: np.ndarray) -> "Residuals":
        """Return the components (size,) of each block times its factor, factors (blocks,)."""
        own = [np.empty((len(stack), 1)) for stack in self._stacks]
        for (stack, member), factor in zip(self._places, factors, strict=True):
            own[stack][member] = factor
        return Residuals([stack * factor for stack, factor in zip(self._stacks, own, strict=True)], self._places)

    def stacks(self) -> tuple[np.ndarray, ...]:
        """Return the arrays (members, …, size)."""
        return self._stacks

    @cached_property
    def squares(self) -> np.ndarray:
        """The sum of the squares of each block, (blocks, …)."""
        sums = [np.einsum("...i,...i->...", stack, stack) for stack in self._stacks]
        result = np.empty((len(self._places), *sums[0].shape[1:]))
        for block, (stack, member) in enumerate(self._places):
            result[block] = sums[stack][member]
        return result


def squares_of(residuals: Sequence[np.ndarray] | Squares) -> np.ndarray:
    """Return the sum of the squares of each block, (blocks, …)."""
    return residuals.squares if isinstance(residuals, Squares) else Residuals.of(residuals).squares
