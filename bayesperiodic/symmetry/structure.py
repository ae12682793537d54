"""Structural identifiability: parameters and combinations that the equations and measured channels can determine."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import sympy as sp

from bayesperiodic import _checks
from bayesperiodic._io import Result, Storable
from bayesperiodic.models.model import Model
from bayesperiodic.models.sensed import with_sensed_inputs
from bayesperiodic.symmetry import invariants
from bayesperiodic.symmetry.centres import has_centres
from bayesperiodic.symmetry.determining import (
    Generator,
    System,
    VectorField,
    determining_equations,
    generators_of,
    system_of,
)
from bayesperiodic.symmetry.discrete import discrete_flows
from bayesperiodic.symmetry.invariants import Directions, Flow
from bayesperiodic.symmetry.sensors import DELAY_OF, with_sensors

if TYPE_CHECKING:
    import pandas as pd


@runtime_checkable
class SensorEntries(Protocol):
    """What is needed of a sensor."""

    order: int

    def acting(self) -> Iterator[tuple[str, Any]]:
        """Yield the kinds of the entries that change the signal, with their values, numbers where they are known."""


@dataclass(frozen=True)
class Symmetry(Storable):
    """Transformation of parameters, and of states that are not measured, that leaves all measured outputs unchanged.

    Its kind is "scaling", "shift" (which adds a constant to a parameter or a state, and may also transform others) or
    "other"; of discrete ones "sign change" or "exchange", without generator and amount. The finite transformation is
    confirmed by exact substitution in the equations.
    """

    kind: str
    parameters: tuple[str, ...]  # those that change; fixing any one of them removes the symmetry
    generator: dict[str, str]  # infinitesimal changes by parameter or state
    transformation: dict[str, str]  # images by parameter or state; empty if no closed form was found
    amount: str  # name of the group parameter: a factor > 0 for scalings, otherwise a number, 0 for the identity
    factor: tuple[tuple[str, ...], ...]  # matrix by which the transformation multiplies the equations
    no_help: tuple[str, ...]  # parameters in the same combinations that do not remove the symmetry if they are fixed

    def __repr__(self) -> str:
        if self.transformation:
            return f"{self.kind}: {', '.join(f'{name} -> {image}' for name, image in self.transformation.items())}"
        changes = ", ".join(f"d({name}) = {move}" for name, move in self.generator.items())
        return f"{self.kind}: {changes} (infinitesimally; no closed form found)"


@dataclass(frozen=True)
class Structure(Result):
    """Structural identifiability of a model: the parameters and combinations that the outputs can determine.

    Attributes
    ----------
    model : str
        Name of the model.
    outputs, known : tuple of str
        The measured outputs, and the parameters assumed to be known.
    table : DataFrame
        One row per unknown parameter. verdict: "determined", "only in combination", "not determined" (in no combination
        either) or "does not appear"; enters: the combinations that contain it (for a determined parameter, the
        coefficients without undetermined ones); fix: numbers, from 1, of the symmetries that fixing it removes;
        partners: other parameters, any one of which determines it if known.
    combinations : tuple of str
        Independent identifiable combinations of the parameters that are not determined; expressions for `derive`. With
        `unexplained` directions they are confirmed at random values only.
    symmetries : tuple of Symmetry
        Independent ones.
    discrete : tuple of Symmetry
        Independent sign changes that are no scaling by −1, and exchanges of two determined parameters.
    to_fix : tuple of str
        The first parameters, in the model's order, that remove all symmetries if they are fixed.
    rank, points : int or None, int
        Rank of exact sensitivities of the outputs to the parameters that appear (None if it could not be computed), and
        number of random parameter values.
    unexplained : tuple of str
        Parameters in directions without sensitivity that no symmetry found explains.
    centres : bool
        True if the model is autonomous and its cycles are not isolated, as those of conservative models: at random
        parameter values an equilibrium is surrounded by cycles of different amplitudes. The verdicts then hold for
        records of motions, but `solve_periodic` and `map_estimate` find no unique cycle.

    Examples
    --------
    >>> found = bp.structure(bp.models.duffing, fixed=["k"])
    >>> found.complete, found.table["verdict"].to_dict()
    (True, {'m': 'determined', 'c': 'determined', 'k3': 'determined'})
    >>> swing = bp.structure(bp.models.pendulum, fixed=["a", "g", "v0"])
    >>> swing.symmetries
    (scaling: m -> m*t, k1 -> k1*t, k2 -> k2*t, k3 -> k3*t,)
    """

    model: str
    outputs: tuple[str, ...]
    known: tuple[str, ...]
    table: pd.DataFrame
    combinations: tuple[str, ...]
    symmetries: tuple[Symmetry, ...]
    discrete: tuple[Symmetry, ...]
    to_fix: tuple[str, ...]
    rank: int | None
    points: int
    unexplained: tuple[str, ...]
    centres: bool = False

    @property
    def complete(self) -> bool:
        """True if the rank confirms that there is no symmetry but those found."""
        return self.rank is not None and not self.unexplained

    def __repr__(self) -> str:
        known = f"; known: {', '.join(self.known)}" if self.known else ""
        lines = [f"Structure of {self.model}, measured: {', '.join(self.outputs)}{known}"]
        lines += self._families() + self._verdicts() + self._changes() + self._discrete_changes()
        return "\n".join([*lines, f"  {self._confirmation()}"])

    def _families(self) -> list[str]:
        if not self.centres:
            return []
        return [
            "  Cycles are not isolated: for the same parameters there are others near each, as in conservative models.",
            "  What follows holds for motions in time, not for a fit of periodic solutions, whose amplitude the",
            "  parameters do not determine. Add the damping and the drive that select it.",
        ]

    def _verdicts(self) -> list[str]:
        named = {v: list(self.table.index[self.table["verdict"] == v]) for v in self.table["verdict"].unique()}
        lines = []
        if names := named.get("determined"):
            lines.append(f"  Determined: {', '.join(map(self._through, names))}.")
        if names := named.get("only in combination"):
            missing = len(names) - len(self.to_fix) - len(self.combinations)
            more = f" and {missing} more without a closed form" * (missing > 0)
            forms = f", which enter only by {', '.join(self.combinations)}{more}" if self.combinations else ""
            lines.append(f"  Only in combination: {', '.join(names)}{forms}.")
        for verdict in ("not determined", "does not appear"):
            if names := named.get(verdict):
                lines.append(f"  {verdict.capitalize()}: {', '.join(names)}.")
        return lines

    def _through(self, name: str) -> str:
        """Return a determined parameter, with the coefficients that determine it if combinations contain it too."""
        terms = str(self.table.at[name, "enters"])
        shared = any(name in symmetry.no_help for symmetry in self.symmetries)
        return f"{name} through {_listed(terms.split('; '), 'and')}" if shared and terms else name

    def _changes(self) -> list[str]:
        if not self.symmetries:
            return []
        lines = ["  Changes that leave the equations and the outputs as they are, confirmed by exact substitution:"]
        for number, symmetry in enumerate(self.symmetries, 1):
            wanted = "" if len(symmetry.parameters) == 1 else "one of "
            helpless = f"; fixing {_listed(symmetry.no_help, 'or')} does not help" if symmetry.no_help else ""
            lines += [f"    {number}. {symmetry!r}", f"       Fix {wanted}{', '.join(symmetry.parameters)}{helpless}."]
        if len(self.to_fix) == 1:
            return lines
        lines.append(f"  {len(self.to_fix)} parameters must be fixed, for example {_listed(self.to_fix, 'and')}.")
        order = list(self.table.index)
        groups = {tuple(sorted((n, *p.split(", ")), key=order.index)) for n, p in self.table["partners"].items() if p}
        if groups:
            listed = [", ".join(group) for group in sorted(groups, key=lambda g: order.index(g[0]))]
            lines.append(f"  Knowing one of a group determines the rest of it: {'; '.join(listed)}.")
        return lines

    def _discrete_changes(self) -> list[str]:
        if not self.discrete:
            return []
        lines = ["  Discrete changes that do the same; priors have to decide between the values:"]
        return lines + [f"    {change!r}" for change in self.discrete]

    def _confirmation(self) -> str:
        if self.rank is None:
            return "The rank of exact sensitivities is not available, so further symmetries are not ruled out."
        appearing = int((self.table["verdict"] != "does not appear").sum())
        if not appearing:
            return "No unknown parameter appears."
        said = f"Rank of exact sensitivities at {self.points} random parameter values: {self.rank} of {appearing}"
        if self.unexplained:
            return f"{said}; further changes, for which no form was found, involve {', '.join(self.unexplained)}."
        return f"{said}, so no other continuous change leaves the outputs as they are."


def _listed(names: Sequence[str], conjunction: str) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {conjunction} {names[-1]}"


def written(expression: sp.Expr, names: Mapping[sp.Symbol, str]) -> str:
    """Return an expression as text such as "k1/(m*l**2)", with factors and terms in the order of the names."""
    number, rest = sp.factor_terms(expression).as_coeff_Mul()
    negative = number.is_negative
    above = [(sp.Integer(abs(number.p)), sp.S.One)] if abs(number.p) != 1 else []
    below = [(sp.Integer(number.q), sp.S.One)] if number.q != 1 else []
    for factor in sorted(sp.Mul.make_args(rest), key=lambda f: _place(f, names)):
        base, power = (factor, sp.S.One) if isinstance(factor, sp.exp) else factor.as_base_exp()
        if base.is_Add and power.is_Integer and _terms(base, names)[0].as_coeff_Mul()[0] < 0:
            base, negative = -base, negative ^ (power.is_odd)
        if base != 1:
            rational = power.is_Rational
            (below if rational and power < 0 else above).append((base, abs(power) if rational else power))
    several = len(above) + len(below) > 1 or bool(negative)
    upper = "*".join(_power(base, power, names, several) for base, power in above) or "1"
    lower = "*".join(_power(base, power, names, True) for base, power in below)
    fraction = upper if not below else f"{upper}/{lower}" if len(below) == 1 else f"{upper}/({lower})"
    return f"-{fraction}" if negative else fraction


def _terms(total: sp.Expr, names: Mapping[sp.Symbol, str]) -> list[sp.Expr]:
    return sorted(total.args, key=lambda term: (len(term.free_symbols), _place(term, names)))


def _place(factor: sp.Expr, names: Mapping[sp.Symbol, str]) -> tuple[bool, int, str]:
    first = next((k for k, symbol in enumerate(names) if factor.has(symbol)), len(names) if factor.free_symbols else -1)
    return not factor.as_base_exp()[0].is_Symbol, first, str(factor)


def _power(base: sp.Expr, power: sp.Expr, names: Mapping[sp.Symbol, str], beside: bool) -> str:
    if base.is_Add:
        first, *others = [written(term, names) for term in _terms(base, names)]
        text = first + "".join(f" - {t[1:]}" if t.startswith("-") else f" + {t}" for t in others)
    elif base.is_Function:
        text = f"{base.func.__name__.lower()}({', '.join(written(a, names) for a in base.args)})"
    else:
        text = str(base.xreplace({s: sp.Symbol(n) for s, n in names.items()}))
    if power == 1:
        return f"({text})" if base.is_Add and beside else text
    exponent = str(power) if power.is_Integer else f"({written(power, names)})"
    return f"{text}**{exponent}" if base.is_Atom or base.is_Function else f"({text})**{exponent}"


def structure(
    model: Model,
    *,
    outputs: Iterable[str] | None = None,
    fixed: Mapping[str, float] | Iterable[str] = (),
    sensors: Mapping[str, SensorEntries] | None = None,
) -> Structure:
    """Analyse structural identifiability: find the parameters and combinations that the outputs can determine.

    The analysis assumes unlimited data without noise, arbitrary inputs, frequencies and motions, and generic parameter
    values. A parameter that is not determined here cannot be determined by any experiment; the converse depends on the
    data. "Determined" means up to discrete changes. Of these, changes of signs are found, and exchanges of two
    parameters, alone or with two states; others, such as the order of three masses, are not searched for.

    Two methods are combined. The first finds Lie symmetries [1]_ [2]_, affine in states and inputs: transformations of
    parameters and states that map solutions to solutions and leave outputs, inputs and time unchanged. They satisfy
    linear equations, which are solved exactly over the rational functions of the parameters; a finite transformation
    is accepted only if substitution in the symbolic equations confirms it. The second computes the rank of exact
    sensitivities of the outputs' Taylor coefficients at random values, which bounds the number of symmetries of any
    kind [3]_. If the rank and the number of symmetries add up to the number of parameters, the result is complete.
    Sensitivities do not detect the dependence of a discontinuity on a parameter; no rank is returned in this case.

    Parameters
    ----------
    model : Model
    outputs : iterable of str, optional
        The measured outputs; by default all.
    fixed : iterable of str, or mapping of str to number, optional
        Known parameters. A value of zero removes their terms; any other value is treated as generic.
    sensors : mapping of str to Sensor, optional
        Of outputs and inputs, as those of a `Problem`. Entries that are priors are unknown parameters, numbers are
        known.

    Returns
    -------
    Structure

    Raises
    ------
    ValueError
        For an unknown output or parameter, no output, a value of zero that the equations divide by, or a sensor of
        something else.

    References
    ----------
    .. [1] J. W. T. Yates, N. D. Evans, M. J. Chappell, Structural identifiability analysis via symmetries of
       differential equations, Automatica 45, 2009, 2585-2591.
    .. [2] B. Merkt, J. Timmer, D. Kaschek, Higher-order Lie symmetries in identifiability and predictability analysis
       of dynamic models, Physical Review E 92, 2015, 012920.
    .. [3] A. Sedoglavic, A probabilistic algorithm to test local algebraic observability in polynomial time, Journal
       of Symbolic Computation 33, 2002, 735-755.

    Examples
    --------
    >>> found = bp.structure(bp.models.pendulum, fixed=["a", "g", "v0"])
    >>> found.combinations
    ('k1/(m*l**2)', 'k2/(m*l**2)', 'k3/(m*l**2)')
    >>> found.table.verdict["l"]
    'determined'
    >>> unknown = {"force": bp.Sensor(gain=bp.LogNormal(1.0, 0.1))}
    >>> bp.structure(bp.models.duffing, sensors=unknown).combinations
    ('c/m', 'k/m', 'k3/m', '1/(m*gain[force])')
    """
    _checks.instance("model", model, Model)
    measured = model.outputs if outputs is None else tuple(outputs)
    for name in measured:
        _checks.one_of("outputs", name, model.outputs)
    if not measured:
        raise ValueError("outputs: must have at least one name, got none.")
    known = tuple(fixed)
    for name in known:
        _checks.one_of("fixed", name, model.parameters)
    values = dict(fixed) if isinstance(fixed, Mapping) else {}
    zeros = [name for name, value in values.items() if _checks.finite_number(f"fixed[{name!r}]", value) == 0.0]
    unknown = _unknown_entries(model, measured, sensors or {})
    orders = {channel: sensor.order for channel, sensor in (sensors or {}).items()}
    of_inputs = {channel: kinds for channel, kinds in unknown.items() if channel in model.inputs}
    whole = system_of(with_sensed_inputs(model, of_inputs, orders, {}), measured)
    system = whole.given(known, {whole.parameters[name]: sp.S.Zero for name in zeros})
    for name in zeros:
        if any(e.has(sp.zoo, sp.nan, sp.oo) for e in system.expressions):
            raise ValueError(f"fixed: must not be zero if the equations divide by it, got {name} = 0.")
    system = with_sensors(system, unknown, orders) if unknown else system
    return replace(analyse_structure(model.name, system, known), centres=has_centres(model, zeros))


def _unknown_entries(
    model: Model, measured: Sequence[str], sensors: Mapping[str, SensorEntries]
) -> dict[str, tuple[str, ...]]:
    """Return the kinds of the unknown entries of sensors by channel."""
    result: dict[str, tuple[str, ...]] = {}
    for channel, sensor in sensors.items():
        _checks.one_of("sensors", channel, (*measured, *model.inputs))
        if not isinstance(sensor, SensorEntries):
            raise ValueError(f"sensors[{channel!r}]: must be a Sensor, got {_checks.shortened(sensor)}.")
        kinds = tuple(kind for kind, value in sensor.acting() if not isinstance(value, float))
        result |= {channel: kinds} if kinds else {}
    return result


def analyse_structure(name: str, whole: System, known: tuple[str, ...]) -> Structure:
    """Return the structure of a symbolic system, whose parameters may have been replaced by expressions."""
    used = whole.used
    system = replace(whole, parameters={n: s for n, s in whole.parameters.items() if s in used})
    names = whole.names
    symmetries = generators_of(determining_equations(system)) if system.parameters else []
    found_flows = [invariants.flow_of(system, symmetry) for symmetry in symmetries]
    flows = [flow and invariants.verified(system, flow) for flow in found_flows]
    generators = [flow.generator if flow else symmetry for symmetry, flow in zip(symmetries, flows, strict=True)]
    directions = invariants.directions_of(system, generators)
    coefficients = invariants.coefficients_of(system)
    invariant = invariants.combinations_of(system, generators, [f for f in flows if f], directions, coefficients)
    combinations = {c: written(c, names).removeprefix("-") for c in invariant}
    settled = [n for n in system.parameters if n not in directions.moved]
    discrete = discrete_flows(system, generators, settled) if system.parameters else []
    return Structure(
        model=name,
        outputs=tuple(name for name in system.outputs if not name.startswith(DELAY_OF)),
        known=known,
        table=_table(whole, generators, directions, coefficients, combinations),
        combinations=tuple(combinations.values()),
        symmetries=tuple(
            _symmetry(whole, _kind(symmetry), generator.field, flow, combinations)
            for symmetry, generator, flow in zip(symmetries, generators, flows, strict=True)
        ),
        discrete=tuple(_symmetry(whole, _discrete_kind(flow), {}, flow) for flow in discrete),
        to_fix=directions.smallest_set(),
        rank=len(system.parameters) - len(directions.rows) if directions.points or not system.parameters else None,
        points=directions.points,
        unexplained=directions.unexplained,
    )


def _kind(generator: Generator) -> str:
    if generator.scaling:
        return "scaling"
    return "shift" if any(move.is_number for move in generator.field.values()) else "other"


def _discrete_kind(flow: Flow) -> str:
    return "sign change" if all(image == -symbol for symbol, image in flow.images.items()) else "exchange"


def _table(
    whole: System,
    generators: Sequence[Generator],
    directions: Directions,
    coefficients: Mapping[sp.Expr, bool],
    combinations: Mapping[sp.Expr, str],
) -> pd.DataFrame:
    import pandas as pd

    moved = directions.moved
    unsure = {whole.parameters[n] for n in moved}
    rows = {}
    for parameter, symbol in whole.parameters.items():
        verdict, enters, partners = "determined", [t for c, t in combinations.items() if symbol in c.free_symbols], []
        if parameter not in directions.names:
            verdict = "does not appear"
        elif parameter in moved:
            alone = directions.alone(parameter)
            verdict = "not determined" if alone else "only in combination"
            partners = [] if alone else directions.partners(parameter)
        else:
            shown = [c for c in coefficients if symbol in c.free_symbols and not c.free_symbols & unsure]
            shown = [] if any(c.free_symbols == {symbol} for c in shown) else shown
            shown.sort(key=lambda c: not coefficients[c])
            enters = [written(c, whole.names).removeprefix("-") + " (in the drive)" * coefficients[c] for c in shown]
        rows[parameter] = {
            "verdict": verdict,
            "enters": "; ".join(enters),
            "fix": ", ".join(str(i) for i, g in enumerate(generators, 1) if symbol in g.field),
            "partners": ", ".join(partners),
        }
    return pd.DataFrame.from_dict(rows, orient="index", columns=["verdict", "enters", "fix", "partners"])


def _symmetry(
    system: System,
    kind: str,
    field: VectorField,
    flow: Flow | None,
    combinations: Iterable[sp.Expr] = (),
) -> Symmetry:
    states = {state: system.symbols[state] for state in system.orders}
    images = flow.images if flow else {}
    moved = {n: s for n, s in (system.parameters | states).items() if s in field or s in images}
    shared = [c.free_symbols for c in combinations if c.free_symbols & set(field)]
    texts = {**system.names, **{symbol: name for name, symbol in system.symbols.items()}}
    amount = ""
    if flow and field:
        wanted = ("t", "scale", "scale_factor") if flow.amount.is_positive else ("delta", "shift_by", "amount")
        amount = next(n for n in wanted if n not in texts.values())
        texts[flow.amount] = amount
    rows = flow.factor.tolist() if flow and flow.factor else []
    return Symmetry(
        kind=kind,
        parameters=tuple(n for n in moved if n in system.parameters),
        generator={n: written(field[s], texts) for n, s in moved.items() if s in field},
        transformation={n: written(images[s], texts) for n, s in moved.items() if s in images},
        amount=amount,
        factor=tuple(tuple(written(e, texts) for e in row) for row in rows),
        no_help=tuple(n for n, s in system.parameters.items() if n not in moved and any(s in c for c in shared)),
    )
