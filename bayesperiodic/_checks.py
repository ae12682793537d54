"""Argument validation, with messages `name: must be …, got …`."""

import difflib
import reprlib
import unicodedata
from collections.abc import Iterable, Mapping
from typing import Any, NoReturn

import numpy as np

MOST_LETTERS, MOST_LISTED = 200, 12
# Names above which not all are listed, such as the columns of a wide file.
MANY = 100
# Sizes of measured values, whose squares and their ratios must be numbers.
SMALLEST_VALUE, LARGEST_VALUE = 1e-100, 1e100


def one_of(argument: str, value: Any, allowed: Iterable[str]) -> None:
    """Raise a ValueError unless `value` is one of `allowed`; the message suggests the most similar name."""
    names = list(allowed)
    if value in names:
        return
    near = [name for name in names if isinstance(value, str) and name.casefold() == value.casefold()]
    near = near or difflib.get_close_matches(str(value)[:MOST_LETTERS], names, n=1, cutoff=0.4)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    shown = repr(value) if isinstance(value, str) and len(value) <= MOST_LETTERS else shortened(value)
    listed = f"{_listed(names[:MOST_LISTED])}, … ({len(names)} in all)" if len(names) > MANY else _listed(names)
    choice = f"{'one of ' if len(names) > 1 else ''}{listed}" if names else "left out"
    raise ValueError(f"{argument}: must be {choice}, got {shown}.{hint}")


def instance(argument: str, value: Any, kind: type | tuple[type, ...]) -> None:
    """Raise a ValueError unless `value` is an instance of a class, or of one of several."""
    if not isinstance(value, kind):
        names = " or ".join(one.__name__ for one in (kind if isinstance(kind, tuple) else (kind,)))
        raise ValueError(f"{argument}: must be a {names}, got {type(value).__name__}.")


def same_names(argument: str, given: Mapping[str, Any], required: Iterable[str]) -> None:
    """Raise a ValueError unless `given` is a mapping whose keys are exactly `required`."""
    names = list(required)
    if not isinstance(given, Iterable):
        raise ValueError(f"{argument}: must be a mapping of {_listed(names)} to values, got {shortened(given)}.")
    for name in given:
        one_of(argument, name, names)
    if missing := [name for name in names if name not in given]:
        raise ValueError(f"{argument}: must have {_listed(names)}, got no {_listed(missing)}.")


def contains(argument: str, given: Iterable[str], required: Iterable[str], remedy: str) -> None:
    """Raise a ValueError that ends with `remedy` unless all required names are given."""
    names = list(given)
    if missing := [name for name in required if name not in names]:
        raise ValueError(f"{argument}: must have {_listed(missing)}, got only {_listed(names) or 'nothing'}; {remedy}.")


def mapping(argument: str, value: Any, example: str) -> Mapping[str, Any]:
    """Return `value`; raise a ValueError unless it is a mapping or a pandas table."""
    if not hasattr(value, "items"):
        raise ValueError(f"{argument}: must be a mapping, such as {example}, got {shortened(value)}.")
    return value


def optional_mapping(argument: str, value: Any, example: str) -> dict[str, Any]:
    """Return a mapping as a dictionary, an empty one for None; raise a ValueError unless it is a mapping."""
    return dict(mapping(argument, {} if value is None else value, example))


def several(argument: str, values: Any) -> tuple[Any, ...]:
    """Return values as a tuple; raise a ValueError unless there can be several, as in a list."""
    if not isinstance(values, Iterable):
        raise ValueError(f"{argument}: must be a sequence, such as a list, got {shortened(values)}.")
    return tuple(values)


