"""Laplace approximation over all sampling coordinates, from the exact Hessian; directions without information."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from bayesperiodic._io import Storable
from bayesperiodic._linalg import covariance_eigh, hessian_eigh, hessian_scale, scaled
from bayesperiodic.density.log_posterior import LogPosterior
from bayesperiodic.estimation.gauss_newton import NO_CURVATURE, Iterate, Objective, climb
from bayesperiodic.likelihood.noise_estimate import log_supports
from bayesperiodic.problem.description import Description

if TYPE_CHECKING:
    import pandas as pd

THETA_STEP = 1e-3
NOISE_STEP = 1e-4


@dataclass(frozen=True)
class JointLaplace(Storable):
    """Mode of a density in sampling coordinates, see `MapEstimate.joint_mode`, its covariance and its log-density."""

    mode: dict[str, float]
    covariance: pd.DataFrame
    log_density: float


def joint_laplace(density: LogPosterior, start: Iterate) -> JointLaplace:
    """Climb from the estimate to the mode in sampling coordinates and invert the exact Hessian there.

    The Hessian over θ comes from central differences of the exact gradient; parameters local to experiments are changed
    together, because each experiment depends on its own only.
    """
    import pandas as pd

    problem, objective = density.problem, Objective(density)
    first = objective.at(start.theta, start.here, start.noise)
    labels = [*problem.names, *problem.free_noise]
    covariance = pd.DataFrame(np.full((len(labels), len(labels)), np.nan), index=labels, columns=labels)
    if first is None:
        return JointLaplace({}, covariance, np.nan)
    mode, _, _ = climb(objective, objective.anchored(first))
    free = [problem.noise_names.index(name) for name in problem.free_noise]
    hessian = _hessian(objective, mode, free)
    if np.isfinite(hessian).all() and np.all(np.diag(hessian) > 0.0):
        curvatures, vectors, scale = hessian_eigh(hessian)
        if curvatures.min() >= NO_CURVATURE * curvatures.max():
            covariance.iloc[:, :] = scaled((vectors / curvatures) @ vectors.T, scale)
    values = [*mode.theta.tolist(), *mode.noise[free].tolist()]
    return JointLaplace(dict(zip(labels, values, strict=True)), covariance, mode.objective)


def _hessian(objective: Objective, mode: Iterate, free: list[int]) -> np.ndarray:
    """Return −∂² log-density over the sampling coordinates."""
    problem, logs = objective.density.problem, objective.density.logarithmic
    count = len(problem.names)
    by_theta = -_second_derivatives(objective, mode) + problem.joint_prior.curvature(mode.theta)
    _, by_residual, _ = problem.likelihood.value_and_gradients(mode.here.residuals, mode.noise)
    gradient = sum(mode.here.vjp(by_residual, adjoint=False).values()) + problem.joint_prior.gradient(mode.theta)
    slopes = np.where(logs, mode.theta, 1.0)
    hessian = np.zeros((count + len(free), count + len(free)))
    hessian[:count, :count] = scaled(by_theta, slopes) - np.diag(np.where(logs, gradient * mode.theta, 0.0))
    supports = log_supports(problem.likelihood) if free else np.empty((0, 2))
    for row, column in enumerate(free):
        changes, here = [], np.log(mode.noise[column])
        # Both ends of a step are within the support.
        steps = np.array([1.0, -1.0]) + (here - NOISE_STEP < supports[row, 0]) - (here + NOISE_STEP > supports[row, 1])
        for step in steps:
            noise = mode.noise.copy()
            noise[column] *= np.exp(step * NOISE_STEP)
            _, by_residual, by_noise = problem.likelihood.value_and_gradients(mode.here.residuals, noise)
            total = sum(mode.here.vjp(by_residual, adjoint=False).values())
            changes.append(np.concatenate([total * slopes, by_noise[free]]))
        hessian[count + row] = -(changes[0] - changes[1]) / (2.0 * NOISE_STEP)
        hessian[:count, count + row] = hessian[count + row, :count]
        if steps.sum():
            # The density falls exponentially from the end of the support.
            hessian[count + row, count + row] += changes[0][count + row] ** 2
    return 0.5 * (hessian + hessian.T)


def _second_derivatives(objective: Objective, mode: Iterate) -> np.ndarray:
    """Return ∂² log-likelihood/∂θ² at the mode, (names, names)."""
    problem, (hessian, _) = objective.density.problem, objective.hessian_and_gradient(mode)
    sd = hessian_scale(hessian)
    result = np.zeros((len(problem.names),) * 2)
    for group in _moved_together(problem):
        ends = []
        for sign in (1.0, -1.0):
            theta = mode.theta.copy()
            theta[list(group.values())] += sign * THETA_STEP * sd[list(group.values())]
            ends.append(_gradients(problem, theta, mode))
        for experiment, column in group.items():
            result[:, column] += (ends[0][experiment] - ends[1][experiment]) / (2.0 * THETA_STEP * sd[column])
    return 0.5 * (result + result.T)


def _moved_together(problem: Description) -> list[dict[str, int]]:
    """Return sets of columns of θ, by experiment; every experiment depends on at most one column of a set."""
    groups: dict[str, dict[str, int]] = {}
    for experiment, parameter_map in problem.parameter_maps.items():
        for name, column in parameter_map.columns.items():
            groups.setdefault(name, {})[experiment] = column
    return list(groups.values())


def _gradients(problem: Description, theta: np.ndarray, mode: Iterate) -> dict[str, np.ndarray]:
    """Return each experiment's gradient of the log-likelihood by θ, at the noise parameters of the mode."""
    there = mode.here.moved(theta)
    if problem.model.autonomous:
        there = there.anchored()
    if not there.converged:
        return dict.fromkeys(problem.observations, np.full(theta.size, np.nan))
    _, by_residual, _ = problem.likelihood.value_and_gradients(there.residuals, mode.noise)
    return there.vjp(by_residual, adjoint=not problem.forward)


