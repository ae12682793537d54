"""Regression guard: the ratios of a quick run against those kept. Seconds are never compared."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# By which factor a median may be worse; on a shared machine those of a quick run stray by a third, some by more, and
# then the ranges over the repeats overlap.
TOLERANCE = 1.6
OWN = "this package"


def worse(now: Mapping[str, Any], kept: Mapping[str, Any], tolerance: float = TOLERANCE) -> list[str]:
    """Return a line for every ratio whose median is worse now by more than the tolerance, and its best than any kept.

    Contenders are compared by their time over this package's, which must not fall, and this package by its time over
    the floor, which must not rise.
    """
    lines = []
    for name, (new, old) in _pairs(now, kept).items():
        rises = "/ floor" in name
        factor = new["median"] / old["median"] if rises else old["median"] / new["median"]
        apart = new["least"] > old["largest"] if rises else new["largest"] < old["least"]
        if factor > tolerance and apart:
            lines.append(f"{name}: {new['median']:.3g}, kept {old['median']:.3g}, worse by a factor {factor:.2f}")
    return lines


def _pairs(now: Mapping[str, Any], kept: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    new, old = _ratios(now), _ratios(kept)
    return {name: (value, old[name]) for name, value in new.items() if name in old}


def _ratios(found: Mapping[str, Any]) -> dict[str, Mapping[str, float]]:
    result = {
        f"{problem}: {row['name']} / {OWN}": row["ratio"]
        for problem, entry in found["problems"].items()
        for row in entry["rows"]
        if row["ratio"] and not row["name"].startswith(OWN)
    }
    for problem, floor in found["floor"].items():
        for scheme, entry in floor["schemes"].items():
            result |= {f"{problem}, {scheme}: {what} / floor": v for what, v in entry["ratio"].items()}
    return result


def compared(now: Mapping[str, Any], kept: Mapping[str, Any]) -> int:
    """Return how many ratios both runs have."""
    return len(_pairs(now, kept))
