"""The log-likelihood of residuals under a noise model, and its derivatives."""

from collections.abc import Iterable, Mapping, Sequence
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
    """One array (…, size) of components a block, stored as `stacks` (members, …, size) with the place of each block."""

    def __init__(self, stacks: Sequence[np.ndarray], places: Sequence[tuple[int, int]]):
        self.stacks, self._places = tuple(stacks), tuple(places)

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
        return self.stacks[stack][member]

    def at(self, index: int) -> "Residuals":
        """Return the components (size,) at one place of the middle axis (…,)."""
        return Residuals([stack[:, index] for stack in self.stacks], self._places)

    def like(self, blocks: Sequence[np.ndarray]) -> "Residuals":
        """Return other arrays, one a block, side by side as these are."""
        if isinstance(blocks, Residuals) and blocks._places == self._places:
            return blocks
        stacks = [np.empty((len(stack), stack.shape[-1])) for stack in self.stacks]
        for (stack, member), block in zip(self._places, blocks, strict=True):
            stacks[stack][member] = block
        return Residuals(stacks, self._places)

    def scaled(self, factors: np.ndarray) -> "Residuals":
        """Return the components (size,) of each block times its factor, factors (blocks,)."""
        scales = self.like(list(factors)).stacks
        return Residuals([scale * stack for scale, stack in zip(scales, self.stacks, strict=True)], self._places)

    def without(self, blocks: Sequence[int]) -> "Residuals":
        """Return the same with components of zero in some blocks."""
        places = [self._places[block] for block in blocks]
        stacks = [np.array(stack) if s in {p for p, _ in places} else stack for s, stack in enumerate(self.stacks)]
        for stack, member in places:
            stacks[stack][member] = 0.0
        return Residuals(stacks, self._places)

    @cached_property
    def squares(self) -> np.ndarray:
        """The sum of the squares of each block, (…, blocks); callers ignore overflows."""
        sums = [np.einsum("...i,...i->...", stack, stack) for stack in self.stacks]
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


