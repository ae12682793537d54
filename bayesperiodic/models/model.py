"""Models: differential and output equations in symbolic form, and their time integration."""

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp

from bayesperiodic import _checks
from bayesperiodic._compile.code_generation import Kernels, SymbolicModel, VjpKernels, grid_functions
from bayesperiodic._compile.grid_function import GridFunction
from bayesperiodic._printing import Printed
from bayesperiodic.models.internal_states import motion_of_elements
from bayesperiodic.models.matrices import definition, of_modes, structure
from bayesperiodic.models.names import (
    DERIVATIVES,
    RESERVED,
    Names,
    as_expression,
    called,
    check_derivative_names,
    with_derivatives,
)
from bayesperiodic.models.structure import MatrixStructure

LARGEST_FLOAT = np.finfo(float).max
# Degrees of freedom above which models of matrices are condensed.
MOST_SYMBOLIC = 10
VJP_FUNCTIONS = ("outputs_vjp", "equations_vjp")


class Model(Printed):
    """Nonlinear model g(q, q̇, q̈, u, τ, θ) = 0 with outputs ŷ = f(q, q̇, q̈, u, τ, θ), eq. (1) of [1]_.

    Residuals, all derivatives and compiled functions are derived from the symbolic equations.

    Parameters
    ----------
    name : str
        A Python identifier.
    states : sequence of str
        Degrees of freedom q. A state is of second order if its second derivative appears in an equation,
        of first order if only its first does.
    parameters : mapping of str to str, or sequence of str
        Names of θ, optionally with their units.
    equations : callable (s, p, u) -> sequence of expressions, or sequence of str
        The residuals g, one per state, as SymPy expressions of ``s.x, s.dx, s.ddx`` (state and its time derivatives,
        per second), ``s.tau`` (time in forcing periods), ``s.frequency`` [Hz], parameters ``p.c`` and inputs
        ``u.force, u.dforce, u.ddforce``; or texts of these names, such as ``"m*ddx + k*x - force"``, with the operators
        and functions of `Problem`'s tied parameters.
    outputs : callable (s, p, u) -> mapping of str to expression, or mapping of str to str
        The measured channels f.
    inputs : sequence of str, optional
        Prescribed periodic signals.
    angles : sequence of str, optional
        States that may wind (advance by a multiple of 2π per period) and outputs compared modulo 2π.
    units : mapping of str to str, optional
        Units of states, inputs, outputs and parameters, for tables and axes.
    description : str, optional
        Docstring of the instance.

    Raises
    ------
    ValueError
        For names that are reserved, repeated or not identifiers, a number of equations different from that of the
        states, an expression with an unknown symbol or function, and a state without a derivative.

    Warns
    -----
    UserWarning
        If a parameter appears in no equation and no output.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, in: D. H. van Campen (Ed.), Interaction between Dynamics and Control in Advanced
       Mechanical Systems, Kluwer, 1997, 191-198.

    Examples
    --------
    >>> model = bp.Model("spring", states=["x"], inputs=["force"], parameters={"m": "kg", "k": "N/m"},
    ...     equations=lambda s, p, u: [p.m * s.ddx + p.k * s.x - u.force],
    ...     outputs=lambda s, p, u: {"displacement": s.x})
    >>> model.orders
    {'x': 2}
    """

    def __init__(
        self,
        name: str,
        *,
        states: Iterable[str],
        parameters: Mapping[str, str] | Iterable[str],
        equations: Callable[..., Iterable[Any]] | Iterable[str],
        outputs: Callable[..., Mapping[str, Any]] | Mapping[str, str],
        inputs: Iterable[str] = (),
        angles: Iterable[str] = (),
        units: Mapping[str, str] | None = None,
        description: str = "",
    ):
        if description:
            self.__doc__ = description
        self._set_names(name, states, inputs, parameters)
        spaces = (
            Names("states", self.state_symbols | self.time_symbols),
            Names("parameters", self.parameter_symbols),
            Names("inputs", self.input_symbols),
        )
        written = called("equations", equations, spaces)
        if isinstance(written, sp.Basic | str) or not isinstance(written, Iterable):
            raise ValueError(f"equations: must return a list, one expression per state, got {written} alone.")
        self.equations = tuple(self._expression("equations", e) for e in written)
        if len(self.equations) != len(self.states):
            raise ValueError(
                f"equations: must be {len(self.states)}, one for each of the states {list(self.states)}, got "
                f"{len(self.equations)}. An equation may contain s.dd{self.states[0]}, so that rates need no states."
            )
        given = dict(_checks.mapping("outputs", called("outputs", outputs, spaces), "{'displacement': s.x}"))
        self.outputs = _checks.identifiers("outputs", given, (*RESERVED, *self.inputs))
        self.output_expressions = tuple(self._expression("outputs", given[n]) for n in self.outputs)
        if not self.outputs:
            raise ValueError("outputs: must have at least one output, got none.")

        self._warn_of_unused((*self.equations, *self.output_expressions), self.parameters)
        self.angles = _checks.several("angles", angles)
        for angle in self.angles:
            _checks.one_of("angles", angle, (*self.states, *self.outputs))
        given = _checks.optional_mapping("units", units, "{'force': 'N'}")
        units = {**(parameters if isinstance(parameters, Mapping) else {}), **given}
        self.units = _checks.checked_units(units, (*self.states, *self.inputs, *self.outputs, *self.parameters))
        self.orders = {state: self._order(state) for state in self.states}

    def _set_names(self, name: str, states: Iterable[str], inputs: Iterable[str], parameters: Iterable[str]) -> None:
        """Check the names, and make their symbols."""
        (self.name,) = _checks.identifiers("name", [name])
        self.states = _checks.identifiers("states", states, RESERVED)
        self.inputs = _checks.identifiers("inputs", inputs, (*RESERVED, *self.states))
        self.parameters = _checks.identifiers("parameters", parameters, RESERVED)
        for argument, space, names in (("states", "s", self.states), ("inputs", "u", self.inputs)):
            check_derivative_names(argument, space, names)
        if not self.states:
            raise ValueError("states: must have at least one name, got none.")
        self.state_symbols = with_derivatives("s", self.states)
        self.input_symbols = with_derivatives("u", self.inputs)
        self.parameter_symbols = {n: sp.Symbol(f"p_{n}", real=True) for n in self.parameters}
        self.time_symbols = {n: sp.Symbol(f"t_{n}", real=True) for n in ("tau", "frequency")}
        self.texts: dict[sp.Expr, str] = {}  # of the expressions that were given as such

    def _warn_of_unused(self, expressions: Iterable[sp.Expr], names: Iterable[str]) -> None:
        used = _symbols(expressions)
        if unused := [n for n in names if self.parameter_symbols[n] not in used]:
            warnings.warn(
                f"parameters: no equation and no output of {self.name!r} contains {', '.join(map(repr, unused))}, so "
                "that no data can determine the value; leave the name out, or check the equations.",
                UserWarning,
                stacklevel=3,
            )

    @classmethod
    def from_matrices(
        cls,
        name: str,
        *,
        mass: Any,
        stiffness: Any,
        damping: Any = None,
        forces: Mapping[str, Any] | None = None,
        base: Mapping[str, tuple[Any, ...]] | None = None,
        outputs: Mapping[str, tuple[Any, str]],
        elements: Iterable[Any] = (),
        condensed: bool | None = None,
        units: Mapping[str, str] | None = None,
    ) -> "Model":
        """Return the model M ẍ + C ẋ + K x + elements = forces − M r z̈, with the motion z of a base.

        The states are x0, x1, …, in the order of the matrices, and those of the elements. A condensed model is solved
        in the displacements of its elements alone, to which the linear rest is condensed by its frequency response, see
        `CondensedModel`; it may have hundreds of degrees of freedom. Else the equations are symbolic, so that time of
        compilation and cost of a solution grow with the cube of the number of states.

        Parameters
        ----------
        name : str
        mass, stiffness, damping : array (n, n), sparse matrix, or mapping of str to such
            Of a mapping, the sum of factor·matrix with an expression of parameters as the factor, for example
            ``damping={"alpha": M, "beta": K}`` or ``stiffness={"1": K0, "E*t**3": K1}``. No damping without `damping`.
        forces : mapping of str to place, optional
            Where each input acts: the number of a degree of freedom, from 0; a tuple (i, j) of two between which it
            acts, positive on i; a mapping of some to their weights, such as ``{0: 0.8, 1: 0.6}`` for an inclined
            direction; or an array (n,) of all weights.
        base : mapping of str to (direction, kind), optional
            Supports that move together: by the name of the input, how the structure is displaced if it follows a unit
            displacement of them without deformation, an array (n,) or a mapping, and whether the input is their
            "acceleration", "velocity" or "displacement". The states are relative to the base then, and so are the
            elements, of which those of one degree of freedom end at the base.
        outputs : mapping of str to (place, kind)
            What is measured: "displacement", "velocity" or "acceleration", of a place like those of `forces`; of a
            tuple (i, j) the difference of i and j. Of places that a base carries, "absolute acceleration" (of an
            accelerometer) or "relative acceleration" (to the base), and so on.
        elements : sequence of elements.Element
            Nonlinear parts. Each parameter of an element is a parameter of the model, called element_parameter.
        condensed : bool, optional
            By default True for more than ten degrees of freedom, if no element depends on the time.
        units : mapping of str to str, optional
            As in `Model`.

        Returns
        -------
        Model

        Raises
        ------
        ValueError
            For matrices that are not square, of different sizes or not finite, a singular mass matrix, a place that
            does not exist, an output that may be absolute or relative, an absolute one that needs the integral of the
            input, a condensed model without input or with an element that depends on the time, and as for `Model`.

        Examples
        --------
        >>> model = bp.Model.from_matrices("two_masses", mass=np.eye(2), stiffness=[[2, -1], [-1, 1]],
        ...     damping={"alpha": np.eye(2)}, forces={"force": 0}, outputs={"a": (1, "acceleration")},
        ...     elements=[bp.elements.Element("joint", bp.elements.jenkins, (1, 0), {"width": 0.1})])
        >>> model.states, model.parameters
        (('x0', 'x1', 'joint'), ('alpha', 'joint_stiffness', 'joint_limit'))
        """
        matrices = {"mass": mass, "damping": damping, "stiffness": stiffness}
        return cls._of_structure(name, structure(matrices, forces, base, outputs, elements), condensed, units)

    @classmethod
    def from_modes(
        cls,
        name: str,
        *,
        frequencies: Sequence[float | str],
        damping_ratios: Sequence[float | str] | float | str,
        shapes: Any,
        forces: Mapping[str, Any] | None = None,
        base: Mapping[str, tuple[Any, ...]] | None = None,
        outputs: Mapping[str, tuple[Any, str]],
        elements: Iterable[Any] = (),
        condensed: bool | None = None,
        units: Mapping[str, str] | None = None,
    ) -> "Model":
        """Return the model of modes with nonlinear elements between points of the structure.

        The equations are q̈ + 4π ζ f q̇ + (2π f)² q = shapesᵀ (forces − elements); the states x0, x1, … are the modal
        coordinates q, and the points are displaced by shapes·q. What other modes bend statically is left out: take
        those that matter at the elements, not only those in the range of frequencies.

        Parameters
        ----------
        name : str
        frequencies : sequence of number or str, (modes,)
            Of the undamped modes [Hz]; a text is a parameter, or an expression of parameters such as ``"1.02*f"``.
        damping_ratios : sequence of number or str, (modes,), or one for all
            Damping over critical damping, ζ.
        shapes : array (points, modes)
            Mode shapes at the points of forces, outputs and elements, for unit modal mass [1/√kg].
        forces, outputs, elements, condensed, units
            As in `from_matrices`, with the numbers of points for those of degrees of freedom.
        base : mapping of str to (direction, kind, participation), optional
            As in `from_matrices`, with the direction at the points, and the participation factors shapesᵀ M r of the
            modes, (modes,) [√kg], which shapes at some points do not determine; programs of finite elements print
            them.

        Returns
        -------
        Model

        Raises
        ------
        ValueError
            For other numbers of frequencies or ratios than modes, a frequency that is not > 0, a place that no mode
            moves, and as for `from_matrices`.

        Examples
        --------
        >>> model = bp.Model.from_modes("plate", frequencies=["f1", 31.0], damping_ratios=["zeta", "zeta"],
        ...     shapes=[[0.5, 0.7], [0.9, -0.4]], forces={"force": 0}, outputs={"a": (1, "acceleration")},
        ...     elements=[bp.elements.Element("mount", bp.elements.cubic, 1)])
        >>> model.parameters
        ('zeta', 'f1', 'mount_k3')
        """
        given = of_modes(frequencies, damping_ratios, shapes, forces, base, outputs, elements)
        return cls._of_structure(name, given, condensed, units)

    @classmethod
    def _of_structure(
        cls, name: str, given: MatrixStructure, condensed: bool | None, units: Mapping[str, str] | None
    ) -> "Model":
        if condensed is None:
            condensed = given.of_motion and bool(given.drives) and given.degrees > MOST_SYMBOLIC
        return CondensedModel(name, given, units) if condensed else cls(name, **definition(given), units=units)

    def _expression(self, argument: str, given: Any) -> sp.Expr:
        if isinstance(given, int | float):
            given = sp.Float(given)
        if isinstance(given, str):
            text, spaces = given, (self.state_symbols, self.input_symbols, self.parameter_symbols, self.time_symbols)
            given = as_expression(argument, text, spaces)
            self.texts[given] = text
        if not isinstance(given, sp.Expr):
            raise ValueError(
                f"{argument}: must be SymPy expressions of s, p and u, got {given!r}; write an equation left = right "
                "as left - right."
            )
        numbers = given.atoms(sp.Number)
        if given.has(sp.I, sp.zoo, sp.nan, sp.oo, -sp.oo) or any(
            abs(number) > sp.Float(LARGEST_FLOAT) for number in numbers
        ):
            raise ValueError(f"{argument}: must be real and finite, got {_checks.shortened(given)}.")
        known = {*self.state_symbols.values(), *self.input_symbols.values()}
        known |= {*self.parameter_symbols.values(), *self.time_symbols.values()}
        if unknown := sorted(map(str, given.free_symbols - known)):
            raise ValueError(f"{argument}: must contain only symbols of s, p and u, got {', '.join(unknown)}.")
        return given

    def _order(self, state: str) -> int:
        for order in (2, 1):
            if self.state_symbols[DERIVATIVES[order] + state] in _symbols(self.equations):
                return order
        raise ValueError(
            f"states: must have a derivative in an equation, got {state!r} without one; eliminate it, or add its "
            "equation."
        )

    @cached_property
    def autonomous(self) -> bool:
        """True if the equations contain neither inputs nor τ, so that the period is unknown."""
        forcing = {*self.input_symbols.values(), self.time_symbols["tau"]}
        return not _symbols(self.equations) & forcing

    @cached_property
    def explicit_time(self) -> bool:
        """True if equations or outputs contain τ, so that a shift of all signals in time matters."""
        return self.time_symbols["tau"] in _symbols((*self.equations, *self.output_expressions))

    @cached_property
    def smooth_signs(self) -> tuple[sp.Expr, ...]:
        """The tanh and arctan terms in the equations whose arguments vary along an orbit."""
        moving = {*self.state_symbols.values(), *self.input_symbols.values(), self.time_symbols["tau"]}
        atoms = set().union(*(e.atoms(sp.tanh, sp.atan) for e in self.equations))
        return tuple(sorted((sign for sign in atoms if sign.free_symbols & moving), key=sp.default_sort_key))

    @cached_property
    def softened(self) -> "Model":
        """The model with an additional last parameter that multiplies the arguments of all smooth signs."""
        sharpness = sp.Symbol("p_sharpness_of_signs", real=True)
        softer = {sign: sign.func(sharpness * sign.args[0]) for sign in self.smooth_signs}
        other = copy(self)
        other.equations = tuple(e.xreplace(softer) for e in self.equations)
        other.parameters = (*self.parameters, "sharpness_of_signs")
        other.parameter_symbols = {**self.parameter_symbols, "sharpness_of_signs": sharpness}
        return other

    @property
    def symbolic(self) -> SymbolicModel:
        """Symbols and expressions, from which the compiled functions are generated."""
        return SymbolicModel(
            states=tuple(self.state_symbols.values()),
            inputs=tuple(self.input_symbols.values()),
            parameters=tuple(self.parameter_symbols.values()),
            tau=self.time_symbols["tau"],
            frequency=self.time_symbols["frequency"],
            equations=self.equations,
            outputs=self.output_expressions,
            transitions=tuple(sign.args[0] for sign in self.smooth_signs),
        )

    @cached_property
    def definition(self) -> str:
        """All that solutions and residuals depend on, as text; equal for equal models."""
        names = self.states, self.inputs, self.parameters, self.outputs, self.angles
        return "\n".join([repr(names), *map(sp.srepr, (*self.equations, *self.output_expressions))])

    @cached_property
    def kernels(self) -> Kernels:
        """The compiled residual, Jacobian, outputs and derivatives; cached on disk."""
        return self.symbolic.kernels()

    @cached_property
    def jacobian_change(self) -> GridFunction:
        """The compiled directional derivative of ∂g/∂(q, q̇, q̈); see `SymbolicModel.jacobian_change_source`."""
        return grid_functions(self.symbolic.jacobian_change_source(), ["jacobian_change"])[0]

    def vjp_kernels(self, moving: tuple[int, ...]) -> VjpKernels:
        """Return the compiled vector-Jacobian products of a gradient.

        Parameters
        ----------
        moving : tuple of int
            Indices of the parameters of the gradient.

        Returns
        -------
        VjpKernels
        """
        if moving not in self._vjp_kernels:
            self._vjp_kernels[moving] = VjpKernels(*grid_functions(self.symbolic.vjp_source(moving), VJP_FUNCTIONS))
        return self._vjp_kernels[moving]

    @cached_property
    def _vjp_kernels(self) -> dict[tuple[int, ...], VjpKernels]:
        return {}

    def input_derivatives(self) -> dict[str, int]:
        """Return the order of the highest time derivative of every input that the model uses."""
        used = _symbols((*self.equations, *self.output_expressions))
        return {
            name: max(order for order in range(3) if not order or self.input_symbols[DERIVATIVES[order] + name] in used)
            for name in self.inputs
        }

    def latex(self) -> str:
        """Return the equations and outputs as a LaTeX ``aligned`` environment."""
        written = {symbol: sp.latex(sp.Symbol(name)) for name, symbol in self.parameter_symbols.items()}
        for names, symbols in ((self.states, self.state_symbols), (self.inputs, self.input_symbols)):
            for name in names:
                plain = sp.latex(sp.Symbol(name)) if len(name) <= 2 or "_" in name else rf"\mathrm{{{name}}}"
                written |= {symbols[name]: plain, symbols["d" + name]: rf"\dot{{{plain}}}"}
                written[symbols["dd" + name]] = rf"\ddot{{{plain}}}"
        written |= {self.time_symbols["tau"]: r"\tau", self.time_symbols["frequency"]: "f"}
        rows = [f"{sp.latex(e, symbol_names=written)} &= 0" for e in self.equations]
        rows += [
            rf"\hat{{y}}_{{\mathrm{{{name}}}}} &= {sp.latex(e, symbol_names=written)}"
            for name, e in zip(self.outputs, self.output_expressions, strict=True)
        ]
        return "\\begin{aligned}\n" + " \\\\\n".join(rows) + "\n\\end{aligned}"

    def __getstate__(self) -> dict[str, Any]:
        # Copies are changed before use; none keeps what was computed from the equations.
        classes = type(self).__mro__
        computed = {name for one in classes for name, value in vars(one).items() if isinstance(value, cached_property)}
        return {key: value for key, value in self.__dict__.items() if key not in computed}

    def __repr__(self) -> str:
        return (
            f"Model({self.name!r}, states={list(self.states)}, inputs={list(self.inputs)}, "
            f"parameters={list(self.parameters)}, outputs={list(self.outputs)})"
        )


