"""Identifiability of each parameter: verdict, evidence and recommendation."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy as sp
from scipy.special import ndtr, softmax, stdtr

from bayesperiodic._io import Result
from bayesperiodic._linalg import in_one_thread
from bayesperiodic._verdicts import BAD, GOOD, with_tone
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.design import FurtherExperiment, Information, default_candidates, rank_candidates
from bayesperiodic.diagnostics.predictive import draws_of
from bayesperiodic.estimation.adequacy import misfit
from bayesperiodic.estimation.check import with_joint
from bayesperiodic.estimation.laplace import combinations, in_words, reduced
from bayesperiodic.estimation.modes import NOTABLE, found_from, notable
from bayesperiodic.estimation.profile import ONE_SIDED, Profile
from bayesperiodic.estimation.profile import profile as profile_of
from bayesperiodic.estimation.result import MapEstimate, orbit_advice
from bayesperiodic.models.model import CondensedModel, Model
from bayesperiodic.models.sensed import DELAY, sensor_name
from bayesperiodic.problem.fingerprint import check_results
from bayesperiodic.problem.parameters import SHIFT
from bayesperiodic.sampling.draws import Posterior
from bayesperiodic.symmetry.determining import system_of, with_signs
from bayesperiodic.symmetry.sensors import with_sensors
from bayesperiodic.symmetry.structure import Structure, analyse_structure

if TYPE_CHECKING:
    import pandas as pd


def structure_of(problem: Problem) -> Structure | None:
    """Return the structural identifiability of a problem: its model, measured channels, free parameters and ties.

    A parameter that is fixed at zero in every experiment is removed from the equations, any other fixed one is known. A
    local parameter counts as one. None for a condensed model, which has no symbolic equations.
    """
    if isinstance(problem.model, CondensedModel):
        return None
    free = set(problem.plain_names.values())
    known = tuple(name for name in problem.model.parameters if name in problem.fixed and name not in free)
    zeros = tuple(sorted(name for name in known if set(problem.fixed[name].values()) == {0.0}))
    unknown = {
        channel: kinds
        for channel, sensor in problem.sensors.given.items()
        if (kinds := tuple(kind for kind, _ in sensor.acting() if sensor_name(kind, channel) in free))
    }
    sensors = tuple((channel, kinds, problem.sensors.given[channel].order) for channel, kinds in unknown.items())
    shifted = SHIFT in free and not problem.model.autonomous and any(DELAY in kinds for kinds in unknown.values())
    return _structure(
        problem.model,
        problem.sensors.channels,
        known,
        zeros,
        tuple(problem.ties.items()),
        sensors=sensors,
        shifted=shifted,
    )


@lru_cache(maxsize=64)
def _structure(
    model: Model,
    outputs: tuple[str, ...],
    known: tuple[str, ...],
    zeros: tuple[str, ...],
    tied: tuple[tuple[str, sp.Expr], ...],
    *,
    sensors: tuple[tuple[str, tuple[str, ...], int], ...],
    shifted: bool,
) -> Structure:
    symbols = model.parameter_symbols
    values = {symbols[name]: sp.S.Zero for name in zeros}
    ties = {symbols[name]: with_signs(expression).subs(values) for name, expression in tied}
    system = system_of(model, outputs).given(known, values | ties)
    if sensors:
        unknown = {channel: kinds for channel, kinds, _ in sensors}
        system = with_sensors(system, unknown, {channel: order for channel, _, order in sensors}, shifted)
    return analyse_structure(model.name, system, known)


POWER, NOTICEABLE = 1.25, 0.05
MOST_THINNED_DRAWS = 20_000


def power_scaling(problem: Problem, posterior: Posterior) -> dict[str, tuple[float, float]]:
    """Return the sensitivity of each parameter's posterior to power-scaling of the prior and of the likelihood.

    The draws are weighted by the prior of θ, or the likelihood, to the powers 0.25 and −0.2. The sensitivity is the
    cumulative Jensen-Shannon distance between the weighted and the unweighted distribution per doubling of the weight,
    averaged over the two powers (Kallioinen et al., Statistics and Computing 34 (2024) 57). A value above 0.05 is
    noticeable: for a normal distribution, it is a shift of the mean by a sixth of its standard deviation. If both are
    large, prior and likelihood are in conflict; if only the first is, the data are uninformative. The two series of
    ArviZ that the package supports scale this diagnostic differently.
    """
    lp = posterior.tree["sample_stats"]["lp"].transpose("chain", "draw").to_numpy().ravel()
    thinned = slice(None, None, max(1, lp.size // MOST_THINNED_DRAWS))
    theta, noise = draws_of(problem, posterior, thinned)
    prior = np.asarray(problem.log_prior(theta))
    jacobian = np.log(theta[:, problem.logarithmic]).sum(axis=1)
    likelihood = lp[thinned] - prior - problem.likelihood.log_prior(noise) - jacobian
    return {
        name: (_sensitivity(theta[:, i], prior), _sensitivity(theta[:, i], likelihood))
        for i, name in enumerate(problem.names)
    }


def _sensitivity(values: np.ndarray, log_density: np.ndarray) -> float:
    powers = np.array([[POWER - 1.0], [1.0 / POWER - 1.0]])
    weights = softmax(powers * (log_density - log_density.max()), axis=1)
    return float(np.mean([cumulative_jensen_shannon(values, w) for w in weights]) / np.log2(POWER))


def cumulative_jensen_shannon(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the normalised cumulative Jensen-Shannon distance, 0 to 1, between unweighted and weighted draws.

    It is the larger one of the distances in the two directions of the axis (Nguyen and Vreeken, Non-parametric
    Jensen-Shannon divergence, ECML PKDD 2015, 173-189).
    """
    order = np.argsort(values, kind="stable")
    x, weighted = values[order], weights[order]
    return max(_one_sided(x, weighted), _one_sided(-x[::-1], weighted[::-1]))


