"""All that a report is about, gathered before a word is written."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp
from markupsafe import Markup
from sympy.printing.mathml import MathMLPresentationPrinter
from sympy.printing.pretty.pretty_symbology import greek_unicode

from bayesperiodic import _checks
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.diagnostics.comparison import Comparison, compare
from bayesperiodic.diagnostics.identifiability import Identifiability, identifiability
from bayesperiodic.diagnostics.predictive import Prediction, predict
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.models.model import Model
from bayesperiodic.posterior import labels
from bayesperiodic.posterior.parameters import SHIFT
from bayesperiodic.posterior.problem import Problem
from bayesperiodic.reporting import html
from bayesperiodic.reporting.html import CAUTION, Block, Column, Equations, Note, Paragraph, Section, Table, code
from bayesperiodic.sampling.posterior import Posterior


@dataclass(frozen=True)
class Evidence:
    """A problem, what was found, and the verdicts; draws, and what rests on them, may be lacking.

    Attributes
    ----------
    unpredicted : str
        Why there is no prediction although there are draws; "" otherwise.
    """

    problem: Problem
    fit: MapEstimate
    posterior: Posterior | None
    identifiability: Identifiability
    comparison: Comparison | None
    prediction: Prediction | None
    unpredicted: str

    @classmethod
    def of(
        cls,
        problem: Problem,
        fit: MapEstimate,
        posterior: Posterior | None,
        found: Identifiability | None,
        comparison: Comparison | None,
        prediction: Prediction | None,
    ) -> "Evidence":
        """Return the evidence, with verdicts that were not given computed.

        Raises
        ------
        ValueError
            If the fit, the posterior or a verdict is of another problem.
        """
        _checks.same_names("fit", fit.theta, problem.names)
        _checks.same_names("fit", fit.residuals, [e.name for e in problem.experiments])
        if posterior is not None and not _is_of(posterior, problem):
            raise ValueError("posterior: it is not allowed; it is of other parameters or data than the problem's.")
        unpredicted = ""
        if posterior is not None and comparison is None:
            comparison = compare(problem, fit, posterior)
        if posterior is not None and prediction is None:
            try:
                prediction = predict(problem, posterior)
            except RuntimeError as error:
                unpredicted = str(error)
        found = identifiability(problem, fit, posterior, profile=False) if found is None else found
        _checks.same_names("identifiability", dict.fromkeys(found.table.index), problem.names)
        if comparison is not None:
            remedy = "give the one of this problem, compare(problem, fit, posterior)"
            _checks.holds("comparison", comparison.table.index, problem.names, remedy)
        if prediction is not None:
            _checks.same_names("prediction", prediction.median, [e.name for e in problem.experiments])
        return cls(problem, fit, posterior, found, comparison, prediction, unpredicted)

    @property
    def synthetic(self) -> bool:
        """Whether any of the data were simulated."""
        return any(e.synthetic for e in self.problem.experiments)

    def unit(self, name: str) -> str:
        """Return the unit of a parameter, a channel or a noise parameter, by its full name, as it is read."""
        units, (plain, _, place) = self.problem.model.units, name.partition("[")
        if plain == SHIFT:
            return "s"
        if name in self.problem.noise_names:
            channel = units.get(place.rstrip("]").partition(",")[0], "")
            return html.unit(labels.squared(channel) if plain == "variance" and channel else "")
        return html.unit(units.get(plain, ""))


def _is_of(posterior: Posterior, problem: Problem) -> bool:
    """Return whether draws are of a problem's parameters, and were made from its data."""
    if set(posterior.names) != {*problem.names, *problem.free_noise}:
        return False
    data = posterior.data["observed_data"]
    measured = {f"{e.name} {channel}": values for e in problem.experiments for channel, values in e.outputs.items()}
    return set(data.data_vars) == set(measured) and all(
        np.array_equal(data[name].to_numpy(), values) for name, values in measured.items()
    )


def data_section(evidence: Evidence) -> Section:
    """Return what was measured, experiment by experiment and channel by channel."""
    blocks: list[Block] = []
    if evidence.synthetic:
        blocks.append(Note(CAUTION, "Some or all of these data are synthetic: they were simulated, not measured."))
    return Section("data", "Data", [*blocks, _experiments(evidence), _channels(evidence)])


def _experiments(evidence: Evidence) -> Table:
    columns = (
        Column("Experiment", numeric=False),
        Column("Data", numeric=False),
        Column("Frequency [Hz]"),
        Column("Standard error [Hz]"),
        Column("Cycles"),
        Column("Periods a response"),
        Column("Points a period"),
        Column("Periodicity"),
    )
    rows = [
        (
            e.name,
            "synthetic" if e.synthetic else "measured",
            html.number(e.frequency, 7),
            html.number(e.frequency_se, 2) if e.frequency_se else html.NOTHING,
            str(e.cycles),
            str(e.periods),
            str(e.samples),
            html.number(e.periodicity, 5),
        )
        for e in evidence.problem.experiments
    ]
    caption = "Experiments. The periodicity is the share of the variance that the mean period explains."
    return Table("table-experiments", caption, columns, tuple(rows))


