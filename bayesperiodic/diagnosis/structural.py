"""The structure of a problem: what its free parameters could be known by, were there no noise and no end of data."""

from functools import lru_cache

import sympy as sp

from bayesperiodic.inference.labels import local_names
from bayesperiodic.inference.problem import Problem
from bayesperiodic.models.model import Model
from bayesperiodic.models.structure.result import Structure
from bayesperiodic.models.structure.structure import analysed
from bayesperiodic.models.structure.system import system_of


def structure_of(problem: Problem) -> Structure:
    """Return the structure of a problem's model for its measured channels, free parameters and ties.

    A parameter that is fixed at zero in every experiment is left out of the equations, any other fixed one is known.
    One that experiments have their own of is taken as one parameter.
    """
    free = {name for name in problem.names if "[" not in name} | set(local_names(problem.names))
    fixed = {name: set(values.values()) for name, values in problem.fixed.items() if name not in free}
    parameters = set(problem.model.parameters)
    zeros = tuple(sorted(name for name, values in fixed.items() if values == {0.0} and name in parameters))
    known = tuple(name for name in problem.model.parameters if name in fixed)
    tied = tuple((name, text) for name, text in problem.tied.items() if name in parameters)
    return _structure(problem.model, problem.channels, known, zeros, tied)


@lru_cache(maxsize=64)
def _structure(
    model: Model,
    outputs: tuple[str, ...],
    known: tuple[str, ...],
    zeros: tuple[str, ...],
    tied: tuple[tuple[str, str], ...],
) -> Structure:
    symbols = model.parameter_symbols
    values = {symbols[name]: sp.S.Zero for name in zeros}
    # The text has passed the whitelist of `expressions` before it gets here.
    ties = {symbols[n]: sp.nsimplify(sp.parse_expr(text, local_dict=dict(symbols)), rational=True) for n, text in tied}
    for _ in ties:
        ties = {symbol: expression.subs(ties | values) for symbol, expression in ties.items()}
    system = system_of(model, outputs)
    return analysed(model.name, system.given(known, values | ties), known)
