"""Draws by full name: ``theta16[run 7]`` is one place of a variable with the dim "experiment"."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import xarray as xr

from bayesperiodic import _checks

CHAIN, DRAW, CHANNEL, EXPERIMENT = "chain", "draw", "channel", "experiment"
NOISE = "noise"


def full_name(variable: str, place: Sequence[str]) -> str:
    """Return what one place of a variable is called.

    Examples
    --------
    >>> from bayesperiodic.posterior.labels import full_name
    >>> full_name("k", ()), full_name("variance", ("force", "run 7"))
    ('k', 'variance[force, run 7]')
    """
    return f"{variable}[{', '.join(place)}]" if place else variable


def pack(
    columns: Mapping[str, np.ndarray], dims: Mapping[str, Sequence[str]], coords: Mapping[str, Sequence[str]]
) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """Return variables, dims and values (chain, draw, …), made of columns (chain, draw) by full name.

    `dims` are those of each variable after chain and draw, `coords` the names along each. Values without a column are
    NaN.
    """
    shape = next(iter(columns.values())).shape
    packed = {}
    for variable, own in dims.items():
        places = list(product(*(coords[dim] for dim in own)))
        values = np.full((*shape, len(places)), np.nan)
        for i, place in enumerate(places):
            values[..., i] = columns.get(full_name(variable, place), np.nan)
        sizes = [len(coords[dim]) for dim in own]
        packed[variable] = (CHAIN, DRAW, *own), values.reshape(*shape, *sizes)
    return packed


def places(group: xr.Dataset) -> dict[str, tuple[str, dict[str, str]]]:
    """Return where everything is that the draws hold, by full name: the variable, and its place by dim."""
    found = {}
    for key, values in group.data_vars.items():
        first, variable = values.isel({CHAIN: 0, DRAW: 0}), str(key)
        dims = [dim for dim in (CHANNEL, EXPERIMENT) if dim in first.dims]
        for place in product(*(group[dim].values.tolist() for dim in dims)):
            at = dict(zip(dims, place, strict=True))
            if not np.isnan(float(first.sel(at))):
                found[full_name(variable, place)] = (variable, at)
    return found


def column(group: xr.Dataset, name: str) -> np.ndarray:
    """Return the draws (chains, draws) of what has this full name; raise a ValueError if it is unknown."""
    known = places(group)
    _checks.one_of("name", name, known)
    variable, at = known[name]
    return group[variable].sel(at).transpose(CHAIN, DRAW).to_numpy()


def unit(group: xr.Dataset, name: str) -> str:
    """Return the unit of what has this full name; "" where there is none."""
    variable, at = places(group)[name]
    key = f"units of {at[CHANNEL]}" if CHANNEL in at else "units"
    return str(group[variable].attrs.get(key, ""))


def squared(unit: str) -> str:
    """Return the unit of a variance.

    Examples
    --------
    >>> from bayesperiodic.posterior.labels import squared
    >>> squared("N"), squared("m/s")
    ('N²', '(m/s)²')
    """
    return f"{unit}²" if unit.isalpha() else f"({unit})²"


def is_noise(group: xr.Dataset, variable: str) -> bool:
    """Return whether a variable is one of the noise model's."""
    return NOISE in group[variable].attrs


def in_experiment(names: Iterable[str], experiment: str | None) -> dict[str, str]:
    """Return full names by the plain names that they have within one experiment; without it the shared ones.

    Examples
    --------
    >>> from bayesperiodic.posterior.labels import in_experiment
    >>> in_experiment(["k", "theta16[run 7]", "theta16[run 8]"], "run 8")
    {'k': 'k', 'theta16': 'theta16[run 8]'}
    """
    result = {}
    for name in names:
        plain, _, label = name.partition("[")
        if not label or label[:-1] == experiment:
            result[plain] = name
    return result


def local_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return the plain names of the parameters that experiments have their own of."""
    return tuple(dict.fromkeys(name.partition("[")[0] for name in names if "[" in name))


def local_hint(names: Iterable[str], experiment: str | None) -> str:
    """Return what to say of expressions that name a local parameter but no experiment."""
    local = local_names(names)
    if not local or experiment is not None:
        return ""
    return f"Experiments have their own {', '.join(local)}; derive(…, experiment=…) takes those of one."


def checked_key(names: Any, free: Iterable[str], noise: Iterable[str]) -> tuple[str, ...]:
    """Return the names of a joint prior; raise a ValueError unless they are a tuple of different free parameters."""
    if not isinstance(names, tuple) or not names:
        raise ValueError(f"names: must be a tuple of names, such as ('k', 'c'), got {names!r}.")
    for name in names:
        if name in [*noise]:
            raise ValueError(f"names: must be parameters of the model, got the noise parameter {name!r}.")
        _checks.one_of("names", name, free)
        if names.count(name) > 1:
            raise ValueError(f"names: must differ, got {names!r}.")
    return names
