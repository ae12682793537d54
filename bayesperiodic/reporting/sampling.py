"""The section on the draws: how far they can be trusted."""

from bayesperiodic.inference.sampling.posterior import Posterior
from bayesperiodic.reporting import figures, text
from bayesperiodic.reporting.blocks import BAD, Block, Column, Note, Paragraph, Section, Table, code


def section(posterior: Posterior) -> Section:
    """Return the diagnostics of the draws."""
    blocks: list[Block] = []
    if not posterior.converged:
        blocks.append(
            Note(BAD, f"The draws have NOT CONVERGED, and what rests on them is provisional: {posterior.reason}.")
        )
    failed = ", ".join(f"{status} {text.percent(share)}" for status, share in posterior.failures.items() if share)
    blocks.append(
        Paragraph(
            f"Stopped: {posterior.reason}; {posterior.log_posterior_calls} evaluations of the "
            f"posterior, {text.percent(posterior.acceptance)} of the proposals accepted. Periodic solves that failed, "
            f"of all proposals: {failed or 'none'}."
        )
    )
    columns = (
        Column("Quantity", numeric=False),
        Column("Effective sample size"),
        Column("Autocorrelation time [steps]"),
        Column("R-hat between ensembles"),
    )
    rows = [
        (
            code(name),
            f"{posterior.ess[name]:.0f}",
            text.number(posterior.tau[name], 3),
            f"{posterior.rhat[name]:.4f}",
        )
        for name in posterior.names
    ]
    blocks += [
        Table("table-sampling", "Diagnostics of the draws, in sampling coordinates.", columns, tuple(rows)),
        figures.traces(posterior),
    ]
    return Section("sampling", "Sampling", blocks)
