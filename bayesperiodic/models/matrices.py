"""Equations and outputs of models that are given by mass, damping and stiffness matrices."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp

from bayesperiodic import _checks
from bayesperiodic._expressions import parse_any
from bayesperiodic._printing import Printed
from bayesperiodic.models.hysteresis import Hysteretic
from bayesperiodic.models.names import DERIVATIVES, Names
from bayesperiodic.models.structure import CONSTANT_PART, POWERS, Base, Matrices, MatrixStructure

KINDS_OF_MOTION = {"displacement": 0, "velocity": 1, "acceleration": 2}  # order of the derivative
# Of a place that moves with a base, what its motion is measured against.
ABSOLUTE, RELATIVE = "absolute ", "relative "
# Share of the sizes of its terms below which a sum of weights is zero.
NO_MOTION = 1e-12
# Arguments of the functions of elements that are no parameters.
OF_THE_MOTION = ("d", "v", "s", "name", "names")


@dataclass(frozen=True)
class Element(Printed):
    """A nonlinear part between two degrees of freedom of `Model.from_matrices`, or of one and the ground.

    Attributes
    ----------
    name : str
        A Python identifier; the parameters are called name_parameter, and the state, if any, name.
    force : callable
        A function of `bp.elements`, or your own: of d, the relative displacement [m], and v, the relative velocity
        [m/s], if it has these arguments, and of its parameters by name. It returns an expression or `Hysteretic`.
    place : int, tuple (i, j), mapping of int to number, or array (n,)
        A degree of freedom; two of them, d being x_i − x_j; or weights of some or all of them, d being the sum of
        weight times displacement, such as ``{0: 0.8, 1: 0.6}`` for an inclined direction, along which the force acts.
    constants : mapping of str to number, optional
        Arguments that are no parameters of the model, such as a width; of `iwan` also the `names` of its states.

    Raises
    ------
    ValueError
        If the name is no identifier, the force is no function, or a constant is no argument of it.

    Examples
    --------
    >>> stop = bp.elements.Element("stop", bp.elements.gap, 3, {"width": 1e-5})
    >>> stop.parameters
    ('k', 'clearance')
    >>> bp.elements.Element("air", lambda v, drag: drag * v * abs(v), 0).parameters
    ('drag',)
    """

    name: str
    force: Callable[..., Any]
    place: Any
    constants: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _checks.identifiers("name", [self.name])
        if not callable(self.force):
            raise ValueError(f"force: must be a function, such as elements.gap, got {self.force!r}.")
        arguments = tuple(inspect.signature(self.force).parameters)
        for constant in _checks.mapping("constants", self.constants, "{'width': 1e-5}"):
            _checks.one_of("constants", constant, [n for n in arguments if n not in OF_THE_MOTION or n == "names"])
        if "names" in arguments and "names" not in self.constants:
            raise ValueError("constants: must have the names of the states, got none; take iwan_states(name, 8).")

    @property
    def parameters(self) -> tuple[str, ...]:
        """Arguments of the force that are parameters."""
        arguments = inspect.signature(self.force).parameters
        return tuple(name for name in arguments if name not in (*OF_THE_MOTION, *self.constants))

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the internal states."""
        arguments = inspect.signature(self.force).parameters
        return tuple(self.constants["names"]) if "names" in arguments else (self.name,) * ("name" in arguments)

    def evaluate(self, d: sp.Expr, v: sp.Expr, s: Names, p: Names) -> Hysteretic:
        """Return the force and the equations of the internal states.

        Parameters
        ----------
        d, v : sympy expression
            Relative displacement and velocity.
        s, p : states and parameters of the model
            With those of the element.

        Returns
        -------
        Hysteretic

        Raises
        ------
        ValueError
            If the force returns no expression.
        """
        motion = {"d": d, "v": v, "s": s, "name": self.name}
        arguments = {n: motion[n] for n in inspect.signature(self.force).parameters if n in motion}
        arguments |= {n: p[f"{self.name}_{n}"] for n in self.parameters}
        given = self.force(**arguments, **self.constants)
        if not isinstance(given, Hysteretic | sp.Expr | float | int):
            raise ValueError(f"force of element {self.name!r}: must return an expression or Hysteretic, got {given!r}.")
        return given if isinstance(given, Hysteretic) else Hysteretic(sp.sympify(given), ())