def _one_sided(x: np.ndarray, weighted: np.ndarray) -> float:
    widths = np.diff(x)
    p, q = np.cumsum(np.full(x.size, 1.0 / x.size))[:-1], np.cumsum(weighted)[:-1]
    total = np.sum((p + q) * widths)
    if total <= 0.0:
        return 0.0
    middle = 0.5 * (p + q)

    # The linear terms of the two parts cancel; with them, rounding errors do not hide small distances.
    def against(density: np.ndarray, other: np.ndarray) -> float:
        with np.errstate(divide="ignore", invalid="ignore"):
            terms = np.where(density > 0.0, density * np.log2(density / middle), 0.0)
        return float(np.sum(terms * widths) + np.sum((other - density) * widths) / (2.0 * np.log(2.0)))

    return float(np.sqrt(max(against(p, q) + against(q, p), 0.0) / total))


DETERMINED, NOT_DETERMINED = with_tone("determined", GOOD), with_tone("not determined", BAD)
PRIOR_ONLY, COMBINATION, SIGN = "only with the prior", "only in combination", "sign undetermined"
CONFLICT, SEVERAL = with_tone("prior conflict", BAD), "several values"
# Standard deviations left by the data alone, in prior sds: the largest one of determined parameters (a contraction of
# 0.9), and the smallest one of undetermined parameters (1 % of the information of the prior).
DETERMINED_SD, UNINFORMED_SD = 1.0 / 3.0, 10.0
UNDETERMINED_GAIN = 1.0 / DETERMINED_SD**2
COLLINEAR = 5.0
SIGN_PROBABILITY = 0.975
MONTE_CARLO_ERRORS = 3.0
UNINFORMED_GAIN = 1e-13
PRIOR_DRAWS = 20_000
BOTH_SIGNS = "both signs fit the data: use a prior of one sign, or measure an output that is odd in it"
# Columns of the printed table, by their titles.
COLUMN_TITLES = {"data sd": "together", "others known": "alone", "prior sensitivity": "prior_sensitivity"}
NO_STRUCTURE = (
    "The model is condensed, without symbolic equations: structural symmetries, and other values of the same "
    "likelihood by them, were not searched. Combinations are those of the Fisher information at the estimate."
)
OTHER_VALUES = "give a prior that excludes the other value, or measure an output that differs between them"


