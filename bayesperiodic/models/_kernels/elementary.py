"""Elementary functions as plain arithmetic, so that loops over the grid that call them are vectorised.

What a generated module calls of this text becomes part of it (see `compile`). A call of the C library's
function keeps such a loop scalar and costs more than all the rest of a model. The rational approximations are those of
S. L. Moshier, Cephes Mathematical Library (1989): errors are of one or two units in the last place.
"""

import math

import numpy as np
from numba import njit

OPTIONS = {"cache": globals().get("CACHE", False), "nogil": True, "error_model": "numpy"}
# ln 2 in two parts, the first with few bits, so that its multiples are exact.
LOG2_HIGH, LOG2_LOW = 6.93145751953125e-1, 1.42860682030941723212e-6


@njit("float64(float64)", **OPTIONS)
def power_of_two(exponent):
    """Return 2**exponent for a whole number from −1022 to 1023, by its bits."""
    return np.int64((np.int64(exponent) + 1023) << 52).view(np.float64)


@njit("float64(float64)", **OPTIONS)
def exp(x):
    """Return exp(x), by exp(r)·2**n with |r| ≤ ln(2)/2."""
    within = min(max(x, -750.0), 750.0)
    n = math.floor(within / math.log(2.0) + 0.5)
    r = (within - n * LOG2_HIGH) - n * LOG2_LOW
    square = r * r
    p = r * ((1.26177193074810590878e-4 * square + 3.02994407707441961300e-2) * square + 1.0)
    q = (3.00198505138664455042e-6 * square + 2.52448340349684104192e-3) * square + 2.27265548208155028766e-1
    half = math.floor(0.5 * n)
    value = (1.0 + 2.0 * (p / (q * square + 2.0 - p))) * power_of_two(half) * power_of_two(n - half)
    return value if x == x else x


@njit("float64(float64)", **OPTIONS)
def tanh(x):
    """Return tanh(x), by a rational function near zero and by exp(2|x|) elsewhere."""
    square = x * x
    p = (-9.64399179425052238628e-1 * square - 9.92877231001918586564e1) * square - 1.61468768441708447952e3
    q = (square + 1.12811678491632931402e2) * square + 2.23548839060100448583e3
    near = x + x * (square * (p / (q * square + 4.84406305325125486048e3)))
    far = math.copysign(1.0 - 2.0 / (exp(2.0 * min(abs(x), 30.0)) + 1.0), x)
    return near if abs(x) < 0.625 else (far if x == x else x)


@njit("float64(float64)", **OPTIONS)
def atan(x):
    """Return atan(x), by a rational function of |x|, (|x| − 1)/(|x| + 1) or −1/|x|."""
    size = abs(x)
    middle, large = size > 0.66, size > math.tan(0.375 * math.pi)
    numerator = -1.0 if large else (size - 1.0 if middle else size)
    denominator = size if large else (size + 1.0 if middle else 1.0)
    start = 0.5 * math.pi if large else (0.25 * math.pi if middle else 0.0)
    rounding = 6.123233995736766e-17 if large else (3.061616997868383e-17 if middle else 0.0)
    t = numerator / denominator
    square = t * t
    p = (-8.750608600031904122785e-1 * square - 1.615753718733365076637e1) * square - 7.500855792314704667340e1
    p = (p * square - 1.228866684490136173410e2) * square - 6.485021904942025371773e1
    q = (square + 2.485846490142306297962e1) * square + 1.650270098316988542046e2
    q = ((q * square + 4.328810604912902668951e2) * square + 4.853903996359136964868e2) * square
    value = t * (square * (p / (q + 1.945506571482613964425e2))) + t + rounding
    return math.copysign(start + value, x)
