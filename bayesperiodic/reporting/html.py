"""Formatting of numbers, units, names and equations, and the template engine."""

import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib.resources import files
from itertools import groupby
from math import floor, isfinite, isinf, isnan, log10
from typing import Any
from xml.dom.minidom import parseString

import numpy as np
import sympy as sp
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from sympy.printing.mathml import MathMLPresentationPrinter
from sympy.printing.pretty.pretty_symbology import greek_unicode

from bayesperiodic._verdicts import BAD, CAUTION, GOOD, NEUTRAL
from bayesperiodic.models.matrices import number_of
from bayesperiodic.models.model import CondensedModel, Model
from bayesperiodic.models.names import DERIVATIVES

# A badge shows its tone by a sign as well as by a colour.
SIGNS = {GOOD: "✓", CAUTION: "!", BAD: "✕", NEUTRAL: "•"}


@dataclass(frozen=True)
class Badge:
    """A verdict of one or two words with its tone."""

    tone: str
    text: str


class Number(str):
    """A formatted number; columns that hold one are aligned to the right."""


Rows = Sequence[Mapping[str, str | Badge]]


def columns(rows: Rows) -> list[tuple[str, bool]]:
    """Return the title of each column, without its common head, and whether it holds numbers.

    A title such as "Laplace: sd" places the column "sd" under the common head "Laplace".
    """
    titles = rows[0] if rows else ()
    return [(title.rpartition(": ")[2], any(isinstance(row[title], Number) for row in rows)) for title in titles]


def heads(rows: Rows) -> list[tuple[str, int]]:
    """Return the common heads with the number of columns below each; empty without any."""
    shared = [title.rpartition(": ")[0] for title in (rows[0] if rows else ())]
    return [(head, len(list(columns))) for head, columns in groupby(shared)] if any(shared) else []


def code(name: str) -> Markup:
    """Return a name in the type of source code."""
    return Markup("<code>{}</code>").format(name)


NOTHING = "–"
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
SMALLEST_PLAIN, LARGEST_PLAIN = 1e-2, 1e6


def number(value: float, digits: int = 3) -> Number:
    """Format a number with a count of significant digits and a raised power of ten."""
    if isnan(value):
        return Number(NOTHING)
    if isinf(value):
        return Number("∞" if value > 0 else "−∞")
    mantissa, _, exponent = f"{value:.{digits}g}".partition("e")
    return Number(mantissa.replace("-", "−") + (_power_of_ten(int(exponent)) if exponent else ""))


def _power_of_ten(exponent: int) -> str:
    return f"×10{str(exponent).translate(RAISED)}"


def percent(fraction: float) -> Number:
    """Format a fraction in per cent with three significant digits."""
    return Number(NOTHING if isnan(fraction) else f"{number(100.0 * fraction)}\u00a0%")


def p_value(p: float) -> Number:
    """Format a p-value; values below 10⁻³⁰⁰ are given as such."""
    return Number("< 10⁻³⁰⁰") if p < 1e-300 else number(p, 2)


def counted(count: int, what: str) -> str:
    """Format a count with its noun."""
    return f"{count} {what}{'s' if count != 1 else ''}"


def unit(text: str) -> str:
    """Format a unit with raised powers, without line breaks."""
    raised = re.sub(r"\^(-?\d+)", lambda match: match[1].translate(RAISED), text).replace(" ", "\u00a0")
    return raised or NOTHING


@dataclass(frozen=True)
class Rounding:
    """Common rounding of the values of one quantity: a power of ten and a number of decimals."""

    exponent: int
    decimals: int

    @classmethod
    def of(cls, value: float, sd: float) -> "Rounding":
        """Return the rounding that shows three significant digits of the standard deviation."""
        known = [abs(x) for x in (value, sd) if isfinite(x) and x != 0.0]
        if not known:
            return cls(0, 3)
        size, step = max(known), abs(sd) if isfinite(sd) and sd != 0.0 else 1e-2 * max(known)
        exponent = 0 if SMALLEST_PLAIN <= size < LARGEST_PLAIN else floor(log10(size))
        return cls(exponent, max(0, 2 - floor(log10(step)) + exponent))

    def text(self, value: float) -> Number:
        """Format one value."""
        if not isfinite(value):
            return number(value)
        shown = f"{value / 10.0**self.exponent:.{self.decimals}f}".replace("-", "−")
        return Number(shown + (_power_of_ten(self.exponent) if self.exponent else ""))

    def sd(self, value: float) -> Number:
        """Format a standard deviation, with its own power of ten if the values have one."""
        return number(value) if self.exponent else self.text(value)

    def interval(self, low: float, high: float) -> Number:
        """Format the two ends of an interval."""
        if not isfinite(low) or not isfinite(high):
            return Number(NOTHING)
        plain, scale = Rounding(0, self.decimals), 10.0**self.exponent
        ends = f"{plain.text(low / scale)} … {plain.text(high / scale)}"
        return Number(f"({ends}){_power_of_ten(self.exponent)}" if self.exponent else ends)