@dataclass(frozen=True)
class Identifiability(Result):
    """Identifiability of each parameter and each direction, relative to the prior.

    Attributes
    ----------
    table : DataFrame
        One row per parameter. ``verdict``: see `identifiability`. ``contraction``: 1 − (posterior sd / prior sd)², of
        the logarithm of positive parameters, with its Monte Carlo error ``contraction_mcse``. ``alone`` and
        ``together``: the sd left by the data alone, in prior sds, if the other parameters are known and if they are
        unknown; ``collinearity``: their ratio. ``profile``: its shape. ``structural``: the parameters of a structural
        symmetry that contains it, if any. ``p_negative`` and ``p_negative_mcse``: probability of a value below zero;
        NaN for positive parameters. ``other_values``: values at other optima, or at images under discrete symmetries,
        with more than 1 % of the mass, see `MapEstimate.modes`, if they are further away than a standard deviation.
        ``prior_sensitivity`` and ``likelihood_sensitivity``: distance per doubling of the prior or the likelihood
        (power-scaling). ``evidence``, the ``remarks`` in it that are not numbers, and ``remedy``: summary and
        recommendation.
    directions : DataFrame
        One row per direction in parameter space, in ascending order of information: information of the data over that
        of the prior, contraction, the direction in words, its parameters, and combinations invariant along it.
    spectrum : array (names,)
        Eigenvalues of the Fisher information, descending, in units of the logarithm of positive parameters and of the
        prior sd of signed ones.
    condition : float
        The ratio of the largest to the smallest.
    experiments : DataFrame
        Candidates for a further experiment, the most informative first: expected gain in nats, and the remaining
        fraction of each parameter's sd.
    structure : Structure or None
        Of the free parameters, from the measured channels; None for a condensed model (`Model.from_matrices`), which
        has no symbolic equations.
    converged : bool
        False if there are draws that have not converged.
    basis : str
        What the verdicts rest on, and whether the model is misspecified.

    Examples
    --------
    >>> found = bp.identifiability(problem, fit, profile=False)
    >>> found.verdicts, found.directions["parameters"].tolist()
    ({'c': 'determined', 'k': 'determined'}, ['c', 'k'])
    """

    table: pd.DataFrame
    directions: pd.DataFrame
    spectrum: np.ndarray
    condition: float
    experiments: pd.DataFrame
    structure: Structure | None
    converged: bool
    basis: str

    @property
    def verdicts(self) -> dict[str, str]:
        """The verdict of each parameter."""
        return dict(self.table["verdict"])

    def __repr__(self) -> str:
        import pandas as pd

        table = self.table
        columns: dict[str, Any] = {"verdict": table["verdict"]}
        for name, column in {"contraction": "contraction", "P(negative)": "p_negative"}.items():
            values = zip(table[column], table[f"{column}_mcse"], strict=True)
            columns[name] = [f"{v:.3f}" + (f" ± {error:.3f}" if error else "") for v, error in values]
        columns |= {title: table[column].map("{:.2g}".format) for title, column in COLUMN_TITLES.items()}
        columns["profile"] = table["profile"]
        shown = pd.DataFrame(columns, index=table.index).replace({"nan": "", "nan ± nan": ""})
        shown = shown.loc[:, (shown != "").any()].replace("", "-")
        lines = ["Identifiability of the parameters (data sd: left by the data alone, in prior sds)", shown.to_string()]
        known = [name for name, verdict in self.verdicts.items() if verdict == DETERMINED]
        names = " and ".join(filter(None, [", ".join(known[:-1]), *known[-1:]]))
        lines += [f"The data determine {names or 'no parameter'}."]
        for (verdict, remarks, remedy), rows in table.groupby(["verdict", "remarks", "remedy"], sort=False):
            if verdict != DETERMINED or remarks or remedy:
                advice = f" Recommendation: {remedy}." if remedy else ""
                lines.append(f"{', '.join(rows.index)}: {verdict}{remarks and f', {remarks}'}.{advice}")
        lines.append(f"The condition number of the Fisher information is {self.condition:.3g}.")
        lines.append(self.basis)
        lines += [] if self.converged else ["The draws have NOT CONVERGED; these results are provisional."]
        return "\n".join(lines)