def structure(
    matrices: Mapping[str, Any],
    forces: Mapping[str, Any] | None,
    base: Mapping[str, tuple[Any, ...]] | None,
    outputs: Mapping[str, tuple[Any, str]],
    elements: Iterable[Element],
    shapes: np.ndarray | None = None,
) -> MatrixStructure:
    """Return the checked structure of matrices by name; see `Model.from_matrices`.

    Places are degrees of freedom, or points whose displacements are `shapes` (points, n) times these.
    """
    parts = {kind: _parts(kind, given) for kind, given in matrices.items()}
    if not parts["mass"]:
        raise ValueError("mass: must be a square matrix, got none.")
    count = len(next(iter(parts["mass"].values())))
    for kind, named in parts.items():
        for matrix in named.values():
            if matrix.shape != (count, count):
                raise ValueError(f"{kind}: must have the shape of mass, {(count, count)}, got {matrix.shape}.")
    if parts["mass"].keys() == {CONSTANT_PART} and np.linalg.matrix_rank(parts["mass"][CONSTANT_PART]) < count:
        raise ValueError("mass: must be regular, got a singular matrix; eliminate the degrees of freedom without mass.")
    if isinstance(elements, Element):
        raise ValueError(f"elements: must be a list of elements, got {elements.name!r} alone; give [element].")
    placed = _checks.several("elements", elements)
    for element in placed:
        _checks.instance("elements", element, Element)
    _checks.identifiers("elements", [element.name for element in placed])
    forces = _checks.mapping("forces", {} if forces is None else forces, "{'force': 0}")
    base = _checks.mapping("base", {} if base is None else base, "{'ground': (np.ones(3), 'acceleration')}")
    _checks.mapping("outputs", outputs, "{'x': (0, 'displacement')}")
    at = np.eye(count) if shapes is None else shapes
    moving = {name: _base(f"base[{name!r}]", given, parts["mass"], shapes) for name, given in base.items()}
    if repeated := [name for name in moving if name in forces]:
        raise ValueError(f"base: must have names that differ from those of forces, got {repeated[0]!r}.")
    measured = {name: _measured(f"outputs[{name!r}]", given, at, moving) for name, given in outputs.items()}
    weights = [_weights(f"place of element {e.name!r}", e.place, at) for e in placed]
    return MatrixStructure(
        matrices=Matrices(parts),
        inputs={name: _weights(f"forces[{name!r}]", place, at) for name, place in forces.items()},
        bases={name: one for name, (one, _) in moving.items()},
        measured={name: (place, order) for name, (place, order, _) in measured.items()},
        carried={name: carried for name, (*_, carried) in measured.items() if carried},
        elements=placed,
        weights=np.array(weights).reshape(-1, count),
    )


def _base(argument: str, given: Any, mass: dict[str, np.ndarray], shapes: np.ndarray | None) -> tuple[Base, np.ndarray]:
    """Return a base, and the displacements of the points for a unit displacement of it."""
    size = 2 if shapes is None else 3
    if not isinstance(given, tuple) or len(given) != size or not isinstance(given[1], str):
        example = "(np.ones(3), 'acceleration'" + (")" if shapes is None else ", participation), of the modes")
        raise ValueError(f"{argument}: must be a direction and a kind, such as {example}, got {given!r}.")
    _checks.one_of(argument, given[1], KINDS_OF_MOTION)
    points = len(mass[next(iter(mass))]) if shapes is None else len(shapes)
    if isinstance(given[0], tuple) or (not isinstance(given[0], Mapping) and np.ndim(given[0]) != 1):
        raise ValueError(
            f"{argument}: must have a direction of {points} displacements, those of all degrees of freedom with a unit "
            f"displacement of the base, got {given[0]!r}."
        )
    direction = given[0] if isinstance(given[0], Mapping) else np.asarray(given[0])
    direction = _weights_of_points(argument, direction, points)
    if shapes is None:
        loads = {factor: part @ direction for factor, part in mass.items()}
    else:
        participation = _checks.real_array(argument, given[2])
        if participation.shape != (shapes.shape[1],) or not np.isfinite(participation).all():
            raise ValueError(
                f"{argument}: must have a finite participation factor of each of the {shapes.shape[1]} modes, got the "
                f"shape {participation.shape}."
            )
        loads = {CONSTANT_PART: participation}
    return Base(loads, KINDS_OF_MOTION[given[1]]), direction


