"""What a residual consists of: measurement noise, model error, and how white it is."""

from dataclasses import dataclass

import numpy as np

from bayesperiodic.inference.estimation.gauss_newton import Iterate
from bayesperiodic.inference.estimation.whiteness import Whiteness, of_components
from bayesperiodic.inference.noise.blocks import POINTS, SPECTRAL
from bayesperiodic.inference.problem import Problem


@dataclass(frozen=True)
class NoiseSplit:
    """Standard deviations of one value of a channel's mean period, in the channel's units.

    Attributes
    ----------
    measurement : float
        What the scatter of the measured cycles explains; NaN where that is not known.
    model : float
        What is left: √(total² − measurement²), or zero.
    total : float
        That of the residual, corrected for the number of free parameters as in eq. (7).
    """

    measurement: float
    model: float
    total: float


def noise_split(problem: Problem, estimate: Iterate, share: float) -> dict[str, NoiseSplit]:
    """Return the split of every channel whose history was compared; `share` is 1 − l/Σn of eq. (7)."""
    sums = {channel: np.zeros(3) for channel in problem.channels}
    for block, r in zip(problem.likelihood.blocks, estimate.here.residuals, strict=True):
        if block.kind in (SPECTRAL, POINTS):
            sums[block.channel] += [block.count, block.weight * float(r @ r), block.count * block.measured]
    result = {}
    for channel, (count, square, measured) in sums.items():
        if count:
            total, measurement = square / (count * share), measured / count
            result[channel] = NoiseSplit(*np.sqrt([measurement, max(total - measurement, 0.0), total]).tolist())
    return result


def channel_whiteness(problem: Problem, estimate: Iterate) -> dict[str, Whiteness]:
    """Return the whiteness of every channel's residual in units of the noise model.

    With several experiments p is the smallest, corrected for their number, lag1 the mean; NaN where only single points
    were compared.
    """
    white = problem.likelihood.whitened(estimate.here.residuals, estimate.noise)
    tests: dict[str, list[Whiteness]] = {channel: [] for channel in problem.channels}
    for block, r in zip(problem.likelihood.blocks, white, strict=True):
        if block.kind == SPECTRAL:
            tests[block.channel].append(of_components(r, block.harmonic))
    nothing = [Whiteness(float("nan"), float("nan"))]
    return {
        channel: Whiteness(
            float(np.minimum(1.0, len(found or nothing) * min(t.p for t in found or nothing))),
            float(np.mean([t.lag1 for t in found or nothing])),
        )
        for channel, found in tests.items()
    }
