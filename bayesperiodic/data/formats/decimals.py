"""Numbers that files give with few digits."""

import re
from decimal import Decimal

# Significant digits of a step that is taken as exact, and of the rate of one whose reciprocal is.
SHORT_STEP, SHORT_RATE = 3, 6
# Half a unit, with the rounding of its comparison.
HALF_UNIT = 0.5001
DECIMAL_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([EeDd][+-]?\d+)?\s*")


def decimal_error(text: str) -> float:
    """Return half a unit of the last digit of a decimal number."""
    exponent = _decimal(text).as_tuple().exponent
    return HALF_UNIT * 10.0 ** int(exponent)


def step_error(text: str) -> float:
    """Return the largest error of a sampling interval [s] in decimal digits; 0 if it is evidently exact.

    Evidently exact are 0.0025, which has few digits, and 0.00390625, the reciprocal of 256, and not 1.95313E-05.
    """
    step = _decimal(text)
    if step <= 0 or _digits(step) <= SHORT_STEP:
        return 0.0
    rate = Decimal(1) / step
    if _digits(rate) <= SHORT_RATE:  # 28 digits of the quotient are computed
        return 0.0
    return decimal_error(text)


def _decimal(text: str) -> Decimal:
    if not DECIMAL_NUMBER.fullmatch(text):
        raise ValueError(f"{text.strip()!r} is no number")
    return Decimal(re.sub("[Dd]", "e", text.strip()))


def _digits(number: Decimal) -> int:
    """Return the number of significant digits without trailing zeros."""
    return len(number.normalize().as_tuple().digits)