def of_modes(
    frequencies: Any,
    damping_ratios: Any,
    shapes: Any,
    forces: Mapping[str, Any] | None,
    base: Mapping[str, tuple[Any, ...]] | None,
    outputs: Mapping[str, tuple[Any, str]],
    elements: Iterable[Element],
) -> MatrixStructure:
    """Return the structure of modes of unit modal mass; see `Model.from_modes`."""
    at = _checks.real_array("shapes", shapes)
    if at.ndim != 2 or not at.size or not np.isfinite(at).all():
        raise ValueError(f"shapes: must be a finite array (points, modes), got the shape {at.shape}.")
    count = at.shape[1]
    if np.ndim(damping_ratios) == 0:
        damping_ratios = [damping_ratios] * count
    pairs = ("frequencies", frequencies), ("damping_ratios", damping_ratios)
    each = zip(*(_of_modes(argument, given, count) for argument, given in pairs), strict=True)
    matrices: dict[str, dict[str, np.ndarray]] = {"damping": {}, "stiffness": {}}
    for mode, (frequency, ratio) in enumerate(each):
        if not isinstance(frequency, str) and not frequency > 0.0:
            raise ValueError(f"frequencies: must be > 0, got {frequency:g}; give a rigid motion a soft support.")
        if not isinstance(ratio, str) and not ratio < 1.0:
            raise ValueError(f"damping_ratios: must be < 1, got {ratio:g}; give 0.02 for two percent.")
        factors = {"damping": f"4*pi*({ratio!s})*({frequency!s})", "stiffness": f"(2*pi*({frequency!s}))**2"}
        for kind, factor in factors.items():
            expression = parse_any(kind, factor)
            known = not expression.names
            part = matrices[kind].setdefault(CONSTANT_PART if known else factor, np.zeros((count, count)))
            part[mode, mode] = expression.value({}) if known else 1.0
    return structure({"mass": np.eye(count)} | matrices, forces, base, outputs, elements, at)


def _of_modes(argument: str, given: Any, count: int) -> list[float | str]:
    values = list(given) if isinstance(given, Iterable) and not isinstance(given, str) else []
    if len(values) != count:
        raise ValueError(f"{argument}: must be one of each of the {count} modes in shapes, got {given!r}.")
    for value in values:
        if isinstance(value, str):
            parse_any(argument, value)
    return [value if isinstance(value, str) else _checks.finite_number(argument, value) for value in values]


def definition(given: MatrixStructure) -> dict[str, Any]:
    """Return the arguments of `Model` for a structure; the equations are functions, which only `Model` calls."""
    degrees = [f"x{number}" for number in range(given.degrees)]

    def equations(s: Names, p: Names, u: Names) -> list[sp.Expr]:
        total: list[sp.Expr] = [sp.S.Zero] * given.degrees
        for kind, power in POWERS.items():
            for name, matrix in given.parts[kind].items():
                expression = given.factors[name]
                factor = expression.symbolic(kind, {n: p[n] for n in expression.names})[0]
                for i, row in enumerate(matrix):
                    total[i] += factor * _combined(row, [s[DERIVATIVES[power] + x] for x in degrees])
        internal: list[sp.Expr] = []
        for element, at in zip(given.elements, given.weights, strict=True):
            d, v = (_combined(at, [s[derivative + x] for x in degrees]) for derivative in DERIVATIVES[:2])
            part = element.evaluate(d, v, s, p)
            internal += part.equations
            total = [sum_ + number_of(w) * part.force if w else sum_ for sum_, w in zip(total, at, strict=True)]
        for name, at in given.inputs.items():
            total = [sum_ - number_of(w) * u[name] if w else sum_ for sum_, w in zip(total, at, strict=True)]
        for name, base in given.bases.items():
            for factor, at in base.loads.items():
                expression = given.factors[factor]
                acceleration = expression.symbolic("mass", {n: p[n] for n in expression.names})[0]
                acceleration *= u[DERIVATIVES[2 - base.order] + name]
                total = [sum_ + number_of(w) * acceleration if w else sum_ for sum_, w in zip(total, at, strict=True)]
        return [*total, *internal]

    return {
        "states": [*degrees, *(state for e in given.elements for state in e.states)],
        "inputs": [*given.drives],
        "parameters": [*given.parameters, *(f"{e.name}_{name}" for e in given.elements for name in e.parameters)],
        "equations": equations,
        "outputs": lambda s, p, u: {
            name: _combined(at, [s[DERIVATIVES[order] + x] for x in degrees])
            + sum(
                number_of(w) * u[DERIVATIVES[order - given.bases[b].order] + b]
                for b, w in given.carried.get(name, {}).items()
            )
            for name, (at, order) in given.measured.items()
        },
    }


def _parts(kind: str, given: Any) -> dict[str, np.ndarray]:
    """Return the matrices of a sum by the names of their factors."""
    if given is None:
        return {}
    named = dict(given) if isinstance(given, Mapping) else {CONSTANT_PART: given}
    if not named:
        raise ValueError(f"{kind}: must have at least one matrix, got none.")
    result = {}
    for name, matrix in named.items():
        if isinstance(matrix, str | Path):
            raise ValueError(f"{kind}: must be a matrix, got {str(matrix)!r}; read a file by read_matrix(path, name).")
        dense = _checks.real_array(kind, matrix.toarray() if hasattr(matrix, "toarray") else matrix)
        if dense.ndim != 2 or dense.shape[0] != dense.shape[1] or not dense.size:
            raise ValueError(f"{kind}: must be a square matrix, got the shape {dense.shape}.")
        _checks.identifiers(kind, parse_any(kind, name).names)
        if not np.isfinite(dense).all():
            raise ValueError(f"{kind}: must be finite, got a matrix with other values.")
        result[name] = dense
    return result


