"""The comparison of responses with all experiments, those of one layout at once."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from bayesperiodic.inference.noise.residuals import Residuals
from bayesperiodic.inference.observation import Observation, Response
from bayesperiodic.parallel import in_threads


class Comparisons:
    """Observations in groups, each of one layout.

    Parameters
    ----------
    groups : iterable of sequence of Observation
    """

    def __init__(self, groups: Iterable[Sequence[Observation]]):
        self._groups = [tuple(group) for group in groups]
        self.observations = {o.experiment.name: o for group in self._groups for o in group}
        self._data = [_data(group) for group in self._groups]
        self._places, first = [], 0
        for group in self._groups:
            blocks = range(first, first + len(group[0].blocks))
            self._places += [[(block, member) for block in blocks] for member in range(len(group))]
            first = blocks.stop

    def residuals(self, responses: Mapping[str, Response], threads: int) -> Residuals:
        """Return the residual components of responses by experiment, in the order of the mapping."""
        with np.errstate(over="ignore", invalid="ignore"):
            found = in_threads(lambda g: self._compared(g, responses), range(len(self._groups)), threads)
        own = dict(zip(self.observations, self._places, strict=True))
        return Residuals(
            [stack for stacks in found for stack in stacks], [place for name in responses for place in own[name]]
        )

    def pulled(self, responses: Mapping[str, Response], weights: Residuals) -> dict[str, Response]:
        """Return the derivatives of Σ weights · predicted components by everything in one response an experiment.

        Parameters
        ----------
        responses : mapping of str to Response
            Without leading axes; in the same order as those that led to the residuals.
        weights : Residuals
            Of the same places as these.
        """
        result, first = {}, 0
        for group, data in zip(self._groups, self._data, strict=True):
            stacks = weights.stacks()[first : first + len(group[0].blocks)]
            first += len(stacks)
            if data is None:
                (alone,) = group
                name = alone.experiment.name
                result[name] = alone.pulled(responses[name], [stack[0] for stack in stacks])
                continue
            outputs = group[0].spread(stacks, responses[group[0].experiment.name].outputs.shape)
            for o, own in zip(group, outputs, strict=True):
                result[o.experiment.name] = Response(own, np.zeros(()), np.zeros(0), np.zeros(()))
        return {name: result[name] for name in responses}

    def _compared(self, group: int, responses: Mapping[str, Response]) -> list[np.ndarray]:
        """Return the residual components of a group, an array (experiments, solves, size) a block."""
        observations, data = self._groups[group], self._data[group]
        if data is None:
            (alone,) = observations
            return [block[None] for block in alone.residuals(responses[alone.experiment.name])]
        outputs = [responses[o.experiment.name].outputs for o in observations]
        signals = np.stack(outputs) if len(outputs) > 1 else outputs[0][None]
        return [own - components for own, components in zip(data, observations[0].components(signals), strict=True)]


def _data(group: Sequence[Observation]) -> list[np.ndarray] | None:
    """Return the measured components of a group, an array (experiments, 1, size) a channel; None without a layout."""
    if group[0].layout is None:
        return None
    return [np.stack(own)[:, None] for own in zip(*(o.data_components() for o in group), strict=True)]
