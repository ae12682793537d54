"""Candidate terms that a model may lack: products, absolute values, signs and lags of what it contains."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import dataclass
from itertools import chain, combinations_with_replacement, count
from typing import Any

import numpy as np
import sympy as sp

from bayesperiodic import _checks
from bayesperiodic.models.elements import smooth_abs, smooth_sign
from bayesperiodic.models.model import CondensedModel, Model
from bayesperiodic.models.names import DERIVATIVES, Names, check_derivative_names, with_derivatives
from bayesperiodic.models.units import Unit, parsed, product, unit_of, written

HIGHEST_DEGREE, HIGHEST_POWER = 3, 5
# Widths of smooth absolute values and signs, relative to the standard deviation of their arguments.
ABS_WIDTH, SIGN_WIDTH = 0.02, 0.2
# Characters of a term in the name of its coefficient.
LONGEST_NAME = 30
# Stands in the expression of a term for the state of its lag.
MEMORY = sp.Symbol("s__memory", real=True)
Factors = Mapping[str, sp.Expr]


@dataclass(frozen=True)
class Term:
    """A term that is added to an equation g or an output f with an unknown coefficient.

    The place is the name of the output, or "equation of x" with the name of the state. A term with memory contains
    `MEMORY` with factor one, the solution of lag·ṁ = force − m; the lag [s] is where its estimation starts.
    """

    place: str
    text: str
    expression: sp.Expr
    force: sp.Expr | None = None
    lag: float = np.nan

    def __str__(self) -> str:
        return f"{self.text} in {self.place}"


def generated(model: Model, where: Iterable[str], deviations: Mapping[str, float]) -> list[Term]:
    """Return the terms from the model's own variables, for every place.

    `deviations` are the standard deviations of the variables along the measured orbits, by name; variables that are
    constant are left out.
    """
    if isinstance(model, CondensedModel):
        each = zip(places(model), _elements_variables(model), strict=True)
        of_place = {place: _expressions(variables, {}, deviations)[1] for place, variables in each if place in where}
        return [Term(place, text, e) for place, texts in of_place.items() for text, e in texts.items()]
    moving, expressions = _expressions(*factors(model), deviations)
    plain = [Term(place, text, e) for place in where for text, e in expressions.items()]
    return plain + [
        Term(place, f"lag({name}) - {f'({name})' if ' ' in name else name}", MEMORY - e, e)
        for place in where
        for name, e in (moving | _forces(model, place)).items()
    ]


def _expressions(
    smooth: Factors, steepest: Factors, deviations: Mapping[str, float]
) -> tuple[dict[str, sp.Expr], dict[str, sp.Expr]]:
    """Return the variables that are not constant, and the terms of them, by text."""
    moving = {name: e for name, e in smooth.items() if deviations.get(name, 1.0) > 0.0}
    expressions: dict[str, sp.Expr] = {"1": sp.Integer(1)}
    for degree in range(1, HIGHEST_DEGREE + 1):
        for chosen in combinations_with_replacement(moving, degree):
            expressions[_product(chosen)] = sp.Mul(*(moving[name] for name in chosen))
    for name, e in moving.items():
        expressions |= {f"{name}**{power}": e**power for power in range(HIGHEST_DEGREE + 1, HIGHEST_POWER + 1)}
    widths = {name: deviations.get(name, 1.0) for name in moving}
    for name, e in moving.items():
        # smooth_abs tends to the absolute value less the width, which would change the coefficients of other terms.
        size = smooth_abs(e, ABS_WIDTH * widths[name]) + ABS_WIDTH * widths[name]
        expressions[f"abs({name})"] = size
        expressions |= {f"{other}*abs({name})": factor * size for other, factor in moving.items()}
        expressions[f"sign({name})"] = smooth_sign(e, SIGN_WIDTH * widths[name])
    expressions |= {name: e for name, e in steepest.items() if deviations.get(name, 1.0) > 0.0}
    return moving, expressions


def _elements_variables(model: CondensedModel) -> list[dict[str, sp.Expr]]:
    """Return displacement and velocity of each element of a condensed model, by name."""
    count = len(model.element_names)
    return [
        {DERIVATIVES[order] + name: model.element_motion[order * count + k] for order in range(2)}
        for k, name in enumerate(model.element_names)
    ]


def of_elements(model: CondensedModel) -> Model:
    """Return a condensed model with the motion of its elements in place of states, and without inputs."""
    check_derivative_names("elements", "s", model.element_names)
    names = [d + name for d in DERIVATIVES for name in model.element_names]
    other: Model = copy(model)
    other.state_symbols, other.input_symbols = dict(zip(names, model.element_motion, strict=True)), {}
    other.states, other.inputs, other.orders = model.element_names, (), dict.fromkeys(model.element_names, 1)
    return other


def _forces(model: Model, place: str) -> dict[str, sp.Expr]:
    """Return the summands of an equation or output, of the latter also the whole, without constant factors, by text.

    Those with highest derivatives of states are left out. The names of outputs stand for their expressions.
    """
    index, outputs = places(model).index(place), model.output_expressions
    whole = (*outputs, *model.equations)[index]
    steepest = {model.state_symbols[DERIVATIVES[order] + state] for state, order in model.orders.items()}
    moving = {*model.state_symbols.values(), *model.input_symbols.values()}
    names = {e: sp.Symbol(name) for e, name in zip(outputs, model.outputs, strict=True) if not e.is_Symbol}
    forces: dict[str, sp.Expr] = {}
    for part in (*sp.Add.make_args(whole), *outputs[index : index + 1]):
        force = part if part in names else part.as_independent(*moving, as_Add=False)[1]
        if force.free_symbols & moving and not force.free_symbols & steepest:
            forces[_written(model, force.xreplace(names))] = force
    return forces


def places(model: Model) -> tuple[str, ...]:
    """Return the names of outputs and equations, as `Term` has them; of a condensed model those of its forces."""
    if isinstance(model, CondensedModel):
        return tuple(f"force of {name}" for name in model.element_names)
    return *model.outputs, *(f"equation of {state}" for state in model.states)


def factors(model: Model) -> tuple[dict[str, sp.Expr], dict[str, sp.Expr]]:
    """Return the variables whose products are candidates, and the highest derivatives, which are so by themselves.

    Of an angle these are its sine and cosine. Of an input its rate is a variable if the model contains it. Of a
    condensed model the variables are displacements and velocities of the elements.
    """
    if isinstance(model, CondensedModel):
        return {name: symbol for variables in _elements_variables(model) for name, symbol in variables.items()}, {}
    known: dict[str, sp.Expr] = {}
    steepest: dict[str, sp.Expr] = {}
    for state, order in model.orders.items():
        symbol = model.state_symbols[state]
        known |= (
            {f"sin({state})": sp.sin(symbol), f"cos({state})": sp.cos(symbol)}
            if state in model.angles
            else {state: symbol}
        )
        for derivative in range(1, order + 1):
            name = DERIVATIVES[derivative] + state
            (known if derivative < order else steepest)[name] = model.state_symbols[name]
    for name, highest in model.input_derivatives().items():
        for derivative in range(min(highest + 2, len(DERIVATIVES))):
            label = DERIVATIVES[derivative] + name
            (known if derivative <= highest else steepest)[label] = model.input_symbols[label]
    return known, steepest


def given(model: Model, candidates: Mapping[str, Iterable[Any]]) -> list[Term]:
    """Return candidates that were given by place, as texts or functions of (s, p, u)."""
    _checks.mapping("candidates", candidates, "{'force': ['x**2']}")
    every = model
    if isinstance(every, CondensedModel):
        model = of_elements(every)
    spaces = (
        Names("states", model.state_symbols | model.time_symbols),
        Names("parameters", model.parameter_symbols),
        Names("inputs", model.input_symbols),
    )
    added = []
    for place, terms in candidates.items():
        argument = f"candidates[{place!r}]"
        _checks.one_of("candidates", place, places(every))
        if isinstance(terms, str) or not isinstance(terms, Iterable):
            raise ValueError(f"{argument}: must be a list of texts or functions of (s, p, u), got {terms!r}.")
        for term in terms:
            force, rest = _lagged(argument, term) if isinstance(term, str) else (None, term)
            expression = model._expression(argument, rest(*spaces) if callable(rest) else rest)
            text = term.strip() if isinstance(term, str) else _written(model, expression)
            memory = None if force is None else model._expression(argument, force)
            for part in (expression, memory):
                if part is not None:
                    _check_order(model, argument, text, part, place)
            if isinstance(every, CondensedModel):
                _check_force(every, argument, text, expression, memory, place)
            added.append(Term(place, text, expression if memory is None else MEMORY + expression, memory))
            try:
                coefficient_unit(every, added[-1])
            except ValueError as error:
                raise ValueError(f"{argument}: must add quantities of the same unit, got {text!r}: {error}.") from None
    return added


def _check_force(
    model: CondensedModel, argument: str, text: str, expression: sp.Expr, memory: sp.Expr | None, place: str
) -> None:
    """Refuse terms that are no function of the motion of the place's element and of parameters."""
    variables = _elements_variables(model)[places(model).index(place)]
    if memory is not None:
        raise ValueError(f"{argument}: must be without memory for {model.name!r}, which is condensed, got {text!r}.")
    if expression.free_symbols - {*variables.values(), *model.parameter_symbols.values()}:
        raise ValueError(
            f"{argument}: must contain only {' and '.join(variables)} and parameters, for {model.name!r} is condensed, "
            f"got {text!r}."
        )