Spectra = list[tuple[np.ndarray, np.ndarray]]  # variances and slopes of each group of alike blocks


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
        self._parameters = [model.parameter_names(block) for block in blocks]
        model.check([b for b, names in zip(blocks, self._parameters, strict=True) if not set(names) <= set(fixed)])
        self.names = tuple(dict.fromkeys(name for names in self._parameters for name in names))
        for name, value in fixed.items():
            _checks.one_of("fixed", name, self.names)
            _checks.positive(f"fixed[{name!r}]", value)
        self.fixed = {name: float(fixed[name]) for name in self.names if name in fixed}
        self.free = tuple(name for name in self.names if name not in fixed)
        self._free = [self.names.index(name) for name in self.free]
        starts = [self.names.index(names[0]) if names else 0 for names in self._parameters]
        self._columns = [slice(i, i + len(names)) for i, names in zip(starts, self._parameters, strict=True)]
        self._sort_blocks()
        self.shared = []
        for experiment, matrix in self.loadings.items():
            sizes = {b: block.size for b, block in enumerate(blocks) if block.experiment == experiment}
            if matrix.any():
                self.shared.append(Shared([*sizes], [*sizes.values()], matrix))
        # One for blocks that share no errors of inputs, zero for the others.
        self._alone = np.ones(len(blocks))
        self._alone[[b for one in self.shared for b in one.members]] = 0.0

    def _sort_blocks(self) -> None:
        """Sort the blocks: groups with one variance first, then other groups, and those with correlated components."""
        alike: dict[Any, list[int]] = {}
        for b, block in enumerate(self.blocks):
            key = type(block), block.alike(self.model), self._parameters[b], block.size, block.weight
            alike.setdefault(key, []).append(b)
        even: list[_AlikeBlocks] = []
        uneven: list[_AlikeBlocks] = []
        self._dense: list[int] = []
        for members in alike.values():
            block = self.blocks[members[0]]
            if block.is_dense(self.model):
                self._dense += members
                continue
            group = _AlikeBlocks(members, block, self._columns[members[0]], block.weight)
            (even if self._checked_size(group) == 1 else uneven).append(group)
        self._groups, self._uneven = [*even, *uneven], uneven
        self._group_of = {b: g for g, group in enumerate(self._groups) for b in group.members}
        # Of the blocks with one variance: index, group, weight and count of each, in the order of the groups.
        order = [b for group in even for b in group.members]
        self._even = np.array(order, dtype=int)
        self._even_groups = np.array([self._group_of[b] for b in order], dtype=int)
        self._even_weights = np.array([self.blocks[b].weight for b in order])
        self._even_counts = self._even_weights * np.array([self.blocks[b].size for b in order])
        # Of their groups: where each begins in that order, and group and column of each slope.
        self._starts = np.searchsorted(self._even_groups, range(len(even)))
        pairs = [(g, column) for g, group in enumerate(even) for column in range(len(self.names))[group.columns]]
        self._slope_groups, self._slope_columns = np.array(pairs, dtype=int).reshape(-1, 2).T

    @property
    def white(self) -> bool:
        """Whether the components of every block are independent and have the same variance."""
        return not self._uneven and not self._dense

    @property
    def correlated(self) -> bool:
        """Whether the components of any block are correlated."""
        return bool(self._dense)

    def groups(self) -> list[tuple[tuple[str, ...], list[int]]]:
        """Return the noise parameters that belong together, by name, and the indices of their blocks."""
        together: dict[tuple[str, ...], list[int]] = {}
        for b, names in enumerate(self._parameters):
            if names:
                together.setdefault(names, []).append(b)
        return list(together.items())

    @cached_property
    def counts(self) -> dict[str, float]:
        """Independent values behind each variance (and "scale"), by its name."""
        return self._summed(block.count for block in self.blocks)

    @property
    def values(self) -> float:
        """The independent values of all data."""
        return sum(block.count if block.counted else block.size for block in self.blocks if block.observed)

    def _summed(self, values: Iterable[Any]) -> dict[str, Any]:
        """Return the sum of values, one a block, behind each variance."""
        result: dict[str, Any] = {}
        for block, names, value in zip(self.blocks, self._parameters, values, strict=True):
            if block.counted:
                result[names[0]] = result.get(names[0], 0.0) + value
        return result

    @cached_property
    def measured(self) -> dict[str, float]:
        """Measured variance behind each variance, the mean over its values; NaN where it is not known."""
        total = self._summed(block.count * block.measured / self.model.unit(block) for block in self.blocks)
        return {name: value / self.counts[name] for name, value in total.items()}

    def moments(self, residuals: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Return Σ weight·r²/S (…,) behind each variance (and "scale"), the M of eq. (6), by its name.

        S is the spectrum for a variance of 1; all its other parameters have to be known.
        """
        units = np.array([self.fixed.get(name, 1.0) for name in self.names])
        units[[self.names.index(names[0]) for names in self._parameters if names]] = 1.0
        spectra = self._spectra(units)
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.array(Residuals.of(residuals).squares)
            for b, g in self._group_of.items():
                variances = spectra[g][0]
                if variances.size == 1:
                    squares[..., b] /= variances[0]
                else:
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
        values[...] = [self.fixed.get(name, np.nan) for name in self.names]
        values[..., self._free] = free
        return values

    def log_prior(self, values: np.ndarray, *, of_total: bool = False) -> np.ndarray:
        """Return the log-density of the free noise parameters over their logarithms, (…,).

        Or that of which the estimate is the maximum: `of_total` takes the coordinates in which Jeffreys' prior of a
        variance that is added to known ones is flat.
        """
        total, prior = np.zeros(values.shape[:-1]), self._log_prior_of(of_total)
        for kind, columns, measured in self._kinds:
            total = total + prior(kind, values[..., columns], measured)[0].sum(axis=-1)
        for _, b, added in self._spectra_of_errors if not of_total else ():
            mean = self._mean_variance(b, values)[0][..., None]
            # With variances V + λ Jeffreys' prior is √(Σ 1/(V + λ)²), the root of the information, in place of 1/V;
            # the density has no integral otherwise where errors of the inputs can explain all components.
            share = mean / (mean + added)
            total = total + 0.5 * np.log(np.add.reduce(share * share, axis=-1) / added.size)
        return total

    def _mean_variance(self, b: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean variance (…,) of a block's components, and the part proportional to its parameter."""
        return self.blocks[b].mean_variance(self.model, values[..., self._columns[b]])

    def _log_prior_of(self, total: bool) -> Any:
        """Return the method of the noise model that gives the log-density over these coordinates."""
        return self.model.log_prior_of_total if total else self.model.log_prior

    def _prior_slopes(self, values: np.ndarray, of_total: bool) -> np.ndarray:
        """Return the derivatives of `log_prior` by the logarithms of the parameters, (…, names)."""
        slopes, prior = np.zeros(values.shape), self._log_prior_of(of_total)
        for kind, columns, measured in self._kinds:
            slopes[..., columns] = prior(kind, values[..., columns], measured)[1]
        for column, b, added in self._spectra_of_errors if not of_total else ():
            mean, proportional = self._mean_variance(b, values)
            share = mean[..., None] / (mean[..., None] + added)
            slope = np.mean(share**2 * (1.0 - share), axis=-1) / np.mean(share**2, axis=-1)
            slopes[..., column] += slope * proportional / mean
        return slopes

    @cached_property
    def _spectra_of_errors(self) -> list[tuple[int, int, np.ndarray]]:
        """Column and a block of each free variance with Jeffreys' prior, and eigenvalues of L·Lᵀ of all its blocks."""
        spectra: dict[str, dict[int, np.ndarray]] = {}
        for one in self.shared if self.model.prior == JEFFREYS and not self.model.pooled else ():
            for b, matrix in zip(one.members, one.covariances, strict=True):
                for name in set(self._parameters[b][:1]) & set(self.free):
                    spectra.setdefault(name, {})[b] = np.linalg.eigvalsh(matrix)
        result = []
        for name, by_block in spectra.items():
            others = [b for b, names in enumerate(self._parameters) if names[:1] == (name,) and b not in by_block]
            values = [*by_block.values(), *(np.zeros(self.blocks[b].size) for b in others)]
            result.append((self.names.index(name), next(iter(by_block)), np.maximum(np.concatenate(values), 0.0)))
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
            if kind in self.model.shape_priors or not self.model.constant_prior
        ]

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def __call__(
        self, residuals: Sequence[np.ndarray], values: np.ndarray, log_variance_factor: float | np.ndarray = 1.0
    ) -> np.ndarray:
        """Return the log-likelihood (…,) of residuals, one (…, size) a block, at values (…, names).

        The logarithms of the variances are multiplied by `log_variance_factor`, one for all blocks or one each: the
        bias correction of eq. (7), see `gauss_newton.bias_correction`.
        """
        factors, residuals = np.full(len(self.blocks), log_variance_factor), Residuals.of(residuals)
        total = self._independent(residuals, values, self._spectra(values), factors)
        for b in self._dense:
            total = total + self._dense_values(b, residuals[b], values, factors[b])
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
            spectral = block.spectral and not block.by_instants(b in self._even)
            harmonic = block.harmonic[order][starts] if spectral else np.full(len(starts), np.nan)
            rows += [(block.experiment, block.channel, h, block.weight) for h in harmonic]
        columns = map(np.array, zip(*rows, strict=True))
        return dict(zip(("experiment", "channel", "harmonic", "weight"), columns, strict=True))

    @cached_property
    def _parts(self) -> list[tuple[int, list[str], np.ndarray, np.ndarray]]:
        """Of each block its index, labels of its observations, values in their order, and where each begins."""
        parts = []
        for b, block in enumerate(self.blocks):
            name, place, end = block.places(b in self._even, b in self._dense)
            order = np.argsort(place, kind="stable")
            numbers, starts = np.unique(place[order], return_index=True)
            labels = [f"{name} {i}{end}" for i in numbers]
            parts.append((b, [name] if labels == [f"{block.channel} 0"] else labels, order, starts))
        return parts

    def terms(self, residuals: Sequence[np.ndarray], values: np.ndarray) -> np.ndarray:
        """Return the log-likelihoods (…, observations) of the `observations`, which sum to that of `__call__`."""
        terms, shared = [], self._shared_terms(residuals, values)
        for b, _, order, starts in self._parts:
            block = self.blocks[b]
            if b in self._dense:
                terms.append(self._dense_values(b, residuals[b], values, 1.0)[..., None])
                continue
            (precisions,) = self.precisions([b], values)
            r = block.independent(residuals[b], b in self._even)
            squares = shared[b] if b in shared else precisions * r**2
            each = block.weight * np.log(block.weight / precisions) + squares
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

    def _independent(
        self, residuals: Residuals, values: np.ndarray, spectra: Spectra, factors: np.ndarray
    ) -> np.ndarray:
        """Return the log-likelihood (…,) of all blocks but those whose components are correlated."""
        total = np.zeros(values.shape[:-1])
        if self._even.size:
            variances = self._even_variances(spectra)
            precisions = self._even_weights / variances
            terms = factors[self._even] * self._even_counts * np.log(variances)
            if not self.shared:
                terms += precisions * residuals.squares.take(self._even, axis=-1)
            elif self._alone.any():
                terms += precisions * (residuals.squares * self._alone).take(self._even, axis=-1)
            # Row by row in memory, and not by BLAS: the rounding of a sum must not depend on how many rows there are.
            total = -0.5 * np.add.reduce(terms, axis=-1)
        for group, (variances, _) in zip(self._uneven, spectra[len(self._starts) :], strict=True):
            terms = len(group.members) * factors[group.members[0]] * np.log(variances)
            if alone := [b for b in group.members if self._alone[b]]:
                terms = terms + sum(residuals[b] ** 2 for b in alone) / variances
            total = total - 0.5 * group.weight * np.add.reduce(terms, axis=-1)
        for one in self.shared:
            parts = [residuals[b] for b in one.members]
            total = total + one.log_likelihood(parts, self._precisions(one.members, spectra), one.mean(factors))
        return total

    def _checked_size(self, group: _AlikeBlocks) -> int:
        """Return the number of variances that the spectrum of a group has, one or one each component."""
        block, count = group.block, len(self._parameters[group.members[0]])
        sizes, without_harmonics = (1, block.size), block.timed and not block.harmonic.size
        try:
            variances, slopes = map(np.shape, block.spectrum(self.model, np.ones(count)))
        except (IndexError, ValueError):
            if not without_harmonics:
                raise
            variances, slopes = (), ()
        if len(variances) == 1 and variances[0] in sizes and slopes in [(size, count) for size in sizes]:
            return variances[0]
        if without_harmonics:
            raise ValueError(
                f"noise: must have a method `covariance` for the points of a mask, got {self.model.name!r}; experiment "
                f"{block.experiment!r} has {block.size} points of {block.channel!r}, which have no harmonics, so that "
                "`spectrum` gives no variances of them. Implement `covariance`, or compare whole periods."
            )
        raise ValueError(
            f"noise: must have a spectrum of shapes (…, 1) or (…, {block.size}) and (…, 1, {count}) or (…, "
            f"{block.size}, {count}) for {block.channel!r} of {block.experiment!r}, got {variances} and {slopes} from "
            f"{self.model.name!r}."
        )

    def _spectra(self, values: np.ndarray) -> Spectra:
        """Return variances (…, size) or (…, 1) of the components of each group, and their slopes."""
        return [group.block.spectrum(self.model, values[..., group.columns]) for group in self._groups]

    def _even_variances(self, spectra: Spectra) -> np.ndarray:
        """Return the variances (…, blocks) of the blocks with one variance."""
        variances = np.concatenate([spectrum for spectrum, _ in spectra[: len(self._starts)]], axis=-1)
        return variances.take(self._even_groups, axis=-1)

    def precisions(self, members: Sequence[int], values: np.ndarray) -> list[np.ndarray]:
        """Return weights over variances of the components of some blocks, (…, size), or (…, 1) if they are the same."""
        return self._precisions(members, self._spectra(values))

    def _precisions(self, members: Sequence[int], spectra: Spectra) -> list[np.ndarray]:
        return [self.blocks[b].weight / spectra[self._group_of[b]][0] for b in members]

    def variance_slopes(self, values: np.ndarray) -> list[np.ndarray]:
        """Return ∂ ln V/∂ ln v (size,) or (1,) of each block by its variance, zero where it has none."""
        spectra, result = self._spectra(values), []
        for b, names in enumerate(self._parameters):
            spectral = names and b in self._group_of
            result.append(spectra[self._group_of[b]][1][..., 0] if spectral else np.full(1, float(bool(names))))
        return result

    def _root(self, b: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower Cholesky factor of the covariance of correlated components, and the covariance's slopes."""
        covariance, slopes = self.model.covariance(self.blocks[b], values[self._columns[b]])
        return np.linalg.cholesky(covariance), slopes

    def _dense_values(self, b: int, r: np.ndarray, values: np.ndarray, factor: float) -> np.ndarray:
        """Return the log-likelihoods (…,) of a block whose components are correlated; −inf if not positive definite."""
        result = np.full(values.shape[:-1], -np.inf)
        for at in np.ndindex(result.shape):
            try:
                root, _ = self._root(b, values[at])
            except np.linalg.LinAlgError:
                continue
            half = solve_triangular(root, r[at], lower=True)
            result[at] = -0.5 * self.blocks[b].weight * (2 * factor * np.sum(np.log(np.diag(root))) + half @ half)
        return result

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def value_and_gradients(
        self,
        residuals: Sequence[np.ndarray],
        values: np.ndarray,
        log_variance_factor: float | np.ndarray = 1.0,
        *,
        of_total: bool = False,
    ) -> tuple[float, Sequence[np.ndarray], np.ndarray]:
        """Return the log-likelihood of residuals (size,) at values (names,), and gradients.

        The gradients are those of log-likelihood plus `log_prior` of φ by each block's residual and by ln φ (names,).
        """
        factors, residuals = np.full(len(self.blocks), log_variance_factor), Residuals.of(residuals)
        spectra, by_value = self._spectra(values), self._prior_slopes(values, of_total)
        total = self._independent(residuals, values, spectra, factors)
        by_residual = self._even_gradients(residuals, spectra, factors, by_value)
        if self._uneven or self._dense or self.shared:
            by_residual = list(by_residual)
        for group, (variances, slopes) in zip(self._uneven, spectra[len(self._starts) :], strict=True):
            stack, factor = np.stack([residuals[b] for b in group.members]), factors[group.members[0]]
            for b, r in zip(group.members, stack, strict=True):
                by_residual[b] = -group.weight * r / variances
            by_logarithm = 0.5 * group.weight * np.add.reduce(stack**2 / variances - factor, axis=0)
            by_value[group.columns] += np.add.reduce(by_logarithm[:, None] * slopes, axis=0)
        for b in self._dense:
            value, by_residual[b], by_phi = self._dense_gradients(b, residuals[b], values, factors[b])
            total = total + value
            by_value[self._columns[b]] += by_phi
        for one in self.shared:
            parts, precisions = [residuals[b] for b in one.members], self._precisions(one.members, spectra)
            gradients = one.gradients(parts, precisions, one.mean(factors))
            for b, more, by_precision in zip(one.members, *gradients, strict=True):
                by_residual[b] = by_residual[b] + more
                slopes = spectra[self._group_of[b]][1]
                by_value[self._columns[b]] -= np.add.reduce(by_precision[:, None] * slopes, axis=0)
        return float(total) if np.isfinite(total) else -np.inf, by_residual, by_value

    def _even_gradients(self, residuals: Residuals, spectra: Spectra, factors: np.ndarray, by_value: np.ndarray) -> Any:
        """Return the gradients by the residuals of blocks with one variance, and add those by ln φ to `by_value`."""
        by_square = np.zeros(len(self.blocks))
        if self._even.size:
            precisions = self._even_weights / self._even_variances(spectra)
            by_square[self._even] = -precisions
            excess = precisions * residuals.squares[self._even] - factors[self._even] * self._even_counts
            slopes = np.concatenate([slope.ravel() for _, slope in spectra[: len(self._starts)]])
            each = 0.5 * np.add.reduceat(excess, self._starts)[self._slope_groups] * slopes
            by_value += np.bincount(self._slope_columns, each, by_value.size)
        return residuals.scaled(by_square)

    def _dense_gradients(
        self, b: int, r: np.ndarray, values: np.ndarray, factor: float
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the log-likelihood of correlated components r (size,), and its gradients by r and ln φ."""
        try:
            root, slopes = self._root(b, values)
        except np.linalg.LinAlgError:
            return -np.inf, np.zeros_like(r), np.zeros(len(self._parameters[b]))
        weight, inverse = self.blocks[b].weight, solve_triangular(root, np.eye(r.size), lower=True)
        half = solve_triangular(root, r, lower=True)
        solved = inverse.T @ half
        value = -0.5 * weight * (2 * factor * np.sum(np.log(np.diag(root))) + half @ half)
        traces = np.einsum("ij,pij->p", inverse.T @ inverse, slopes)
        return value, -weight * solved, 0.5 * weight * (solved @ slopes @ solved - factor * traces)

    def whitened(self, vectors: Sequence[np.ndarray], values: np.ndarray) -> list[np.ndarray]:
        """Return vectors (…, size), one a block, in units of the noise: their squares sum to −2 log-likelihood."""
        spectra = self._spectra(values)
        result = self._whitened_alone(vectors, values, spectra)
        for one in self.shared:
            joint = one.whitened([result[b] for b in one.members], self._precisions(one.members, spectra))
            for b, part in zip(one.members, joint, strict=True):
                result[b] = part
        return result

    def _whitened_alone(self, vectors: Sequence[np.ndarray], values: np.ndarray, spectra: Any) -> list[np.ndarray]:
        """Return vectors (…, size), one a block, in units of the noise of the block without errors of the inputs."""
        result = list(vectors)
        for b in self._group_of:
            (precisions,) = self._precisions([b], spectra)
            result[b] = vectors[b] * np.sqrt(precisions)
        for b in self._dense:
            block, (root, _) = self.blocks[b], self._root(b, values)
            white = solve_triangular(root, vectors[b].reshape(-1, block.size).T, lower=True)
            result[b] = np.sqrt(block.weight) * white.T.reshape(vectors[b].shape)
        return result

    def units(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the sd of whitened components by white noise of variance one in a block alone, (size,) by block.

        Components of correlated noise, and of blocks that share errors of inputs, are mixtures: the latter of all of
        the group, whose channels may have other units.
        """
        spectra, mixed = self._spectra(values), {b for one in self.shared for b in one.members} | set(self._dense)
        unit = [np.eye(block.size) if b in mixed else np.ones((1, block.size)) for b, block in enumerate(self.blocks)]
        result = self._whitened_alone(unit, values, spectra)
        for one in self.shared:
            precisions, alone = self._precisions(one.members, spectra), [result[b] for b in one.members]
            for k, b in enumerate(one.members):
                parts = [part if j == k else np.zeros((len(alone[k]), part.shape[1])) for j, part in enumerate(alone)]
                result[b] = one.whitened(parts, precisions)[k]
        return [np.linalg.norm(white, axis=0) for white in result]

    def simulate(self, values: np.ndarray, generator: np.random.Generator) -> list[np.ndarray]:
        """Return noise at values (draws, names): components (draws, size), one array a block."""
        result, spectra = [], self._spectra(values)
        for b, block in enumerate(self.blocks):
            white = generator.standard_normal((len(values), block.size))
            if b in self._dense:
                white = np.einsum("dij,dj->di", [self._root(b, row)[0] for row in values], white)
            else:
                white *= np.sqrt(spectra[self._group_of[b]][0])
            result.append(white)
        for one in self.shared:
            errors = generator.standard_normal((len(values), one.parts[0].shape[1]))
            for b, part in zip(one.members, one.parts, strict=True):
                result[b] += errors @ part.T
        return result

    def guess(self) -> np.ndarray:
        """Return where the noise parameters start, (names,): variances 1, shapes at the medians of their priors."""
        medians = {kind: float(prior.quantile(np.array(0.5))) for kind, prior in self.model.shape_priors.items()}
        starts = {name: medians.get(name.partition("[")[0], 1.0) for name in self.names}
        return np.array([self.fixed.get(name, start) for name, start in starts.items()])