@in_one_thread
def identifiability(
    problem: Problem,
    fit: MapEstimate,
    posterior: Posterior | None = None,
    *,
    profile: Profile | bool = True,
    candidates: Iterable[tuple[str, float, float]] | None = None,
) -> Identifiability:
    """Classify the identifiability of each parameter, with evidence and a recommendation.

    Widths are those of the draws, or without draws of the Laplace approximations at all optima of the estimate, see
    `MapEstimate.modes`, relative to the prior. The first criterion that applies determines the verdict:

    1. "prior conflict": the data alone contradict the prior, see `MapEstimate.prior_conflict`; the estimate is a
       compromise, and its contraction means nothing. With draws, power-scaling confirms it or not.
    2. "sign undetermined": the size of a signed parameter is determined, but both signs have a probability above 2.5 %
       (by more than three Monte Carlo errors).
    3. "several values": it would be "determined", but has another value, further away than a standard deviation, at
       another optimum with more than 1 % of the mass.
    4. "only with the prior": the profile (Raue et al., Bioinformatics 25 (2009) 1923-1929) ends at the support of the
       prior on one side, although the parameter is not collinear with others.
    5. "not determined": with all other parameters known, the data have less than 1 % of the information of the prior.
    6. "only in combination": a structural symmetry of the equations contains the parameter, see `structure`. Not
       examined for condensed models.
    7. "determined": with the other parameters unknown, the data alone leave less than a third of the prior sd.
    8. "only in combination" if the other parameters increase its sd at least fivefold, otherwise "only with the prior".

    "not determined" replaces "determined" if an orbit of the estimate is not the measured one
    (`MapEstimate.other_orbits`).

    Parameters
    ----------
    problem : Problem
    fit : MapEstimate
    posterior : Posterior, optional
    profile : Profile or bool
        The profiles of all parameters, True to compute them, False to omit them.
    candidates : iterable of (run, frequency [Hz], scale), optional
        Possible further experiments: the inputs of a run with scaled variation at another frequency. By default half,
        once and twice the frequency and the amplitude of up to five runs; none for a free-running model.

    Returns
    -------
    Identifiability

    Raises
    ------
    ValueError
        For an estimate of another problem, or a candidate of an unknown run.

    Examples
    --------
    >>> bp.identifiability(problem, fit, profile=False).verdicts
    {'c': 'determined', 'k': 'determined'}
    """
    import pandas as pd

    problem = check_results(problem, fit=fit, **({} if posterior is None else {"posterior": posterior}))
    fit, information, structure = with_joint(problem, fit), Information.of(problem, fit), structure_of(problem)
    shapes = profile_of(problem, fit).shape if profile is True else profile.shape if profile else {}
    options = default_candidates(problem) if candidates is None else [FurtherExperiment(*c) for c in candidates]
    experiments, directions = rank_candidates(problem, fit, information, options), _directions(information)
    widths, errors = _widths(problem, fit, posterior, information)
    left = information.together if posterior is None else np.sqrt(1.0 / np.maximum(1.0 / widths**2 - 1.0, 1e-12))
    table = pd.DataFrame(
        {
            "verdict": "",
            "contraction": 1.0 - widths**2,
            "contraction_mcse": errors,
            "alone": information.alone,
            "together": left,
            "collinearity": information.collinearity,
            "profile": [shapes.get(name, "") for name in problem.names],
            "structural": [_partners(structure, problem.plain_names[name]) for name in problem.names],
        },
        index=[*problem.names],
    )
    images = _structural_images(problem, fit, structure)
    others = {name: fit.other_values(name) or images.get(name, []) for name in problem.names}
    table["other_values"] = [", ".join(f"{value:.4g}" for value in values) for values in others.values()]
    signs = [_negative(problem, fit, posterior, name) for name in problem.names]
    table[["p_negative", "p_negative_mcse"]] = np.array(signs)
    scaling = {} if posterior is None else power_scaling(problem, posterior)
    sensitivities = [scaling.get(name, (np.nan, np.nan)) for name in problem.names]
    table[["prior_sensitivity", "likelihood_sensitivity"]] = np.array(sensitivities)
    rows = table.to_dict("index")
    for name, within, row in zip(problem.names, information.together, rows.values(), strict=True):
        signed = np.isfinite(row["p_negative"])
        conflict, size_known = name in fit.prior_conflict.members, signed and _size_known(problem, fit, posterior, name)
        row["verdict"] = CONFLICT if conflict else _verdict(row, size_known, within)
        both = row["verdict"] == SIGN and abs(fit.theta[name]) > 2.0 * fit.sd[name]
        remarks = ([_against_the_prior(fit, row)] if conflict else []) + _remarks(row)
        row["remedy"] = BOTH_SIGNS if both else _remedy(row, name, directions, experiments, structure)
        if advice := orbit_advice(fit):
            row["verdict"] = NOT_DETERMINED if row["verdict"] == DETERMINED else row["verdict"]
            remarks.append(f"at another orbit than the measured one in {', '.join(map(repr, fit.other_orbits))}")
            row["remedy"] = advice
        row["remarks"] = ", ".join(remarks)
        row["evidence"] = ", ".join([*_numbers(row), *remarks])
    wrong = misfit(problem, fit)
    return Identifiability(
        pd.DataFrame.from_dict(rows, orient="index"),
        directions,
        information.spectrum,
        information.condition,
        experiments,
        structure,
        converged=posterior is None or posterior.converged,
        basis="\n".join(
            filter(None, [_basis(fit, posterior), "" if structure else NO_STRUCTURE, wrong and f"{wrong}."])
        ),
    )


