"""Rows of the sampling study: what must show, the value found, the limits allowed, and whether they are met."""

from __future__ import annotations

import math
from typing import Any

import pandas as pd

Row = dict[str, Any]


def row(what: str, value: float | None, low: float, high: float | None, note: str = "") -> Row:
    """Return a row of results.json, `high` None if nothing is too high; without a value there is no verdict."""
    value = None if value is None or math.isnan(value) else float(value)
    met = None if value is None else value >= low and (high is None or value <= high)
    return {"what": what, "value": value, "low": low, "high": high, "met": met, "note": note}


def unjudged(entry: Row, why: str) -> Row:
    """Return a row that keeps its value and has no verdict."""
    return entry | {"met": None, "note": why}


def table(rows: list[Row]) -> str:
    """Return rows as text, notes below."""
    verdicts, lines = {True: "yes", False: "NO", None: "-"}, []
    notes = list(dict.fromkeys(entry["note"] for entry in rows if entry["note"]))
    for entry in rows:
        mark = f" ({notes.index(entry['note']) + 1})" if entry["note"] else ""
        low, high = entry["low"], entry["high"]
        value = "-" if entry["value"] is None else f"{entry['value']:.4g}"
        if low == high:
            allowed = f"{low:g}"
        elif high is None:
            allowed = f"≥ {low:g}"
        else:
            allowed = f"≤ {high:g}" if low == 0.0 else f"{low:g} … {high:g}"
        lines.append({"": verdicts[entry["met"]], "what": entry["what"] + mark, "found": value, "allowed": allowed})
    shown = pd.DataFrame(lines).to_string(index=False)
    return "\n".join([shown, *(f"  ({i}) {note}" for i, note in enumerate(notes, start=1))])
