"""Internal states of elements with memory over a period, for given displacements of the elements.

On each two steps of the grid the states w follow from ẇ = h(d, ḋ, w) by the formula of Lobatto IIIA with three points,
which is implicit and of order four ([1]_); where a rate has a kink the error is of order three. The state is periodic
to rounding. Derivatives are those of the formula, with the period closed.

References
----------
.. [1] E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 2nd ed., Springer, 1996, section IV.5.
"""

from typing import NamedTuple

import numpy as np

from bayesperiodic.models.model import CondensedModel
from bayesperiodic.periodic.receptance import compiled


class Memory(NamedTuple):
    """Periodic internal states, and the equations of the elements at all points with their derivatives."""

    states: np.ndarray  # (points, 3·variables), displacements and internal states, then their derivatives
    columns: np.ndarray  # (points, variables + variables·3·variables), see `_kernels.condensed.march`
    step: float
    blocks: np.ndarray
    owners: np.ndarray  # (internal states,), the element of each

    @property
    def elements(self) -> int:
        """Number of elements."""
        return self._variables - len(self.owners)

    @property
    def _variables(self) -> int:
        return self.states.shape[1] // 3

    @property
    def slopes(self) -> np.ndarray:
        """Derivatives of the equations, (points, variables, 3, variables)."""
        given = self._variables
        return self.columns[:, given:].reshape(-1, given, 3, given)

    @property
    def rates(self) -> np.ndarray:
        """Derivatives of the internal states by time, (points, internal states)."""
        return self.columns[:, self.elements : self._variables]

    @property
    def by_displacement(self) -> np.ndarray:
        """Derivatives of the rates by the displacement of the element, (points, internal states)."""
        return self.slopes[:, self.elements + np.arange(len(self.owners)), 0, self.owners]

    @property
    def by_velocity(self) -> np.ndarray:
        """Derivatives of the rates by the velocity of the element, (points, internal states)."""
        return self.slopes[:, self.elements + np.arange(len(self.owners)), 1, self.owners]

    @property
    def of_forces(self) -> np.ndarray:
        """Derivatives of the forces by the internal states, (points, elements, internal states)."""
        return self.slopes[:, : self.elements, 0, self.elements :]

    def on_fewer(self, points: int) -> "Memory":
        """Return this on fewer of its points, but not fewer than the given ones."""
        every = 1
        while len(self.states) >= 2 * every * points:
            every *= 2
        states, columns = self.states[::every].copy(), self.columns[::every].copy()
        return self._replace(states=states, columns=columns, step=every * self.step)

    def steepest(self, rates: np.ndarray) -> np.ndarray:
        """Return bounds of the change of the forces by that of the displacements (harmonics, elements).

        They hold for changes at angular frequencies `rates` that are fast enough to leave the states no time to relax.
        """
        slow = np.abs(self.by_displacement).max(axis=0) / np.maximum(rates, rates[1])[:, None]
        change = np.abs(self.by_velocity).max(axis=0) + slow
        result = np.zeros((len(rates), self.elements))
        for state, owner in enumerate(self.owners):
            result[:, owner] += np.abs(self.of_forces[:, owner, state]).max() * change[:, state]
        return result

    def change(self, added: np.ndarray) -> np.ndarray:
        """Return changes of the forces (points, elements, columns) by those of the rates (points, states, columns).

        Those are with all states held.
        """
        moved = np.array(added, dtype=float, order="C")
        compiled().tangent(self.columns, moved, self.step, self.blocks)
        return np.asarray(self.of_forces @ moved)

    def along(self, d: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the change of the forces by those of displacements and velocities, (points, elements, columns)."""
        by_d, by_v = self.by_displacement[..., None], self.by_velocity[..., None]
        return self.change(by_d * d[:, self.owners] + by_v * v[:, self.owners])


def error_of_fewer(y_f: np.ndarray, change: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the relative error of outputs y by the formula of the internal states; infinite where it is not known.

    `change` (…, harmonics, elements) is that of the forces where half of the points give them, of which at kinks, where
    the formula is of order two, a third is left. `y_f` (…, harmonics, outputs, elements) and y (…, harmonics, outputs)
    may have more harmonics.
    """
    moved = np.linalg.norm((y_f[..., : change.shape[-2], :, :] @ change[..., None])[..., 0], axis=-2)
    worst = np.max(moved / np.maximum(np.linalg.norm(y, axis=-2), np.finfo(float).tiny), axis=-1, initial=0.0)
    return np.where(np.isfinite(worst), worst / 3.0, np.inf)


def remembered(
    model: CondensedModel, states: np.ndarray, parameters: np.ndarray, frequency: float, period: float,
    near: Memory | None = None,
) -> Memory | None:  # fmt: skip
    """Return the periodic internal states for displacements and velocities in `states`; None if they are not found.

    `states` (points, 3·variables) are filled, starting from the internal states of a motion that is near, if any.
    """
    kernels, given = model.element_kernels, states.shape[1] // 3
    columns, step = np.empty((len(states), given * (1 + 3 * given))), 2 * period / len(states)
    blocks, owners = (np.array(given, dtype=np.int64) for given in (model.state_blocks, model.state_owners))
    call = kernels.residual_jacobian.address, states, columns, parameters, frequency, step, blocks
    if near is None:
        if not compiled().march(*call):
            return None
    else:
        inner = slice(near.elements, given)
        states[:, inner] = near.states[:, inner]
        if not compiled().follow_states(*call):
            return None
        # The derivatives at the last states.
        columns = kernels.evaluate(
            "residual_jacobian", states, np.empty((len(states), 0)), parameters, np.zeros(len(states)), frequency
        )
    return Memory(states, columns, step, blocks, owners)
