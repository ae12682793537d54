"""Structural identifiability: which parameters the equations and the measured channels can determine at all."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import pandas as pd
import sympy as sp

from bayesperiodic import checks
from bayesperiodic.models.model import Model
from bayesperiodic.models.structure.determining import determining_equations
from bayesperiodic.models.structure.directions import Directions, directions_of
from bayesperiodic.models.structure.flow import Flow, flow_of, verified
from bayesperiodic.models.structure.generators import Generator, generators_of
from bayesperiodic.models.structure.invariants import coefficients_of, combinations_of
from bayesperiodic.models.structure.result import Structure, Symmetry
from bayesperiodic.models.structure.system import System, system_of
from bayesperiodic.models.structure.text import written


def structure(
    model: Model, *, outputs: Iterable[str] | None = None, fixed: Mapping[str, float] | Iterable[str] = ()
) -> Structure:
    """Find which parameters, and which combinations of them, can be determined from the measured outputs at all.

    Everything is taken at its best: no noise, no end of data, any inputs, frequencies and motions, and parameters in
    general position. What is found undetermined here no experiment can determine; the converse needs the data.

    Two searches meet. One is for transformations of the parameters and the states that map solutions to solutions and
    leave outputs, inputs and time alone (Lie symmetries, as in [1]_ [2]_; those of the states affine in states and
    inputs). They obey linear equations, solved exactly over the rational functions of the parameters; a finite
    transformation is accepted only if substitution in the symbolic equations confirms it. The other is the rank of
    exact sensitivities of the outputs' Taylor coefficients at random values, beyond which no symmetry of any kind can
    exist [3]_. Where the two add up to the number of parameters, nothing is left open.

    Parameters
    ----------
    model : Model
    outputs : iterable of str, optional
        The measured ones; by default all.
    fixed : iterable of str, or mapping of str to number, optional
        Parameters that are known. A value of zero removes their terms, any other is taken as general.

    Returns
    -------
    Structure

    Raises
    ------
    ValueError
        For an unknown output or parameter, no output, or a value of zero that the equations divide by.

    Notes
    -----
    "Determined" means up to isolated alternatives: discrete ambiguities, such as the common sign of two factors, are
    not looked for. A jump (not a corner) whose place depends on a parameter is seen by the symmetries but not by the
    sensitivities, so that no rank is given then.

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
    >>> import bayesperiodic as bp
    >>> found = bp.structure(bp.models.pendulum, fixed=["a", "g", "v0"])
    >>> found.combinations
    ('k1/(m*l**2)', 'k2/(m*l**2)', 'k3/(m*l**2)')
    >>> found.table.verdict["l"]
    'determined'
    """
    measured = model.outputs if outputs is None else tuple(outputs)
    for name in measured:
        checks.one_of("outputs", name, model.outputs)
    if not measured:
        raise ValueError("outputs: () is not allowed; at least one must be measured.")
    known = tuple(fixed)
    for name in known:
        checks.one_of("fixed", name, model.parameters)
    values = dict(fixed) if isinstance(fixed, Mapping) else {}
    zeros = [name for name, value in values.items() if checks.finite_number(f"fixed[{name!r}]", value) == 0.0]
    whole = system_of(model, measured)
    system = whole.given(known, {whole.parameters[name]: sp.S.Zero for name in zeros})
    for name in zeros:
        if any(e.has(sp.zoo, sp.nan, sp.oo) for e in (*system.equations, *system.outputs.values())):
            raise ValueError(f"fixed: {name} = 0 is not allowed; the equations divide by it.")
    return analysed(model.name, system, known)


def analysed(name: str, whole: System, known: tuple[str, ...]) -> Structure:
    """Return the structure of a symbolic system, in which parameters may have been replaced by expressions."""
    system = replace(whole, parameters={n: s for n, s in whole.parameters.items() if n in whole.appearing})
    names = {s: n for n, s in (whole.parameters | whole.known).items()}
    kinds, generators, flows = _symmetries(system)
    directions = directions_of(system, generators)
    coefficients = coefficients_of(system)
    found = combinations_of(system, generators, [f for f in flows if f], directions, coefficients)
    combinations = {c: written(c, names).removeprefix("-") for c in found}
    return Structure(
        model=name,
        outputs=tuple(system.outputs),
        known=known,
        table=_table(whole, system, generators, directions, coefficients, combinations, names),
        combinations=tuple(combinations.values()),
        symmetries=tuple(
            _symmetry(system, kind, generator, flow, combinations, names)
            for kind, generator, flow in zip(kinds, generators, flows, strict=True)
        ),
        to_fix=directions.smallest_set(),
        rank=len(system.parameters) - len(directions.rows) if directions.points or not system.parameters else None,
        points=directions.points,
        unexplained=directions.unexplained,
    )


def _symmetries(system: System) -> tuple[list[str], list[Generator], list[Flow | None]]:
    """Return the kinds of the symmetries, their generators and, where there is a closed one, their finite forms."""
    found = generators_of(determining_equations(system)) if system.parameters else []
    flows = [verified(system, flow) if (flow := flow_of(g)) else None for g in found]
    return (
        [_kind(g) for g in found],
        [flow.generator if flow else g for g, flow in zip(found, flows, strict=True)],
        flows,
    )


def _kind(generator: Generator) -> str:
    if generator.weights:
        return "scaling"
    constant = any(move.is_number for move in (*generator.parameters.values(), *generator.states.values()))
    return "shift" if constant else "other"


def _table(
    whole: System,
    system: System,
    generators: Sequence[Generator],
    directions: Directions,
    coefficients: Mapping[sp.Expr, bool],
    combinations: Mapping[sp.Expr, str],
    names: Mapping[sp.Symbol, str],
) -> pd.DataFrame:
    moved = directions.moved
    unsure = {system.parameters[n] for n in moved}
    rows = {}
    for parameter, symbol in whole.parameters.items():
        verdict, enters, partners = "determined", [t for c, t in combinations.items() if symbol in c.free_symbols], []
        if parameter not in system.parameters:
            verdict = "does not appear"
        elif parameter in moved:
            alone = directions.alone(parameter)
            verdict = "not determined" if alone else "only in combination"
            partners = [] if alone else directions.partners(parameter)
        else:
            own = [c for c in coefficients if symbol in c.free_symbols and not c.free_symbols & unsure]
            own = [] if any(c.free_symbols == {symbol} for c in own) else own
            own.sort(key=lambda c: not coefficients[c])
            enters = [written(c, names).removeprefix("-") + " (in the drive)" * coefficients[c] for c in own]
        rows[parameter] = {
            "verdict": verdict,
            "enters": "; ".join(enters),
            "fix": ", ".join(str(i) for i, g in enumerate(generators, 1) if parameter in g.parameters),
            "partners": ", ".join(partners),
        }
    return pd.DataFrame.from_dict(rows, orient="index", columns=["verdict", "enters", "fix", "partners"])


def _symmetry(
    system: System,
    kind: str,
    generator: Generator,
    flow: Flow | None,
    combinations: Mapping[sp.Expr, str],
    names: Mapping[sp.Symbol, str],
) -> Symmetry:
    symbols = system.parameters | {s: system.symbols[s] for s in generator.states}
    moves = generator.parameters | generator.states
    shared = [c.free_symbols for c in combinations if c.free_symbols & {symbols[n] for n in generator.parameters}]
    texts = {**names, **{system.symbols[s]: s for s in (*system.symbols,)}}
    amount = ""
    if flow is not None:
        wanted = ("t", "scale", "scale_factor") if flow.amount.is_positive else ("delta", "shift_by", "amount")
        amount = next(n for n in wanted if n not in texts.values())
        texts[flow.amount] = amount
    return Symmetry(
        kind=kind,
        parameters=tuple(generator.parameters),
        generator={n: written(move, texts) for n, move in moves.items()},
        transformation={n: written(flow.images[symbols[n]], texts) for n in moves} if flow else {},
        amount=amount,
        factor=tuple(tuple(written(e, texts) for e in flow.factor.row(i)) for i in range(flow.factor.rows))
        if flow and flow.factor
        else (),
        no_help=tuple(
            n for n, s in system.parameters.items() if n not in generator.parameters and any(s in c for c in shared)
        ),
    )