def _weights(argument: str, place: Any, shapes: np.ndarray) -> np.ndarray:
    """Return the weights of all degrees of freedom in a place, whose displacements are `shapes` (points, n)."""
    weights = _weights_of_points(argument, place, len(shapes)) @ shapes
    if not weights.any():
        raise ValueError(f"{argument}: must be moved by at least one mode, got {place!r}, a node of all.")
    return np.asarray(weights)


def _weights_of_points(argument: str, place: Any, count: int) -> np.ndarray:
    if isinstance(place, Mapping):
        weights = np.zeros(count)
        for number, weight in place.items():
            weights[_degree(argument, number, count)] = _checks.finite_number(argument, weight)
        if not weights.any():
            raise ValueError(f"{argument}: must have a weight that is not zero, got {place!r}.")
        return weights
    if isinstance(place, np.ndarray) and place.ndim:
        weights = _checks.real_array(argument, place)
        if weights.shape != (count,) or not np.isfinite(weights).all() or not weights.any():
            raise ValueError(
                f"{argument}: must be {count} finite weights, not all zero, got an array of shape {weights.shape}."
            )
        return weights
    numbers = place if isinstance(place, tuple) else (place,)
    if isinstance(place, list) or len(numbers) not in (1, 2) or numbers[1:] == numbers[:1]:
        raise ValueError(
            f"{argument}: must be one degree of freedom, a tuple of two different ones, a mapping of some to their "
            f"weights, or an array of {count} weights, got {place!r}."
        )
    weights = np.zeros(count)
    for number, sign in zip(numbers, (1.0, -1.0), strict=False):
        weights[_degree(argument, number, count)] = sign
    return weights


def _degree(argument: str, number: Any, count: int) -> int:
    if _checks.integer(argument, number, minimum=0) >= count:
        raise ValueError(f"{argument}: must be below {count}, the number of degrees of freedom, got {number}.")
    return int(number)


def _measured(
    argument: str, given: Any, shapes: np.ndarray, bases: Mapping[str, tuple[Base, np.ndarray]]
) -> tuple[np.ndarray, int, dict[str, float]]:
    """Return the weights of an output, the order of its derivative, and what a unit displacement of each base adds."""
    if not isinstance(given, tuple) or len(given) != 2 or not isinstance(given[1], str):
        raise ValueError(f"{argument}: must be a place and a kind, such as (0, 'acceleration'), got {given!r}.")
    place, kind = given
    weights = _weights_of_points(argument, place, len(shapes))
    carried = {}
    for name, (_, direction) in bases.items():
        terms = weights * direction
        if abs(terms.sum()) > NO_MOTION * np.abs(terms).sum():
            carried[name] = float(terms.sum())
    if carried and kind in KINDS_OF_MOTION:
        raise ValueError(
            f"{argument}: must be {ABSOLUTE + kind!r}, as of an accelerometer, or {RELATIVE + kind!r}, to the base, "
            f"got {kind!r} of a place that moves with the base {next(iter(carried))!r}."
        )
    said = (ABSOLUTE, RELATIVE) if carried else ("",)
    _checks.one_of(argument, kind, [one + plain for one in said for plain in KINDS_OF_MOTION])
    plain = kind.removeprefix(ABSOLUTE).removeprefix(RELATIVE)
    order = KINDS_OF_MOTION[plain]
    if not kind.startswith(ABSOLUTE):
        carried = {}
    for name in carried:
        if order < (known := bases[name][0].order):
            known_kind = [*KINDS_OF_MOTION][known]
            raise ValueError(
                f"{argument}: must be a derivative of the input {name!r}, the base's {known_kind}, got {kind!r}, which "
                f"is an integral of it; take {RELATIVE + plain!r} or {ABSOLUTE + known_kind!r}, or give the base's "
                f"{plain}."
            )
    return _weights(argument, place, shapes), order, carried


def _combined(weights: np.ndarray, symbols: list[sp.Symbol]) -> sp.Expr:
    terms = (number_of(w) * symbol for w, symbol in zip(weights, symbols, strict=True) if w)
    return sum(terms, sp.S.Zero)


def number_of(value: float) -> sp.Expr:
    """Return a coefficient, 1 and −1 as such."""
    return sp.Integer(int(value)) if abs(value) == 1.0 else sp.Float(float(value))
