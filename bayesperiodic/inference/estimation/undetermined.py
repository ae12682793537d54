"""Which parameters, or combinations of them, the data say nothing about."""

from collections.abc import Sequence

import numpy as np

NEARLY_SINGULAR = 1e-10
SHOWN = 0.05


def undetermined(
    information: np.ndarray, theta: np.ndarray, names: Sequence[str], logarithmic: np.ndarray
) -> tuple[str, ...]:
    """Return, in words, the directions in which the data's information vanishes.

    Parameters
    ----------
    information : array (names, names)
        The data's part of H of eq. (8).
    theta : array (names,)
    names : sequence of str
    logarithmic : bool array (names,)
        Positive parameters; their combinations are written as products of powers.

    Returns
    -------
    tuple of str
        Such as "a: no output depends on it" or "a → a·t, b → b·t^-1": changes of the parameters that change no output.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesperiodic.inference.estimation.undetermined import undetermined
    >>> row = np.array([2.0, 1.0]) / [3.0, 5.0]
    >>> undetermined(np.outer(row, row), np.array([3.0, 5.0]), ["a", "b"], np.array([True, True]))
    ('a → a·t, b → b·t^-2',)
    """
    slopes = np.where(logarithmic, theta, 1.0)
    scaled = information * np.outer(slopes, slopes)
    size = np.sqrt(np.diag(scaled))
    silent = [f"{name}: no output depends on it" for name, own in zip(names, size, strict=True) if own == 0.0]
    acting = np.flatnonzero(size > 0.0)
    if not acting.size:
        return tuple(silent)
    part = scaled[np.ix_(acting, acting)] / np.outer(size[acting], size[acting])
    values, vectors = np.linalg.eigh(part)
    directions = _reduced(vectors[:, values < NEARLY_SINGULAR].T / size[acting])
    return tuple(silent + [_in_words(direction, acting, names, logarithmic) for direction in directions])


def _reduced(directions: np.ndarray) -> np.ndarray:
    """Return vectors that span the same (directions, acting), each without what the others begin with."""
    rows = directions.copy()
    for i in range(len(rows)):
        relative = np.abs(rows) / np.abs(rows).max(axis=1, keepdims=True)
        column = int(np.argmax(relative[i] > SHOWN))
        rows[i] /= rows[i, column]
        for j in range(len(rows)):
            if j != i:
                rows[j] -= rows[j, column] * rows[i]
    return rows


def _in_words(direction: np.ndarray, acting: np.ndarray, names: Sequence[str], logarithmic: np.ndarray) -> str:
    """Return what moves together, relative to the first of the positive parameters that move noticeably."""
    shown = np.abs(direction) > SHOWN * np.abs(direction).max()
    powers = [i for i in range(acting.size) if shown[i] and logarithmic[acting[i]]]
    first = powers[0] if powers else int(np.argmax(shown))
    parts = []
    for i in np.flatnonzero(shown):
        name, ratio = names[acting[i]], direction[i] / direction[first]
        if logarithmic[acting[i]]:
            parts.append(f"{name} → {name}·t" + ("" if abs(ratio - 1.0) < 5e-4 else f"^{ratio:.3g}"))
        elif powers:
            parts.append(f"{name} → {name} {'+' if ratio > 0 else '−'} {abs(ratio):.3g}·ln t")
        else:
            scale = "" if abs(abs(ratio) - 1.0) < 5e-4 else f"{abs(ratio):.3g}·"
            parts.append(f"{name} → {name} {'+' if ratio > 0 else '−'} {scale}t")
    return ", ".join(parts)