SHOWN_PART = 0.05
LARGEST_EXPONENT = 4
ROUNDED_RATIO = 0.06


def reduced(directions: np.ndarray) -> np.ndarray:
    """Return vectors that span the same space (directions, names), by Gauss-Jordan elimination."""
    rows = directions.copy()
    for i in range(len(rows)):
        relative = np.abs(rows) / np.abs(rows).max(axis=1, keepdims=True)
        column = int(np.argmax(relative[i] > SHOWN_PART))
        rows[i] /= rows[i, column]
        for j in range(len(rows)):
            if j != i:
                rows[j] -= rows[j, column] * rows[i]
    return rows


def exponents(direction: np.ndarray) -> list[Fraction] | None:
    """Return a direction in logarithms as simple fractions, the first positive; None if there are none nearby."""
    shown = np.abs(direction) > SHOWN_PART * np.abs(direction).max()
    smallest = np.abs(direction[shown]).min()
    for unit in (smallest, np.abs(direction).max()):
        fractions = [
            Fraction(float(v / unit)).limit_denominator(LARGEST_EXPONENT) for v in np.where(shown, direction, 0.0)
        ]
        errors = [abs(float(f) - v / unit) for f, v in zip(fractions, direction, strict=True)]
        largest, lost = max(abs(f) for f in fractions), any(not f for f, s in zip(fractions, shown, strict=True) if s)
        if largest <= LARGEST_EXPONENT and not lost and max(errors) < ROUNDED_RATIO * max(1.0, float(largest)):
            sign = 1 if next(f for f in fractions if f) > 0 else -1
            return [sign * f for f in fractions]
    return None