def _basis(fit: MapEstimate, posterior: Posterior | None) -> str:
    """Return a sentence on what the verdicts rest on."""
    starts, optima = len(fit.starts), 1 + len(notable(fit.other_modes))
    if posterior is not None:
        fewest = min(posterior.ess[name] for name in fit.theta)
        return (
            f"The verdicts rest on {fewest:.0f} or more effective draws of each parameter, and hold for the modes "
            "that these have reached."
        )
    if optima > 1:
        return f"No draws: the verdicts rest on the Laplace approximations at {optima} optima, {found_from(starts)}."
    return f"No draws: the verdicts rest on the Laplace approximation at the only optimum {found_from(starts)}."


def _structural_images(problem: Problem, fit: MapEstimate, structure: Structure | None) -> dict[str, list[float]]:
    """Return the values of parameters at images of the estimate under discrete symmetries that the prior allows.

    There the likelihood is the same; the prior density must be more than 1 % of that at the estimate.
    """
    images: dict[str, list[float]] = {}
    for change in structure.discrete if structure else ():
        moves = {name: image for name, image in change.transformation.items() if name in change.parameters}
        if moves.keys() <= fit.theta.keys():
            values = {
                n: (-1.0 if image[0] == "-" else 1.0) * fit.theta[image.lstrip("-")] for n, image in moves.items()
            }
            if problem.log_prior(fit.theta | values) > problem.log_prior(fit.theta) + np.log(NOTABLE):
                for name, value in values.items():
                    if abs(value - fit.theta[name]) > fit.sd[name]:
                        images.setdefault(name, []).append(value)
    return images


def _partners(structure: Structure | None, plain: str) -> str:
    """Return the parameters of the structural symmetries that contain one, itself included."""
    symmetries = structure.symmetries if structure else ()
    names = [p for symmetry in symmetries if plain in symmetry.parameters for p in symmetry.parameters]
    return ", ".join(dict.fromkeys(names))


