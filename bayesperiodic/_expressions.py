"""Expressions that come as text: read through a whitelist, evaluated by a small interpreter, never by Python's own."""

import ast
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesperiodic import _checks

MAX_LENGTH = 1000
MAX_EXPONENT = 1000.0
SHOWN = 80


@dataclass(frozen=True)
class Operation:
    """A function of one or two numbers.

    Attributes
    ----------
    value : callable
        Of the operands.
    slopes : tuple of callable
        Its derivative by each operand, of the same operands.
    """

    value: Callable[..., Any]
    slopes: tuple[Callable[..., Any], ...]


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
FUNCTIONS = {
    "sqrt": Operation(np.sqrt, (lambda a: 0.5 / np.sqrt(a),)),
    "exp": Operation(np.exp, (np.exp,)),
    "log": Operation(np.log, (lambda a: 1.0 / a,)),
    "sin": Operation(np.sin, (np.cos,)),
    "cos": Operation(np.cos, (lambda a: -np.sin(a),)),
    "tan": Operation(np.tan, (lambda a: 1.0 / np.cos(a) ** 2,)),
    "atan": Operation(np.arctan, (lambda a: 1.0 / (1.0 + a * a),)),
    "sinh": Operation(np.sinh, (np.cosh,)),
    "cosh": Operation(np.cosh, (np.sinh,)),
    "tanh": Operation(np.tanh, (lambda a: 1.0 / np.cosh(a) ** 2,)),
    "abs": Operation(np.abs, (lambda a: np.where(a == 0.0, np.nan, np.sign(a)),)),
}
CONSTANTS = {"pi": np.pi}
ALLOWED = f"numbers, names, pi, + - * / **, parentheses and {', '.join(FUNCTIONS)} of one argument"


