"""Arithmetic expressions in text form: parsed by a whitelist and evaluated without Python's `eval`."""

import ast
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from bayesperiodic import _checks

if TYPE_CHECKING:
    import sympy as sp

MAX_LENGTH = 1000
MAX_EXPONENT = 1000.0
# Of the polynomials in an expression that is analysed symbolically; the work grows with the square of the degree.
MAX_DEGREE = 20.0
MAX_DENOMINATOR = 1000
SHOWN_LETTERS = 80


@dataclass(frozen=True)
class Operation:
    """A function of one or two numbers."""

    value: Callable[..., Any]
    slopes: tuple[Callable[..., Any], ...]  # its derivatives with respect to each operand
    symbolic: str = ""  # name of a function in SymPy; the `value` of operators takes symbols too


def _slope_by_base(a: Any, b: Any) -> Any:
    return np.where(b == 0.0, 0.0, b * np.power(a, b - 1.0))


def _slope_by_exponent(a: Any, b: Any) -> Any:
    return np.where((a == 0.0) & (b > 0.0), 0.0, np.power(a, b) * np.log(a))


OPERATORS = {
    ast.Add: Operation(np.add, (lambda a, b: 1.0, lambda a, b: 1.0)),
    ast.Sub: Operation(np.subtract, (lambda a, b: 1.0, lambda a, b: -1.0)),
    ast.Mult: Operation(np.multiply, (lambda a, b: b, lambda a, b: a)),
    ast.Div: Operation(np.divide, (lambda a, b: 1.0 / b, lambda a, b: -a / b / b)),
    ast.Pow: Operation(np.power, (_slope_by_base, _slope_by_exponent)),
    ast.USub: Operation(np.negative, (lambda a: -1.0,)),
    ast.UAdd: Operation(np.positive, (lambda a: 1.0,)),
}
OPERATIONS = {
    "sqrt": Operation(np.sqrt, (lambda a: 0.5 / np.sqrt(a),), "sqrt"),
    "exp": Operation(np.exp, (np.exp,), "exp"),
    "log": Operation(np.log, (lambda a: 1.0 / a,), "log"),
    "sin": Operation(np.sin, (np.cos,), "sin"),
    "cos": Operation(np.cos, (lambda a: -np.sin(a),), "cos"),
    "tan": Operation(np.tan, (lambda a: 1.0 / np.cos(a) ** 2,), "tan"),
    "atan": Operation(np.arctan, (lambda a: 1.0 / (1.0 + a * a),), "atan"),
    "sinh": Operation(np.sinh, (np.cosh,), "sinh"),
    "cosh": Operation(np.cosh, (np.sinh,), "cosh"),
    "tanh": Operation(np.tanh, (lambda a: 1.0 / np.cosh(a) ** 2,), "tanh"),
    "abs": Operation(np.abs, (lambda a: np.where(a == 0.0, np.nan, np.sign(a)),), "Abs"),
}
CONSTANTS = {"pi": np.pi}
# A function of a number, which is then no fraction in symbolic form; SymPy distinguishes 0.5 and 1/2.
FLOAT_FUNCTION = "float"
DESCRIBED = {
    "Attribute": "an attribute (a dot)",
    "BitXor": "^ (powers are written **)",
    "Call": "a call of something other than a function name",
    "Compare": "a comparison",
    "Subscript": "a subscript",
}
ALLOWED_EXPRESSION = f"numbers, names, pi, + - * / **, parentheses and {', '.join(OPERATIONS)} of one argument"


class Float(float):
    """A number that was written as ``float(0.5)``, or computed from one."""


