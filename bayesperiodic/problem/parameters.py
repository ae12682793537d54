"""Parameters of a model that are free, fixed or tied, and names of parameters and their draws.

A parameter local to an experiment is called ``theta16[run 7]``; its draws are one place of a variable with the dim
"experiment". The parameters of sensors are called ``delay[force]``, local ones ``delay[force, run 7]``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesperiodic import _checks
from bayesperiodic._expressions import Expression, parse
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.models.sensed import SHIFT

if TYPE_CHECKING:
    import xarray as xr

CHAIN, DRAW, CHANNEL, EXPERIMENT = "chain", "draw", "channel", "experiment"
NOISE = "noise"


def local_name(name: str, experiment: str) -> str:
    """Return what a parameter local to an experiment is called, ``theta16[run 7]`` or ``delay[force, run 7]``."""
    return f"{name[:-1]}, {experiment}]" if name.endswith("]") else f"{name}[{experiment}]"


def expand_priors(
    priors: Mapping[Any, Any],
    local: Sequence[str],
    experiments: Sequence[str],
    fixed: Mapping[str, Mapping[str, float]],
) -> dict[Any, Any]:
    """Return the priors with every local parameter's given once for each experiment that has no fixed value of it."""
    result: dict[Any, Any] = {}
    for key, prior in priors.items():
        if key in local:
            names = [local_name(key, e) for e in experiments if e not in fixed.get(key, {})]
            result |= {name: prior for name in names if name not in priors}
        else:
            result[key] = prior
    return result


def plain_names(names: Iterable[str], local: Iterable[str], experiments: Iterable[str]) -> dict[str, str]:
    """Return the plain names of parameters by their full names: k by k, and theta16 by ``theta16[run 7]``."""
    plain_by_name = {local_name(plain, run): plain for plain in local for run in experiments}
    return {name: plain_by_name.get(name, name) for name in names}


def check_delays(experiments: Iterable[Experiment], known: Iterable[str]) -> None:
    """Raise a ValueError unless the delays of channels of other clocks are known or parameters.

    A delay of all outputs is enough if they have one clock, and so have the inputs.
    """
    names = [*known]
    for e in experiments:
        clock = {channel: name for name, channels in e.clocks.items() for channel in channels}
        whole = all(len({clock.get(channel) for channel in kind}) <= 1 for kind in (e.inputs, e.outputs))
        if whole and (SHIFT in names or local_name(SHIFT, e.name) in names):
            continue
        for channel in clock:
            if not any(name == f"delay[{channel}]" or name.startswith(f"delay[{channel}, ") for name in names):
                all_late = f"priors={{{SHIFT!r}: bp.Uniform(…)}} for all outputs or " if whole else ""
                raise ValueError(
                    f"experiments: must have known delays or free ones, got {e.name!r}, in which {channel!r} has "
                    f"another clock ({clock[channel]!r}), so that its delay is unknown; give {all_late}"
                    f"sensors={{{channel!r}: bp.Sensor(delay=…)}}, with a prior of plus or minus half a period "
                    f"({0.5 * e.periods / e.frequency:.3g} s) if the loggers have no common start."
                )


def free_names(parameters: Iterable[str], local: Iterable[str], experiments: Iterable[str]) -> list[str]:
    """Return every name that a free parameter may have, in order."""
    result: list[str] = []
    for name in (*parameters, SHIFT):
        if name in local:
            result += [local_name(name, experiment) for experiment in experiments]
        elif name != SHIFT:
            result.append(name)
    return result


