"""Changes of the likelihood with the variances of the noise, estimated and measured ones."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.likelihood.block import Block
from bayesperiodic.likelihood.input_noise import FROM_CYCLES, error_waves
from bayesperiodic.likelihood.noise_spectrum import NoiseSpectrum
from bayesperiodic.problem.description import Description

# Share of an estimated variance in those of the components, below which it counts as zero.
LEAST_VARIANCE_SHARE = 1e-3


class NoiseChange(NamedTuple):
    """Derivatives by the logarithm of a variance: with S the covariance of the residual components, P = S⁻½ S′ S⁻½.

    J are the whitened derivatives of the components by θ.
    """

    information: np.ndarray  # (names, names), J P Jᵀ, minus the derivative of the information
    doubled: np.ndarray  # (names, names), J P P Jᵀ
    trace: float  # of P
    square: float  # trace of P P: the degrees of freedom of the variance if it is estimated from these components

    def __add__(self, other: Any) -> "NoiseChange":
        return NoiseChange(*(a + b for a, b in zip(self, other, strict=True)))


class IndependentPart(NamedTuple):
    """Blocks whose components are independent of those of others, joined."""

    members: Sequence[int]
    blocks: Sequence[Block]
    changes: np.ndarray  # (names, components), whitened
    weight: np.ndarray  # (components,), independent values per component
    shared: Any  # errors of inputs that move all of them
    precisions: list[np.ndarray]

    def again(self, vectors: np.ndarray) -> np.ndarray:
        """Return vectors (…, components), in units of the blocks' own noise, whitened for the errors of inputs."""
        if self.shared is None:
            return vectors
        parts = np.split(vectors, np.cumsum([block.size for block in self.blocks])[:-1], axis=-1)
        return np.concatenate(self.shared.whitened(parts, self.precisions), axis=-1)

    def change(self, share: np.ndarray) -> NoiseChange:
        """Return the change with a variance that has these shares (components,) in those of the components."""
        moved = self.again(self.changes) * share
        left, square = share * self.weight, share * self.weight @ share
        if self.shared is not None:
            axes, squares = self.shared.whitening(self.precisions)
            taken = (axes * (squares / (1.0 + squares))) @ axes.T
            left = share * (self.weight - np.diag(taken))
            square = square - 2.0 * share**2 @ np.diag(taken) + share @ taken**2 @ share
        twice = self.again(moved)
        information = self.again(self.changes) @ moved.T
        return NoiseChange(information, twice @ twice.T, float(left.sum()), float(square))

    def change_of_errors(self, loadings: np.ndarray, share: np.ndarray) -> NoiseChange:
        """Return the change with the variances of errors of inputs, shares (errors,), loadings (components, errors)."""
        root = np.sqrt(np.concatenate([np.broadcast_to(p, b.size) for p, b in self._each()]))
        white = self.again(root * loadings.T)
        along, gram = self.changes @ white.T, white @ white.T
        moved = along * share
        square = float(share @ gram**2 @ share)
        return NoiseChange(moved @ along.T, moved @ gram @ moved.T, float(share @ np.diag(gram)), square)

    def _each(self) -> Iterator[tuple[np.ndarray, Block]]:
        return zip(self.precisions, self.blocks, strict=True)


def _parts(problem: Description, jacobian: Any, noise: np.ndarray) -> Iterator[IndependentPart]:
    """Yield the blocks of every experiment with errors of inputs, and the other blocks one by one."""
    likelihood = problem.likelihood
    changes = likelihood.whitened(jacobian, noise)
    shared = {b: one for one in likelihood.shared for b in one.members}
    alone = [(b,) for b in range(len(likelihood.blocks)) if b not in shared]
    for members in [*alone, *(one.members for one in likelihood.shared)]:
        blocks, one = [likelihood.blocks[b] for b in members], shared.get(members[0])
        weight = np.concatenate([np.full(block.size, block.weight) for block in blocks])
        precisions = likelihood.precisions(members, noise) if one else []
        yield IndependentPart(
            members, blocks, np.concatenate([changes[b] for b in members], axis=1), weight, one, precisions
        )