@dataclass(frozen=True)
class Expression:
    """A function of named numbers; made by `parse`."""

    text: str
    names: tuple[str, ...]  # those that appear, in order of appearance
    steps: tuple[float | str | Operation, ...]  # in postfix order

    def __reduce__(self) -> tuple[Any, ...]:
        return parse, ("expression", self.text, self.names)

    def value(self, values: Mapping[str, Any]) -> np.ndarray:
        """Return the value at numbers or arrays, which are broadcast; NaN or infinite where undefined."""
        return self._evaluate(values, ())[0]

    def gradient(self, values: Mapping[str, Any], by: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """Return the derivatives with respect to the names `by`, by default those that appear.

        A derivative that does not exist is NaN or infinite, such as those of abs and sqrt at 0.
        """
        return self._evaluate(values, self.names if by is None else tuple(by))[1]

    def symbolic(
        self, argument: str, symbols: Mapping[str, "sp.Expr"], degrees: Mapping[str, float] | None = None
    ) -> tuple["sp.Expr", float]:
        """Return the expression in SymPy, with simple fractions as such, and the largest degree of its polynomials.

        `degrees` are those of the symbols, if they are expressions themselves. A ValueError, which names the
        `argument`, is raised for a degree above 20.
        """
        import sympy as sp

        stack: list[tuple[Any, float]] = []
        for step in self.steps:
            if isinstance(step, Operation):
                operands, orders = zip(*_popped(stack, len(step.slopes)), strict=True)
                degree = sum(orders) if step in (OPERATORS[ast.Mult], OPERATORS[ast.Div]) else max(orders)
                if step.symbolic:
                    stack.append((getattr(sp, step.symbolic)(*operands), 1.0))
                    continue
                if step is OPERATORS[ast.Pow]:
                    degree = orders[0] * max(1.0, abs(float(operands[1]))) if operands[1].is_number else 1.0
                if degree > MAX_DEGREE:
                    raise ValueError(
                        f"{argument}: must have powers and products of a degree up to {MAX_DEGREE:g}, got "
                        f"{self.text[:SHOWN_LETTERS]!r} of degree {degree:g}."
                    )
                stack.append((step.value(*operands), degree))
            elif isinstance(step, str):
                stack.append((symbols[step], (degrees or {}).get(step, 1.0)))
            else:
                exact = Fraction(step).limit_denominator(MAX_DENOMINATOR)
                simple = float(exact) == step and not isinstance(step, Float)
                stack.append((sp.Rational(exact) if simple else sp.Float(step), 0.0))
        return stack[0]

    def _evaluate(self, values: Mapping[str, Any], wanted: tuple[str, ...]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return the value and the wanted derivatives, by forward differentiation."""
        if missing := [name for name in self.names if name not in values]:
            raise ValueError(f"values: must have {list(self.names)} for {self.text!r}, got no {missing}.")
        given = {name: np.asarray(values[name], dtype=float) for name in self.names}
        stack: list[tuple[Any, dict[str, Any]]] = []
        with np.errstate(all="ignore"):
            for step in self.steps:
                if isinstance(step, Operation):
                    terms = _popped(stack, len(step.slopes))
                    operands = [value for value, _ in terms]
                    total: dict[str, Any] = {}
                    for slope, (_, partials) in zip(step.slopes, terms, strict=True):
                        factor = slope(*operands) if partials else 0.0
                        for name, partial in partials.items():
                            total[name] = total.get(name, 0.0) + factor * partial
                    stack.append((step.value(*operands), total))
                elif isinstance(step, str):
                    stack.append((given[step], {step: 1.0} if step in wanted else {}))
                else:
                    stack.append((step, {}))
        value, partials = stack[0]
        shape = np.broadcast_shapes(*{array.shape for array in given.values()})
        return np.full(shape, value, float), {name: np.full(shape, partials.get(name, 0.0), float) for name in wanted}


def _popped(stack: list[Any], count: int) -> list[Any]:
    """Remove the last entries of a stack and return them."""
    start = len(stack) - count
    last = stack[start:]
    del stack[start:]
    return last


def parse(argument: str, text: Any, names: Iterable[str], note: str = "") -> Expression:
    """Parse a text such as ``"k1/(m*l**2)"``.

    Only numbers, `names`, pi, + - * / **, parentheses and `OPERATIONS` are accepted; a name pi replaces the constant.
    Numbers are floats, and parts without names are evaluated when the text is parsed; ``float(0.5)`` is 0.5, but no
    fraction in symbolic form. A ValueError, which names the
    `argument` and for an unknown name ends with the `note`, is raised for anything else, more than 1000 characters, a
    number or a part without names that is not finite, and a constant exponent beyond ±1000.

    Examples
    --------
    >>> from bayesperiodic._expressions import parse
    >>> stiffness = parse("c1", "k1/(m*l**2)", ["k1", "m", "l"])
    >>> stiffness.value({"k1": [8.0, 16.0], "m": 2.0, "l": 1.0})
    array([4., 8.])
    >>> stiffness.gradient({"k1": 8.0, "m": 2.0, "l": 1.0}, by=["l"])
    {'l': array(-8.)}
    """
    parser = _Parser(argument, text, names, note)
    nodes, pending = [], [parser.tree()]
    while pending:  # without recursion, which deep nesting would exhaust
        node = pending.pop()
        children = parser.children(node)
        nodes.append((node, len(children)))
        pending.extend(children)
    stack: list[Steps] = []
    for node, count in reversed(nodes):
        stack.append(parser.steps(node, _popped(stack, count)))
    appearing = tuple(dict.fromkeys(step for step in stack[0] if isinstance(step, str)))
    return Expression(parser.text, appearing, tuple(stack[0]))


def parse_any(argument: str, text: Any) -> Expression:
    """Parse a text with any names, see `parse`; pi is the constant."""
    nodes = [*ast.walk(_Parser(argument, text, (), "").tree())]
    functions = {id(node.func) for node in nodes if isinstance(node, ast.Call)}
    named = [node for node in nodes if isinstance(node, ast.Name) and id(node) not in functions]
    places = {node.id: (node.lineno, node.col_offset) for node in reversed(named) if node.id not in CONSTANTS}
    return parse(argument, text, sorted(places, key=places.__getitem__))


def parse_all(
    argument: str, expressions: Any, names: Iterable[str], reserved: Iterable[str] = (), note: str = ""
) -> dict[str, Expression]:
    """Parse a mapping of new names to texts; see `parse`.

    The new names must be identifiers that are neither in `names` nor in `reserved`. A text cannot refer to a new name.
    """
    _checks.mapping(argument, expressions, "{'c1': 'k1/(m*l**2)'}")
    known = tuple(names)
    _checks.identifiers(argument, expressions, (*known, *reserved))
    return {name: parse(f"{argument}[{name!r}]", text, known, note) for name, text in expressions.items()}


Steps = list[float | str | Operation]


class _Parser:
    """The text of one expression, and the steps of its nodes."""

    def __init__(self, argument: str, text: Any, names: Iterable[str], note: str):
        if not isinstance(text, str):
            raise ValueError(f"{argument}: must be a text of {ALLOWED_EXPRESSION}, got {text!r}.")
        self.text, self.argument, self.note = text.strip(), argument, note
        self.shown = repr(text if len(text) <= SHOWN_LETTERS else f"{text[:SHOWN_LETTERS]}…")
        # Python's parser normalises names, for example µ (micro) to μ (mu).
        normal = {name: unicodedata.normalize("NFKC", name) for name in names}
        self.names = {after: name for name, after in normal.items()}
        if same := [name for name, after in normal.items() if self.names[after] != name]:
            self.refuse(f"where {same[0]!r} is the same name as another one to Python; rename it")
        if len(text) > MAX_LENGTH:
            self.refuse(f"which has {len(text)} characters, more than {MAX_LENGTH}")

    def refuse(self, reason: str) -> NoReturn:
        raise ValueError(
            f"{self.argument}: must consist of {ALLOWED_EXPRESSION}, got {self.shown}, {reason}."
        ) from None

    def tree(self) -> ast.expr:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return ast.parse(self.text, mode="eval").body
        except (SyntaxError, ValueError):
            self.refuse("which is not an expression" if self.text else "which is empty")
        except (RecursionError, MemoryError):
            self.refuse("which is nested too deeply")

    def children(self, node: ast.AST) -> list[ast.expr]:
        """Return the operands of a node; raise a ValueError unless the node is on the whitelist."""
        if isinstance(node, ast.Constant | ast.Name):
            return []
        if isinstance(node, ast.UnaryOp) and type(node.op) in OPERATORS:
            return [node.operand]
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
            return [node.left, node.right]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            self._check_name(node.func.id, (*OPERATIONS, FLOAT_FUNCTION), "functions")
            if node.keywords or len(node.args) != 1:
                self.refuse(f"in which {node.func.id} has not exactly one argument")
            return node.args
        kind = type(getattr(node, "op", node)).__name__
        self.refuse("which contains " + DESCRIBED.get(kind, f"Python's {kind}"))

    def steps(self, node: Any, operands: list[Steps]) -> Steps:
        """Return the steps of a node, or its value if all operands are numbers."""
        if isinstance(node, ast.Constant):
            return [self._number(node.value)]
        if isinstance(node, ast.Name) and node.id in self.names:
            return [self.names[node.id]]
        if isinstance(node, ast.Name):
            self._check_name(node.id, dict.fromkeys((*self.names.values(), *CONSTANTS)), "names")
            return [CONSTANTS[node.id]]
        numbers = [part[0] for part in operands if len(part) == 1 and isinstance(part[0], float)]
        called = isinstance(node, ast.Call)
        if called and node.func.id == FLOAT_FUNCTION:
            if not numbers:
                self.refuse(f"in which {FLOAT_FUNCTION} has an argument that is no number")
            return [Float(numbers[0])]
        operation = OPERATIONS[node.func.id] if called else OPERATORS[type(node.op)]
        if operation is OPERATORS[ast.Pow] and isinstance(exponent := operands[1][-1], float):
            if abs(exponent) > MAX_EXPONENT:
                self.refuse(f"whose exponent {exponent:g} is beyond ±{MAX_EXPONENT:g}")
        if len(numbers) < len(operands):
            return [*chain.from_iterable(operands), operation]
        with np.errstate(all="ignore"):
            result = float(operation.value(*numbers))
        if not np.isfinite(result):
            self.refuse("in which a part without names is not finite")
        return [Float(result) if any(isinstance(number, Float) for number in numbers) else result]

    def _check_name(self, name: str, allowed: Iterable[str], kind: str) -> None:
        try:
            _checks.one_of(f"{self.argument}: {kind} in {self.shown}", name, allowed)
        except ValueError as error:
            raise ValueError(f"{error} {self.note}".strip()) from None

    def _number(self, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.refuse(f"which contains {value!r}")
        with suppress(OverflowError):
            if np.isfinite(number := float(value)):
                return number
        self.refuse("which contains a number beyond the largest float")
