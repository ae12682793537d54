"""The section on the data."""

from bayesperiodic.data.experiment import Experiment
from bayesperiodic.reporting import text
from bayesperiodic.reporting.blocks import CAUTION, Block, Column, Note, Section, Table, code
from bayesperiodic.reporting.evidence import Evidence


def section(evidence: Evidence) -> Section:
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
            text.number(e.frequency, 7),
            text.number(e.frequency_se, 2) if e.frequency_se else text.NOTHING,
            str(e.cycles),
            str(e.periods),
            str(e.samples),
            text.number(e.periodicity, 5),
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
        text.number(float(measured.min()), 4),
        text.number(float(measured.max()), 4),
        str(e.harmonics[channel]) if channel in e.harmonics else "all",
        str(e.independent[channel]) if channel in e.independent else text.NOTHING,
        text.number(e.scatter[channel]) if channel in e.scatter else text.NOTHING,
    )
