"""The section on the model: equations, and what is known of its parameters beforehand."""

from bayesperiodic.inference.parameters import SHIFT
from bayesperiodic.inference.problem import Problem
from bayesperiodic.reporting import mathml, text
from bayesperiodic.reporting.blocks import Block, Column, Equations, Paragraph, Section, Table, code
from bayesperiodic.reporting.evidence import Evidence

LONGEST = 120


def section(evidence: Evidence) -> Section:
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
        Equations("equations", "Equations of motion", mathml.equations(model), model.latex()),
        Equations("outputs", "Measured channels as the model has them", mathml.outputs(model)),
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
        (code(name), mathml.symbol(name.partition("[")[0]), evidence.unit(name), role, known)
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
        return [(plain, "fixed", text.number(next(iter(by_run.values())), 6))]
    return [(f"{plain}[{run}]", "fixed", text.number(value, 6)) for run, value in by_run.items()]


def _shortened(words: str) -> str:
    return words if len(words) <= LONGEST else f"{words[:LONGEST]}…"