def _lagged(argument: str, text: str) -> tuple[str | None, str]:
    """Return force and rest of a text such as ``"lag(x**2) - x**2"``; None and the text if there is no lag in it."""
    start, _, inner = text.strip().partition("(")
    if not re.search(r"\blag\s*\(", text):
        return None, text
    depths = np.cumsum([(c == "(") - (c == ")") for c in inner])
    end = int(np.argmax(depths < 0))
    force, rest = inner[:end], inner[end + 1 :].strip()
    if start.strip() != "lag" or not end or re.search(r"\blag\b", force + rest) or rest[:1] not in ("", "+", "-"):
        raise ValueError(f"{argument}: must be lag(…), alone or plus or minus a term without a lag, got {text!r}.")
    return force, f"0 {rest}"


def _check_order(model: Model, argument: str, text: str, expression: sp.Expr, place: str) -> None:
    """Refuse derivatives that the model's equations do not have."""
    allowed = {model.state_symbols[d + s] for s, order in model.orders.items() for d in DERIVATIVES[: order + 1]}
    for name, symbol in model.state_symbols.items():
        if symbol in expression.free_symbols - allowed:
            raise ValueError(
                f"{argument}: must contain derivatives that the equations contain, got {name!r} in {text!r}."
            )
    inputs = {*model.input_symbols.values(), model.time_symbols["tau"]}
    if model.autonomous and place not in model.outputs and expression.free_symbols & inputs:
        raise ValueError(f"{argument}: must be without inputs and tau for an autonomous model, got {text!r}.")


