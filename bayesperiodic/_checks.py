"""Argument errors in one voice: name the argument, the value, and what is allowed."""

import difflib
import reprlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np


def one_of(argument: str, value: Any, allowed: Iterable[str]) -> None:
    """Raise a ValueError unless `value` is one of `allowed`; the nearest allowed name is suggested."""
    names = list(allowed)
    if value in names:
        return
    near = difflib.get_close_matches(str(value), names, n=1, cutoff=0.4)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    listed = ", ".join(repr(name) for name in names) or "nothing"
    raise ValueError(f"{argument}: {value!r} is not known; allowed: {listed}.{hint}")


def same_names(argument: str, given: Mapping[str, Any], wanted: Iterable[str]) -> None:
    """Raise a ValueError unless the keys of `given` are exactly `wanted`."""
    names = list(wanted)
    for name in given:
        one_of(argument, name, names)
    missing = [name for name in names if name not in given]
    if missing:
        raise ValueError(f"{argument}: missing {', '.join(map(repr, missing))}; needed: {', '.join(map(repr, names))}.")


def holds(argument: str, given: Iterable[str], wanted: Iterable[str], remedy: str) -> None:
    """Raise a ValueError with a remedy unless a result has all the names wanted of it."""
    names = list(given)
    if missing := [name for name in wanted if name not in names]:
        has = ", ".join(map(repr, names)) or "nothing"
        raise ValueError(f"{argument}: it has no {', '.join(map(repr, missing))}, only {has}; {remedy}.")


def mapping(argument: str, value: Any, example: str) -> Mapping[str, Any]:
    """Return `value`; raise a ValueError unless it has names and values, as a dict or a table of pandas does."""
    if not hasattr(value, "items"):
        raise ValueError(f"{argument}: {_shown(value)} is not allowed; it must be a mapping, such as {example}.")
    return value


def identifiers(argument: str, names: Iterable[str], reserved: Iterable[str] = ()) -> tuple[str, ...]:
    """Return the names as a tuple; raise a ValueError for one that is no identifier, is reserved or comes twice."""
    result = tuple(names)
    taken = set(reserved)
    for name in result:
        if not isinstance(name, str) or not name.isidentifier() or name.startswith("_"):
            raise ValueError(
                f"{argument}: {name!r} is not allowed; names are Python identifiers such as 'force', without a leading "
                "underscore."
            )
        if name in taken:
            raise ValueError(f"{argument}: {name!r} is reserved or used twice; choose another name.")
        taken.add(name)
    return result


def positive(argument: str, value: Any) -> float:
    """Return `value` as a float; raise a ValueError unless it is finite and > 0."""
    number = finite_number(argument, value)
    if number <= 0.0:
        raise ValueError(f"{argument}: {value!r} is not allowed; it must be > 0.")
    return number


def finite_number(argument: str, value: Any) -> float:
    """Return `value` as a float; raise a ValueError unless it is one finite real number."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{argument}: {value!r} is not allowed; it must be a real number.") from None
    if not np.isfinite(number):
        raise ValueError(f"{argument}: {value!r} is not allowed; it must be finite.")
    return number


def integer(argument: str, value: Any, minimum: int | None = None) -> int:
    """Return `value` as an int; raise a ValueError unless it is a whole number, of at least `minimum`."""
    no_integer = isinstance(value, bool) or not isinstance(value, int | np.integer)
    if no_integer or (minimum is not None and value < minimum):
        least = "" if minimum is None else f" of at least {minimum}"
        whole = isinstance(value, float | np.floating) and float(value).is_integer()
        hint = f", such as {int(value)}, without a decimal point" if whole else ""
        raise ValueError(f"{argument}: {value!r} is not allowed; it must be a whole number{least}{hint}.")
    return int(value)


def finite_vector(argument: str, values: Any, length: int | None = None, meaning: str = "") -> np.ndarray:
    """Return `values` as a 1-d float array; raise a ValueError for text, a wrong length, NaN or infinity.

    `meaning` tells in the message what the length is, such as "samples·periods".
    """
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{argument}: {_shown(values)} is not allowed; it must be an array of real numbers.") from None
    if array.ndim != 1:
        raise ValueError(f"{argument}: shape {array.shape} is not allowed; it must be one-dimensional.")
    if length is not None and array.size != length:
        told = f" ({meaning})" if meaning else ""
        raise ValueError(f"{argument}: {array.size} values are not allowed; there must be {length}{told}.")
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise ValueError(
            f"{argument}: {array[bad[0]]} at index {bad[0]} is not allowed ({bad.size} of {array.size} samples are "
            "NaN or infinite); every sample must be finite."
        )
    return array


def _shown(value: Any) -> str:
    """Return a value as a short text, its middle left out where it is long."""
    return " ".join(reprlib.repr(value).split())
