"""The log-likelihood of residuals under a noise model, and its derivatives."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from bayesperiodic import _checks, _fourier
from bayesperiodic.likelihood.input_noise import Shared
from bayesperiodic.likelihood.noise import (
    CHANNEL,
    CORRELATED,
    EXPERIMENT,
    JEFFREYS,
    KNOWN,
    POINTS,
    SCALE,
    SPECTRAL,
    VARIANCE,
    Block,
    Noise,
)


class Residuals(Sequence[np.ndarray]):
    """One array (…, size) of components a block, stored as stacks (members, …, size) with the place of each block."""

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
        """The sum of the squares of each block, (…, blocks)."""
        sums = [_square(stack) for stack in self._stacks]
        result = np.empty((*sums[0].shape[1:], len(self._places)))
        for block, (stack, member) in enumerate(self._places):
            result[..., block] = sums[stack][member]
        return result


class Likelihood:
    """Log-likelihood of the residuals of a problem's blocks under a noise model, and its derivatives.

    `names` are all noise parameters, `fixed` those with known values, `free` the others. `loadings` are those of noisy
    inputs by experiment, L (components of all its blocks, errors), see `input_noise`.
    """

    def __init__(
        self,
        model: Noise,
        blocks: Sequence[Block],
        fixed: Mapping[str, float],
        loadings: Mapping[str, np.ndarray] | None = None,
    ):
        self.loadings = dict(loadings or {})
        self.model, self.blocks = model, tuple(blocks)
        model.check([b for b in blocks if not set(model.parameter_names(b)) <= set(fixed)])
        self.names = tuple(dict.fromkeys(name for block in blocks for name in model.parameter_names(block)))
        for name, value in fixed.items():
            _checks.one_of("fixed", name, self.names)
            _checks.positive(f"fixed[{name!r}]", value)
        self.fixed = {name: float(fixed[name]) for name in self.names if name in fixed}
        self.free = tuple(name for name in self.names if name not in fixed)
        self._columns = [[self.names.index(name) for name in model.parameter_names(block)] for block in blocks]
        self._free = [self.names.index(name) for name in self.free]
        self.shared = []
        for experiment, matrix in self.loadings.items():
            members = [b for b, block in enumerate(self.blocks) if block.experiment == experiment]
            if matrix.any():
                self.shared.append(Shared(members, [self.blocks[b].size for b in members], matrix))

    def groups(self) -> list[tuple[tuple[str, ...], list[int]]]:
        """Return the noise parameters that belong together, by name, and the indices of their blocks."""
        together = dict.fromkeys(tuple(columns) for columns in self._columns if columns)
        return [
            (tuple(self.names[i] for i in group), [b for b, own in enumerate(self._columns) if tuple(own) == group])
            for group in together
        ]

    @cached_property
    def counts(self) -> dict[str, float]:
        """Independent values behind each variance (and "scale"), by its name."""
        return self._summed(block.count for block in self.blocks)

    def _summed(self, values: Iterable[Any]) -> dict[str, Any]:
        """Return the sum of values, one a block, behind each variance."""
        result: dict[str, Any] = {}
        for block, columns, value in zip(self.blocks, self._columns, values, strict=True):
            if block.counted:
                name = self.names[columns[0]]
                result[name] = result.get(name, 0.0) + value
        return result

    @cached_property
    def measured(self) -> dict[str, float]:
        """Measured variance behind each variance, the mean over its values; NaN where it is not known."""
        total = self._summed(block.count * block.measured for block in self.blocks)
        return {name: value / self.counts[name] for name, value in total.items()}

    def moments(self, residuals: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Return Σ weight·r²/S (…,) behind each variance (and "scale"), the M of eq. (6), by its name.

        S is the spectrum for a variance of 1; all its other parameters have to be known.
        """
        if self.model.flat:
            squares, gains = Residuals.of(residuals).squares, self._gains
        else:
            squares, gains = Residuals.of(self._unit(residuals)).squares, np.ones(len(self.blocks))
        return self._summed(block.weight / gains[b] * squares[..., b] for b, block in enumerate(self.blocks))

    @cached_property
    def _gains(self) -> np.ndarray:
        """Variances (blocks,) of components for variances of 1."""
        return np.array([self.model.gain(block) for block in self.blocks])

    def _unit(self, residuals: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the residuals over the square roots of the spectra for variances of 1."""
        values = np.array([self.fixed.get(name, 1.0) for name in self.names])
        result = list(residuals)
        for members in self._alike:
            block, columns = self.blocks[members[0]], self._columns[members[0]]
            if block.kind == SPECTRAL:
                scale = np.sqrt(self._variances(block, np.array([1.0, *values[columns[1:]]]))[0])
                for b in members:
                    result[b] = residuals[b] / scale
        return result

    def value_variances(self, values: np.ndarray) -> dict[tuple[str, str], np.ndarray]:
        """Return the variance (…,) of one value of each channel, by (experiment, channel), where it has its own.

        With that which the errors of the inputs cause, given the data, averaged over the period.
        """
        result = {}
        for block, columns in zip(self.blocks, self._columns, strict=True):
            if block.kind in (SPECTRAL, POINTS):
                own, count = values[..., columns], max(block.points, 1)
                harmonic = np.minimum(np.arange(count), count - np.arange(count))
                if block.kind == POINTS:
                    averaged = block.averaged * count / block.size
                    block = replace(block, harmonic=harmonic, size=count, averaged=averaged)
                result[block.experiment, block.channel] = self.model.spectrum(block, own)[0].mean(axis=-1)
        for one in self.shared:
            caused = one.caused(self.precisions(one.members, values))
            for b, own in zip(one.members, caused, strict=True):
                if (key := (self.blocks[b].experiment, self.blocks[b].channel)) in result:
                    result[key] = result[key] + own
        return result

    def complete(self, free: np.ndarray) -> np.ndarray:
        """Return the values of all noise parameters (…, names) from those of the free ones (…, free)."""
        values = np.empty((*free.shape[:-1], len(self.names)))
        for i, name in enumerate(self.names):
            values[..., i] = self.fixed[name] if name in self.fixed else free[..., self.free.index(name)]
        return values

    def log_prior(self, values: np.ndarray) -> np.ndarray:
        """Return the log-density of the free noise parameters over their logarithms, (…,)."""
        total = np.zeros(values.shape[:-1])
        for kind, columns, measured in self._kinds:
            total = total + self.model.log_prior(kind, values[..., columns], measured)[0].sum(axis=-1)
        for column, block, spectrum in self._spectra_of_errors:
            total = total + self.model.jeffreys_factor(block, values[..., column], spectrum)
        return total

    def _prior_slopes(self, values: np.ndarray) -> np.ndarray:
        """Return the derivatives of `log_prior` by the logarithms of the parameters, (…, names)."""
        slopes = np.zeros(values.shape)
        for kind, columns, measured in self._kinds:
            slopes[..., columns] = self.model.log_prior(kind, values[..., columns], measured)[1]
        for column, block, spectrum in self._spectra_of_errors:
            slopes[..., column] += self.model.jeffreys_slope(block, values[..., column], spectrum)
        return slopes

    @cached_property
    def _spectra_of_errors(self) -> list[tuple[int, Block, np.ndarray]]:
        """Column of each free variance with Jeffreys' prior, a block, and the eigenvalues of L·Lᵀ of all its blocks."""
        found: dict[int, list[tuple[int, np.ndarray]]] = {}
        if self.model.prior == JEFFREYS:
            for one in self.shared:
                for b, matrix in zip(one.members, one.covariances, strict=True):
                    if self._columns[b] and self._columns[b][0] in self._free:
                        found.setdefault(self._columns[b][0], []).append((b, np.linalg.eigvalsh(matrix)))
        result = []
        for column, own in found.items():
            with_errors = {b for b, _ in own}
            others = [b for b, columns in enumerate(self._columns) if columns[:1] == [column] and b not in with_errors]
            rest = [np.zeros(self.blocks[b].size) for b in others]
            result.append((column, self.blocks[own[0][0]], np.maximum(np.concatenate([v for _, v in own] + rest), 0.0)))
        return result

    @cached_property
    def _kinds(self) -> list[tuple[str, list[int], np.ndarray]]:
        """The kinds of free noise parameters whose prior matters, their columns and the measured variances of these."""
        kinds: dict[str, list[int]] = {}
        for i in self._free:
            name = self.names[i]
            kinds.setdefault(VARIANCE if name.startswith(SCALE) else name.partition("[")[0], []).append(i)
        return [
            (kind, columns, np.array([self.measured.get(self.names[i], np.nan) for i in columns]))
            for kind, columns in kinds.items()
            if not self.model.has_constant_prior(kind)
        ]

    def __call__(
        self, residuals: Sequence[np.ndarray], values: np.ndarray, log_variance_factor: float | np.ndarray = 1.0
    ) -> np.ndarray:
        """Return the log-likelihood (…,) of residuals, one (…, size) a block, at values (…, names).

        The logarithms of the variances are multiplied by `log_variance_factor`, one for all blocks or one each: the
        bias correction of eq. (7), see `gauss_newton.bias_correction`.
        """
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            total = (self._flat if self.model.flat else self._by_kind)(residuals, values, log_variance_factor)
            for one in self.shared:
                own, precisions = [residuals[b] for b in one.members], self.precisions(one.members, values)
                total = total + one.log_likelihood(own, precisions, _mean(log_variance_factor, one))
        return np.where(np.isfinite(total), total, -np.inf)

    @cached_property
    def observations(self) -> tuple[str, ...]:
        """Names of what is independent given θ and φ, the parts of the likelihood in `terms`.

        Under white noise these are the values of a channel at the points of a mask, or of its mean period at as many
        equally spaced instants as it has independent components; these are the samples where all harmonics are kept.
        Under coloured noise they are the harmonics of a channel, or, with a mask, the channel of an experiment as a
        whole. Values with a given covariance, and multipliers, are whitened; the last ones are frequencies of
        free-running models.
        """
        return tuple(f"{self.blocks[b].experiment}: {label}" for b, labels, *_ in self._parts for label in labels)

    @cached_property
    def labels(self) -> dict[str, np.ndarray]:
        """Experiment, channel, harmonic (NaN if it is not one) and weight of each of the `observations`, by name.

        The weight is the number of independent values for each value.
        """
        rows = []
        for b, _, order, starts in self._parts:
            block = self.blocks[b]
            spectral = block.kind == SPECTRAL and not self.model.flat
            harmonic = block.harmonic[order][starts] if spectral else np.full(len(starts), np.nan)
            rows += [(block.experiment, block.channel, h, block.weight) for h in harmonic]
        columns = zip(*rows, strict=True)
        return {name: np.array(c) for name, c in zip((EXPERIMENT, CHANNEL, "harmonic", "weight"), columns, strict=True)}

    @cached_property
    def _parts(self) -> list[tuple[int, list[str], np.ndarray, np.ndarray]]:
        """Of each block its index, labels of its observations, values in their order, and where each begins."""
        found = []
        for b, block in enumerate(self.blocks):
            name, place, end = "value" if block.channel == SCALE else block.channel, np.arange(block.size), ""
            if self._is_dense(block):
                place = np.zeros(block.size, dtype=int)
            elif block.kind == SPECTRAL and not self.model.flat:
                name, place = f"{name}, harmonic", block.harmonic
            elif block.kind in (SPECTRAL, POINTS):
                points = block.size if block.kind == SPECTRAL else block.points
                place = place if block.kind == SPECTRAL else np.rint(block.position * points).astype(int)
                name, end = f"{name}, at", f"/{points} of the period"
            order = np.argsort(place, kind="stable")
            numbers, starts = np.unique(place[order], return_index=True)
            labels = [f"{name} {i}{end}" for i in numbers]
            found.append((b, [name] if labels == [f"{block.channel} 0"] else labels, order, starts))
        return found

    def terms(self, residuals: Sequence[np.ndarray], values: np.ndarray) -> np.ndarray:
        """Return the log-likelihoods (…, observations) of the `observations`, which sum to that of `__call__`."""
        found, shared = [], self._shared_terms(residuals, values)
        for b, _, order, starts in self._parts:
            block, phi, r = self.blocks[b], values[..., self._columns[b]], residuals[b]
            if self._is_dense(block):
                found.append(self._together([r], block, phi, 1.0)[..., None])
                continue
            if b in shared:
                each = shared[b]
                if block.kind != KNOWN:
                    each = each + block.weight * np.log(self._variances(block, phi)[0])
                found.append(-0.5 * np.add.reduceat(each[..., order], starts, axis=-1))
                continue
            if block.kind == SPECTRAL and self.model.flat:
                r = _fourier.from_components(r, block.size)
            each = r**2
            if block.kind != KNOWN:
                variances = self._variances(block, phi)[0]
                each = block.weight * (np.log(variances) + each / variances)
            found.append(-0.5 * np.add.reduceat(each[..., order], starts, axis=-1))
        return np.concatenate(found, axis=-1)

    def _shared_terms(self, residuals: Sequence[np.ndarray], values: np.ndarray) -> dict[int, np.ndarray]:
        """Return the squares of whitened components plus their parts of ln|S|, by block that shares errors."""
        found: dict[int, np.ndarray] = {}
        for one in self.shared:
            p = self.precisions(one.members, values)
            axes, squares = one.whitening(p)
            scaled = [residuals[b] * np.sqrt(own) for b, own in zip(one.members, p, strict=True)]
            white = np.concatenate(scaled, axis=-1)
            along = (white[..., None, :] @ axes)[..., 0, :] * (1.0 - 1.0 / np.sqrt(1.0 + squares))
            white = white - (axes @ along[..., None])[..., 0]
            each = white**2 + np.sum(axes**2 * np.log1p(squares)[..., None, :], axis=-1)
            parts = np.split(each, np.cumsum([len(part) for part in one.parts])[:-1], axis=-1)
            found |= zip(one.members, parts, strict=True)
        return found

    def _by_kind(
        self, residuals: Sequence[np.ndarray], values: np.ndarray, log_variance_factor: float | np.ndarray
    ) -> np.ndarray:
        """Return the log-likelihood (…,) of errors whose spectrum is not flat, alike blocks together.

        Without the squares of blocks that share errors of inputs.
        """
        total = np.zeros(values.shape[:-1])
        residuals = [r * alone if self.shared else r for r, alone in zip(residuals, self._alone, strict=True)]
        for members in self._alike:
            own = values[..., self._columns[members[0]]]
            factor = float(np.broadcast_to(log_variance_factor, len(residuals))[members[0]])
            total = total + self._together([residuals[b] for b in members], self.blocks[members[0]], own, factor)
        return total

    def _flat(
        self, residuals: Sequence[np.ndarray], values: np.ndarray, log_variance_factor: float | np.ndarray
    ) -> np.ndarray:
        """Return the log-likelihood (…,) of all blocks under errors whose spectrum is flat.

        Without the squares of blocks that share errors of inputs.
        """
        at, known, columns, sizes, weights, measured = self._levels
        v = self.model.level(values[..., columns] * self._gains[at], measured)
        factor = log_variance_factor if isinstance(log_variance_factor, float) else log_variance_factor[at]
        terms = factor * sizes * np.log(v)
        squares = np.zeros(len(self.blocks))
        if np.any(self._alone):
            squares = Residuals.of(residuals).squares
            squares = squares * self._alone if self.shared else squares
            terms = terms + squares[..., at] / v
        # Row by row in memory, and not by BLAS: the rounding of a sum must not depend on how many rows there are.
        terms = np.ascontiguousarray(weights * terms)
        total = np.add.reduce(terms, axis=-1)
        if known.size:
            total = total + np.add.reduce(np.ascontiguousarray(squares[..., known]), axis=-1)
        return -0.5 * total

    @cached_property
    def _alone(self) -> np.ndarray:
        """Zero for blocks that share errors of inputs, one for the others, (blocks,)."""
        with_errors = {b for one in self.shared for b in one.members}
        return np.array([0.0 if b in with_errors else 1.0 for b in range(len(self.blocks))])

    @cached_property
    def _levels(self) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return blocks with a variance, the others, and of the first the column, size, weight and measured value."""
        known = np.array([block.kind == KNOWN for block in self.blocks], dtype=bool)
        own = [(block, columns[0]) for block, columns in zip(self.blocks, self._columns, strict=True) if columns]
        return (
            np.flatnonzero(~known) if known.any() else slice(None),
            np.flatnonzero(known),
            np.array([column for _, column in own], dtype=int),
            np.array([block.size for block, _ in own], dtype=float),
            np.array([block.weight for block, _ in own]),
            np.array([0.0 if block.kind == CORRELATED else block.measured for block, _ in own]),
        )

    @cached_property
    def _alike(self) -> list[list[int]]:
        """The indices of blocks whose components have the same variances: whole periods, averaged over as much data."""
        groups: dict[Any, list[int]] = {}
        for b, (block, columns) in enumerate(zip(self.blocks, self._columns, strict=True)):
            measured = block.measured if self.model.needs_scatter else None
            key = (tuple(columns), block.weight, block.averaged, block.points, measured, block.harmonic.tobytes())
            groups.setdefault(key if block.kind == SPECTRAL else b, []).append(b)
        return list(groups.values())

    def _together(
        self, residuals: list[np.ndarray], block: Block, values: np.ndarray, log_variance_factor: float
    ) -> np.ndarray:
        """Return the log-likelihood (…,) of blocks like this one."""
        r = residuals[0]
        if block.kind == KNOWN:
            return -0.5 * _square(r)
        if self._is_dense(block):
            flat, rows = values.reshape(-1, values.shape[-1]), r.reshape(-1, r.shape[-1])
            each = [self._dense(block, row, v, log_variance_factor)[0] for row, v in zip(rows, flat, strict=True)]
            return np.array(each).reshape(values.shape[:-1])
        if block.kind == CORRELATED:
            v = values[..., 0]
            return -0.5 * block.weight * (log_variance_factor * block.size * np.log(v) + _square(r) / v)
        variances = self._variances(block, values)[0]
        squares = sum(r**2 for r in residuals)
        terms = len(residuals) * log_variance_factor * np.log(variances) + squares / variances
        return -0.5 * block.weight * np.sum(terms, axis=-1)

    def precisions(self, members: Sequence[int], values: np.ndarray) -> list[np.ndarray]:
        """Return weights over variances of the components of some blocks, (…, size), or (…, 1) if they are the same."""
        result = []
        for b in members:
            block, phi = self.blocks[b], values[..., self._columns[b]]
            if self.model.flat and block.kind == SPECTRAL:
                result.append(block.weight / self.model.level(phi[..., :1] * self._gains[b], block.measured))
                continue
            if block.kind == KNOWN:
                result.append(np.ones((*values.shape[:-1], 1)))
                continue
            variances = self._variances(block, phi)[0]
            result.append(block.weight / (variances[..., :1] if self.model.flat else variances))
        return result

    def _is_dense(self, block: Block) -> bool:
        """Return whether the components of a block are correlated: points under noise that is not white."""
        return block.kind == POINTS and not self.model.flat

    def _variances(self, block: Block, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if block.kind == CORRELATED:
            shape = (*values.shape[:-1], block.size)
            return np.broadcast_to(values[..., :1], shape), np.ones((*shape, 1))
        return self.model.spectrum(block, values)

    def _dense(
        self, block: Block, r: np.ndarray, values: np.ndarray, log_variance_factor: float
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the log-likelihood of one residual with a dense covariance, and its gradients by r and ln φ."""
        covariance, slopes = self.model.covariance(block, values)
        try:
            factor = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            return -np.inf, np.zeros_like(r), np.zeros(len(slopes))
        half = solve_triangular(factor, r, lower=True)
        solved = solve_triangular(factor, half, lower=True, trans=1)
        inverse = solve_triangular(factor, np.eye(block.size), lower=True)
        traces = np.einsum("ki,kj,pij->p", inverse, inverse, slopes)
        value = -0.5 * block.weight * (2 * log_variance_factor * np.sum(np.log(np.diag(factor))) + half @ half)
        return (
            value,
            -block.weight * solved,
            0.5 * block.weight * (solved @ slopes @ solved - log_variance_factor * traces),
        )

    def gradients(
        self, residuals: Sequence[np.ndarray], values: np.ndarray, log_variance_factor: float | np.ndarray = 1.0
    ) -> tuple[Sequence[np.ndarray], np.ndarray]:
        """Return the gradients of log-likelihood plus log-prior of φ, by each block's residual and by ln φ (names,)."""
        find = self._flat_gradients if self.model.flat else self._gradients_by_kind
        by_residual, by_value = find(Residuals.of(residuals), values, log_variance_factor)
        if not self.shared:
            return by_residual, by_value
        total = list(by_residual)
        for one in self.shared:
            own, precisions = [residuals[b] for b in one.members], self.precisions(one.members, values)
            found = one.gradients(own, precisions, _mean(log_variance_factor, one))
            for b, more, by_precision in zip(one.members, *found, strict=True):
                total[b] = total[b] + more
                if columns := self._columns[b]:
                    by_value[columns] -= by_precision @ self._variances(self.blocks[b], values[columns])[1]
        return total, by_value

    def _gradients_by_kind(
        self, residuals: Sequence[np.ndarray], values: np.ndarray, log_variance_factor: float | np.ndarray
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """Return the gradients by each block's residual and by ln φ (names,) under errors that are not white."""
        slopes = self._prior_slopes(values)
        by_residual: list[np.ndarray] = [np.empty(0)] * len(self.blocks)
        for members in self._alike:
            block, columns = self.blocks[members[0]], self._columns[members[0]]
            own = np.stack([residuals[b] for b in members])
            factor = float(np.broadcast_to(log_variance_factor, len(self.blocks))[members[0]])
            if block.kind == KNOWN:
                by_residual[members[0]] = -own[0]
                continue
            if self._is_dense(block):
                _, by_residual[members[0]], by_phi = self._dense(block, own[0], values[columns], factor)
            else:
                variances, change = self._variances(block, values[columns])
                for b, r in zip(members, own, strict=True):
                    by_residual[b] = -block.weight * r / variances
                by_phi = 0.5 * block.weight * np.sum(own**2 / variances - factor, axis=0) @ change
            slopes[columns] += by_phi
        return by_residual, slopes

    def _flat_gradients(
        self, residuals: Residuals, values: np.ndarray, log_variance_factor: float | np.ndarray
    ) -> tuple[Residuals, np.ndarray]:
        """Return the gradients by each block's residual and by ln φ (names,) under errors whose spectrum is flat."""
        by_value, squares = self._prior_slopes(values), residuals.squares
        at, _, columns, sizes, weights, measured = self._levels
        raised = values[columns] * self._gains[at]
        v = self.model.level(raised, measured)
        by_square = np.full(len(self.blocks), -0.5)
        by_square[at] = -0.5 * weights / v
        # V is proportional to v, or to v plus what is measured.
        factor = np.broadcast_to(log_variance_factor, len(self.blocks))[at]
        by_level = 0.5 * weights * (squares[at] / v - factor * sizes) * raised / v
        np.add.at(by_value, columns, by_level)
        return residuals.scaled(2.0 * by_square), by_value

    def whitened(self, vectors: Sequence[np.ndarray], values: np.ndarray) -> list[np.ndarray]:
        """Return vectors (…, size), one a block, in units of the noise: their squares sum to −2 log-likelihood."""
        result = list(vectors)
        for members in self._alike:
            block, columns, first = self.blocks[members[0]], self._columns[members[0]], members[0]
            if block.kind == KNOWN:
                continue
            if self._is_dense(block):
                covariance, _ = self.model.covariance(block, values[columns])
                rows = vectors[first].reshape(-1, block.size)
                white = solve_triangular(np.linalg.cholesky(covariance), rows.T, lower=True)
                result[first] = np.sqrt(block.weight) * white.T.reshape(vectors[first].shape)
            else:
                scale = np.sqrt(block.weight / self._variances(block, values[columns])[0])
                for b in members:
                    result[b] = vectors[b] * scale
        for one in self.shared:
            joint = one.whitened([result[b] for b in one.members], self.precisions(one.members, values))
            for b, own in zip(one.members, joint, strict=True):
                result[b] = own
        return result

    def simulate(self, values: np.ndarray, generator: np.random.Generator) -> list[np.ndarray]:
        """Return noise at values (draws, names): components (draws, size), one array a block."""
        result = []
        for block, columns in zip(self.blocks, self._columns, strict=True):
            white = generator.standard_normal((len(values), block.size))
            if self._is_dense(block):
                factors = np.linalg.cholesky([self.model.covariance(block, row)[0] for row in values[:, columns]])
                white = np.einsum("dij,dj->di", factors, white)
            elif block.kind != KNOWN:
                white *= np.sqrt(self._variances(block, values[:, columns])[0])
            result.append(white)
        for one in self.shared:
            errors = generator.standard_normal((len(values), one.parts[0].shape[1]))
            for b, part in zip(one.members, one.parts, strict=True):
                result[b] += errors @ part.T
        return result

    def guess(self) -> np.ndarray:
        """Return where the noise parameters start, (names,): variances 1, shapes at the medians of their priors."""
        values = np.ones(len(self.names))
        for i, name in enumerate(self.names):
            kind = name.partition("[")[0]
            if kind in self.model.shape_priors:
                values[i] = float(self.model.shape_priors[kind].quantile(np.array(0.5)))
            values[i] = self.fixed.get(name, values[i])
        return values


def _mean(log_variance_factor: float | np.ndarray, one: Shared) -> float:
    """Return the factor of errors that blocks share: the mean of theirs, weighted by their sizes."""
    if isinstance(log_variance_factor, float):
        return log_variance_factor
    return float(np.average(log_variance_factor[list(one.members)], weights=[len(part) for part in one.parts]))


def _square(r: np.ndarray) -> np.ndarray:
    """Return the sum of squares (…,) of components (…, size)."""
    return np.einsum("...i,...i->...", r, r)
