"""Separate optima of the log-posterior, and their masses by the Laplace approximation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import softmax
from tqdm import tqdm

from bayesperiodic._io import Storable
from bayesperiodic._linalg import hessian_eigh
from bayesperiodic.estimation.gauss_newton import NO_CURVATURE, End, Iterate, Objective, preference, prior_only
from bayesperiodic.estimation.laplace import JointLaplace
from bayesperiodic.models.model import CondensedModel
from bayesperiodic.periodic.schemes import FourierScheme, find_scheme
from bayesperiodic.problem.description import Description

if TYPE_CHECKING:
    import pandas as pd

# Default number of starts: at most 8, and at most this number of unknowns of all starts and experiments. A dense
# scheme counts as many times more as its grid is longer than 50 points.
MOST_STARTS, MOST_UNKNOWNS, DENSE = 8, 16_000, 50
# Ends of the iteration are separate optima if their distance exceeds one standard deviation of the Laplace
# approximation at one of them. Optima whose objective is lower than the best one's by more than 30 are left out.
SEPARATE_SDS, LOWEST_OBJECTIVE, MOST_MODES = 1.0, 30.0, 16
# An iterate within this distance of a known optimum leads to it, if its objective is lower by no more than the square.
NEAR_SDS = 0.3
# A converged end is preferred to one that has not converged if their objectives differ by less.
EQUAL_OBJECTIVES = 1e-3
# Smallest density of an image, relative to the optimum's, and largest number of signs changed in all combinations.
CREDIBLE, MOST_SIGNS = 1e-3, 4
# Images that are solved between two updates of the progress bar, and seconds after which bars are shown.
IMAGES_AT_ONCE, SHOWN_AFTER = 16, 2.0
# Mass of another optimum above which the estimate alone does not describe the posterior.
NOTABLE = 0.01
# Share of the prior from which the iteration ends at an optimum, for the statement on what the starts can miss.
BASIN = 0.1


@dataclass(frozen=True)
class Mode(Storable):
    """Optimum of the log-posterior other than the estimate, with the Laplace approximation there.

    `objective` is that of `MapEstimate.history`, `mass` the fraction of the posterior mass; `sd` are natural values,
    `joint_mode` and `joint_covariance` those of `MapEstimate`, at this optimum.
    """

    theta: dict[str, float]
    sd: dict[str, float]
    objective: float
    mass: float
    joint_mode: dict[str, float]
    joint_covariance: pd.DataFrame

    def __repr__(self) -> str:
        values = ", ".join(f"{name} = {value:.4g}" for name, value in self.theta.items())
        return f"{values} (objective {self.objective:.6g}, {self.mass:.1%} of the mass)"

    def differs(self, name: str, value: float, sd: float) -> bool:
        """Return whether a parameter is further than one sd, the smaller one, from its value at the estimate."""
        widths = [width for width in (sd, self.sd[name]) if np.isfinite(width)]
        return bool(abs(self.theta[name] - value) > SEPARATE_SDS * min(widths, default=np.inf))


def default_starts(problem: Description) -> tuple[int, int]:
    """Return the number of starts whose iterations are cheap, 1 to 8, from the number of unknowns, and the most.

    The most are for models that tests reject. They are more for condensed models only: friction and contact have local
    optima, and their solves have few unknowns.
    """
    points = [e.samples * e.periods for e in problem.experiments]
    dense = isinstance(find_scheme(problem.scheme), FourierScheme)
    unknowns = len(problem.model.states) * sum(p * (max(1.0, p / DENSE) if dense else 1.0) for p in points)
    cheap = int(np.clip(MOST_UNKNOWNS / unknowns, 1, MOST_STARTS))
    return cheap, MOST_STARTS if isinstance(problem.model, CondensedModel) else cheap


def with_images(
    objective: Objective, ends: Sequence[End], climbed: Callable[[Iterate], End], progress: bool = False
) -> list[End]:
    """Return the separate optima among the ends and among their images, the best first.

    Images differ from an optimum by signs, or by the exchange of two parameters. Where their density is at least a
    thousandth of the optimum's, the iteration starts there as well; those of an optimum that is itself left out are not
    solved. Ends are left out if more of their orbits are not the measured ones than of the best end's.
    """
    ends = sorted(ends, key=preference, reverse=True)
    fewest = len(ends[0].iterate.here.other_orbits)
    ends = [end for end in ends if len(end.iterate.here.other_orbits) == fewest]
    settled = [end for end in ends if end.status == "converged"]
    equal = [end for end in settled if end.iterate.objective > ends[0].iterate.objective - EQUAL_OBJECTIVES]
    optima = [(equal or ends)[0]]
    for end in settled:
        if _is_separate(objective, end.iterate.theta, optima):
            optima.append(end)
    waiting = list(optima)
    while waiting and len(optima) < MOST_MODES:
        here = waiting.pop(0).iterate
        if here.objective < max(end.iterate.objective for end in optima) - LOWEST_OBJECTIVE:
            continue
        for image in _credible_images(objective, here, progress):
            start = objective.at(image, here.here, here.noise) if _is_separate(objective, image, optima) else None
            if start is None:
                continue
            end = climbed(objective.anchored(start))
            if not _is_separate(objective, end.iterate.theta, optima):
                continue
            if end.status == "converged" and len(end.iterate.here.other_orbits) == fewest:
                optima.append(end)
                waiting.append(end)
    optima.sort(key=lambda end: -end.iterate.objective)
    return [end for end in optima if end.iterate.objective >= optima[0].iterate.objective - LOWEST_OBJECTIVE]


def optimum_of(objective: Objective, iterate: Iterate, ends: Sequence[End]) -> End | None:
    """Return the converged end next to an iterate of the same objective, which the climb leads to; None if none is."""
    for end in ends:
        if end.status == "converged" and len(iterate.here.other_orbits) == len(end.iterate.here.other_orbits):
            missing = end.iterate.objective - iterate.objective
            if 0.0 <= missing <= _distance(objective, iterate.theta, end.iterate) ** 2 <= NEAR_SDS**2:
                return end
    return None


def _is_separate(objective: Objective, theta: np.ndarray, optima: Sequence[End]) -> bool:
    """Return whether θ (names,) is further than a standard deviation from all optima found."""
    return all(_distance(objective, theta, end.iterate) > SEPARATE_SDS for end in optima)


def _distance(objective: Objective, theta: np.ndarray, mode: Iterate) -> float:
    """Return the distance in standard deviations, directions without curvature left out.

    Parameters that the data do not narrow are integrated out: where their estimate is depends on the prior alone, whose
    density may be flat far from its maximum. Where the curvature is not finite, all other points are far.
    """
    hessian = objective.hessian_and_gradient(mode)[0]
    if not np.isfinite(hessian).all():
        return 0.0 if np.array_equal(theta, mode.theta) else np.inf
    idle = prior_only(objective.density.problem, mode.theta, hessian)
    if idle.all():
        return 0.0
    told = ~idle
    if idle.any():
        across = hessian[np.ix_(told, idle)]
        hessian = hessian[np.ix_(told, told)] - across @ np.linalg.solve(hessian[np.ix_(idle, idle)], across.T)
    values, vectors, scale = hessian_eigh(hessian)
    along = vectors.T @ ((theta - mode.theta)[told] / scale)
    curved = np.abs(values) > NO_CURVATURE * np.abs(values).max()
    return float(np.sqrt(np.sum(np.abs(values[curved]) * along[curved] ** 2)))


def _credible_images(objective: Objective, mode: Iterate, progress: bool) -> np.ndarray:
    """Return images of an optimum, (images, names), whose density is at least a thousandth of the optimum's.

    Images with a negligible prior are not solved. Of thirty parameters there are hundreds, which may take minutes.
    """
    problem = objective.density.problem
    points = np.concatenate([mode.theta[None], images(problem, mode.theta)])
    prior = problem.joint_prior.log_prob(points)
    points = points[prior > prior[0] + np.log(CREDIBLE)]
    if len(points) == 1:
        return points[1:]
    density = objective.density.with_settings(solver=mode.here.solver)
    values = np.empty(len(points))
    with tqdm(total=len(points), desc="MAP", unit="image", leave=False, disable=not progress, delay=SHOWN_AFTER) as bar:
        for start in range(0, len(points), IMAGES_AT_ONCE):
            block = points[start : start + IMAGES_AT_ONCE]
            values[start : start + len(block)] = density.at(block, np.tile(mode.noise, (len(block), 1))).log_prob
            bar.update(len(block))
    return points[1:][values[1:] > values[0] + np.log(CREDIBLE)]


def images(problem: Description, theta: np.ndarray) -> np.ndarray:
    """Return θ with other signs, or with two values exchanged, (images, names).

    Up to four signs are changed in all combinations, more than four one by one and all together. Parameters local to
    experiments are not exchanged.
    """
    supports = problem.joint_prior.supports
    signed = [i for i, (low, high) in enumerate(supports.values()) if low < 0.0 < high]
    sizes = range(1, len(signed) + 1) if len(signed) <= MOST_SIGNS else (1, len(signed))
    changed = []
    for columns in (list(c) for n in sizes for c in combinations(signed, n)):
        image = theta.copy()
        image[columns] *= -1.0
        changed.append(image)
    for i, j in combinations([i for i, name in enumerate(supports) if "[" not in name], 2):
        image = theta.copy()
        image[[i, j]] = theta[[j, i]]
        changed.append(image)
    return np.array(changed).reshape(-1, theta.size)


def weighed(problem: Description, ends: Sequence[End], laplaces: Sequence[JointLaplace]) -> tuple[Mode, ...]:
    """Return the optima after the first with their masses: density times √det(2π C), of all sampling coordinates.

    Where one of them has no joint covariance C, the masses are in proportion to the densities.
    """
    labels = [*problem.names]
    heights = np.array([one.log_density for one in laplaces])
    if all(one.covariance.notna().all(axis=None) for one in laplaces):
        heights = heights + [0.5 * np.linalg.slogdet(one.covariance)[1] for one in laplaces]
    masses = softmax(heights) if np.isfinite(heights).all() else np.full(len(ends), np.nan)
    modes = []
    for end, laplace, mass in zip(ends[1:], laplaces[1:], masses[1:], strict=True):
        theta = end.iterate.theta
        with np.errstate(invalid="ignore"):
            sd = np.sqrt(np.diag(laplace.covariance.loc[labels, labels])) * np.where(problem.logarithmic, theta, 1.0)
        modes.append(
            Mode(
                dict(zip(labels, theta.tolist(), strict=True)),
                dict(zip(labels, sd.tolist(), strict=True)),
                end.iterate.objective,
                float(mass),
                laplace.mode,
                laplace.covariance,
            )
        )
    return tuple(modes)


def notable(modes: Sequence[Mode]) -> list[Mode]:
    """Return the optima with more than 1 % of the mass, or with a mass that is not known."""
    return [mode for mode in modes if not mode.mass <= NOTABLE]


def missed_by(starts: int) -> str:
    """Return with which probability a number of starts, the first not at random, has missed an optimum, in words.

    If the iteration ends at an optimum from a share p of the prior, none of n draws from it does with (1 − p)ⁿ. This
    share is not the mass of the optimum, which may be larger or smaller.
    """
    if starts < 2:
        return "others were not looked for"
    chance = (1.0 - BASIN) ** (starts - 1)
    return f"one that a tenth of the prior leads to is missed with a probability of {chance:.2g}"


def found_from(starts: int) -> str:
    """Return what is said of optima, in words: the number of starts, and what these can miss."""
    return f"found from {starts} start{'s' * (starts > 1)} ({missed_by(starts)})"
