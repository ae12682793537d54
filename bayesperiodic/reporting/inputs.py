"""Inputs of the report, and the typesetting of equations and symbols."""

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
import sympy as sp
from markupsafe import Markup
from sympy.printing.mathml import MathMLPresentationPrinter
from sympy.printing.pretty.pretty_symbology import greek_unicode

from bayesperiodic import _checks
from bayesperiodic.diagnostics.comparison import Comparison, compare
from bayesperiodic.diagnostics.identifiability import Identifiability, identifiability
from bayesperiodic.diagnostics.predictive import Prediction, predict
from bayesperiodic.estimation.map_estimate import estimation_warnings
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.models.model import Model
from bayesperiodic.posterior.parameters import SHIFT, squared
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.reporting import html
from bayesperiodic.sampling.posterior import Posterior

# Level of the whiteness test, and the ratio of robust to Laplace sd above which the report warns.
NOT_WHITE, LARGE_RATIO = 0.01, 1.5


@dataclass(frozen=True)
class ReportInputs:
    """A problem, its estimate, and the draws and diagnostics that the report shows; those that are missing are None.

    Attributes
    ----------
    no_prediction : str
        Reason why there is no prediction although there are draws; "" otherwise.
    """

    problem: Problem
    fit: MapEstimate
    posterior: Posterior | None
    identifiability: Identifiability
    comparison: Comparison | None
    prediction: Prediction | None
    no_prediction: str

    @classmethod
    def of(
        cls,
        problem: Problem,
        fit: MapEstimate,
        posterior: Posterior | None,
        found: Identifiability | None,
        comparison: Comparison | None,
        prediction: Prediction | None,
    ) -> "ReportInputs":
        """Check that all inputs belong to one problem, and compute the diagnostics that are not given."""
        runs, no_prediction = [e.name for e in problem.experiments], ""
        _checks.same_names("fit", fit.theta, problem.names)
        _checks.same_names("fit", fit.residuals, runs)
        if posterior is not None:
            _check_data(posterior, problem)
            comparison = compare(problem, fit, posterior) if comparison is None else comparison
            try:
                prediction = predict(problem, posterior) if prediction is None else prediction
            except RuntimeError as error:
                no_prediction = str(error)
        found = identifiability(problem, fit, posterior, profile=False) if found is None else found
        _checks.same_names("identifiability", dict.fromkeys(found.table.index), problem.names)
        if comparison is not None:
            remedy = "give the one of this problem, compare(problem, fit, posterior)"
            _checks.contains("comparison", comparison.table.index, problem.names, remedy)
        if prediction is not None:
            _checks.same_names("prediction", prediction.median, runs)
        return cls(problem, fit, posterior, found, comparison, prediction, no_prediction)

    @property
    def synthetic(self) -> bool:
        """Whether any of the data were simulated."""
        return any(e.synthetic for e in self.problem.experiments)

    @property
    def clocks(self) -> set[str]:
        """The time symbols, of "tau" and "frequency", that the model contains."""
        model = self.problem.model
        used = set().union(*(e.free_symbols for e in (*model.equations, *model.output_expressions)))
        return {name for name in ("tau", "frequency") if model.time_symbols[name] in used}

    @cached_property
    def summary(self) -> pd.DataFrame:
        """Mean, sd, interval and diagnostics of the draws by name; empty without draws."""
        return pd.DataFrame() if self.posterior is None else self.posterior.summary()

    @property
    def robust_ratios(self) -> dict[str, float]:
        """Robust over Laplace standard deviation where it exceeds 1.5 although some residual is not white."""
        ratios = {name: self.fit.robust_sd[name] / sd for name, sd in self.fit.sd.items() if sd > 0.0}
        large = {name: ratio for name, ratio in ratios.items() if np.isfinite(ratio) and ratio > LARGE_RATIO}
        return large if self.coloured else {}

    @property
    def coloured(self) -> list[str]:
        """The channels whose residual is not white."""
        return [channel for channel, white in self.fit.whiteness.items() if white.p < NOT_WHITE]

    @property
    def underestimated_sds(self) -> list[str]:
        """A warning if standard deviations are too small because a residual is not white."""
        if not (ratios := self.robust_ratios):
            return []
        worst = max(ratios, key=lambda name: ratios[name])
        return [
            f"The residual of {', '.join(self.coloured)} is not white, so the standard deviations and intervals of "
            f"{', '.join(ratios)} are too small; the robust ones are up to {html.number(ratios[worst], 2)} times as "
            f"large ({worst})."
        ]

    @property
    def warnings(self) -> list[str]:
        """All warnings on the estimate."""
        return [*estimation_warnings(self.problem, self.fit), *self.underestimated_sds]

    def unit(self, name: str) -> str:
        """Return the formatted unit of a parameter, a channel or a noise parameter, by its full name."""
        units, (plain, _, place) = self.problem.model.units, name.partition("[")
        if plain == SHIFT:
            return "s"
        if name in self.problem.noise_names:
            channel = units.get(place.rstrip("]").partition(",")[0], "")
            return html.unit(squared(channel) if plain == "variance" and channel else "")
        return html.unit(units.get(plain, ""))


