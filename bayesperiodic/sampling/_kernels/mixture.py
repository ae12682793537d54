"""The compiled likelihood of units under normal populations; loaded through the kernel cache, not imported."""

import numpy as np
from numba import njit

# ln 2 in two parts, the first of few digits; a number whose last bit is that of one; the lowest logarithm.
LOG2_E = 1.4426950408889634
LOG_TWO, REST_OF_LOG_TWO, ROUNDING_SHIFT, LOWEST = (
    0.6931471803691238,
    1.9082149292705877e-10,
    6755399441055744.0,
    -700.0,
)
LANES = 8
MIXTURE_OPTIONS = {
    "cache": globals().get("CACHE", False), "nogil": True, "error_model": "numpy", "fastmath": {"contract"},
}  # fmt: skip


@njit("void(float64[:,:,::1], float64[:,:,::1], float64[:,::1])", **MIXTURE_OPTIONS)
def log_means(features, coefficients, result):
    """Fill ln of the mean over the draws of exp(coefficients · features) (units, points).

    Features (units, features, draws), coefficients (units, points, features). The loops over draws have no branches, so
    that they become vector instructions; x = k·ln 2 + r, the exponential of r by its series, 2^k by its bits.
    """
    units, width, draws = features.shape
    whole = draws - draws % LANES
    x, power, lanes = np.empty(draws), np.empty(draws), np.empty(LANES)
    bits = power.view(np.int64)
    for unit in range(units):
        for point in range(coefficients.shape[1]):
            x[:] = 0.0
            for k in range(width):
                c = coefficients[unit, point, k]
                for n in range(draws):
                    x[n] += c * features[unit, k, n]
            lanes[:] = x[0]
            for n in range(0, whole, LANES):
                for lane in range(LANES):
                    lanes[lane] = x[n + lane] if x[n + lane] > lanes[lane] else lanes[lane]
            top = max(lanes.max(), x[whole:].max() if whole < draws else x[0])
            for n in range(draws):
                y = x[n] - top
                y = y if y > LOWEST else LOWEST
                power[n] = y * LOG2_E + ROUNDING_SHIFT
                turns = power[n] - ROUNDING_SHIFT
                x[n] = (y - turns * LOG_TWO) - turns * REST_OF_LOG_TWO
            for n in range(draws):
                r = x[n]
                # Horner's scheme of r^10/10! + … + r + 1.
                series = ((r * (1.0 / 3628800.0) + 1.0 / 362880.0) * r + 1.0 / 40320.0) * r + 1.0 / 5040.0
                series = ((series * r + 1.0 / 720.0) * r + 1.0 / 120.0) * r + 1.0 / 24.0
                series = (((series * r + 1.0 / 6.0) * r + 0.5) * r + 1.0) * r + 1.0
                x[n] = series
                bits[n] = (bits[n] + 1023) << 52
            lanes[:] = 0.0
            for n in range(0, whole, LANES):
                for lane in range(LANES):
                    lanes[lane] += x[n + lane] * power[n + lane]
            total = lanes.sum()
            for n in range(whole, draws):
                total += x[n] * power[n]
            result[unit, point] = top + np.log(total / draws)
