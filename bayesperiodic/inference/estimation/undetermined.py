"""Which parameters, or combinations of them, the data say nothing about."""

from collections.abc import Sequence

import numpy as np

from bayesperiodic.inference.estimation.directions import in_words, reduced

NEARLY_SINGULAR = 1e-10
SILENT = "no output depends on it"


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
    silent = [f"{name}: {SILENT}" for name, own in zip(names, size, strict=True) if own == 0.0]
    acting = np.flatnonzero(size > 0.0)
    if not acting.size:
        return tuple(silent)
    part = scaled[np.ix_(acting, acting)] / np.outer(size[acting], size[acting])
    values, vectors = np.linalg.eigh(part)
    directions = reduced(vectors[:, values < NEARLY_SINGULAR].T / size[acting])
    own = [names[i] for i in acting.tolist()]
    return tuple(silent + [in_words(direction, own, logarithmic[acting]) for direction in directions])
