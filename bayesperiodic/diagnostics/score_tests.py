"""Score tests of terms that a model may lack: the effect of each on the outputs against the residual, without a fit."""

from collections.abc import Container, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import sympy as sp
from scipy.special import fdtrc

from bayesperiodic import _fourier
from bayesperiodic._linalg import column_space
from bayesperiodic.data.experiment import Experiment
from bayesperiodic.density.problem import Problem
from bayesperiodic.diagnostics.candidates import MEMORY, Term, factors, of_elements, places, values
from bayesperiodic.estimation.adequacy import Whitened, used
from bayesperiodic.estimation.covariance import predicted_changes, residual_variances
from bayesperiodic.estimation.gauss_newton import Iterate
from bayesperiodic.estimation.result import MapEstimate
from bayesperiodic.likelihood.quantities import Quantities
from bayesperiodic.periodic.condensed import CondensedEquations
from bayesperiodic.periodic.equations import PeriodicEquations, respond
from bayesperiodic.periodic.solution import PeriodicSolution, periodic_part

# Part of the square of an effect that the parameters cannot have instead, below which the two cannot be told apart.
UNIDENTIFIABLE = 1e-6
# 1 − cos² of the angle between two effects that are the same on the measured orbits.
SAME_EFFECT = 1e-8
# Lags that are tried: in radians of the fastest and of the slowest experiment, with this factor or less between them.
SHORTEST_LAG, LONGEST_LAG, LARGEST_LAG_FACTOR = 0.3, 3.0, 3.5


class Compared(NamedTuple):
    """Residual components (size,) and their derivatives (directions, size), one array a block."""

    residuals: list[np.ndarray]
    jacobian: list[np.ndarray]


class ScoreTests:
    """Score tests of the coefficients of terms at zero, given an optimum.

    Attributes
    ----------
    identifiable : array (terms,) of bool
        Whether the parameters cannot have the same effect.
    explained : array (terms,)
        Part of the sum of squares of the whitened residual that each term would explain, linearised.
    p : array (terms,)
        Of the tests. Where the spectrum of the noise of all outputs was measured between the harmonics, the residual is
        compared with it, the noise of the inputs included; otherwise with its own smoothed spectrum.
    widths : array (terms,)
        Coefficients whose effect is as large as the measured output, in the channel where it is largest.
    """

    def __init__(self, problem: Problem, optimum: Iterate, terms: Sequence[Term]):
        likelihood, noise, here = problem.likelihood, optimum.noise, optimum.here
        solutions = here.solver.solutions(optimum.theta)
        effects = _effects(problem, optimum.theta, solutions, terms)
        finite = np.isfinite(np.concatenate(effects, axis=1)).all(axis=1)
        effects = [np.where(finite[:, None], effect, 0.0) for effect in effects]
        data: list[np.ndarray] = []  # components of the measured outputs less their means, one array (size,) a block
        for e in problem.experiments:
            seen = problem.observations[e.name]
            signals = np.zeros((len(seen.data), len(seen.compared_channels)))
            signals[:, : len(seen.channels)] = seen.data - seen.data.mean(axis=0)
            parts = zip(seen.blocks, seen.errors(signals), strict=True)
            data += [block.sizes if isinstance(block, Quantities) else part for block, part in parts]
        self.widths = _widths(likelihood.whitened(data, noise), likelihood.whitened(effects, noise))
        joined = [np.concatenate([s, c]) for s, c in zip(here.jacobian, effects, strict=True)]
        white, parameters = Whitened(problem, Compared(list(here.residuals), joined), noise), len(problem.names)
        plain = _projected(white.parts, parameters)
        self._effects, self.identifiable = plain.effects, finite & plain.identifiable
        self.explained = plain.gains() / max(plain.square, np.finfo(float).tiny)
        self.p = self._p(problem, optimum, white, parameters)

    def _p(self, problem: Problem, optimum: Iterate, white: Whitened, parameters: int) -> np.ndarray:
        """Return the p-values (terms,)."""
        blocks, known = white.blocks, [white.spectrum(i) for i in range(len(white.blocks))]
        if all(spectrum is not None or not block.counted for spectrum, block in zip(known, blocks, strict=True)):
            parts = [white.in_units_of_noise(i) for i in range(len(blocks))]
            tests, weights = _projected(parts, parameters), [np.full(part[0].size, np.inf) for part in parts]
            for i, spectrum in enumerate(known):
                if spectrum is not None:
                    weights[i] = spectrum[1][white.parts[i][2]]
            # Degrees of freedom of the measured variances that the variance of a score consists of.
            shares = tests.effects**2 / np.maximum(np.sum(tests.effects**2, axis=1), np.finfo(float).tiny)[:, None]
            freedom = 1.0 / np.maximum(shares @ (1.0 / np.concatenate(weights)), 1e-9)
            statistic = tests.gains()
        else:
            likelihood, noise, here = problem.likelihood, optimum.noise, optimum.here
            jacobian, residuals = (likelihood.whitened(part, noise) for part in (here.jacobian, here.residuals))
            information = problem.joint_prior.curvature(optimum.theta) + sum(s @ s.T for s in jacobian)
            variances = residual_variances(likelihood, jacobian, residuals, noise, information)
            sds = [np.sqrt(np.maximum(used(b, v)[0], 1e-12)) for b, v in zip(blocks, variances, strict=True)]
            parts = [[r / sd, j / sd] for (r, j, _), sd in zip(white.parts, sds, strict=True)]
            tests = _projected(parts, parameters)
            freedom = np.full(len(tests.effects), max(tests.freedom - 1.0, 1.0))
            gains = tests.gains()
            statistic = gains * freedom / np.maximum(tests.square - gains, np.finfo(float).tiny)
        return np.where(self.identifiable, fdtrc(1.0, freedom, statistic), 1.0)

    def groups(self, among: Container[int]) -> Iterator[list[int]]:
        """Yield the indices of identifiable terms with the same effect on the data, sorted, by what they explain."""
        size = np.sqrt(np.sum(self._effects**2, axis=1))
        left = [i for i in np.argsort(-self.explained, kind="stable") if self.identifiable[i] and i in among]
        while left:
            cosine = self._effects[left] @ self._effects[left[0]] / (size[left] * size[left[0]])
            same = 1.0 - cosine**2 < SAME_EFFECT
            yield sorted(int(i) for i, alike in zip(left, same, strict=True) if alike)
            left = [i for i, alike in zip(left, same, strict=True) if not alike]


