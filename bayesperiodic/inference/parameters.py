"""Which parameters of a model are free, fixed or tied, and how all of them follow from the free ones."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesperiodic import checks
from bayesperiodic.expressions import Expression, parse


@dataclass(frozen=True)
class ParameterMap:
    """From θ, the free parameters, to all parameters of a model.

    Attributes
    ----------
    parameters : tuple of str
        All of the model's.
    names : tuple of str
        The free ones, in the order of θ.
    fixed : dict of str to float
    tied : dict of str to Expression
        Each only of parameters that are free, fixed or tied before it.
    """

    parameters: tuple[str, ...]
    names: tuple[str, ...]
    fixed: dict[str, float]
    tied: dict[str, Expression]

    @classmethod
    def of(
        cls, parameters: tuple[str, ...], names: tuple[str, ...], fixed: Mapping[str, float], tied: Mapping[str, Any]
    ) -> "ParameterMap":
        """Return the checked map.

        Raises
        ------
        ValueError
            For a parameter that is none of the three or two of them, an unknown name, an expression that is not allowed
            or that comes back to itself.
        """
        for name in tied:
            checks.one_of("tied", name, parameters)
            for argument, others in (("priors", names), ("fixed", fixed)):
                if name in others:
                    raise ValueError(f"tied: {name!r} is in {argument} too; a parameter is free, fixed or tied.")
        if without := [n for n in parameters if n not in names and n not in fixed and n not in tied]:
            raise ValueError(
                f"priors: {', '.join(map(repr, without))} has neither a prior nor a value; a free parameter needs a "
                "prior, any other a value in `fixed` or an expression in `tied`."
            )
        expressions = {name: parse(f"tied[{name!r}]", text, parameters) for name, text in tied.items()}
        return cls(parameters, names, dict(fixed), _ordered(expressions))

    def values(self, theta: np.ndarray) -> np.ndarray:
        """Return all parameters (points, parameters) of θ (points, names)."""
        known: dict[str, Any] = {**self.fixed, **{name: theta[:, i] for i, name in enumerate(self.names)}}
        for name, expression in self.tied.items():
            known[name] = expression.value(known)
        return np.stack([np.broadcast_to(known[name], len(theta)) for name in self.parameters], axis=-1)

    def slopes(self, theta: np.ndarray) -> np.ndarray:
        """Return ∂(all parameters)/∂θ at one θ (names,), (parameters, names)."""
        by_name = {name: row for name, row in zip(self.names, np.eye(len(self.names)), strict=True)}
        known: dict[str, Any] = {**self.fixed, **dict(zip(self.names, theta.tolist(), strict=True))}
        for name, expression in self.tied.items():
            gradient = expression.gradient(known)
            by_name[name] = sum(
                (float(slope) * by_name[n] for n, slope in gradient.items() if n in by_name), np.zeros(len(self.names))
            )
            known[name] = float(expression.value(known))
        nothing = np.zeros(len(self.names))
        return np.stack([by_name.get(name, nothing) for name in self.parameters])


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
            raise ValueError(f"tied: {circle!r} is not allowed; these expressions come back to themselves.")
        result |= {name: expressions[name] for name in ready}
    return result