def changes_by_variance(
    problem: Description, jacobian: Any, noise: np.ndarray, least: float = LEAST_VARIANCE_SHARE
) -> dict[str, NoiseChange]:
    """Return the change with each unknown variance, by its name, without those with no larger share than `least`."""
    likelihood = problem.likelihood
    result: dict[str, NoiseChange] = {}
    slopes = likelihood.variance_slopes(noise)
    named = {b: group[0] for group, members in likelihood.groups() if group[0] in likelihood.free for b in members}
    for part in _parts(problem, jacobian, noise):
        for name in dict.fromkeys(named[b] for b in part.members if b in named):
            each = [
                np.broadcast_to(slopes[b] if named.get(b) == name else 0.0, block.size)
                for b, block in zip(part.members, part.blocks, strict=True)
            ]
            share = np.concatenate(each)
            change = part.change(share)
            result[name] = result[name] + change if name in result else change
    counts = likelihood.counts
    return {name: change for name, change in result.items() if change.trace > least * counts[name]}


def changes_by_measured(problem: Description, jacobian: Any, noise: np.ndarray) -> Iterator[tuple[NoiseChange, float]]:
    """Yield the change with each measured variance of noise, of outputs and inputs, and its degrees of freedom."""
    experiments = {e.name: e for e in problem.experiments}
    for part in _parts(problem, jacobian, noise):
        experiment = experiments[part.blocks[0].experiment]
        if problem.noise.needs_scatter:
            yield from _of_outputs(problem, part, experiment, noise)
        if part.shared is not None and problem.input_noise == FROM_CYCLES:
            yield from _of_inputs(problem, part, experiment)


def _of_outputs(
    problem: Description, part: IndependentPart, experiment: Experiment, noise: np.ndarray
) -> Iterator[tuple[NoiseChange, float]]:
    """Yield the changes with the measured variances of outputs."""
    likelihood, last = problem.likelihood, 0
    for b, block in zip(part.members, part.blocks, strict=True):
        first, last = last, last + block.size
        if not block.timed or not block.measured > 0.0:
            continue
        variances = block.weight / likelihood.precisions([b], noise)[0]
        every = block.spectrum_measured if block.spectrum_measured.size else block.measured
        share = np.zeros(part.weight.size)
        share[first:last] = np.minimum(every / variances, 1.0)
        spectrum = NoiseSpectrum.of(experiment, block.channel) if block.spectrum_measured.size else None
        if spectrum is None:
            if experiment.cycles > 1:
                yield part.change(share), (experiment.cycles - 1.0) * experiment.independent[block.channel]
            continue
        for mixed, freedom in zip(spectrum.mixing.T, spectrum.freedom, strict=True):
            mixture = np.zeros(part.weight.size)
            mixture[first:last] = mixed[block.harmonic]
            if mixture.any():
                yield part.change(share * mixture), freedom


def _of_inputs(
    problem: Description, part: IndependentPart, experiment: Experiment
) -> Iterator[tuple[NoiseChange, float]]:
    """Yield the changes with the measured variances of inputs."""
    where, waves = error_waves(experiment, problem.input_noise)
    if not where:  # an error of the frequency only
        return
    loadings = problem.likelihood.loadings[experiment.name][:, : len(where)]
    harmonic = np.abs(waves).argmax(axis=1)
    for name in dict.fromkeys(where):
        spectrum = NoiseSpectrum.of(experiment, name)
        columns = np.flatnonzero([other == name for other in where])
        for mixed, freedom in zip(spectrum.mixing.T, spectrum.freedom, strict=True) if spectrum else ():
            share = mixed[harmonic[columns]]
            if share.any():
                yield part.change_of_errors(loadings[:, columns], share), freedom