DOTS = ("", "˙", "¨")
TRANSPOSED = "<msup><mi>{}</mi><mi>T</mi></msup>"
# Displacements of an output or element of a condensed model that are written out.
MOST_WRITTEN = 6
# Space between factors, because some of them are words.
AS_READ = {
    "<mo>-</mo>": "<mo>−</mo>",
    "<mo>&InvisibleTimes;</mo>": '<mo lspace="0.08em" rspace="0.08em">\u2062</mo>',
    "&ExponentialE;": "e",
    "&pi;": "π",
}
TAGS = {
    "sign": "sgn", "Max": "max", "Min": "min", "log": "ln",
    "StrictGreaterThan": "&gt;", "StrictLessThan": "&lt;", "GreaterThan": "≥", "LessThan": "≤", "Unequality": "≠",
}  # fmt: skip


def equations(model: Model) -> list[Markup]:
    """Return the equations of motion, one per state, with the terms that contain no state on the right-hand side.

    Of a condensed model they are that of all degrees of freedom with matrices, and the forces of the elements.
    """
    if isinstance(model, CondensedModel):
        return _condensed_equations(model)
    printer, states = _MathPrinter(_names(model)), model.state_symbols.values()
    sides = [equation.as_independent(*states, as_Add=True) for equation in model.equations]
    return [printer.equation(left, -right) for right, left in sides]


def outputs(model: Model) -> list[Markup]:
    """Return the output equations, one per channel."""
    printer = _MathPrinter(_names(model))
    if isinstance(model, CondensedModel):
        measured, carried = model.structure.measured.items(), model.structure.carried
        return [
            printer.displayed(printer.named(name), _moved(model, printer, *given, carried.get(name, {})))
            for name, given in measured
        ]
    each = zip(model.outputs, model.output_expressions, strict=True)
    return [printer.equation(sp.Symbol(name), expression) for name, expression in each]


def _condensed_equations(model: CondensedModel) -> list[Markup]:
    count = len(model.element_forces)
    numbers = range(1, count + 1)
    moving = dict(zip(model.element_motion, ((f"d_{k}", order) for order in range(3) for k in numbers), strict=True))
    moving |= {symbol: (f"w_{k}", 0) for k, symbol in enumerate(model.internal_states, 1)}
    printer, terms, masses = _MathPrinter(_names(model) | moving), [], []
    for factor, letter, number, order in model.structure.linear_terms(model.parameter_symbols):
        scale = printer.text(factor) if factor != 1 else ""
        scale = f"<mrow><mo>(</mo>{scale}<mo>)</mo></mrow>" if factor.is_Add else scale
        matrix = f"{scale}{printer.named(f'{letter}_{number}')}"
        terms.append(f"{matrix}{printer.named('x', order)}")
        masses += [matrix] if letter == "M" else []
    terms += [f"{TRANSPOSED.format('W')}{printer.named('f')}"] if count else []
    mass = masses[0] if len(masses) == 1 else f"<mrow><mo>(</mo>{'<mo>+</mo>'.join(masses)}<mo>)</mo></mrow>"
    loads = [printer.named("B") + printer.named("u")] * bool(model.structure.inputs)
    loads += [
        f"<mo>−</mo>{mass}{printer.named(f'r_{number}')}{printer.named(name, 2 - base.order)}"
        for number, (name, base) in enumerate(model.structure.bases.items())
    ]
    rows = [printer.displayed("<mo>+</mo>".join(terms), "".join(loads))]
    each = zip(numbers, model.structure.weights, model.element_forces, strict=True)
    for k, at, force in each:
        rows.append(printer.displayed(printer.named(f"d_{k}"), _moved(model, printer, at, 0)))
        rows.append(printer.displayed(printer.named(f"f_{k}"), printer.text(force)))
    for k, rate in enumerate(model.element_rates, 1):
        rows.append(printer.displayed(printer.named(f"w_{k}", 1), printer.text(rate)))
    return rows


def _moved(
    model: CondensedModel,
    printer: "_MathPrinter",
    weights: np.ndarray,
    order: int,
    carried: Mapping[str, float] | None = None,
) -> str:
    """Return the weighted sum of displacements or of their derivatives, as a product where it has many terms.

    `carried` is the weight of the motion of each base, by which an absolute motion differs from a relative one.
    """
    moved = (model.state_symbols[DERIVATIVES[order] + name] for name in model.states)
    text = f"{TRANSPOSED.format('w')}{printer.named('x', order)}"
    if np.count_nonzero(weights) <= MOST_WRITTEN:
        text = printer.text(sp.Add(*(number_of(w) * x for w, x in zip(weights, moved, strict=True) if w)))
    for name, weight in (carried or {}).items():
        size = printer.text(number_of(abs(weight))) if abs(weight) != 1.0 else ""
        dots = order - model.structure.bases[name].order
        text += f"<mo>{'+' if weight > 0.0 else '−'}</mo>{size}{printer.named(name, dots)}"
    return text


