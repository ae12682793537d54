"""Directions in which parameters can move together unseen, in words, and the combinations that stay."""

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

SHOWN = 0.05
LARGEST = 4
ROUNDED = 0.06


def reduced(directions: np.ndarray) -> np.ndarray:
    """Return vectors that span the same space (directions, names), each without what the others begin with.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesperiodic.inference.estimation.directions import reduced
    >>> reduced(np.array([[2.0, 2.0, 4.0], [0.0, 3.0, 3.0]])).tolist()
    [[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]
    """
    rows = directions.copy()
    for i in range(len(rows)):
        relative = np.abs(rows) / np.abs(rows).max(axis=1, keepdims=True)
        column = int(np.argmax(relative[i] > SHOWN))
        rows[i] /= rows[i, column]
        for j in range(len(rows)):
            if j != i:
                rows[j] -= rows[j, column] * rows[i]
    return rows


def exponents(direction: np.ndarray) -> list[Fraction] | None:
    """Return a direction in logarithms as simple fractions, the first positive; None if there are none nearby.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesperiodic.inference.estimation.directions import exponents
    >>> exponents(np.array([0.499, -0.001, -0.998]))
    [Fraction(1, 1), Fraction(0, 1), Fraction(-2, 1)]
    """
    shown = np.abs(direction) > SHOWN * np.abs(direction).max()
    smallest = np.abs(direction[shown]).min()
    for unit in (smallest, np.abs(direction).max()):
        found = [Fraction(float(v / unit)).limit_denominator(LARGEST) for v in np.where(shown, direction, 0.0)]
        errors = [abs(float(f) - v / unit) for f, v in zip(found, direction, strict=True)]
        largest, lost = max(abs(f) for f in found), any(not f for f, s in zip(found, shown, strict=True) if s)
        if largest <= LARGEST and not lost and max(errors) < ROUNDED * max(1.0, float(largest)):
            sign = 1 if next(f for f in found if f) > 0 else -1
            return [sign * f for f in found]
    return None


def combinations(direction: np.ndarray, names: Sequence[str], logarithmic: np.ndarray) -> list[str]:
    """Return combinations of the parameters that do not change along a direction, as expressions.

    Products of powers where all that move are positive, sums where none is; nothing for a mixture or where no simple
    exponents fit.

    Parameters
    ----------
    direction : array (names,)
        In logarithms of positive parameters and in signed ones as they are.
    names : sequence of str
    logarithmic : bool array (names,)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesperiodic.inference.estimation.directions import combinations
    >>> combinations(np.array([1.0, -1.0]), ["a", "b"], np.array([True, True]))
    ['a*b']
    >>> combinations(np.array([1.0, 0.5, 0.5]), ["m", "k", "c"], np.array([True, True, True]))
    ['m/k**2', 'c/k']
    >>> combinations(np.array([1.0, -1.0]), ["a", "b"], np.array([False, False]))
    ['a + b']
    """
    shown = np.flatnonzero(np.abs(direction) > SHOWN * np.abs(direction).max())
    if shown.size < 2:
        return []
    powers = logarithmic[shown]
    if powers.all():
        rational = exponents(direction[shown])
        if rational is None:
            return []
        pivot = min(range(len(rational)), key=lambda i: (abs(rational[i]), i))
        ratios = [r / rational[pivot] for r in rational]
        if max(max(abs(r.numerator), r.denominator) for r in ratios) > LARGEST:
            return []
        return [
            _product(names[shown[i]], ratios[i], names[shown[pivot]], first=i < pivot)
            for i in range(len(rational))
            if i != pivot
        ]
    if powers.any():
        return []
    pivot = int(np.argmax(np.abs(direction[shown])))
    return [
        _sum(names[shown[pivot]], -float(direction[shown[pivot]] / direction[shown[i]]), names[shown[i]])
        for i in range(shown.size)
        if i != pivot
    ]


def _product(name: str, ratio: Fraction, other: str, *, first: bool) -> str:
    """Return name·other^(−ratio), raised to whole exponents that begin with a positive one."""
    own, its = ratio.denominator, -ratio.numerator
    factors = [(name, own), (other, its)] if first or its < 0 else [(other, its), (name, own)]
    return _of_powers(factors)


def _of_powers(factors: list[tuple[str, int]]) -> str:
    def power(name: str, exponent: int) -> str:
        return name if exponent == 1 else f"{name}**{exponent}"

    above = [power(n, e) for n, e in factors if e > 0]
    below = [power(n, -e) for n, e in factors if e < 0]
    return "/".join(["*".join(above), *below])


def _sum(name: str, ratio: float, other: str) -> str:
    scale = "" if abs(abs(ratio) - 1.0) < ROUNDED else f"{abs(ratio):.3g}*"
    return f"{name} {'+' if ratio > 0 else '-'} {scale}{other}"


def in_words(direction: np.ndarray, names: Sequence[str], logarithmic: np.ndarray) -> str:
    """Return what moves together along a direction, the simplest exponents put in where they fit.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesperiodic.inference.estimation.directions import in_words
    >>> in_words(np.array([0.5, -1.0]), ["a", "b"], np.array([True, True]))
    'a → a·t, b → b·t^-2'
    """
    shown = np.flatnonzero(np.abs(direction) > SHOWN * np.abs(direction).max())
    powers = [i for i in shown if logarithmic[i]]
    unit = direction[powers[0]] if powers else direction[shown[np.argmax(np.abs(direction[shown]))]]
    simple = exponents(direction[shown]) if len(powers) == shown.size else None
    parts = []
    for k, i in enumerate(shown):
        name = names[int(i)]
        ratio = float(simple[k] / simple[0]) if simple else float(direction[i] / unit)
        if logarithmic[i]:
            parts.append(f"{name} → {name}·t" + ("" if abs(ratio - 1.0) < 5e-4 else f"^{ratio:.3g}"))
        else:
            scale = "" if abs(abs(ratio) - 1.0) < 5e-4 else f"{abs(ratio):.3g}·"
            parts.append(f"{name} → {name} {'+' if ratio > 0 else '−'} {scale}{'ln t' if powers else 't'}")
    return ", ".join(parts)
