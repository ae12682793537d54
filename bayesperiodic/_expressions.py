"""Arithmetic expressions in text form: parsed by a whitelist and evaluated without Python's `eval`."""

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
        The function of the operands.
    slopes : tuple of callable
        Its derivatives with respect to each operand, as functions of the operands.
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
    """A function of named numbers; made by `parse`.

    Attributes
    ----------
    text : str
    names : tuple of str
        The names that appear, in order of appearance.
    steps : tuple of float, str or Operation
        Numbers, names and operations in postfix order.
    """

    text: str
    names: tuple[str, ...]
    steps: tuple[float | str | Operation, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        return parse, ("expression", self.text, self.names)

    def value(self, values: Mapping[str, Any]) -> np.ndarray:
        """Return the value at numbers or arrays, which are broadcast; NaN or infinite where undefined."""
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
        """Return the derivatives with respect to the names `by`, by default those that appear.

        They are computed by forward differentiation. A derivative that does not exist is NaN or infinite, such as those
        of abs and sqrt at 0.
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
            raise ValueError(f"values: must have {list(self.names)} for {self.text!r}, got no {missing}.")
        given = {name: np.asarray(values[name], dtype=float) for name in self.names}
        shapes = {value.shape for value in given.values()}
        return given, shapes.pop() if len(shapes) == 1 else np.broadcast_shapes(*shapes)


def parse(argument: str, text: Any, names: Iterable[str], note: str = "") -> Expression:
    """Parse a text such as ``"k1/(m*l**2)"``.

    Only numbers, `names`, pi, + - * / **, parentheses and `FUNCTIONS` are accepted. Numbers are floats, and parts
    without names are evaluated when the text is parsed.

    Parameters
    ----------
    argument : str
        Name of the argument, for error messages.
    text : str
    names : iterable of str
        Names that the text may contain; a name pi replaces the constant.
    note : str
        Added to the message about an unknown name.

    Raises
    ------
    ValueError
        For anything else, more than 1000 characters, a number or a part without names that is not finite, and a
        constant exponent beyond ±1000.

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
    """Parse a mapping of new names to texts; see `parse`.

    The new names must be identifiers that are neither in `names` nor in `reserved`. A text cannot refer to a new name.
    """
    _checks.mapping(argument, expressions, "{'c1': 'k1/(m*l**2)'}")
    known = tuple(names)
    _checks.identifiers(argument, expressions, (*known, *reserved))
    return {name: parse(f"{argument}[{name!r}]", text, known, note) for name, text in expressions.items()}


class _Reader:
    """Collects the steps of one text from its nodes in postfix order."""

    def __init__(self, argument: str, text: Any, names: Iterable[str], note: str):
        if not isinstance(text, str):
            raise ValueError(f"{argument}: must be a text of {ALLOWED}, got {text!r}.")
        self.text = text.strip()
        shown = text if len(text) <= SHOWN else f"{text[:SHOWN]}…"
        self.argument, self.shown = argument, repr(shown)
        # Python's parser normalises names, for example µ (micro) to μ (mu).
        self.names = {unicodedata.normalize("NFKC", name): name for name in names}
        self.note = note
        self.steps: list[float | str | Operation] = []
        self._numbers: list[bool] = []
        if len(text) > MAX_LENGTH:
            self.refuse(f"which has {len(text)} characters, more than {MAX_LENGTH}")

    def refuse(self, reason: str) -> None:
        """Raise the ValueError."""
        raise ValueError(f"{self.argument}: must consist of {ALLOWED}, got {self.shown}, {reason}.") from None

    def children(self, node: ast.AST) -> list[ast.expr]:
        """Return the operands of a node; raise a ValueError unless the node is on the whitelist."""
        if isinstance(node, ast.Constant | ast.Name):
            return []
        if isinstance(node, ast.UnaryOp) and type(node.op) in OPERATORS:
            return [node.operand]
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
            return [node.left, node.right]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            self.known(node.func.id, FUNCTIONS, "functions")
            if node.keywords or len(node.args) != 1:
                self.refuse(f"in which {node.func.id} has not exactly one argument")
            return node.args
        self.refuse(f"which contains {_described(node)}")
        return []

    def known(self, name: str, allowed: Iterable[str], kind: str = "names") -> None:
        """Raise the ValueError of `_checks.one_of`, with the note, unless a name is allowed."""
        try:
            _checks.one_of(f"{self.argument}: {kind} in {self.shown}", name, allowed)
        except ValueError as error:
            raise ValueError(f"{error} {self.note}".strip()) from None

    def read(self, node: ast.AST) -> None:
        """Append the step of a node after those of its operands."""
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
                self.refuse(f"whose exponent {self._last_number():g} is beyond ±{MAX_EXPONENT:g}")
            self._operate(OPERATORS[type(node.op)])

    def _append(self, step: float | str, number: bool) -> None:
        self.steps.append(step)
        self._numbers.append(number)

    def _last_number(self) -> float:
        last = self.steps[-1]
        assert isinstance(last, float)
        return last

    def _operate(self, operation: Operation) -> None:
        """Append an operation, or its value if all operands are numbers."""
        arity = len(operation.slopes)
        if not all(self._numbers[-arity:]):
            self.steps.append(operation)
            self._numbers[-arity:] = [False]
            return
        with np.errstate(all="ignore"):
            result = float(operation.value(*self.steps[-arity:]))
        if not np.isfinite(result):
            self.refuse("in which a part without names is not finite")
        self.steps[-arity:] = [result]
        self._numbers[-arity:] = [True]

    def _number(self, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.refuse(f"which contains {value!r}")
        try:
            number = float(value)
        except OverflowError:
            number = np.inf
        if not np.isfinite(number):
            self.refuse("which contains a number beyond the largest float")
        return number


def _tree(reader: _Reader) -> ast.expr:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return ast.parse(reader.text, mode="eval").body
    except (SyntaxError, ValueError):
        reader.refuse("which is not an expression" if reader.text else "which is empty")
    except (RecursionError, MemoryError):
        reader.refuse("which is nested too deeply")
    raise AssertionError("unreachable")


def _postfix(reader: _Reader, tree: ast.expr) -> list[ast.expr]:
    """Return the nodes in postfix order, without recursion."""
    found, pending = [], [tree]
    while pending:
        node = pending.pop()
        found.append(node)
        pending.extend(reader.children(node))
    return found[::-1]


def _pop(stack: list[Any], operation: Operation) -> list[Any]:
    """Remove the operands of an operation from the stack and return them."""
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
        "Call": "a call of something other than a function name",
        "Compare": "a comparison",
        "Subscript": "a subscript",
    }
    return words.get(kind, f"Python's {kind}")