def _check_data(posterior: Posterior, problem: Problem) -> None:
    """Raise a ValueError unless the draws are of the problem's parameters and were made from its data."""
    data = posterior.data["observed_data"]
    measured = {f"{e.name} {channel}": values for e in problem.experiments for channel, values in e.outputs.items()}
    if (
        set(posterior.names) != {*problem.names, *problem.free_noise}
        or set(data.data_vars) != set(measured)
        or not all(np.array_equal(data[name].to_numpy(), values) for name, values in measured.items())
    ):
        raise ValueError(
            "posterior: must be of the parameters and data of `problem`, got draws of other parameters or data. Give "
            "sample(problem, fit)."
        )


DOTS = ("", "˙", "¨")
# Space between factors, because some of them are words.
AS_READ = {
    "<mo>-</mo>": "<mo>−</mo>",
    "<mo>&InvisibleTimes;</mo>": '<mo lspace="0.08em" rspace="0.08em">\u2062</mo>',
    "&ExponentialE;": "e",
    "&pi;": "π",
}
FUNCTIONS = {"sign": "sgn", "Max": "max", "Min": "min", "log": "ln"}


def equations(model: Model) -> tuple[Markup, ...]:
    """Return the equations of motion, one per state, with the terms that contain no state on the right-hand side."""
    printer, states = _Printer(model), set(model.state_symbols.values())
    rows = []
    for equation in model.equations:
        terms = sp.Add.make_args(equation)
        left = [term for term in terms if term.free_symbols & states]
        right = [-term for term in terms if not term.free_symbols & states]
        rows.append(_block(printer, sp.Add(*left), sp.Add(*right)))
    return tuple(rows)


def outputs(model: Model) -> tuple[Markup, ...]:
    """Return the output equations, one per channel."""
    printer = _Printer(model)
    each = zip(model.outputs, model.output_expressions, strict=True)
    return tuple(_block(printer, sp.Symbol(name), expression) for name, expression in each)


def symbol(name: str) -> Markup:
    """Typeset a name: Greek letters, and digits and the parts after underscores as subscripts."""
    return Markup(f"<math>{_Printer.text_of(_Printer().named(name))}</math>")


def parts(name: str) -> tuple[str, tuple[str, ...]]:
    """Split a name into its base and its subscripts."""
    pieces = [piece for part in name.split("_") for piece in re.findall(r"\d+|\D+", part)]
    base, *below = (greek_unicode.get(piece, piece) for piece in pieces)
    return base, tuple(below)


class _Printer(MathMLPresentationPrinter):
    """Printer of the symbols of a model by their names, with dots for time derivatives."""

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
        """Return a node as text, with entities replaced by characters."""
        text = node.toxml()
        for printed, wanted in AS_READ.items():
            text = text.replace(printed, wanted)
        return text

    def node(self, tag: str, *children: Any) -> Any:
        """Create an element with text or elements in it."""
        made = self.dom.createElement(tag)
        for child in children:
            made.appendChild(self.dom.createTextNode(child) if isinstance(child, str) else child)
        return made

    def named(self, name: str, order: int = 0) -> Any:
        """Typeset a name with dots and subscripts."""
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
        """Return the tag or name of a function."""
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
        """Sort terms by their highest derivative, negative ones last."""
        terms = super()._as_ordered_terms(expr, order)
        return sorted(terms, key=lambda term: (-self._height(term), term.could_extract_minus_sign()))

    def _height(self, term: sp.Expr) -> int:
        return max((self._names.get(s, ("", 0))[1] for s in term.free_symbols), default=0)


def _block(printer: _Printer, *sides: sp.Expr) -> Markup:
    """Return a displayed equation."""
    printed = "<mo>=</mo>".join(printer.text_of(printer._print(side)) for side in sides)
    return Markup(f'<math display="block">{printed}</math>')
