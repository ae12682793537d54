"""The section on the estimates: MAP, Laplace and MCMC side by side."""

import numpy as np

from bayesperiodic.reporting import figures, text
from bayesperiodic.reporting.blocks import CAUTION, Block, Column, Note, Paragraph, Section, Table, code
from bayesperiodic.reporting.evidence import Evidence

PROBABILITY = 0.9


def section(evidence: Evidence) -> Section:
    """Return the estimates of all free parameters and noise parameters."""
    blocks: list[Block] = [Note(CAUTION, f"Not determined by the data: {said}.") for said in evidence.fit.undetermined]
    blocks += [_parameters(evidence), _noise(evidence)]
    sentence = (
        "The MAP estimate is the maximum of the posterior density, the Laplace approximation the normal distribution "
        "around it; its intervals are Student’s t. The robust standard deviation holds also where the residual is not "
        "as the noise model says; far from the other one, the noise model is too sure of itself, or not sure enough."
    )
    if evidence.posterior is None:
        return Section("estimates", "Estimates", [*blocks, Paragraph(f"{sentence} There are no draws (MCMC).")])
    blocks += [
        Paragraph(f"{sentence} MCMC is the distribution of the draws."),
        figures.corner(evidence, evidence.posterior),
    ]
    return Section("estimates", "Estimates", blocks)


def _parameters(evidence: Evidence) -> Table:
    columns = (
        Column("Parameter", numeric=False),
        Column("Unit", numeric=False),
        Column("MAP"),
        Column("sd", group="Laplace"),
        Column("90 % interval", group="Laplace"),
        Column("robust sd", group="Laplace"),
        *_mcmc_columns(evidence),
    )
    fit, intervals = evidence.fit, evidence.fit.interval(PROBABILITY)
    rows = []
    for name, value in fit.theta.items():
        rounding = text.Rounding.of(value, fit.sd[name])
        rows.append(
            (
                code(name),
                evidence.unit(name),
                rounding.text(value),
                rounding.sd(fit.sd[name]),
                rounding.interval(*intervals[name]),
                rounding.sd(fit.robust_sd[name]),
                *mcmc_cells(evidence, name, rounding),
            )
        )
    return Table("table-estimates", "Estimates of the free parameters.", columns, tuple(rows))


def _noise(evidence: Evidence) -> Table:
    columns = (
        Column("Noise parameter", numeric=False),
        Column("Unit", numeric=False),
        Column("Independent values"),
        Column("Estimate (eq. 7)"),
        Column("relative sd", group="Laplace"),
        *_mcmc_columns(evidence),
    )
    fit, rows = evidence.fit, []
    for name, value in fit.noise.items():
        free = name in evidence.problem.free_noise
        place = list(fit.joint_covariance.index).index(name) if free else -1
        relative = np.sqrt(float(fit.joint_covariance.to_numpy()[place, place])) if free else np.nan
        rounding = text.Rounding.of(value, value * relative)
        rows.append(
            (
                code(name),
                evidence.unit(name),
                text.number(_independent(evidence, name), 6),
                rounding.text(value) if free else f"{text.number(value, 6)} (known)",
                text.percent(relative),
                *mcmc_cells(evidence, name, rounding),
            )
        )
    return Table("table-noise", "Estimates of the noise parameters.", columns, tuple(rows))


def _independent(evidence: Evidence, name: str) -> float:
    """Return the independent values behind a variance; the fit has those of a channel by the channel's name."""
    short = name.removeprefix("variance[").removesuffix("]")
    return evidence.fit.independent.get(short, evidence.fit.independent.get(name, np.nan))


def _mcmc_columns(evidence: Evidence) -> tuple[Column, ...]:
    titles = () if evidence.posterior is None else ("mean", "sd", "90 % interval")
    return tuple(Column(title, group="MCMC") for title in titles)


def mcmc_cells(evidence: Evidence, name: str, rounding: text.Rounding) -> tuple[str, ...]:
    """Return mean, standard deviation and 90 % interval of the draws; nothing where there are none."""
    if evidence.posterior is None:
        return ()
    if name not in evidence.posterior.names:
        return (text.NOTHING,) * 3
    draws = evidence.posterior.draws(name)
    low, high = np.quantile(draws, [0.5 - 0.5 * PROBABILITY, 0.5 + 0.5 * PROBABILITY])
    return rounding.text(draws.mean()), rounding.sd(draws.std(ddof=1)), rounding.interval(low, high)
