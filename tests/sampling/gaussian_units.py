"""Units whose posteriors are normal, so that populations of them have densities in closed form."""

import numpy as np

from bayesperiodic.sampling.population_units import Coordinate, UnitDraws

LINE = Coordinate(logarithmic=False, unit="m", support=(-np.inf, np.inf))


def gaussian_units(estimates, sds, seed, *, prior_mean=1.0, prior_sd=0.5, draws=2000):
    """Return units of independent normal estimates (units, names), drawn with a normal prior of every parameter."""
    generator, units = np.random.default_rng(seed), {}
    for number, (estimate, sd) in enumerate(zip(estimates, sds, strict=True)):
        variance = 1.0 / (1.0 / sd**2 + 1.0 / prior_sd**2)
        mean = variance * (estimate / sd**2 + prior_mean / prior_sd**2)
        points = mean + np.sqrt(variance) * generator.standard_normal((draws, len(estimate)))
        label = f"unit {number + 1}"
        units[label] = UnitDraws.of(
            [label], [LINE] * len(estimate), points,
            lambda x: -0.5 * np.sum(((x - prior_mean) / prior_sd) ** 2, axis=-1), draws,
        )  # fmt: skip
    return units