@dataclass(frozen=True)
class Expression:
    """A function of named numbers, as `parse` reads it.

    Attributes
    ----------
    text : str
    names : tuple of str
        The names that appear, in order of appearance.
    steps : tuple of float, str or Operation
        In postfix order: a number, a name, or an operation on what precedes.
    """

    text: str
    names: tuple[str, ...]
    steps: tuple[float | str | Operation, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        return parse, ("expression", self.text, self.names)

    def value(self, values: Mapping[str, Any]) -> np.ndarray:
        """Return the value at numbers or arrays, NumPy's rules of broadcasting; NaN or infinite where undefined."""
        given, shape = self._given(values)
        stack: list[Any] = []
        with np.errstate(all="ignore"):
            for step in self.steps:
                if isinstance(step, Operation):
                    operands = _pop(stack, step)
                    stack.append(step.value(*operands))
                else:
                    stack.append(given[step] if isinstance(step, str) else step)
        result = np.empty(shape)
        result[...] = stack[0]
        return result

    def gradient(self, values: Mapping[str, Any], by: Iterable[str] | None = None) -> dict[str, np.ndarray]:
        """Return the exact derivatives by the names `by`, by default those that appear.

        They are carried along with the values (forward mode). Where a derivative does not exist it is NaN or infinite,
        such as those of abs and sqrt at 0.
        """
        wanted = self.names if by is None else tuple(by)
        given, shape = self._given(values)
        stack: list[tuple[Any, dict[str, Any]]] = []
        with np.errstate(all="ignore"):
            for step in self.steps:
                if isinstance(step, Operation):
                    terms = _pop(stack, step)
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
        partials = stack[0][1]
        result = {name: np.empty(shape) for name in wanted}
        for name, slopes in result.items():
            slopes[...] = partials.get(name, 0.0)
        return result

    def _given(self, values: Mapping[str, Any]) -> tuple[dict[str, np.ndarray], tuple[int, ...]]:
        """Return the values of the names that appear, and the shape of the result."""
        if missing := [name for name in self.names if name not in values]:
            raise ValueError(f"values: missing {', '.join(map(repr, missing))}; {self.text!r} needs them.")
        given = {name: np.asarray(values[name], dtype=float) for name in self.names}
        shapes = {value.shape for value in given.values()}
        return given, shapes.pop() if len(shapes) == 1 else np.broadcast_shapes(*shapes)


def parse(argument: str, text: Any, names: Iterable[str], note: str = "") -> Expression:
    """Read a text such as ``"k1/(m*l**2)"``.

    Only numbers, `names`, pi, + - * / **, parentheses and the functions of `FUNCTIONS` are let through. Numbers are
    floats from the start, and parts without names are evaluated at once.

    Parameters
    ----------
    argument : str
        What the text is, for error messages.
    text : str
    names : iterable of str
        Those that the text may contain; one that is called pi hides the constant.
    note : str
        Added to the message about an unknown name.

    Raises
    ------
    ValueError
        For anything else, a text of more than 1000 characters, a number or part without names that is not finite, an
        exponent without names beyond ±1000.

    Examples
    --------
    >>> from bayesperiodic._expressions import parse
    >>> stiffness = parse("c1", "k1/(m*l**2)", ["k1", "m", "l"])
    >>> stiffness.value({"k1": [8.0, 16.0], "m": 2.0, "l": 1.0})
    array([4., 8.])
    >>> stiffness.gradient({"k1": 8.0, "m": 2.0, "l": 1.0}, by=["l"])
    {'l': array(-8.)}
    """
    reader = _Reader(argument, text, names, note)
    for node in _postfix(reader, _tree(reader)):
        reader.read(node)
    steps = tuple(reader.steps)
    appearing = tuple(dict.fromkeys(step for step in steps if isinstance(step, str)))
    return Expression(reader.text, appearing, steps)


def parse_all(
    argument: str, expressions: Any, names: Iterable[str], reserved: Iterable[str] = (), note: str = ""
) -> dict[str, Expression]:
    """Read a mapping of new names to texts; the new names must be identifiers, and neither `names` nor `reserved`.

    See `parse`. A text cannot refer to another of the new names.
    """
    if not isinstance(expressions, Mapping):
        raise ValueError(
            f"{argument}: {expressions!r} is not allowed; it must be a mapping of names to texts, such as "
            "{'c1': 'k1/(m*l**2)'}."
        )
    known = tuple(names)
    _checks.identifiers(argument, expressions, (*known, *reserved))
    return {name: parse(f"{argument}[{name!r}]", text, known, note) for name, text in expressions.items()}


class _Reader:
    """Collects the steps of one text, node by node in postfix order."""

    def __init__(self, argument: str, text: Any, names: Iterable[str], note: str):
        if not isinstance(text, str):
            raise ValueError(f"{argument}: {text!r} is not allowed; it must be a text of {ALLOWED}.")
        self.text = text.strip()
        shown = text if len(text) <= SHOWN else f"{text[:SHOWN]}…"
        self.label = f"{argument}: {shown!r}"
        # Python's parser normalises names, µ (micro) to μ (mu) for one.
        self.names = {unicodedata.normalize("NFKC", name): name for name in names}
        self.note = note
        self.steps: list[float | str | Operation] = []
        self._numbers: list[bool] = []
        if len(text) > MAX_LENGTH:
            self.refuse(f"it has {len(text)} characters, more than {MAX_LENGTH}")

    def refuse(self, reason: str) -> None:
        """Raise the ValueError."""
        raise ValueError(f"{self.label} is not allowed, {reason}; it must consist of {ALLOWED}.") from None

    def children(self, node: ast.AST) -> list[ast.expr]:
        """Return the operands of a node; refuse one that is not on the whitelist."""
        if isinstance(node, ast.Constant | ast.Name):
            return []
        if isinstance(node, ast.UnaryOp) and type(node.op) in OPERATORS:
            return [node.operand]
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
            return [node.left, node.right]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            self.known(node.func.id, FUNCTIONS, " (as a function)")
            if node.keywords or len(node.args) != 1:
                self.refuse(f"{node.func.id} takes one argument")
            return node.args
        self.refuse(f"it contains {_described(node)}")
        return []

    def known(self, name: str, allowed: Iterable[str], role: str = "") -> None:
        """Raise the ValueError of `_checks.one_of`, with the note, unless a name is allowed."""
        try:
            _checks.one_of(f"{self.label}{role}", name, allowed)
        except ValueError as error:
            raise ValueError(f"{error} {self.note}".strip()) from None

    def read(self, node: ast.AST) -> None:
        """Append the step of a node whose operands were read."""
        if isinstance(node, ast.Constant):
            self._append(self._number(node.value), True)
        elif isinstance(node, ast.Name) and node.id not in self.names:
            self.known(node.id, dict.fromkeys((*self.names.values(), *CONSTANTS)))
            self._append(CONSTANTS[node.id], True)
        elif isinstance(node, ast.Name):
            self._append(self.names[node.id], False)
        elif isinstance(node, ast.Call):
            assert isinstance(node.func, ast.Name)
            self._operate(FUNCTIONS[node.func.id])
        elif isinstance(node, ast.BinOp | ast.UnaryOp):
            if isinstance(node.op, ast.Pow) and self._numbers[-1] and abs(self._last_number()) > MAX_EXPONENT:
                self.refuse(f"the exponent {self._last_number():g} is beyond ±{MAX_EXPONENT:g}")
            self._operate(OPERATORS[type(node.op)])

    def _append(self, step: float | str, number: bool) -> None:
        self.steps.append(step)
        self._numbers.append(number)

    def _last_number(self) -> float:
        last = self.steps[-1]
        assert isinstance(last, float)
        return last

    def _operate(self, operation: Operation) -> None:
        """Append an operation; evaluate it at once if all its operands are numbers."""
        arity = len(operation.slopes)
        if not all(self._numbers[-arity:]):
            self.steps.append(operation)
            self._numbers[-arity:] = [False]
            return
        with np.errstate(all="ignore"):
            result = float(operation.value(*self.steps[-arity:]))
        if not np.isfinite(result):
            self.refuse("a part of it that has no names is not finite")
        self.steps[-arity:] = [result]
        self._numbers[-arity:] = [True]

    def _number(self, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.refuse(f"it contains {value!r}")
        try:
            number = float(value)
        except OverflowError:
            number = np.inf
        if not np.isfinite(number):
            self.refuse("it contains a number beyond the largest float")
        return number


def _tree(reader: _Reader) -> ast.expr:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return ast.parse(reader.text, mode="eval").body
    except (SyntaxError, ValueError):
        reader.refuse("it is no expression" if reader.text else "it is empty")
    except (RecursionError, MemoryError):
        reader.refuse("it is nested too deeply")
    raise AssertionError("unreachable")


def _postfix(reader: _Reader, tree: ast.expr) -> list[ast.expr]:
    """Return the nodes, operands before what operates on them, without recursion."""
    found, pending = [], [tree]
    while pending:
        node = pending.pop()
        found.append(node)
        pending.extend(reader.children(node))
    return found[::-1]


def _pop(stack: list[Any], operation: Operation) -> list[Any]:
    """Take the operands of an operation off the stack."""
    arity = len(operation.slopes)
    operands = stack[-arity:]
    del stack[-arity:]
    return operands


def _described(node: ast.AST) -> str:
    operator = getattr(node, "op", None)
    kind = type(node if operator is None else operator).__name__
    words = {
        "Attribute": "an attribute (a dot)",
        "BitXor": "^ (powers are written **)",
        "Call": "a call of something else than a function's name",
        "Compare": "a comparison",
        "Subscript": "a subscript",
    }
    return words.get(kind, f"Python's {kind}")