def combinations(direction: np.ndarray, names: Sequence[str], logarithmic: np.ndarray) -> list[str]:
    """Return combinations of the parameters that do not change along a direction, as expressions.

    Products of powers if the direction (names,), in logarithms of positive parameters, changes positive parameters
    only, sums if it changes none of them; an empty list for a mixture, or if no simple exponents fit.

    Examples
    --------
    >>> combinations(np.array([1.0, 0.5, 0.5]), ["m", "k", "c"], np.array([True, True, True]))
    ['m/k**2', 'c/k']
    >>> combinations(np.array([1.0, -1.0]), ["a", "b"], np.array([False, False]))
    ['a + b']
    """
    shown = np.flatnonzero(np.abs(direction) > SHOWN_PART * np.abs(direction).max())
    involved, direction, powers = [names[i] for i in shown.tolist()], direction[shown], logarithmic[shown]
    if shown.size < 2 or powers.any() != powers.all():
        return []
    if not powers.all():
        pivot = int(np.argmax(np.abs(direction)))
        return [
            _sum(involved[pivot], -float(direction[pivot] / direction[i]), involved[i])
            for i in range(shown.size)
            if i != pivot
        ]
    rational = exponents(direction)
    if rational is None:
        return []
    pivot = min(range(len(rational)), key=lambda i: (abs(rational[i]), i))
    ratios = [r / rational[pivot] for r in rational]
    if max(max(abs(r.numerator), r.denominator) for r in ratios) > LARGEST_EXPONENT:
        return []
    return [
        _product(involved[i], ratios[i], involved[pivot], first=i < pivot) for i in range(len(rational)) if i != pivot
    ]


def _product(name: str, ratio: Fraction, other: str, *, first: bool) -> str:
    """Return name·other^(−ratio), raised to whole exponents that begin with a positive one."""

    def power(name: str, exponent: int) -> str:
        return name if exponent == 1 else f"{name}**{exponent}"

    first_power, other_power = power(name, ratio.denominator), power(other, abs(ratio.numerator))
    if ratio > 0:
        return f"{first_power}/{other_power}"
    return f"{first_power}*{other_power}" if first else f"{other_power}*{first_power}"


def _sum(name: str, ratio: float, other: str) -> str:
    scale = "" if abs(abs(ratio) - 1.0) < ROUNDED_RATIO else f"{abs(ratio):.3g}*"
    return f"{name} {'+' if ratio > 0 else '-'} {scale}{other}"


def in_words(direction: np.ndarray, names: Sequence[str], logarithmic: np.ndarray) -> str:
    """Return the joint change of the parameters along a direction, with simple exponents where they fit.

    Examples
    --------
    >>> in_words(np.array([0.5, -1.0]), ["a", "b"], np.array([True, True]))
    'a -> a·t, b -> b·t^-2'
    """
    shown = np.flatnonzero(np.abs(direction) > SHOWN_PART * np.abs(direction).max())
    powers = [i for i in shown if logarithmic[i]]
    unit = direction[powers[0]] if powers else direction[shown[np.argmax(np.abs(direction[shown]))]]
    simple = exponents(direction[shown]) if len(powers) == shown.size else None
    parts = []
    for k, i in enumerate(shown):
        name = names[int(i)]
        ratio = float(simple[k] / simple[0]) if simple else float(direction[i] / unit)
        if logarithmic[i]:
            parts.append(f"{name} -> {name}·t" + ("" if abs(ratio - 1.0) < 5e-4 else f"^{ratio:.3g}"))
        else:
            scale = "" if abs(abs(ratio) - 1.0) < 5e-4 else f"{abs(ratio):.3g}·"
            parts.append(f"{name} -> {name} {'+' if ratio > 0 else '-'} {scale}{'ln t' if powers else 't'}")
    return ", ".join(parts)


NEARLY_SINGULAR = 1e-10
SILENT = "no output depends on it"
# Relative size of the finite change at which a statement is tested, and the largest change of the data, relative to
# that by one of the parameters alone, that counts as none.
TESTED_CHANGE, UNCHANGED = 0.1, 1e-4
# Least relative effect of a parameter that belongs to a direction.
INVOLVED = 1e-3
IN_COMBINATION = "a combination of "