def _widths(
    problem: Problem, fit: MapEstimate, posterior: Posterior | None, information: Information
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ratio of posterior to prior sd of each coordinate, and the Monte Carlo error of the contraction."""
    if posterior is None:
        names, modes, masses = list(problem.names), [fit, *fit.other_modes], fit.modes["mass"].to_numpy()
        variances = np.array([np.diag(mode.joint_covariance.loc[names, names]) for mode in modes])
        means = information.coordinates(np.array([list(mode.theta.values()) for mode in modes]))
        variances += (means - masses @ means) ** 2
        return np.sqrt(masses @ variances) / information.prior_sd, np.zeros(len(names))
    prior = problem.joint_prior.sample(PRIOR_DRAWS, np.random.default_rng(0))
    draws = np.stack([posterior.draws(name) for name in problem.names], axis=-1)
    widths = _half_width(information.coordinates(draws)) / _half_width(information.coordinates(prior))
    # The standard error of half the central 68 % interval of a normal sample is 1.1 times that of its sd.
    size = np.array([posterior.ess[name] for name in problem.names])
    return widths, 2.0 * widths**2 * 1.1 / np.sqrt(2.0 * size)


def _half_width(values: np.ndarray) -> np.ndarray:
    """Return half the central 68 % interval of values (draws, …)."""
    low, high = np.quantile(values, [ndtr(-1.0), ndtr(1.0)], axis=0)
    return 0.5 * (high - low)


def _negative(problem: Problem, fit: MapEstimate, posterior: Posterior | None, name: str) -> tuple[float, float]:
    """Return the probability that a parameter is negative, and its Monte Carlo error; NaN if it cannot be.

    NaN for the delay of a free-running model too: its zero is that of an arbitrary phase.
    """
    low, high = problem.joint_prior.supports[name]
    if not low < 0.0 < high or (problem.model.autonomous and problem.plain_names[name] == SHIFT):
        return np.nan, np.nan
    if posterior is None:
        freedom = min(fit.degrees_of_freedom[name], 1e9)
        fractions = [float(stdtr(freedom, -mode.theta[name] / mode.sd[name])) for mode in [fit, *fit.other_modes]]
        return float(fit.modes["mass"].to_numpy() @ fractions), 0.0
    share = float(np.mean(posterior.draws(name) < 0.0))
    size = posterior.ess[name]
    bounded = np.clip(share, 1.0 / (size + 2.0), 1.0 - 1.0 / (size + 2.0))
    return share, float(np.sqrt(bounded * (1.0 - bounded) / size))


def _size_known(problem: Problem, fit: MapEstimate, posterior: Posterior | None, name: str) -> bool:
    """Return whether the data at least halve the width of the absolute value of a parameter."""
    column = problem.names.index(name)
    prior = np.abs(problem.joint_prior.sample(PRIOR_DRAWS, np.random.default_rng(0))[:, column])
    if posterior is None:
        generator, modes = np.random.default_rng(1), [fit, *fit.other_modes]
        chosen = generator.choice(len(modes), PRIOR_DRAWS, p=fit.modes["mass"])
        centres, widths = np.array([(mode.theta[name], mode.sd[name]) for mode in modes]).T
        values = centres[chosen] + widths[chosen] * generator.standard_normal(PRIOR_DRAWS)
    else:
        values = posterior.draws(name)
    return bool(_half_width(np.abs(values)) < 0.5 * _half_width(prior))


def _verdict(row: dict, size_known: bool, within: float) -> str:
    """Return the verdict; `within` is the sd that the data alone leave at one optimum, in prior sds."""
    margin = MONTE_CARLO_ERRORS * row["p_negative_mcse"]
    if size_known and max(row["p_negative"], 1.0 - row["p_negative"]) < SIGN_PROBABILITY - margin:
        return SIGN
    if row["other_values"] and min(within, row["together"]) <= DETERMINED_SD:
        return SEVERAL
    if row["profile"] == ONE_SIDED and row["collinearity"] < COLLINEAR:
        return PRIOR_ONLY
    if row["alone"] > UNINFORMED_SD:
        return NOT_DETERMINED
    if row["structural"]:
        return COMBINATION
    if row["together"] <= DETERMINED_SD:
        return DETERMINED
    return COMBINATION if row["collinearity"] >= COLLINEAR and row["alone"] < 1.0 else PRIOR_ONLY


def _against_the_prior(fit: MapEstimate, row: dict) -> str:
    text = fit.prior_conflict.text.replace("Prior and data disagree", "prior and data disagree")
    prior, likelihood = row["prior_sensitivity"], row["likelihood_sensitivity"]
    if not np.isfinite(prior):
        return f"{text}, without draws to confirm it"
    confirmed = "confirmed" if min(prior, likelihood) > NOTICEABLE else "not confirmed"
    return (
        f"{text}, {confirmed} by power-scaling ({prior:.2g} and {likelihood:.2g} per doubling of prior and likelihood)"
    )


def _numbers(row: dict) -> list[str]:
    """Return the numbers behind a verdict, in words."""
    error = f" ± {row['contraction_mcse']:.2g}" if row["contraction_mcse"] else ""
    texts = [f"contraction {row['contraction']:.3g}{error}"]
    if row["collinearity"] >= COLLINEAR:
        factor = "infinitely" if not row["collinearity"] < 1e6 else f"{row['collinearity']:.3g} times"
        texts.append(f"the other parameters widen it {factor}")
    if row["alone"] > DETERMINED_SD and row["profile"] != ONE_SIDED:
        texts.append(f"the data alone would leave {row['alone']:.3g} prior sds with all other parameters known")
    if row["profile"] and row["profile"] != "closed":
        texts.append(f"profile {row['profile']}")
    if np.isfinite(row["p_negative"]):
        error = f" ± {row['p_negative_mcse']:.2g}" if row["p_negative_mcse"] else ""
        texts.append(f"P(negative) = {row['p_negative']:.3g}{error}")
    if np.isfinite(row["prior_sensitivity"]) and row["prior_sensitivity"] > NOTICEABLE:
        texts.append(f"sensitive to the prior ({row['prior_sensitivity']:.2g} per doubling)")
    return texts


def _remarks(row: dict) -> list[str]:
    """Return the causes of a verdict that are not numbers."""
    causes = ["by a structural symmetry"] if row["structural"] else []
    others = row["other_values"]
    return causes + ([f"{others} at another optimum with more than 1 % of the mass"] if others else [])


def _remedy(row: dict, name: str, directions: pd.DataFrame, experiments: pd.DataFrame, known: Structure | None) -> str:
    if row["verdict"] in (DETERMINED, SEVERAL):
        return "" if row["verdict"] == DETERMINED else OTHER_VALUES
    if row["verdict"] == CONFLICT:
        return "check units, prior and data, try map_estimate(starts=8), or widen the prior"
    if row["verdict"] == COMBINATION:
        rows = directions[[name in members.split(", ") for members in directions["parameters"]]]
        rows = rows[rows["gain"] < UNDETERMINED_GAIN]
        members, combos = row["structural"], ", ".join(known.combinations if known else ())
        if not members and len(rows):
            members, combos = rows.iloc[0][["parameters", "combinations"]]
        if members:
            return f"fix one of {members}" + (f", or report {combos}" if combos else "")
    ranked = experiments.dropna(subset=[name]).sort_values(name)
    if len(ranked) and ranked.iloc[0][name] < 0.9:
        best = ranked.iloc[0]
        drive = f" with {best['scale']:.3g} times its amplitude" if experiments["scale"].nunique() > 1 else ""
        return (
            f"measure {best['run']} at {best['frequency']:.3g} Hz{drive}: this would leave {best[name]:.0%} of the sd"
        )
    none = "no candidate experiment would reduce its sd by 10 %" if len(experiments) else "or measure another output"
    return f"report it with its prior, or fix it; {none}"


def _directions(information: Information) -> pd.DataFrame:
    """Return the directions of parameter space in ascending order of information.

    Directions without information are reduced to as few parameters as possible.
    """
    import pandas as pd

    gains, vectors = information.gains, information.directions.T
    uninformed = gains < UNINFORMED_GAIN * gains.max()
    shown = vectors.copy()
    if uninformed.sum() > 1:
        shown[uninformed] = reduced(vectors[uninformed])
    names, logarithmic = information.names, information.logarithmic
    members = np.abs(shown) > 0.05 * np.abs(shown).max(axis=1, keepdims=True)
    invariant = [
        combinations(v, names, logarithmic) if low else ()
        for v, low in zip(shown, gains < UNDETERMINED_GAIN, strict=True)
    ]
    return pd.DataFrame(
        {
            "gain": gains,
            "contraction": gains / (1.0 + gains),
            "direction": [in_words(vector, names, logarithmic) for vector in shown],
            "parameters": [", ".join(np.array(names)[part]) for part in members],
            "combinations": [", ".join(part) for part in invariant],
        }
    )