class CondensedModel(Model):
    """Model of matrices whose periodic solutions are found in the displacements of its elements alone.

    `Model.from_matrices` makes it. It has no symbolic equations: what needs them raises a ValueError. The internal
    states of elements, such as `elements.jenkins`, are no states of the model.

    Parameters
    ----------
    name : str
    structure : MatrixStructure
        Checked matrices, places and elements.
    units : mapping of str to str, optional

    Raises
    ------
    ValueError
        Without a force, for an element that depends on the time, and for internal states whose equations are not of
        first order and linear in the derivatives.
    """

    def __init__(self, name: str, structure: MatrixStructure, units: Mapping[str, str] | None = None):
        if not structure.of_motion:
            raise ValueError(
                "elements: must be functions of displacement, velocity and internal states in a condensed model, got "
                "one with an argument s and no states; take condensed=False, or an element without s."
            )
        if not structure.drives:
            raise ValueError(
                "forces: must have at least one force or a base in a condensed model, got none; take condensed=False."
            )
        given = definition(structure)
        self._set_names(name, given["states"], given["inputs"], given["parameters"])
        inner, self.states = self.states[structure.degrees :], self.states[: structure.degrees]
        self.outputs = _checks.identifiers("outputs", structure.measured, (*RESERVED, *self.inputs))
        if not self.outputs:
            raise ValueError("outputs: must have at least one output, got none.")
        moving = motion_of_elements(structure.elements, inner, self.parameter_symbols)
        self.element_forces, self.element_rates = moving.forces, moving.rates
        self.element_symbols, self.state_blocks, self.state_owners = moving.symbols, moving.blocks, moving.owners
        self.element_motion, self.internal_states = moving.of_elements, moving.states
        unknown = [n for n in self.parameters if n not in structure.parameters]
        self._warn_of_unused([*moving.forces, *moving.rates], unknown)
        self.element_names = tuple(element.name for element in structure.elements)
        # Functions cannot be pickled; what they returned is kept.
        self.structure = replace(structure, elements=())
        self.angles, self.orders = (), dict.fromkeys(self.states, 2)
        self.units = _checks.checked_units(units, (*self.states, *self.inputs, *self.outputs, *self.parameters))

    def refusal(self) -> ValueError:
        """Return the error for what needs symbolic equations."""
        return ValueError(
            f"model: must have symbolic equations for this, got {self.name!r}, which is condensed to the displacements "
            "of its elements; make it with Model.from_matrices(…, condensed=False), of few degrees of freedom, such as "
            "the modes in the frequency range."
        )

    @property
    def equations(self) -> tuple[sp.Expr, ...]:  # type: ignore[override]
        """Refused."""
        raise self.refusal()

    @property
    def output_expressions(self) -> tuple[sp.Expr, ...]:  # type: ignore[override]
        """Refused."""
        raise self.refusal()

    @property
    def symbolic(self) -> SymbolicModel:
        """Refused."""
        raise self.refusal()

    @cached_property
    def autonomous(self) -> bool:
        """False, since a force acts."""
        return False

    @cached_property
    def explicit_time(self) -> bool:
        """False, since elements do not depend on the time."""
        return False

    @cached_property
    def smooth_signs(self) -> tuple[sp.Expr, ...]:
        """None: the points of the grid are doubled until the forces are resolved."""
        return ()

    @cached_property
    def definition(self) -> str:
        """All that solutions depend on, as text; equal for equal models."""
        names = self.states, self.inputs, self.parameters, self.outputs, "condensed"
        places = repr((self.state_owners, *self.element_motion[: len(self.element_forces)], *self.internal_states))
        expressions = map(sp.srepr, (*self.element_forces, *self.element_rates))
        return "\n".join([repr(names), self.structure.digest, places, *expressions])

    @cached_property
    def element_kernels(self) -> Kernels:
        """The compiled forces of the elements, then the rates of internal states; cached on disk.

        They are equations of the elements' displacements and of the internal states.
        """
        return SymbolicModel(
            states=self.element_symbols,
            inputs=(),
            parameters=tuple(self.parameter_symbols.values()),
            tau=self.time_symbols["tau"],
            frequency=self.time_symbols["frequency"],
            equations=(*self.element_forces, *self.element_rates) or (sp.S.Zero,),
            outputs=(sp.S.Zero,),
            transitions=(),
        ).kernels()

    @cached_property
    def with_all_outputs(self) -> "CondensedModel":
        """The model whose outputs are the displacements of all degrees of freedom."""
        other, places = copy(self), np.eye(len(self.states))
        everywhere = {x: (places[i], 0) for i, x in enumerate(self.states)}
        other.structure = replace(self.structure, measured=everywhere, carried={})
        other.outputs = self.states
        return other

    def input_derivatives(self) -> dict[str, int]:
        """Return 0 for every force, and how often the motion of a base is differentiated to be its acceleration."""
        return dict.fromkeys(self.inputs, 0) | {name: 2 - base.order for name, base in self.structure.bases.items()}

    def latex(self) -> str:
        """Return the equation of motion, and the forces of the elements, as a LaTeX ``aligned`` environment."""
        written = {symbol: sp.latex(sp.Symbol(name)) for name, symbol in self.parameter_symbols.items()}
        count = len(self.element_forces)
        for order, mark in enumerate(("d", r"\dot{d}")):
            for number in range(count):
                written[self.element_motion[order * count + number]] = f"{mark}_{{{number + 1}}}"
        written |= {symbol: f"w_{{{number}}}" for number, symbol in enumerate(self.internal_states, 1)}
        forces = [
            rf"{left}_{{{number + 1}}} &= {sp.latex(e, symbol_names=written)}"
            for left, given in (("f", self.element_forces), (r"\dot{w}", self.element_rates))
            for number, e in enumerate(given)
        ]
        motion = self.structure.latex(self.parameter_symbols, written)
        return (
            "\\begin{aligned}\n"
            + " \\\\\n".join([motion, *(["d &= W x"] if count else []), *forces])
            + "\n\\end{aligned}"
        )


def _symbols(expressions: Iterable[sp.Expr]) -> set[sp.Symbol]:
    return set().union(*(e.free_symbols for e in expressions))


def parameter_vector(model: Model, parameters: Mapping[str, float]) -> np.ndarray:
    """Return the value of every parameter, (parameters,); raise a ValueError for other names and values."""
    _checks.same_names("parameters", parameters, model.parameters)
    return np.array([_checks.finite_number(f"parameters[{n!r}]", parameters[n]) for n in model.parameters])
