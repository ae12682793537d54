"""The log-likelihood of residuals under a noise model, and its derivatives."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from bayesperiodic import _checks
from bayesperiodic.likelihood.block import Block
from bayesperiodic.likelihood.input_noise import Shared
from bayesperiodic.likelihood.noise import JEFFREYS, VARIANCE, Noise
from bayesperiodic.likelihood.section_points import SCALE


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
        return Residuals([np.stack([group[m] for m in range(len(group))]) for group in members], self._places)

    def scaled(self, factors: np.ndarray) -> "Residuals":
        """Return the components (size,) of each block times its factor, factors (blocks,)."""
        scales = [np.empty((len(stack), 1)) for stack in self._stacks]
        for (stack, member), factor in zip(self._places, factors, strict=True):
            scales[stack][member] = factor
        return Residuals([stack * factor for stack, factor in zip(self._stacks, scales, strict=True)], self._places)

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


class _AlikeBlocks(NamedTuple):
    """Blocks whose components have the same variances."""

    members: list[int]
    block: Block  # the first of them
    columns: slice  # noise parameters among all
    weight: float  # independent values per component, one for values in units of their standard deviation


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
        self._even, self._uneven, self._dense_groups = self._sorted_groups()
        self.shared = []
        for experiment, matrix in self.loadings.items():
            members = [b for b, block in enumerate(self.blocks) if block.experiment == experiment]
            if matrix.any():
                self.shared.append(Shared(members, [self.blocks[b].size for b in members], matrix))

    @property
    def white(self) -> bool:
        """Whether the components of every block are independent and have the same variance."""
        return not self._uneven and not self._dense_groups

    def groups(self) -> list[tuple[tuple[str, ...], list[int]]]:
        """Return the noise parameters that belong together, by name, and the indices of their blocks."""
        together = dict.fromkeys(tuple(columns) for columns in self._columns if columns)
        return [
            (
                tuple(self.names[i] for i in group),
                [b for b, places in enumerate(self._columns) if tuple(places) == group],
            )
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
        units = np.array([self.fixed.get(name, 1.0) for name in self.names])
        units[[columns[0] for columns in self._columns if columns]] = 1.0
        squares = np.array(Residuals.of(residuals).squares)
        if self._even:
            squares[..., self._even_blocks] /= self._even_variances(units)
        for group in self._uneven:
            variances = self._spectrum(group, units)[0]
            for b in group.members:
                squares[..., b] = np.add.reduce(residuals[b] ** 2 / variances, axis=-1)
        return self._summed(block.weight * squares[..., b] for b, block in enumerate(self.blocks))

    def value_variances(self, values: np.ndarray) -> dict[tuple[str, str], np.ndarray]:
        """Return the variance (…,) of one value of each channel, by (experiment, channel), where it has its own.

        With that which the errors of the inputs cause, given the data, averaged over the period.
        """
        result = {}
        for block, columns in zip(self.blocks, self._columns, strict=True):
            if (whole := block.whole_period()) is not None:
                variances = self.model.spectrum(whole, values[..., columns])[0]
                result[block.experiment, block.channel] = variances.mean(axis=-1)
        for one in self.shared:
            caused = one.caused(self.precisions(one.members, values))
            for b, parameters in zip(one.members, caused, strict=True):
                if (key := (self.blocks[b].experiment, self.blocks[b].channel)) in result:
                    result[key] = result[key] + parameters
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
        for _, b, added in self._spectra_of_errors:
            mean = self._mean_variance(b, values)[0][..., None]
            # With variances V + λ Jeffreys' prior is √(Σ 1/(V + λ)²), the root of the information, in place of 1/V;
            # the density has no integral otherwise where errors of the inputs can explain all components.
            share = mean / (mean + added)
            total = total + 0.5 * np.log(np.add.reduce(share * share, axis=-1) / added.size)
        return total

    def _mean_variance(self, b: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean variance (…,) of a block's components, and the part proportional to its parameter."""
        return self.blocks[b].mean_variance(self.model, values[..., self._columns[b]])

    def _prior_slopes(self, values: np.ndarray) -> np.ndarray:
        """Return the derivatives of `log_prior` by the logarithms of the parameters, (…, names)."""
        slopes = np.zeros(values.shape)
        for kind, columns, measured in self._kinds:
            slopes[..., columns] = self.model.log_prior(kind, values[..., columns], measured)[1]
        for column, b, added in self._spectra_of_errors:
            mean, proportional = self._mean_variance(b, values)
            share = mean[..., None] / (mean[..., None] + added)
            slope = np.mean(share**2 * (1.0 - share), axis=-1) / np.mean(share**2, axis=-1)
            slopes[..., column] += slope * proportional / mean
        return slopes

    @cached_property
    def _spectra_of_errors(self) -> list[tuple[int, int, np.ndarray]]:
        """Column and a block of each free variance with Jeffreys' prior, and eigenvalues of L·Lᵀ of all its blocks."""
        spectra: dict[int, list[tuple[int, np.ndarray]]] = {}
        if self.model.prior == JEFFREYS:
            for one in self.shared:
                for b, matrix in zip(one.members, one.covariances, strict=True):
                    if self._columns[b] and self._columns[b][0] in self._free:
                        spectra.setdefault(self._columns[b][0], []).append((b, np.linalg.eigvalsh(matrix)))
        result = []
        for column, pairs in spectra.items():
            with_errors = {b for b, _ in pairs}
            others = [b for b, columns in enumerate(self._columns) if columns[:1] == [column] and b not in with_errors]
            rest = [np.zeros(self.blocks[b].size) for b in others]
            result.append((column, pairs[0][0], np.maximum(np.concatenate([v for _, v in pairs] + rest), 0.0)))
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
            total = self._without_inputs(residuals, values, log_variance_factor)
            for one in self.shared:
                parts, precisions = [residuals[b] for b in one.members], self.precisions(one.members, values)
                total = total + one.log_likelihood(parts, precisions, _mean(log_variance_factor, one))
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
            spectral = block.spectral and not self._is_even[b]
            harmonic = block.harmonic[order][starts] if spectral else np.full(len(starts), np.nan)
            rows += [(block.experiment, block.channel, h, block.weight) for h in harmonic]
        columns = zip(*rows, strict=True)
        return {
            name: np.array(c) for name, c in zip(("experiment", "channel", "harmonic", "weight"), columns, strict=True)
        }

    @cached_property
    def _parts(self) -> list[tuple[int, list[str], np.ndarray, np.ndarray]]:
        """Of each block its index, labels of its observations, values in their order, and where each begins."""
        parts = []
        for b, block in enumerate(self.blocks):
            name, place, end = block.places(self._is_even[b], b in self._dense_groups)
            order = np.argsort(place, kind="stable")
            numbers, starts = np.unique(place[order], return_index=True)
            labels = [f"{name} {i}{end}" for i in numbers]
            parts.append((b, [name] if labels == [f"{block.channel} 0"] else labels, order, starts))
        return parts

    def terms(self, residuals: Sequence[np.ndarray], values: np.ndarray) -> np.ndarray:
        """Return the log-likelihoods (…, observations) of the `observations`, which sum to that of `__call__`."""
        terms, shared = [], self._shared_terms(residuals, values)
        for b, _, order, starts in self._parts:
            r = residuals[b]
            if b not in self._group_of:
                terms.append(self._dense_values(b, r, values, 1.0)[..., None])
                continue
            group = self._group_of[b]
            variances = self._spectrum(group, values)[0]
            r = self.blocks[b].independent(r, self._is_even[b])
            squares = shared[b] if b in shared else group.weight * r**2 / variances
            each = group.weight * np.log(variances) + squares
            terms.append(-0.5 * np.add.reduceat(each[..., order], starts, axis=-1))
        return np.concatenate(terms, axis=-1)

    def _shared_terms(self, residuals: Sequence[np.ndarray], values: np.ndarray) -> dict[int, np.ndarray]:
        """Return the squares of whitened components plus their parts of ln|S|, by block that shares errors."""
        terms: dict[int, np.ndarray] = {}
        for one in self.shared:
            p = self.precisions(one.members, values)
            axes, squares = one.whitening(p)
            scaled = [residuals[b] * np.sqrt(weights) for b, weights in zip(one.members, p, strict=True)]
            white = np.concatenate(scaled, axis=-1)
            along = (white[..., None, :] @ axes)[..., 0, :] * (1.0 - 1.0 / np.sqrt(1.0 + squares))
            white = white - (axes @ along[..., None])[..., 0]
            each = white**2 + np.sum(axes**2 * np.log1p(squares)[..., None, :], axis=-1)
            parts = np.split(each, np.cumsum([len(part) for part in one.parts])[:-1], axis=-1)
            terms |= zip(one.members, parts, strict=True)
        return terms

    def _without_inputs(
        self, residuals: Sequence[np.ndarray], values: np.ndarray, log_variance_factor: float | np.ndarray
    ) -> np.ndarray:
        """Return the log-likelihood (…,) without the squares of blocks that share errors of inputs."""
        total = np.zeros(values.shape[:-1])
        if self._even:
            total = self._even_total(residuals, values, log_variance_factor)
        for group in self._uneven:
            variances = self._spectrum(group, values)[0]
            factor = len(group.members) * self._factor(log_variance_factor, group)
            terms = factor * np.log(variances)
            if alone := [b for b in group.members if self._alone[b]]:
                terms = terms + sum(residuals[b] ** 2 for b in alone) / variances
            total = total - 0.5 * group.weight * np.add.reduce(terms, axis=-1)
        for b in self._dense_groups:
            total = total + self._dense_values(b, residuals[b], values, self._factor(log_variance_factor, b))
        return total

    def _even_total(
        self, residuals: Sequence[np.ndarray], values: np.ndarray, log_variance_factor: float | np.ndarray
    ) -> np.ndarray:
        """Return the log-likelihood (…,) of blocks whose components all have the same variance."""
        at, sizes, weights = self._even_blocks, self._even_sizes, self._even_weights
        variances = self._even_variances(values)
        factor = log_variance_factor if isinstance(log_variance_factor, float) else log_variance_factor[at]
        terms = factor * sizes * np.log(variances)
        if np.any(self._alone):
            squares = Residuals.of(residuals).squares
            squares = squares * self._alone if self.shared else squares
            terms = terms + squares[..., at] / variances
        # Row by row in memory, and not by BLAS: the rounding of a sum must not depend on how many rows there are.
        return -0.5 * np.add.reduce(np.ascontiguousarray(weights * terms), axis=-1)

    def _factor(self, log_variance_factor: float | np.ndarray, group: "_AlikeBlocks | int") -> float:
        """Return the factor of the logarithms of one group or block."""
        b = group if isinstance(group, int) else group.members[0]
        return log_variance_factor if isinstance(log_variance_factor, float) else float(log_variance_factor[b])

    @cached_property
    def _alone(self) -> np.ndarray:
        """Zero for blocks that share errors of inputs, one for the others, (blocks,)."""
        with_errors = {b for one in self.shared for b in one.members}
        return np.array([0.0 if b in with_errors else 1.0 for b in range(len(self.blocks))])

    def _sorted_groups(self) -> tuple[list[_AlikeBlocks], list[_AlikeBlocks], list[int]]:
        """Return groups whose components have one variance, others, and the blocks whose components are correlated."""
        groups: dict[Any, list[int]] = {}
        for b, (block, columns) in enumerate(zip(self.blocks, self._columns, strict=True)):
            key = type(block), block.alike(self.model), tuple(columns), block.size, block.weight
            groups.setdefault(key, []).append(b)
        even: list[_AlikeBlocks] = []
        uneven: list[_AlikeBlocks] = []
        dense: list[int] = []
        for members in groups.values():
            block, columns = self.blocks[members[0]], self._columns[members[0]]
            if block.is_dense(self.model):
                dense += members
                continue
            group = _AlikeBlocks(
                members, block, slice(columns[0], columns[-1] + 1) if columns else slice(0), block.weight
            )
            (even if self._checked_size(group) == 1 else uneven).append(group)
        return even, uneven, dense

    def _checked_size(self, group: _AlikeBlocks) -> int:
        """Return the number of variances that the spectrum of a group has, one or one each component."""
        block, count = group.block, len(self._columns[group.members[0]])
        sizes = (1, block.size)
        try:
            variances, slopes = map(np.shape, self._spectrum(group, np.ones(len(self.names))))
        except (IndexError, ValueError):
            if not block.refusal(self.model):
                raise
            variances, slopes = (), ()
        if len(variances) == 1 and variances[0] in sizes and slopes in [(size, count) for size in sizes]:
            return variances[0]
        if reason := block.refusal(self.model):
            raise ValueError(reason)
        raise ValueError(
            f"noise: must have a spectrum of shapes (…, 1) or (…, {block.size}) and (…, 1, {count}) or (…, "
            f"{block.size}, {count}) for {block.channel!r} of {block.experiment!r}, got {variances} and {slopes} from "
            f"{self.model.name!r}."
        )

    def _spectrum(self, group: _AlikeBlocks, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the variances (…, size) or (…, 1) of a group's components, and their slopes by its parameters."""
        return group.block.spectrum(self.model, values[..., group.columns])

    def _even_variances(self, values: np.ndarray) -> np.ndarray:
        """Return the variances (…, blocks) of the blocks of `_even_blocks`."""
        each = [self._spectrum(group, values)[0] for group in self._even]
        joined = each[0] if len(each) == 1 else np.concatenate(each, axis=-1)
        return joined[..., self._even_places]

    @cached_property
    def _even_blocks(self) -> Any:
        """Indices of the blocks of `_even`; a slice where they are all."""
        order = [b for group in self._even for b in group.members]
        return slice(None) if order == list(range(len(self.blocks))) else np.array(order, dtype=int)

    @cached_property
    def _even_places(self) -> Any:
        """The group of each of `_even_blocks`."""
        places = [g for g, group in enumerate(self._even) for _ in group.members]
        return slice(None) if len(places) == len(self._even) else np.array(places, dtype=int)

    @cached_property
    def _even_sizes(self) -> np.ndarray:
        return np.array([group.block.size for group in self._even for _ in group.members], dtype=float)

    @cached_property
    def _even_weights(self) -> np.ndarray:
        return np.array([group.weight for group in self._even for _ in group.members])

    @cached_property
    def _is_even(self) -> list[bool]:
        """Whether the components of each block all have the same variance."""
        even = {b for group in self._even for b in group.members}
        return [b in even for b in range(len(self.blocks))]

    @cached_property
    def _group_of(self) -> dict[int, _AlikeBlocks]:
        """The group of each block whose components are independent."""
        return {b: group for group in (*self._even, *self._uneven) for b in group.members}

    def precisions(self, members: Sequence[int], values: np.ndarray) -> list[np.ndarray]:
        """Return weights over variances of the components of some blocks, (…, size), or (…, 1) if they are the same."""
        groups = [self._group_of[b] for b in members]
        return [group.weight / self._spectrum(group, values)[0] for group in groups]

    def _dense_values(self, b: int, r: np.ndarray, values: np.ndarray, log_variance_factor: float) -> np.ndarray:
        """Return the log-likelihoods (…,) of a block whose components are correlated."""
        rows, parameters = r.reshape(-1, r.shape[-1]), values[..., self._columns[b]].reshape(-1, len(self._columns[b]))
        pairs = zip(rows, parameters, strict=True)
        each = [self._dense(self.blocks[b], row, phi, log_variance_factor)[0] for row, phi in pairs]
        return np.array(each).reshape(values.shape[:-1])

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
        residuals, by_value = Residuals.of(residuals), self._prior_slopes(values)
        by_residual: Any = [np.empty(0)] * len(self.blocks)
        if self._even:
            by_residual = self._even_gradients(residuals, values, log_variance_factor, by_value)
            by_residual = list(by_residual) if self._uneven or self._dense_groups else by_residual
        for group in self._uneven:
            variances, slopes = self._spectrum(group, values)
            stack, factor = np.stack([residuals[b] for b in group.members]), self._factor(log_variance_factor, group)
            for b, r in zip(group.members, stack, strict=True):
                by_residual[b] = -group.weight * r / variances
            by_logarithm = 0.5 * group.weight * np.add.reduce(stack**2 / variances - factor, axis=0)
            by_value[group.columns] += np.add.reduce(by_logarithm[:, None] * slopes, axis=0)
        for b in self._dense_groups:
            columns, factor = self._columns[b], self._factor(log_variance_factor, b)
            _, by_residual[b], by_phi = self._dense(self.blocks[b], residuals[b], values[columns], factor)
            by_value[columns] += by_phi
        if not self.shared:
            return by_residual, by_value
        total = list(by_residual)
        for one in self.shared:
            parts, precisions = [residuals[b] for b in one.members], self.precisions(one.members, values)
            gradients = one.gradients(parts, precisions, _mean(log_variance_factor, one))
            for b, more, by_precision in zip(one.members, *gradients, strict=True):
                total[b] = total[b] + more
                group = self._group_of[b]
                slopes = self._spectrum(group, values)[1]
                by_value[group.columns] -= np.add.reduce(by_precision[:, None] * slopes, axis=0)
        return total, by_value

    def _even_gradients(
        self, residuals: Residuals, values: np.ndarray, log_variance_factor: float | np.ndarray, by_value: np.ndarray
    ) -> Residuals:
        """Return the gradients by the residuals of blocks with one variance, and add those by ln φ to `by_value`."""
        at, weights, spectra = self._even_blocks, self._even_weights, [self._spectrum(g, values) for g in self._even]
        variances = np.concatenate([spectrum for spectrum, _ in spectra])[self._even_places]
        factor = log_variance_factor if isinstance(log_variance_factor, float) else log_variance_factor[at]
        by_logarithm = 0.5 * weights * (residuals.squares[at] / variances - factor * self._even_sizes)
        by_square, start = np.zeros(len(self.blocks)), 0
        by_square[at] = -0.5 * weights / variances
        for group, (_, slopes) in zip(self._even, spectra, strict=True):
            stop = start + len(group.members)
            by_value[group.columns] += np.add.reduce(by_logarithm[start:stop]) * slopes[0]
            start = stop
        return residuals.scaled(2.0 * by_square)

    def whitened(self, vectors: Sequence[np.ndarray], values: np.ndarray) -> list[np.ndarray]:
        """Return vectors (…, size), one a block, in units of the noise: their squares sum to −2 log-likelihood."""
        result = list(vectors)
        for group in (*self._even, *self._uneven):
            scale = np.sqrt(group.weight / self._spectrum(group, values)[0])
            for b in group.members:
                result[b] = vectors[b] * scale
        for b in self._dense_groups:
            block = self.blocks[b]
            covariance, _ = self.model.covariance(block, values[self._columns[b]])
            white = solve_triangular(np.linalg.cholesky(covariance), vectors[b].reshape(-1, block.size).T, lower=True)
            result[b] = np.sqrt(block.weight) * white.T.reshape(vectors[b].shape)
        for one in self.shared:
            joint = one.whitened([result[b] for b in one.members], self.precisions(one.members, values))
            for b, part in zip(one.members, joint, strict=True):
                result[b] = part
        return result

    def simulate(self, values: np.ndarray, generator: np.random.Generator) -> list[np.ndarray]:
        """Return noise at values (draws, names): components (draws, size), one array a block."""
        result = []
        for b, (block, columns) in enumerate(zip(self.blocks, self._columns, strict=True)):
            white = generator.standard_normal((len(values), block.size))
            if b in self._dense_groups:
                factors = np.linalg.cholesky([self.model.covariance(block, row)[0] for row in values[:, columns]])
                white = np.einsum("dij,dj->di", factors, white)
            else:
                white *= np.sqrt(self._spectrum(self._group_of[b], values)[0])
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