def symbol(name: str) -> Markup:
    """Typeset a name: Greek letters, and digits and the parts after underscores as subscripts."""
    return Markup(f"<math>{_MathPrinter({}).text(sp.Symbol(name))}</math>")


def _names(model: Model) -> dict[sp.Symbol, tuple[str, int]]:
    """Return the name and the order of the derivative of each symbol."""
    meanings = {model.time_symbols["tau"]: ("tau", 0), model.time_symbols["frequency"]: ("f", 0)}
    meanings |= {symbol: (name, 0) for name, symbol in model.parameter_symbols.items()}
    for names, symbols in ((model.states, model.state_symbols), (model.inputs, model.input_symbols)):
        meanings |= {symbols["d" * order + name]: (name, order) for name in names for order in range(3)}
    return meanings


class _MathPrinter(MathMLPresentationPrinter):
    """Printer of symbols by their names, with dots for time derivatives."""

    def __init__(self, names: dict[sp.Symbol, tuple[str, int]]):
        super().__init__()
        self._names = names

    def equation(self, *sides: sp.Expr) -> Markup:
        """Return a displayed equation."""
        return self.displayed(*map(self.text, sides))

    def displayed(self, *sides: str) -> Markup:
        """Return a displayed equation of typeset sides."""
        return Markup(f'<math display="block">{"<mo>=</mo>".join(sides)}</math>')

    def named(self, name: str, order: int = 0) -> str:
        """Return a typeset name, with dots for time derivatives."""
        return str(self._symbol(name, order).toxml())

    def text(self, expression: sp.Expr) -> str:
        """Return an expression as text, with entities replaced by characters."""
        text = self._print(expression).toxml()
        for printed, wanted in AS_READ.items():
            text = text.replace(printed, wanted)
        return text

    def mathml_tag(self, e: Any) -> str:
        """Return the tag or name of a function, or the sign of a relation."""
        return TAGS.get(type(e).__name__) or super().mathml_tag(e)

    def _print_Symbol(self, sym: sp.Symbol, style: str = "plain") -> Any:
        return self._symbol(*self._names.get(sym, (sym.name, 0)))

    def _symbol(self, name: str, order: int) -> Any:
        pieces = [greek_unicode.get(piece, piece) for piece in re.findall(r"\d+|[^\d_]+", name)]
        base, *below = (f"<mn>{piece}</mn>" if piece.isdigit() else f"<mi>{escape(piece)}</mi>" for piece in pieces)
        if order:
            base = f'<mover accent="true">{base}<mo>{DOTS[order]}</mo></mover>'
        if below:
            marks = below[0] if len(below) == 1 else f"<mrow>{''.join(below)}</mrow>"
            base = f"<msub>{base}{marks}</msub>"
        return parseString(base).documentElement

    def _print_Float(self, expr: sp.Float) -> Any:
        mantissa, _, exponent = f"{float(expr):.12g}".partition("e")
        markup = f"<mn>{mantissa}</mn>"
        if exponent:
            power = str(int(exponent)).replace("-", "−")
            markup = f"<mrow>{markup}<mo>×</mo><msup><mn>10</mn><mn>{power}</mn></msup></mrow>"
        return parseString(markup).documentElement

    def _print_Piecewise(self, expr: sp.Piecewise) -> Any:
        rows = ""
        for value, condition in expr.args:
            when = f"<mtext>if\u00a0</mtext>{self.text(condition)}"
            when = "<mtext>otherwise</mtext>" if condition is sp.true else when
            rows += f"<mtr><mtd>{self.text(value)}</mtd><mtd>{when}</mtd></mtr>"
        return parseString(f"<mrow><mo>{{</mo><mtable>{rows}</mtable></mrow>").documentElement

    def _as_ordered_terms(self, expr: sp.Expr, order: Any = None) -> list[sp.Expr]:
        """Sort terms by their highest derivative, negative ones last."""
        terms = super()._as_ordered_terms(expr, order)
        return sorted(terms, key=lambda term: (-self._height(term), term.could_extract_minus_sign()))

    def _height(self, term: sp.Expr) -> int:
        return max((self._names.get(s, ("", 0))[1] for s in term.free_symbols), default=0)


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("bayesperiodic.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.tests["badge"] = lambda value: isinstance(value, Badge)
    made.globals |= {"signs": SIGNS, "Badge": Badge, "columns": columns, "heads": heads}
    made.globals |= {"equations": equations, "outputs": outputs}
    made.filters |= {"number": number, "percent": percent, "counted": counted}
    return made


def page(**content: Any) -> str:
    """Render the page; all text is escaped, and the browser runs no script but the one with this digest."""
    script = (files("bayesperiodic.reporting") / "templates" / "page.js").read_text(encoding="utf-8")
    digest = b64encode(sha256(script.encode()).digest()).decode("ascii")
    return _environment().get_template("page.html").render(content, script=Markup(script), digest=digest)