def _written(model: Model, expression: sp.Expr) -> str:
    spaces = (model.state_symbols, model.input_symbols, model.parameter_symbols, model.time_symbols)
    return str(expression.xreplace({symbol: sp.Symbol(name) for space in spaces for name, symbol in space.items()}))


def _product(names: Iterable[str]) -> str:
    return "*".join(name if power == 1 else f"{name}**{power}" for name, power in Counter(names).items())


def values(
    model: Model, expressions: Iterable[sp.Expr], variables: np.ndarray, inputs: np.ndarray, parameters: np.ndarray,
    tau: np.ndarray, frequency: float,
) -> np.ndarray:  # fmt: skip
    """Return expressions at points, (expressions, points).

    `variables` (points, 3·states) are q, q̇, q̈, `inputs` (points, 3·inputs) u, u̇, ü, `parameters` those of the model.
    """
    symbols = [*model.state_symbols.values(), *model.input_symbols.values(), *model.parameter_symbols.values()]
    symbols += model.time_symbols.values()
    listed = list(expressions)
    function: Callable[..., Any] = sp.lambdify(symbols, listed, modules="numpy", cse=True)
    with np.errstate(all="ignore"):
        results = function(*variables.T, *inputs.T, *parameters, tau, frequency)
    return np.array([np.broadcast_to(np.asarray(one, dtype=float), tau.shape) for one in results]).reshape(-1, tau.size)


def symbol_units(model: Model) -> dict[sp.Symbol, Unit]:
    """Return the units of the model's symbols, where they are known: states, inputs, their rates, and parameters."""
    units = {model.time_symbols["tau"]: {}, model.time_symbols["frequency"]: {"Hz": 1.0}}
    for space, names in ((model.state_symbols, model.states), (model.input_symbols, model.inputs)):
        for name in names:
            if (unit := parsed(model.units.get(name, ""))) is not None:
                units |= {space[d + name]: product(unit, {"s": 1.0}, -i) for i, d in enumerate(DERIVATIVES)}
    for name, symbol in model.parameter_symbols.items():
        if (unit := parsed(model.units.get(name, ""))) is not None:
            units[symbol] = unit
    return units