class _Projected(NamedTuple):
    """Residual and effects without what the parameters can do, in units in which the components are independent."""

    residual: np.ndarray  # (size,)
    effects: np.ndarray  # (terms, size)
    identifiable: np.ndarray  # (terms,)
    freedom: int  # components less parameters

    @property
    def square(self) -> float:
        return float(self.residual @ self.residual)

    def gains(self) -> np.ndarray:
        """Return the part of the residual's square that each effect explains (terms,)."""
        squares = np.sum(self.effects**2, axis=1)
        score = (self.effects @ self.residual) ** 2
        return np.divide(score, squares, out=np.zeros(squares.size), where=self.identifiable)


def _projected(parts: Sequence[Sequence[np.ndarray]], parameters: int) -> _Projected:
    """Return what is left of residuals (size,) and derivatives by parameters and terms, (directions, size) a block."""
    r, j = (np.concatenate([part[i] for part in parts], axis=-1) for i in (0, 1))
    basis, effects = column_space(j[:parameters]), j[parameters:]
    left = effects - (effects @ basis) @ basis.T
    identifiable = np.sum(left**2, axis=1) > UNIDENTIFIABLE * np.sum(effects**2, axis=1)
    return _Projected(r - basis @ (basis.T @ r), left, identifiable, r.size - basis.shape[1])


def along_orbit(
    problem: Problem, theta: np.ndarray, experiment: Experiment, solution: PeriodicSolution, terms: Sequence[sp.Expr]
) -> np.ndarray:
    """Return expressions of the model's symbols along an orbit (terms, points)."""
    equations, z, parameters = _at(problem, theta, experiment, solution)
    if isinstance(equations, CondensedEquations):
        none, still = np.empty((len(z), 0)), np.zeros(len(z))
        return values(
            of_elements(equations.model), terms, equations.states(z), none, parameters, still, equations.frequency
        )
    return values(
        problem.model, terms, equations.states(z), equations.inputs, parameters, equations.grid.tau, equations.frequency
    )


