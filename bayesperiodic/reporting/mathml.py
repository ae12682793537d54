"""Equations and symbols as MathML, which browsers typeset without any script."""

import re
from collections.abc import Iterable
from typing import Any

import sympy as sp
from markupsafe import Markup
from sympy.printing.mathml import MathMLPresentationPrinter
from sympy.printing.pretty.pretty_symbology import greek_unicode

from bayesperiodic.models.model import Model

DOTS = ("", "˙", "¨")
# A little space between factors, as some of them are words.
AS_READ = {
    "<mo>-</mo>": "<mo>−</mo>",
    "<mo>&InvisibleTimes;</mo>": '<mo lspace="0.08em" rspace="0.08em">\u2062</mo>',
    "&ExponentialE;": "e",
    "&pi;": "π",
}
FUNCTIONS = {"sign": "sgn", "Max": "max", "Min": "min", "log": "ln"}


def equations(model: Model) -> tuple[Markup, ...]:
    """Return the equations of motion, one a state; what no state enters stands on the right-hand side.

    Examples
    --------
    >>> import bayesperiodic as bp
    >>> from bayesperiodic.reporting.mathml import equations
    >>> equations(bp.models.duffing)[0].count("<mover")
    2
    """
    printer, states = _Printer(model), set(model.state_symbols.values())
    rows = []
    for equation in model.equations:
        terms = sp.Add.make_args(equation)
        left = [term for term in terms if term.free_symbols & states]
        right = [-term for term in terms if not term.free_symbols & states]
        rows.append(_block(printer, sp.Add(*left), sp.Add(*right)))
    return tuple(rows)


def outputs(model: Model) -> tuple[Markup, ...]:
    """Return what the model says of the measured channels, an equation a channel."""
    printer = _Printer(model)
    each = zip(model.outputs, model.output_expressions, strict=True)
    return tuple(_block(printer, sp.Symbol(name), expression) for name, expression in each)


def symbol(name: str) -> Markup:
    """Return a name as it is typeset: Greek letters, digits and what follows an underscore as subscripts.

    Examples
    --------
    >>> from bayesperiodic.reporting.mathml import symbol
    >>> print(symbol("theta16"))
    <math><msub><mi>θ</mi><mn>16</mn></msub></math>
    """
    return Markup(f"<math>{_Printer.text_of(_Printer().named(name))}</math>")


def parts(name: str) -> tuple[str, tuple[str, ...]]:
    """Return what a name has on the line, and its subscripts.

    Examples
    --------
    >>> from bayesperiodic.reporting.mathml import parts
    >>> parts("k_alpha2"), parts("Kx"), parts("omega0")
    (('k', ('α', '2')), ('Kx', ()), ('ω', ('0',)))
    """
    pieces = [piece for part in name.split("_") for piece in re.findall(r"\d+|\D+", part)]
    base, *below = (greek_unicode.get(piece, piece) for piece in pieces)
    return base, tuple(below)


class _Printer(MathMLPresentationPrinter):
    """Prints the symbols of a model by their names, with dots for time derivatives."""

    def __init__(self, model: Model | None = None):
        super().__init__()
        self._names: dict[sp.Symbol, tuple[str, int]] = {}
        if model is None:
            return
        for names, symbols in ((model.states, model.state_symbols), (model.inputs, model.input_symbols)):
            for name in names:
                self._names |= {symbols["d" * order + name]: (name, order) for order in range(3)}
        self._names |= {symbol: (name, 0) for name, symbol in model.parameter_symbols.items()}
        self._names |= {model.time_symbols["tau"]: ("tau", 0), model.time_symbols["frequency"]: ("f", 0)}

    @staticmethod
    def text_of(node: Any) -> str:
        """Return a node as text, with signs and entities as the characters they stand for."""
        text = node.toxml()
        for printed, wanted in AS_READ.items():
            text = text.replace(printed, wanted)
        return text

    def node(self, tag: str, *children: Any) -> Any:
        """Return an element with a text or other elements in it."""
        made = self.dom.createElement(tag)
        for child in children:
            made.appendChild(self.dom.createTextNode(child) if isinstance(child, str) else child)
        return made

    def named(self, name: str, order: int = 0) -> Any:
        """Return a name with dots and subscripts."""
        base, below = parts(name)
        line = self.node("mi", base)
        if order:
            line = self.node("mover", line, self.node("mo", DOTS[order]))
            line.setAttribute("accent", "true")
        if not below:
            return line
        marks = [self.node("mn" if piece.isdigit() else "mi", piece) for piece in below]
        return self.node("msub", line, marks[0] if len(marks) == 1 else self.node("mrow", *marks))

    def mathml_tag(self, e: Any) -> str:
        """Return the name of a function as it is written."""
        return FUNCTIONS.get(type(e).__name__) or super().mathml_tag(e)

    def _print_Symbol(self, sym: sp.Symbol, style: str = "plain") -> Any:
        return self.named(*self._names.get(sym, (sym.name, 0)))

    def _print_Float(self, expr: sp.Float) -> Any:
        mantissa, _, exponent = f"{float(expr):.12g}".partition("e")
        if not exponent:
            return self.node("mn", mantissa)
        power = self.node("msup", self.node("mn", "10"), self.node("mn", str(int(exponent)).replace("-", "−")))
        return self.node("mrow", self.node("mn", mantissa), self.node("mo", "×"), power)

    def _print_Piecewise(self, expr: sp.Piecewise) -> Any:
        rows = []
        for value, condition in expr.args:
            when = [self.node("mtext", "if\u00a0"), self._print(condition)]
            if condition is sp.true:
                when = [self.node("mtext", "otherwise")]
            rows.append(self.node("mtr", self.node("mtd", self._print(value)), self.node("mtd", *when)))
        return self.node("mrow", self.node("mo", "{"), self.node("mtable", *rows))

    def _print_Relational(self, e: Any) -> Any:
        sign = {">": "&gt;", "<": "&lt;", ">=": "≥", "<=": "≤", "==": "=", "!=": "≠"}[e.rel_op]
        return self.node("mrow", self._print(e.lhs), self.node("mo", sign), self._print(e.rhs))

    def _as_ordered_terms(self, expr: sp.Expr, order: Any = None) -> list[sp.Expr]:
        """Return the terms by the highest derivative in them, and within these those with a minus sign last."""
        terms = super()._as_ordered_terms(expr, order)
        return sorted(terms, key=lambda term: (-self._height(term), term.could_extract_minus_sign()))

    def _height(self, term: sp.Expr) -> int:
        return max((self._names.get(s, ("", 0))[1] for s in term.free_symbols), default=0)


def _block(printer: _Printer, *sides: sp.Expr) -> Markup:
    """Return an equation on a line of its own."""
    return Markup(f'<math display="block">{"<mo>=</mo>".join(_written(printer, sides))}</math>')


def _written(printer: _Printer, sides: Iterable[sp.Expr]) -> list[str]:
    return [printer.text_of(printer._print(side)) for side in sides]