def coefficient_unit(model: Model, term: Term) -> str:
    """Return the unit of the coefficient of a term as text; "" where units are missing.

    A ValueError is raised for a term that adds quantities of different dimensions.
    """
    if isinstance(model, CondensedModel):  # whose states have no units
        return ""
    units, index = symbol_units(model), places(model).index(term.place)
    if term.force is not None and (memory := unit_of(term.force, units)) is not None:
        units[MEMORY] = memory
    term_unit = unit_of(term.expression, units)
    if index < len(model.outputs):
        whole = parsed(model.units.get(term.place, ""))
    else:
        parts = sp.Add.make_args(sp.expand(model.equations[index - len(model.outputs)]))
        whole = next((unit for part in parts if (unit := _unit_or_none(part, units)) is not None), None)
    return "" if term_unit is None or whole is None else written(product(whole, term_unit, -1.0))


def _unit_or_none(expression: sp.Expr, units: Mapping[sp.Symbol, Unit]) -> Unit | None:
    try:
        return unit_of(expression, units)
    except ValueError:
        return None


def coefficient_names(model: Model, terms: Iterable[Term]) -> list[str]:
    """Return a new parameter for the coefficient of each term, such as ``c_w_x_2`` for ``w*x**2``.

    Those of terms with memory are ``c_lag_x`` for ``lag(x) - x``, with lag and state as `lag_names` has them.
    """
    taken = {*model.parameters, *model.state_symbols, *model.input_symbols, *model.outputs}
    names: list[str] = []
    for term in terms:
        plain = term.text if term.force is None else term.text.partition(") - ")[0]
        choice = plain[:LONGEST_NAME], f"{plain[:LONGEST_NAME]} in {term.place}"
        short, long = ("c_" + re.sub(r"\W+", "_", text).strip("_") for text in choice)
        choices = chain((short, long), (f"{long}_{number}" for number in count(2)))
        names.append(next(name for name in choices if not taken & {name, *lag_names(name)}))
        taken |= {names[-1], *lag_names(names[-1])}
    return names


def lag_names(name: str) -> tuple[str, str]:
    """Return the names of the lag and of the state of a term with memory, by that of its coefficient."""
    return "tau" + name[1:], "m" + name[1:]


def extended(model: Model, terms: Mapping[str, Term]) -> Model:
    """Return the model with the terms, by the names of their coefficients."""
    other = copy(model)
    lags = {name: lag_names(name) for name, term in terms.items() if term.force is not None}
    new = _checks.identifiers("terms", [*terms, *(lag for lag, _ in lags.values())], model.parameters)
    symbols = {name: sp.Symbol(f"p_{name}", real=True) for name in new}
    other.parameters, other.parameter_symbols = (*model.parameters, *new), model.parameter_symbols | symbols
    other.states = *model.states, *(state for _, state in lags.values())
    other.state_symbols = with_derivatives("s", other.states)
    other.orders = model.orders | dict.fromkeys(other.states[len(model.states) :], 1)
    other.units = model.units | {name: coefficient_unit(model, term) for name, term in terms.items()}
    if isinstance(model, CondensedModel) and isinstance(other, CondensedModel):
        forces = list(model.element_forces)
        for name, term in terms.items():
            forces[places(model).index(term.place)] += symbols[name] * term.expression
        other.element_forces = tuple(forces)
        return other
    equations, outputs = list(model.equations), list(model.output_expressions)
    for name, term in terms.items():
        index, expression = places(model).index(term.place), term.expression
        if term.force is not None:
            lag, state = lags[name]
            memory, rate = other.state_symbols[state], other.state_symbols[f"d{state}"]
            equations.append(symbols[lag] * rate + memory - term.force)
            expression = expression.xreplace({MEMORY: memory})
            unit = unit_of(term.force, symbol_units(model))
            other.units |= {lag: "s", state: "" if unit is None else written(unit)}
        where, i = (outputs, index) if index < len(outputs) else (equations, index - len(outputs))
        where[i] += symbols[name] * expression
    other.equations, other.output_expressions = tuple(equations), tuple(outputs)
    return other
