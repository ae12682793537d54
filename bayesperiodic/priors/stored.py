"""Priors as texts that results store: a name of a class of this package and its numbers; nothing is evaluated."""

import json
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from bayesperiodic.priors import single
from bayesperiodic.priors.joint import MultivariateNormal

# Attribute of draws that contains the text.
PRIORS = "priors"
Block = str | tuple[str, ...]

STORABLE: dict[str, Any] = {kind.__name__: kind for kind in (
    single.HalfNormal, single.InverseGamma, single.LogNormal, single.LogUniform, single.Normal, single.StudentT,
    single.TruncatedNormal, single.Uniform, MultivariateNormal,
)}  # fmt: skip


def as_text(blocks: Mapping[Block, Any]) -> str:
    """Return the priors of this package as a text; others, such as those of SciPy, are left out."""
    lines = []
    for key, prior in blocks.items():
        if STORABLE.get(type(prior).__name__) is type(prior):
            values = [np.asarray(getattr(prior, one.name), dtype=float).tolist() for one in fields(prior)]
            lines.append([list(key) if isinstance(key, tuple) else key, type(prior).__name__, values])
    return json.dumps(lines)


def from_text(text: str) -> dict[Block, Any]:
    """Return the priors of `as_text`; of a text of unknown classes, those that are known."""
    lines = json.loads(text) if text else []
    return {tuple(k) if isinstance(k, list) else k: STORABLE[kind](*v) for k, kind, v in lines if kind in STORABLE}