def _channels(evidence: Evidence) -> Table:
    columns = (
        Column("Channel", numeric=False),
        Column("Experiment", numeric=False),
        Column("Kind", numeric=False),
        Column("Unit", numeric=False),
        Column("Smallest"),
        Column("Largest"),
        Column("Harmonics kept"),
        Column("Independent values"),
        Column("Scatter of one cycle"),
    )
    rows = [
        _channel(evidence, e, channel, kind)
        for e in evidence.problem.experiments
        for kind, channels in (("input", e.inputs), ("output", e.outputs))
        for channel in channels
    ]
    caption = "Channels: what was prescribed (inputs) and what the model is compared with (outputs)."
    return Table("table-channels", caption, columns, tuple(rows))


def _channel(evidence: Evidence, e: Experiment, channel: str, kind: str) -> tuple:
    values = (e.inputs if kind == "input" else e.outputs)[channel]
    measured = values if e.mask is None or kind == "input" else values[e.mask]
    return (
        code(channel),
        e.name,
        kind if e.mask is None or kind == "input" else f"{kind}, at {measured.size} points",
        evidence.unit(channel),
        html.number(float(measured.min()), 4),
        html.number(float(measured.max()), 4),
        str(e.harmonics[channel]) if channel in e.harmonics else "all",
        str(e.independent[channel]) if channel in e.independent else html.NOTHING,
        html.number(e.scatter[channel]) if channel in e.scatter else html.NOTHING,
    )


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
    >>> from bayesperiodic.reporting.inputs import equations
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
    >>> from bayesperiodic.reporting.inputs import symbol
    >>> print(symbol("theta16"))
    <math><msub><mi>θ</mi><mn>16</mn></msub></math>
    """
    return Markup(f"<math>{_Printer.text_of(_Printer().named(name))}</math>")


def parts(name: str) -> tuple[str, tuple[str, ...]]:
    """Return what a name has on the line, and its subscripts.

    Examples
    --------
    >>> from bayesperiodic.reporting.inputs import parts
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


LONGEST = 120


def model_section(evidence: Evidence) -> Section:
    """Return the model's equations, its parameters and what is assumed of the noise."""
    model, problem = evidence.problem.model, evidence.problem
    states = ", ".join(f"{name} [{evidence.unit(name)}]" for name in model.states)
    used = set().union(*(e.free_symbols for e in (*model.equations, *model.output_expressions)))
    said = {"tau": "τ is the time in forcing periods", "frequency": "f is the frequency in Hz"}
    clocks = [words for name, words in said.items() if model.time_symbols[name] in used]
    blocks: list[Block] = [
        Paragraph(
            f"The model {model.name} has the state{'s' if len(model.states) > 1 else ''} {states}. "
            f"{'; '.join(['A dot is a derivative by time, per second', *clocks])}."
        ),
        Equations("equations", "Equations of motion", equations(model), model.latex()),
        Equations("outputs", "Measured channels as the model has them", outputs(model)),
        _parameters(evidence),
        Paragraph(
            f"The noise model is “{problem.noise.name}”: {_noise_words(problem)} What is said of a variance rests on "
            f"the {problem.noise.prior_text}."
        ),
    ]
    return Section("model", "Model", blocks)


def _noise_words(problem: Problem) -> str:
    own = "each channel" if problem.noise.per == "channel" else "each channel of each experiment"
    return {
        "independent": f"independent errors, with an unknown variance for {own}.",
        "measured": f"the scatter of the measured cycles, and an independent model error with a variance for {own}.",
        "circulant": f"errors correlated along the period and stationary on the circle, with a variance for {own}.",
    }.get(problem.noise.name, f"one of the user's own, by {problem.noise.per}.")


def _parameters(evidence: Evidence) -> Table:
    problem = evidence.problem
    columns = (
        Column("Parameter", numeric=False),
        Column("Symbol", numeric=False),
        Column("Unit", numeric=False),
        Column("Role", numeric=False),
        Column("Prior, value or expression", numeric=False),
    )
    rows = [
        (code(name), symbol(name.partition("[")[0]), evidence.unit(name), role, known)
        for name, role, known in _roles(problem)
    ]
    caption = "Parameters, and what was known of them before the data."
    return Table("table-parameters", caption, columns, tuple(rows))


def _roles(problem: Problem) -> list[tuple[str, str, str]]:
    """Return of every parameter its full name, whether it is free, and what is known of it."""
    priors, found = problem.joint_prior.marginals, []
    partners = {name: key for key in problem.priors if isinstance(key, tuple) for name in key}
    for plain in (*problem.model.parameters, SHIFT):
        for name in (n for n in problem.names if n.partition("[")[0] == plain):
            others = [other for other in partners.get(name, ()) if other != name]
            known = _shortened(repr(priors[name])) + (f", jointly with {', '.join(others)}" if others else "")
            found.append((name, "free", known))
        if plain in problem.tied:
            found.append((plain, "tied", problem.tied[plain]))
        found += _fixed(problem, plain)
    return found


def _fixed(problem: Problem, plain: str) -> list[tuple[str, str, str]]:
    """Return the fixed values of a parameter: one, or those of the experiments where they differ."""
    by_run = problem.fixed.get(plain, {})
    if len(by_run) == len(problem.experiments) and len(set(by_run.values())) == 1:
        return [(plain, "fixed", html.number(next(iter(by_run.values())), 6))]
    return [(f"{plain}[{run}]", "fixed", html.number(value, 6)) for run, value in by_run.items()]


def _shortened(words: str) -> str:
    return words if len(words) <= LONGEST else f"{words[:LONGEST]}…"