def identifiers(argument: str, names: Iterable[str], reserved: Iterable[str] = ()) -> tuple[str, ...]:
    """Return the names as a tuple; raise a ValueError unless they are different, unreserved identifiers.

    Names must be in Unicode's normal form NFKC, in which Python reads names in code: there K and the Kelvin sign, or
    µ (micro) and μ (mu), are the same name.
    """
    result, taken = several(argument, names), tuple(reserved)
    for place, name in enumerate(result):
        if not isinstance(name, str) or not name.isidentifier() or name.startswith("_"):
            raise ValueError(
                f"{argument}: must be Python identifiers without a leading underscore, such as 'force', got "
                f"{shortened(name)}."
            )
        if len(name) > MOST_LETTERS:
            raise ValueError(
                f"{argument}: must have at most {MOST_LETTERS} letters, got {len(name)} in {name[:20]!r}…."
            )
        if (normal := unicodedata.normalize("NFKC", name)) != name:
            raise ValueError(
                f"{argument}: must be in Unicode's normal form NFKC, as names in Python's code are, got {name!r} "
                f"({_code_points(name)}); write {normal!r} ({_code_points(normal)})."
            )
        if name in result[:place]:
            raise ValueError(f"{argument}: must differ, got {name!r} twice.")
        if name in taken:
            others = f"{_listed(taken[:MOST_LISTED])}{', …' * (len(taken) > MOST_LISTED)}"
            raise ValueError(
                f"{argument}: must be neither reserved nor used elsewhere ({others}), got {name!r}; choose another "
                "name."
            )
    return result


def text(argument: str, value: Any) -> str:
    """Return `value`; raise a ValueError unless it is a text that can be written to a file.

    Arrays of texts and HDF5 end a text at the character 0.
    """
    try:
        if b"\0" not in str.encode(value, "utf-8"):
            return str(value)
    except (TypeError, UnicodeEncodeError):
        pass
    raise ValueError(f"{argument}: must be a text of Unicode characters, got {shortened(value)}.")


def positive(argument: str, value: Any) -> float:
    """Return `value` as a float; raise a ValueError unless it is finite and > 0."""
    number = finite_number(argument, value)
    if number <= 0.0:
        raise ValueError(f"{argument}: must be > 0, got {value!r}.")
    return number


def finite_number(argument: str, value: Any) -> float:
    """Return `value` as a float; raise a ValueError unless it is one finite real number."""
    try:
        if isinstance(value, str | np.complexfloating):
            raise TypeError
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{argument}: must be a real number, got {shortened(value)}.") from None
    if not np.isfinite(number):
        raise ValueError(f"{argument}: must be finite, got {value!r}.")
    return number


def integer(argument: str, value: Any, minimum: int | None = None) -> int:
    """Return `value` as an int; raise a ValueError unless it is an integer, of at least `minimum`."""
    no_integer = isinstance(value, bool) or not isinstance(value, int | np.integer)
    if no_integer or (minimum is not None and value < minimum):
        bound = "" if minimum is None else f" >= {minimum}"
        whole = isinstance(value, float | np.floating) and float(value).is_integer()
        hint = f"; write {int(value)}, without a decimal point" if whole else ""
        raise ValueError(f"{argument}: must be an integer{bound}, got {shortened(value)}{hint}.")
    return int(value)


def real_array(argument: str, values: Any) -> np.ndarray:
    """Return `values` as an array of floats; raise a ValueError unless they are real numbers.

    It is a copy, unless `values` is an array of floats that is read-only. Masked values, and the missing ones of
    pandas, are NaN. Dates and durations are no numbers.
    """
    try:
        array = np.asarray(values)
        if np.iscomplexobj(array) or array.dtype.kind in "mM":
            raise ValueError
        if array.dtype == object:
            import pandas as pd

            array = np.where(pd.isna(array), np.nan, array)
        floats = array.astype(float, copy=_can_change(array))
    except (TypeError, ValueError):
        kind = getattr(values, "dtype", None)
        got = f"{shortened(values)}{f' of type {kind}' if kind is not None else ''}"
        raise ValueError(f"{argument}: must be an array of real numbers, got {got}.") from None
    return np.where(np.ma.getmaskarray(values), np.nan, floats) if np.ma.isMaskedArray(values) else floats