def variable_deviations(problem: Problem, fit: MapEstimate) -> dict[str, float]:
    """Return the standard deviations of the model's variables along the orbits of all experiments."""
    variables = {name: e for part in factors(problem.model) for name, e in part.items()}
    theta, listed = problem.vector(fit.theta), list(variables.values())
    each = [along_orbit(problem, theta, e, fit.solutions[e.name], listed) for e in problem.experiments]
    return dict(zip(variables, np.std(np.concatenate(each, axis=1), axis=1).tolist(), strict=True))


def lags_to_try(fit: MapEstimate) -> list[float]:
    """Return lags [s] of terms with memory, which cover all experiments."""
    rates = [2.0 * np.pi * solution.frequency / solution.periods for solution in fit.solutions.values()]
    ends = SHORTEST_LAG / max(rates), LONGEST_LAG / min(rates)
    return np.geomspace(*ends, 1 + int(np.ceil(np.log(ends[1] / ends[0]) / np.log(LARGEST_LAG_FACTOR)))).tolist()


def _at(
    problem: Problem, theta: np.ndarray, experiment: Experiment, solution: PeriodicSolution
) -> tuple[PeriodicEquations, np.ndarray, np.ndarray]:
    """Return equations, z (points, states) and the model's parameters of an orbit."""
    equations = problem.equations[experiment.name].at_frequency(solution.frequency)
    parameters = problem.parameters(theta[None], experiment.name)[0]
    z = periodic_part(equations, solution.states)
    if isinstance(equations, CondensedEquations):  # on as many points as it takes
        z = equations.find(parameters, z)[0].z
    return equations, z, parameters


def _effects(
    problem: Problem, theta: np.ndarray, solutions: Mapping[str, PeriodicSolution], terms: Sequence[Term]
) -> list[np.ndarray]:
    """Return the derivatives of the predicted components by each coefficient, one array (terms, size) a block.

    NaN for terms that are not finite along an orbit.
    """
    where = np.array([places(problem.model).index(term.place) for term in terms], dtype=int)
    outputs, effects = sum(place in problem.model.outputs for place in places(problem.model)), []
    for e in problem.experiments:
        equations, z, parameters = _at(problem, theta, e, solutions[e.name])
        listed = [term.expression.xreplace({MEMORY: sp.Integer(0)}) for term in terms]
        forces, lagging = [t.force for t in terms if t.force is not None], [t.force is not None for t in terms]
        along, memory = np.split(along_orbit(problem, theta, e, solutions[e.name], listed + forces), [len(terms)])
        lags = np.array([t.lag for t in terms])[lagging] * equations.frequency / equations.grid.periods
        along[lagging] += _fourier.lagged(memory, lags)
        finite = np.isfinite(along).all(axis=1)
        added = np.zeros((len(terms), len(z), outputs + equations.count))
        added[np.arange(len(terms)), :, where] = np.where(finite[:, None], along, 0.0)
        f, g = np.ascontiguousarray(added[..., :outputs]), np.ascontiguousarray(added[..., outputs:])
        if isinstance(equations, CondensedEquations):
            moved = equations.moved_by_forces(z, parameters, g)
        else:
            columns, derivatives = equations.residual_jacobian(z, parameters), equations.derivatives(z, parameters)
            moved = respond(equations, z, columns, derivatives, g, f)
        sizes = [block.size for block in problem.observations[e.name].blocks]
        caused = np.full((len(terms), sum(sizes)), np.nan)
        if moved is not None:
            caused[finite] = predicted_changes(problem, e, equations, theta, z, moved)[finite]
        effects += np.split(caused, np.cumsum(sizes)[:-1], axis=1)
    return effects


def _widths(data: Sequence[np.ndarray], effects: Sequence[np.ndarray]) -> np.ndarray:
    """Return the coefficients (terms,) whose effect on one of the blocks is as large as its data."""
    sizes = np.array([np.linalg.norm(c, axis=1) for c in effects])
    wanted = np.array([np.linalg.norm(part) for part in data])[:, None]
    ratio = np.divide(wanted, sizes, out=np.full(sizes.shape, np.inf), where=(sizes > 0.0) & (wanted > 0.0))
    least = ratio.min(axis=0)
    return np.where(np.isfinite(least), least, 1.0)