@dataclass(frozen=True)
class ParameterMap:
    """Map from θ, the free parameters of all experiments, to all parameters of one experiment."""

    parameters: tuple[str, ...]  # the model's, those of sensors, and last "shift", the delay of all outputs [s]
    count: int  # number of the model's
    columns: dict[str, int]  # places of this experiment's free ones in θ
    size: int  # length of θ
    fixed: dict[str, float]
    tied: dict[str, Expression]  # each only of parameters that are free, fixed or tied before it

    @classmethod
    def of(
        cls,
        parameters: tuple[str, ...],
        sensors: tuple[str, ...],
        names: tuple[str, ...],
        experiment: str,
        fixed_by_run: Mapping[str, Mapping[str, float]],
        tied: Mapping[str, Any],
    ) -> ParameterMap:
        """Return the checked map of an experiment; `names` are those of θ, `sensors` parameters of sensors."""
        fixed = {name: values[experiment] for name, values in fixed_by_run.items() if experiment in values}
        every = (*parameters, *sensors, SHIFT)
        columns = {name: names.index(n) for name in every for n in (name, local_name(name, experiment)) if n in names}
        for name in tied:
            _checks.one_of("tied", name, every)
            for argument, others in (("priors", columns), ("fixed", fixed)):
                if name in others:
                    raise ValueError(f"tied: {name!r} is in {argument} too; a parameter is free, fixed or tied.")
        known = {SHIFT: 0.0} if SHIFT not in columns and SHIFT not in tied else {}
        known |= fixed
        if without := [n for n in every if n not in columns and n not in known and n not in tied]:
            raise ValueError(
                f"priors: {', '.join(map(repr, without))} has neither a prior nor a value in experiment "
                f"{experiment!r}; a free parameter needs a prior, any other a value in `fixed` or an expression in "
                "`tied`."
            )
        expressions = {name: parse(f"tied[{name!r}]", text, every) for name, text in tied.items()}
        return cls(every, len(parameters), columns, len(names), known, _ordered(expressions))

    @property
    def delayed(self) -> bool:
        """Whether the outputs may be late."""
        return SHIFT in self.columns or SHIFT in self.tied or self.fixed[SHIFT] != 0.0

    def values(self, theta: np.ndarray) -> np.ndarray:
        """Return all parameters (points, parameters) of θ (points, names)."""
        return self._alone.values(theta)[0]

    def split(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the parameters of the model and those of the sensors at one θ (names,)."""
        values = self.values(theta[None])[0]
        return np.ascontiguousarray(values[: self.count]), values[self.count :]

    @cached_property
    def _alone(self) -> ParameterMaps:
        return ParameterMaps([self])

    def slopes(self, theta: np.ndarray) -> np.ndarray:
        """Return ∂(all parameters)/∂θ at one θ (names,), (parameters, names)."""
        nothing = np.zeros(self.size)
        by_name = {name: np.eye(1, self.size, i)[0] for name, i in self.columns.items()}
        known: dict[str, Any] = {**self.fixed, **{name: float(theta[i]) for name, i in self.columns.items()}}
        for name, expression in self.tied.items():
            gradient = expression.gradient(known)
            by_name[name] = sum((float(slope) * by_name[n] for n, slope in gradient.items() if n in by_name), nothing)
            known[name] = float(expression.value(known))
        return np.stack([by_name.get(name, nothing) for name in self.parameters])


class ParameterMaps:
    """Maps of several experiments with the same free and tied parameters, whose indices are `moving`."""

    def __init__(self, maps: Sequence[ParameterMap]):
        first = maps[0]
        self._tied, self._size, self.count = first.tied, first.size, first.count
        self._fixed = np.array([[m.fixed.get(name, np.nan) for name in first.parameters] for m in maps])
        self._places = np.array([first.parameters.index(name) for name in first.columns], dtype=int)
        self._columns = np.array([[m.columns[name] for name in first.columns] for m in maps], dtype=int)
        named = {name for expression in self._tied.values() for name in expression.names} | self._tied.keys()
        self._named = {name: i for i, name in enumerate(first.parameters) if name in named}
        free = {*first.columns, *self._tied}
        self._rows = np.arange(len(maps))[:, None]
        self.moving = tuple(i for i, name in enumerate(first.parameters[: self.count]) if name in free)

    def values(self, theta: np.ndarray) -> np.ndarray:
        """Return all parameters (maps, points, parameters) of θ (points, names)."""
        result = np.empty((len(self._fixed), len(theta), self._fixed.shape[1]))
        result[...] = self._fixed[:, None]
        result[:, :, self._places] = theta[:, self._columns].transpose(1, 0, 2)
        if self._tied:
            known = {name: result[..., i] for name, i in self._named.items()}
            for name, expression in self._tied.items():
                known[name][:] = expression.value(known)
        return result

    def vjp(self, values: np.ndarray, by_parameter: np.ndarray) -> np.ndarray:
        """Return derivatives by θ, (maps, names), from those by all parameters, (maps, parameters)."""
        left, result = by_parameter.copy(), np.zeros((len(by_parameter), self._size))
        if self._tied:
            known = {name: values[:, i] for name, i in self._named.items()}
            for name, expression in reversed(self._tied.items()):
                for argument, slope in expression.gradient(known).items():
                    left[:, self._named[argument]] += slope * left[:, self._named[name]]
        result[self._rows, self._columns] = left[:, self._places]
        return result


def _ordered(expressions: dict[str, Expression]) -> dict[str, Expression]:
    """Return the expressions such that each comes after those that it names."""
    result: dict[str, Expression] = {}
    while len(result) < len(expressions):
        ready = [
            name
            for name, expression in expressions.items()
            if name not in result and all(n not in expressions or n in result for n in expression.names)
        ]
        if not ready:
            circle = {name: e.text for name, e in expressions.items() if name not in result}
            raise ValueError(f"tied: must not be circular, got {circle!r}.")
        result |= {name: expressions[name] for name in ready}
    return result


def full_name(variable: str, place: Sequence[str]) -> str:
    """Return what one place of a variable is called: k, or variance[force, run 7]."""
    if not place:
        return variable
    labels = ", ".join(place)
    return f"{variable[:-1]}, {labels}]" if variable.endswith("]") else f"{variable}[{labels}]"


def pack(
    shape: tuple[int, ...],
    columns: Mapping[str, Callable[[], np.ndarray | float]],
    dims: Mapping[str, Sequence[str]],
    coords: Mapping[str, Sequence[str]],
) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """Return variables, dims and values (chain, draw, …), made of what returns the columns (chain, draw) by full name.

    `dims` are those of each variable after chain and draw, `coords` the names along each. Values without a column are
    NaN.
    """
    packed = {}
    for variable, further in dims.items():
        places = list(product(*(coords[dim] for dim in further)))
        values = np.full((*shape, len(places)), np.nan)
        for i, place in enumerate(places):
            if (name := full_name(variable, place)) in columns:
                values[..., i] = columns[name]()
        sizes = [len(coords[dim]) for dim in further]
        packed[variable] = (CHAIN, DRAW, *further), values.reshape(*shape, *sizes)
    return packed


def places(group: xr.Dataset) -> dict[str, tuple[str, dict[str, str]]]:
    """Return where everything is that the draws hold, by full name: the variable, and its place by dim."""
    result = {}
    for key, values in group.data_vars.items():
        first, variable = values.isel({CHAIN: 0, DRAW: 0}), str(key)
        dims = [dim for dim in (CHANNEL, EXPERIMENT) if dim in first.dims]
        for place in product(*(group[dim].values.tolist() for dim in dims)):
            at = dict(zip(dims, place, strict=True))
            if not np.isnan(float(first.sel(at))):
                result[full_name(variable, place)] = (variable, at)
    return result


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


def support(group: xr.Dataset, name: str) -> tuple[float, float]:
    """Return the support of what has this full name; of draws without it the positive half-line if all are positive."""
    variable, _ = places(group)[name]
    given = group[variable].attrs.get(f"support of {name}")
    low, high = (0.0 if (column(group, name) > 0.0).all() else -np.inf, np.inf) if given is None else given
    return float(low), float(high)


def squared(unit: str) -> str:
    """Return the unit of a variance: N², (m/s)², or 1."""
    return unit if unit == "1" else f"{unit}²" if unit.isalpha() else f"({unit})²"


def in_experiment(names: Iterable[str], experiment: str | None) -> dict[str, str]:
    """Return full names by the plain names that they have within one experiment; without it the shared ones."""
    result = {}
    for name in names:
        plain, _, label = name.partition("[")
        if not label or label[:-1] == experiment:
            result[plain] = name
    return result


def local_names(names: Iterable[str], experiments: Iterable[str]) -> tuple[str, ...]:
    """Return the plain names of the model's parameters that experiments have their own of."""
    ends = tuple(f"[{experiment}]" for experiment in experiments)
    return tuple(dict.fromkeys(name.partition("[")[0] for name in names if name.endswith(ends)))


def local_hint(names: Iterable[str], experiments: Iterable[str], experiment: str | None) -> str:
    """Return what to say of expressions that name a local parameter but no experiment."""
    local = local_names(names, experiments)
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