def finite_vector(argument: str, values: Any, length: int | None = None, meaning: str = "") -> np.ndarray:
    """Return `values` as a finite 1-d float array; `meaning` explains the length, such as "samples·periods"."""
    array = _vector(argument, values, length, meaning)
    _size(argument, array)
    return array


def _vector(argument: str, values: Any, length: int | None, meaning: str) -> np.ndarray:
    array = real_array(argument, values)
    if array.ndim != 1:
        raise ValueError(f"{argument}: must be one-dimensional, got shape {array.shape}.")
    if length is not None and array.size != length:
        explained = f" ({meaning})" if meaning else ""
        raise ValueError(f"{argument}: must have {length} values{explained}, got {array.size}.")
    return array


def measured_vector(argument: str, values: Any, length: int | None = None, meaning: str = "") -> np.ndarray:
    """Return `values` as by `finite_vector`; raise a ValueError if its values are too small or too large."""
    return measured(argument, _vector(argument, values, length, meaning))


def measured(argument: str, array: np.ndarray) -> np.ndarray:
    """Return an array of floats itself; raise a ValueError unless it is finite, and not too small or too large."""
    size = _size(argument, array)
    if size and not SMALLEST_VALUE < size < LARGEST_VALUE:
        raise ValueError(
            f"{argument}: must be between {SMALLEST_VALUE:g} and {LARGEST_VALUE:g} in size, got up to {size:g}; choose "
            "another unit."
        )
    return array


def _size(argument: str, array: np.ndarray) -> float:
    """Return the largest size in an array, without temporary arrays; raise a ValueError if one is not finite."""
    if not array.size:
        return 0.0
    low, high = float(array.min()), float(array.max())
    if not np.isfinite(low) or not np.isfinite(high):  # NaN is both
        bad = np.flatnonzero(~np.isfinite(array))
        raise ValueError(
            f"{argument}: must be finite, got {array.flat[bad[0]]} at index {bad[0]} ({bad.size} of {array.size} "
            "values are masked, NaN or infinite)."
        )
    return max(-low, high)


class ReadOnly(dict[Any, Any]):
    """A dictionary that refuses changes; unlike `types.MappingProxyType` it can be pickled, copied and stored."""

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise TypeError("This mapping is read-only. Change a copy, dict(…), and make another object with it.")

    __setitem__ = __delitem__ = __ior__ = clear = pop = popitem = setdefault = update = _refuse

    def __reduce__(self) -> tuple[Any, ...]:
        return read_only, (dict(self),)


def read_only(value: Any) -> Any:
    """Return arrays and mappings, also those in mappings, as copies that refuse changes; other values as they are."""
    if isinstance(value, Mapping):
        return ReadOnly({key: read_only(item) for key, item in value.items()})
    if isinstance(value, np.ndarray) and _can_change(value):
        value = value.copy()
        value.flags.writeable = False
    return value


def _can_change(array: np.ndarray) -> bool:
    """Return whether an array, or one whose memory it uses, can be written to."""
    return bool(array.flags.writeable or array.base is not None)


def _code_points(name: str) -> str:
    return " ".join(f"U+{ord(letter):04X}" for letter in name[:MOST_LISTED])


def _listed(names: Iterable[str]) -> str:
    return ", ".join(map(repr, names))


def shortened(value: Any) -> str:
    """Return the representation of a value on one line, without the middle part if it is long."""
    return " ".join(reprlib.repr(value).split())


def checked_units(units: Mapping[str, str] | None, names: Iterable[str]) -> dict[str, str]:
    """Return units by name; raise a ValueError for other names and for what is no text."""
    result = optional_mapping("units", units, "{'force': 'N'}")
    for name, unit in result.items():
        one_of("units", name, names)
        text(f"units[{name!r}]", unit)
    return result
