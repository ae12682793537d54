"""Terms of a model that are not finite where a solve starts, such as divisions by a state at rest."""

from collections.abc import Iterator

import numpy as np
import sympy as sp

from bayesperiodic.models.names import DERIVATIVES
from bayesperiodic.periodic.equations import PeriodicEquations


def singular_term(equations: PeriodicEquations, z: np.ndarray, parameters: np.ndarray) -> str:
    """Return the first term of the equations that is not finite at z (points, states), and where; empty without one.

    The text names the states and inputs in the term with their values at the first grid point at which it is singular.
    """
    columns = equations.residual_jacobian(z, parameters)
    lost = np.flatnonzero(~np.isfinite(columns).all(axis=1))
    if not lost.size:
        return ""
    model, point = equations.model, int(lost[0])
    moving: dict[sp.Symbol, tuple[str, float]] = {}
    for names, symbols, values in (
        (model.states, model.state_symbols, equations.states(z)[point]),
        (model.inputs, model.input_symbols, equations.inputs[point]),
    ):
        every = [d + name for d in DERIVATIVES for name in names]
        moving |= {symbols[name]: (name, float(value)) for name, value in zip(every, values, strict=True)}
    given = dict(zip(model.parameters, parameters.tolist(), strict=True))
    time = {"tau": float(equations.grid.tau[point]), "frequency": equations.frequency}
    fixed = {model.parameter_symbols[name]: (name, value) for name, value in given.items()}
    fixed |= {model.time_symbols[name]: (name, value) for name, value in time.items()}
    numbers = {symbol: sp.Float(value) if value else sp.S.Zero for symbol, (_, value) in (moving | fixed).items()}
    plain = {symbol: sp.Symbol(name, real=True) for symbol, (name, _) in (moving | fixed).items()}
    for part, said in _parts(model.equations, list(moving)):
        value = part.xreplace(numbers)
        if not (value.is_finite and value.is_real):
            where = [f"{name} = {at:.6g}" for symbol, (name, at) in moving.items() if symbol in part.free_symbols]
            return f"{said.format(part.xreplace(plain))}{' at ' * bool(where)}{', '.join(where)}"
    return ""


def _parts(equations: tuple[sp.Expr, ...], moving: list[sp.Symbol]) -> Iterator[tuple[sp.Expr, str]]:
    """Yield the terms of equations, each after its parts, and then those of their derivatives, with a format."""
    for expression in equations:
        for part in sp.postorder_traversal(expression):
            yield part, "{}"
    for expression in equations:
        for symbol in moving:
            for part in sp.postorder_traversal(sp.diff(expression, symbol)):
                yield part, "{} (in a derivative of the equations)"