def undetermined(
    information: np.ndarray,
    theta: np.ndarray,
    names: Sequence[str],
    logarithmic: np.ndarray,
    change: Callable[[np.ndarray], float],
) -> tuple[str, ...]:
    """Return, in words, the directions in which the data's part of H of eq. (8) (names, names) vanishes.

    change(θ) is the norm of the change of all residuals in units of the noise. A direction is written as a joint change
    of the parameters by powers of a factor or by sums if a change by 10 % confirms it, otherwise as a combination.

    Examples
    --------
    >>> row = np.array([2.0, 1.0]) / [3.0, 5.0]
    >>> product = lambda theta: abs(np.log((theta[0] / 3) ** 2 * theta[1] / 5))
    >>> undetermined(np.outer(row, row), np.array([3.0, 5.0]), ["a", "b"], np.array([True, True]), product)
    ('a -> a·t, b -> b·t^-2',)
    """
    slopes = np.where(theta != 0.0, theta, 1.0)
    information = scaled(information, slopes)
    size = np.sqrt(np.diag(information))
    silent = [f"{name}: {SILENT}" for name, effect in zip(names, size, strict=True) if effect == 0.0]
    acting = np.flatnonzero(size > 0.0)
    if not acting.size:
        return tuple(silent)
    values, vectors, _ = covariance_eigh(information[np.ix_(acting, acting)], size[acting])
    combined = []
    for effects in reduced(vectors[:, values < NEARLY_SINGULAR].T):
        involved = np.abs(effects) > INVOLVED * np.abs(effects).max()
        direction = np.zeros(len(names))
        direction[acting[involved]] = effects[involved] / size[acting[involved]]
        shown = np.flatnonzero(direction)
        forms = [by_powers(direction, theta, names), by_sums(direction * slopes, theta, names)]
        for text, there in forms if logarithmic[shown].any() else reversed(forms):
            if text and change(there) <= UNCHANGED * np.max(size * np.abs((there - theta) / slopes)):
                break
        else:
            listed = [names[int(i)] for i in shown]
            text = IN_COMBINATION + " and ".join(filter(None, [", ".join(listed[:-1]), listed[-1]]))
        combined.append(text)
    return tuple(silent + combined)


def by_powers(direction: np.ndarray, theta: np.ndarray, names: Sequence[str]) -> tuple[str, np.ndarray]:
    """Return a relative direction as powers, such as "a -> a·t, b -> b·t^-2", and such a θ; "" if none fit."""
    shown = np.flatnonzero(direction)
    simple = exponents(direction[shown]) if np.all(theta[shown]) else None
    if simple is None or not all(simple):
        return "", theta
    powers = np.zeros(theta.size)
    powers[shown] = np.array(simple, dtype=float) / float(simple[0])
    factors = [f"·t^{power:.3g}" if power != 1.0 else "·t" for power in powers[shown]]
    text = ", ".join(f"{names[int(i)]} -> {names[int(i)]}{f}" for i, f in zip(shown, factors, strict=True))
    return text, theta * (1.0 + TESTED_CHANGE) ** (powers / np.abs(powers).max())


def by_sums(direction: np.ndarray, theta: np.ndarray, names: Sequence[str]) -> tuple[str, np.ndarray]:
    """Return a direction as sums, such as "a -> a + t, b -> b - 0.5·t", and a θ changed so."""
    shown = np.flatnonzero(direction)
    ratios = np.zeros(theta.size)
    for i in shown:
        ratios[i] = float(f"{direction[i] / direction[shown[0]]:.6g}")  # the numbers that are written are tested
    terms = [("" if abs(r) == 1.0 else f"{abs(r):.6g}·", "+" if r > 0.0 else "-") for r in ratios[shown]]
    text = ", ".join(f"{names[int(i)]} -> {names[int(i)]} {b} {a}t" for i, (a, b) in zip(shown, terms, strict=True))
    scale = np.min(np.where(theta != 0.0, np.abs(theta), 1.0)[shown] / np.abs(ratios[shown]))
    return text, theta + TESTED_CHANGE * scale * ratios


def sds(covariance: pd.DataFrame) -> dict[str, float]:
    """Return the roots of the diagonal of a covariance."""
    with np.errstate(invalid="ignore"):
        return dict(zip(covariance.index, np.sqrt(np.diag(covariance)).tolist(), strict=True))
