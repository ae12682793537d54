"""Simultaneous fit of orbits and parameters, an initial estimate where the orbits at the first guess of θ do not serve.

Measured orbits need not satisfy the equations of motion until the end. First θ is moved to where the equations hold
best along the measured orbits. Then each iteration linearises g(z, θ) = 0 at the present orbit z of every experiment
and at θ, which do not solve it yet, and takes the Gauss-Newton step of all unknowns; the orbits are eliminated, as
dz = −g_z⁻¹ (g + g_θ dθ) ([1]_). The steps are so short that the equations are nearly linear along them, which keeps
each orbit on its own branch.

References
----------
.. [1] H. G. Bock, Recent advances in parameter identification techniques for ordinary differential equations, in:
   Numerical Treatment of Inverse Problems in Differential and Integral Equations, Birkhäuser, 1983, 95-121.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesperiodic._linalg import hessian_eigh, in_one_thread, scaled, unwarned
from bayesperiodic.data.experiment import DATA
from bayesperiodic.likelihood.likelihood import Likelihood
from bayesperiodic.likelihood.noise_estimate import estimate_noise
from bayesperiodic.likelihood.observation import Observation, Response
from bayesperiodic.models.model import CondensedModel
from bayesperiodic.periodic.equations import CyclicFactors, PeriodicEquations, along
from bayesperiodic.problem.description import Description

MOST_ORBIT_STEPS = 60
LARGEST_STEP = 0.7
NONLINEAR, SMALLEST_SHARE = 0.5, 1e-3
ON_ORBIT, SMALL_TURN = 1e-6, 1e-2
# Of the orbits that outputs show: harmonics of the forcing, weight of the equations, iterations; turns with θ.
SEEN, EQUATIONS, SEEN_ROUNDS, TURNS, FEW_TURNS = 8, 0.03, 5, 100, 5
# Means of a state that are tried, in standard deviations from the one found.
MEANS = (1.0, -1.0, 2.0, -2.0)
Guesses = Mapping[str, Mapping[str, np.ndarray]]


@dataclass(frozen=True)
class LinearisedOrbit:
    """One experiment's equations and outputs linearised where neither orbit nor parameters solve them."""

    factors: CyclicFactors  # of ∂g/∂z
    correction: np.ndarray  # −g_z⁻¹ g (points, states), Newton's step at fixed parameters
    response: np.ndarray  # −g_z⁻¹ g_θ (names, points, states)
    residuals: list[np.ndarray]  # of the corrected orbit, (size,) a block
    jacobian: list[np.ndarray]  # derivatives of the predicted components by θ, (names, size) a block


class InitialEstimate(NamedTuple):
    """Result of a simultaneous fit."""

    theta: np.ndarray  # (names,), the estimate, or the last θ that was reached
    states: dict[str, dict[str, np.ndarray]]  # of every experiment, turns included; empty if the fit failed
    blocked: str  # the experiment whose orbit could not be followed; empty otherwise


@unwarned
def simultaneous_fit(problem: Description, theta: np.ndarray, guesses: Guesses | None = None) -> InitialEstimate | None:
    """Return θ and orbits near the MAP point; None for autonomous and condensed models, or without guesses.

    The fit starts at θ (names,) and at guesses, by default the experiments' own, ignores multipliers, and moves
    positive parameters in their logarithms. Where the guesses are the orbits at θ, there is nothing to fit: the
    result is θ with the guesses.
    """
    if (
        problem.model.autonomous
        or isinstance(problem.model, CondensedModel)
        or not (guesses or all(e.guess for e in problem.experiments))
    ):
        return None
    fit = _SimultaneousFit(problem, guesses or experiments_guesses(problem, theta))
    if all(fit.solves(name, z, theta) for name, z in fit.guess.items()):
        return InitialEstimate(theta, {name: fit.states(name, z) for name, z in fit.guess.items()}, "")
    return fit.iterate(fit.parameters_along_guesses(theta))


@unwarned
@in_one_thread
def experiments_guesses(problem: Description, theta: np.ndarray) -> dict[str, Any]:
    """Return the experiments' guesses; in place of "data" states found from a θ (names,), see `measured_orbits`."""
    guesses: dict[str, Any] = {e.name: e.guess for e in problem.experiments}
    wanted = [name for name, guess in guesses.items() if guess == DATA]
    if not wanted:
        return guesses
    near = {name: _states_of(problem, name, theta, guess) for name, guess in guesses.items()}
    seen = [name for name, guess in guesses.items() if not guess or guess == DATA]
    fit = _SimultaneousFit(problem, near)
    near |= {name: fit.states(name, fit.orbit_of_any_mean(name, theta)) for name in wanted}
    measured = measured_orbits(problem, theta, near, FEW_TURNS, seen).states
    for name, states in ((name, measured[name]) for name in wanted):
        if lost := [state for state, values in states.items() if not np.isfinite(values).all()]:
            raise ValueError(
                f"guess of experiment {name!r}: must be finite, got nan for {lost[0]!r} from the data; give the states "
                "as a mapping, or start nearer to the truth."
            )
    return guesses | {name: measured[name] for name in wanted}


def _states_of(problem: Description, name: str, theta: np.ndarray, guess: Any) -> Any:
    """Return the states of an experiment's guess, of the equilibrium at θ (names,) where it has none."""
    if guess and guess != DATA:
        return guess
    equations = problem.equations[name]
    z = equations.static_guess(problem.parameters(theta[None], name)[0])
    turning = z + equations.drift * equations.grid.tau[:, None]
    return dict(zip(problem.model.states, turning.T.copy(), strict=True))


@unwarned
def measured_orbits(
    problem: Description, theta: np.ndarray, near: Guesses, most: int = TURNS, seen: Iterable[str] | None = None
) -> InitialEstimate:
    """Return orbits of a driven model that give the measured outputs, and the θ that fits them, in turns from a θ.

    The orbits solve the equations only as far as the outputs leave them free; `near` are the states of other orbits
    from which they start. Orbits that are not `seen`, by default all are, stay as they are.
    """
    fit, names = _SimultaneousFit(problem, near), list(near if seen is None else seen)
    misfit, before, turns = np.inf, np.inf, 0
    while turns < most and not before - misfit < SMALL_TURN:
        fit.guess |= {name: fit.measured_orbit(name, theta) for name in names}
        theta = fit.parameters_along_guesses(theta)
        misfit, before, turns = fit._misfit(theta), misfit, turns + 1
    return InitialEstimate(theta, {name: fit.states(name, z) for name, z in fit.guess.items()}, "")


class _SimultaneousFit:
    def __init__(self, problem: Description, guesses: Guesses):
        self.problem, self.maps, self.equations = problem, problem.parameter_maps, problem.equations
        experiments = [e.without_multipliers() for e in problem.experiments]
        self.observations = {
            e.name: Observation(e, problem.model, problem.sensors.parameters(self.maps[e.name].delayed))
            for e in experiments
        }
        blocks = [block for observation in self.observations.values() for block in observation.blocks]
        self.likelihood = Likelihood(problem.noise, blocks, problem.likelihood.fixed)
        self.guess = {}
        for name, states in guesses.items():
            turning = np.stack([states[state] for state in problem.model.states], axis=-1)
            self.guess[name] = turning - self._turns(name)

    def states(self, name: str, z: np.ndarray) -> dict[str, np.ndarray]:
        """Return the states (points,), turns included, of the periodic part (points, states) of an orbit."""
        return dict(zip(self.problem.model.states, (z + self._turns(name)).T.copy(), strict=True))

    def _turns(self, name: str) -> np.ndarray:
        return self.equations[name].drift * self.equations[name].grid.tau[:, None]

    def parameters_along_guesses(self, theta: np.ndarray) -> np.ndarray:
        """Return the θ near which the equations hold best along the experiments' guesses, by damped Gauss-Newton."""
        now = self._misfit(theta)
        for _ in range(MOST_ORBIT_STEPS):
            total, count = 0.0, 0
            hessian, gradient = np.zeros((theta.size, theta.size)), np.zeros(theta.size)
            for name, z in self.guess.items():
                at, equations = self.problem.parameters(theta[None], name)[0], self.equations[name]
                g = _weighed(equations, equations.residual_jacobian(z, at)[:, : equations.count, None]).ravel()
                by = _weighed(
                    equations, equations.derivatives(z, at).g_theta @ self.maps[name].slopes(theta)[: at.size]
                )
                by = by.reshape(g.size, theta.size)
                hessian, gradient = hessian + by.T @ by, gradient - by.T @ g
                total, count = total + g @ g, count + g.size
            if total == 0.0:
                break
            weight = self.problem.counted / total
            step, size = self._step(weight * hessian, weight * gradient, theta)
            if size < SMALL_TURN:
                break
            share = 1.0
            while share > SMALLEST_SHARE:
                there = self._there(theta, share * step)
                trial = self._misfit(there)
                if trial < now:
                    break
                share *= 0.5
            else:
                break
            theta, now = there, trial
        return theta

    def solves(self, name: str, z: np.ndarray, theta: np.ndarray) -> bool:
        """Return whether an orbit (points, states) solves the equations at θ."""
        equations, at = self.equations[name], self.problem.parameters(theta[None], name)[0]
        columns = equations.residual_jacobian(z, at)
        factors = equations.factors(columns)
        if not np.isfinite(columns).all() or not factors.regular:
            return False
        return _size(factors.solve(-columns[None, :, : equations.count])[0], z) < ON_ORBIT

    def measured_orbit(self, name: str, theta: np.ndarray) -> np.ndarray:
        """Return the orbit (points, states) near the guess that fits the outputs and, as far as it can, the equations.

        Least squares over the low harmonics, in which each block of outputs and each equation is divided by the size
        of its derivatives.
        """
        equations, observation, z = self.equations[name], self.observations[name], self.guess[name]
        (at, sensors), (points, count) = self.maps[name].split(theta), z.shape
        phase = 2 * np.pi * np.outer(np.arange(SEEN * equations.grid.periods + 1), np.arange(points) / points)
        waves = np.concatenate([np.cos(phase), np.sin(phase[1:])])[: points - 1]
        sizes = np.ptp(z, axis=0) + SMALL_TURN * np.abs(z).max()
        basis = np.einsum("hn,st->hsnt", waves, np.diag(np.where(sizes > 0.0, sizes, 1.0)))
        basis = basis.reshape(-1, points, count)
        changes, none = equations.changes(basis), np.zeros(len(basis))
        still = np.zeros((len(basis), sensors.size))
        for _ in range(SEEN_ROUNDS):
            d, columns = equations.derivatives(z, at), equations.residual_jacobian(z, at)
            by_q = columns[:, count:].reshape(points, count, -1)
            here = Response(equations.outputs(z, at), np.array(equations.frequency), none[:0], sensors)
            moved = Response(along(d.f_q, changes), none, none[:, None][:, :0], still)
            g = _weighed(equations, columns[:, :count, None])[..., 0]
            dg = _weighed(equations, np.einsum("neq,dnq->ned", by_q, changes))
            parts = [
                (1.0, *pair) for pair in zip(observation.changes(here, moved), observation.residuals(here), strict=True)
            ]
            parts += [(EQUATIONS, dg[:, e].T, -g[:, e]) for e in range(count)]
            scales = [weight / (float(np.linalg.norm(j)) or np.inf) for weight, j, _ in parts]
            rows = np.concatenate([scale * j.T for scale, (_, j, _) in zip(scales, parts, strict=True)])
            right = np.concatenate([scale * r for scale, (_, _, r) in zip(scales, parts, strict=True)])
            if not (np.isfinite(rows).all() and np.isfinite(right).all()):
                break
            z = z + np.tensordot(np.linalg.lstsq(rows, right, rcond=1e-9)[0], basis, 1)
        return z

    def orbit_of_any_mean(self, name: str, theta: np.ndarray) -> np.ndarray:
        """Return the measured orbit that solves the equations best, from means of each state on both sides.

        Outputs such as a velocity leave the mean of a state to the equations, which may have several solutions.
        """
        best = self.measured_orbit(name, theta)
        error = self._equation_error(name, best, theta)
        for shift in np.kron(np.eye(best.shape[1]), np.array(MEANS)[:, None]):
            self.guess[name] = best + shift * np.std(best, axis=0)
            z = self.measured_orbit(name, theta)
            if (other := self._equation_error(name, z, theta)) < error:
                best, error = z, other
        return best

    def _equation_error(self, name: str, z: np.ndarray, theta: np.ndarray) -> float:
        at, equations = self.problem.parameters(theta[None], name)[0], self.equations[name]
        return float(np.sum(_weighed(equations, equations.residual_jacobian(z, at)[:, : equations.count, None]) ** 2))

    def _misfit(self, theta: np.ndarray) -> float:
        """Return −log of the prior's density and of that of the equations' errors along the guesses."""
        prior = float(self.problem.joint_prior.log_prob(theta))
        if not np.isfinite(prior):
            return np.inf
        total = sum(self._equation_error(name, z, theta) for name, z in self.guess.items())
        return 0.5 * self.problem.counted * np.log(max(total, np.finfo(float).tiny)) - prior

    def _there(self, theta: np.ndarray, step: np.ndarray) -> np.ndarray:
        return np.where(self.problem.logarithmic, theta * np.exp(step * self.problem.logarithmic), theta + step)

    def iterate(self, theta: np.ndarray) -> InitialEstimate:
        """Return where the Gauss-Newton iteration in orbits and θ leads to from the guesses and a θ."""
        orbits, noise = self.guess, self.likelihood.guess()
        for _ in range(MOST_ORBIT_STEPS):
            linear = {}
            for name, z in orbits.items():
                one = self._linearise(name, z, theta)
                if one is None:
                    return InitialEstimate(theta, {}, name)
                linear[name] = one
            noise = estimate_noise(self.likelihood, [r for one in linear.values() for r in one.residuals], noise, 1.0)
            step, size = self._step(*self._information(linear, noise), theta)
            if size == np.inf:
                return InitialEstimate(theta, {}, next(iter(orbits)))
            off = {name: _size(one.correction, orbits[name]) for name, one in linear.items()}
            worst = max(off, key=lambda name: off[name])
            if off[worst] < ON_ORBIT and size < SMALL_TURN:
                break
            theta, orbits, blocked = self._moved(linear, orbits, theta, step)
            if blocked:
                return InitialEstimate(theta, {}, blocked)
        # Where the data leave a direction open, θ moves on along it while the orbits solve the equations.
        if off[worst] < SMALL_TURN:
            return InitialEstimate(theta, {name: self.states(name, z) for name, z in orbits.items()}, "")
        return InitialEstimate(theta, {}, worst)

    def _linearise(self, name: str, z: np.ndarray, theta: np.ndarray) -> LinearisedOrbit | None:
        """Return one experiment's equations linearised at an orbit and θ; None where ∂g/∂z is singular."""
        equations, mapped = self.equations[name], self.maps[name]
        (at, sensors), (by, of_sensors) = mapped.split(theta), np.split(mapped.slopes(theta), [mapped.count])
        d, columns = equations.derivatives(z, at), equations.residual_jacobian(z, at)
        factors = equations.factors(columns)
        if not np.isfinite(columns).all() or not factors.regular:
            return None
        g = np.concatenate([np.tensordot(by, d.g_theta, (0, 2)), columns[None, :, : equations.count]])
        dz = factors.solve(-g)
        outputs = along(d.f_q, equations.changes(dz))
        outputs[:-1] += np.tensordot(by, d.f_theta, (0, 2))
        frequency, none = np.array(equations.frequency), np.zeros(0)
        here = Response(equations.outputs(z, at) + outputs[-1], frequency, none, sensors)
        directions = Response(outputs[:-1], np.zeros(theta.size), np.zeros((theta.size, 0)), of_sensors.T)
        observation = self.observations[name]
        return LinearisedOrbit(
            factors, dz[-1], dz[:-1], observation.residuals(here), observation.changes(here, directions)
        )

    def _information(self, linear: dict[str, LinearisedOrbit], noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the data's part of the Hessian and of the gradient of the log-density by θ."""
        jacobian = [part for one in linear.values() for part in one.jacobian]
        residuals = [r for one in linear.values() for r in one.residuals]
        white = np.concatenate(self.likelihood.whitened(jacobian, noise), axis=1)
        return white @ white.T, white @ np.concatenate(self.likelihood.whitened(residuals, noise))

    def _step(self, hessian: np.ndarray, gradient: np.ndarray, theta: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the step of θ's coordinates, positive parameters in their logarithms, and its length in sds.

        None and infinite where the equations or the prior overflow.
        """
        prior = self.problem.joint_prior
        by_prior = prior.gradient(theta)
        unit = np.where(self.problem.logarithmic, theta, 1.0)
        hessian = scaled(hessian + prior.curvature(theta), unit)
        hessian -= np.diag(np.where(self.problem.logarithmic, theta * by_prior, 0.0))
        gradient = (gradient + by_prior) * unit
        if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
            return np.zeros(theta.size), np.inf
        values, vectors, scale = hessian_eigh(hessian)
        values = np.maximum(np.abs(values), 1e-13 * np.abs(values).max())
        along = vectors.T @ (scale * gradient) / values
        step = scale * (vectors @ along)
        longest = np.max(np.abs(step), where=self.problem.logarithmic, initial=0.0)
        return step * min(1.0, LARGEST_STEP / max(longest, LARGEST_STEP)), float(np.sqrt(np.sum(values * along**2)))

    def _moved(
        self, linear: dict[str, LinearisedOrbit], orbits: dict[str, np.ndarray], theta: np.ndarray, step: np.ndarray
    ) -> tuple[np.ndarray, dict[str, np.ndarray], str]:
        """Return θ and the orbits a step further, so short that all equations are nearly linear; or what forbids it."""
        share, blocked = 1.0, next(iter(orbits))
        while share > SMALLEST_SHARE:
            there = self._there(theta, share * step)
            share *= 0.5
            if not np.isfinite(self.problem.joint_prior.log_prob(there)):
                continue
            moved: dict[str, np.ndarray] = {}
            for name, one in linear.items():
                z = self._orbit_moved(name, one, orbits[name], there - theta, there, 2.0 * share)
                if z is None:
                    blocked = name
                    break
                moved[name] = z
            else:
                return there, moved, ""
        return theta, orbits, blocked

    def _orbit_moved(
        self, name: str, linear: LinearisedOrbit, z: np.ndarray, change: np.ndarray, there: np.ndarray, share: float
    ) -> np.ndarray | None:
        """Return an orbit a step further, with one chord correction; None where the step is not nearly linear."""
        equations = self.equations[name]
        step = share * linear.correction + np.tensordot(change, linear.response, (0, 0))
        at = self.problem.parameters(there[None], name)[0]
        columns = equations.residual_jacobian(z + step, at)
        if not np.isfinite(columns).all():
            return None
        again = linear.factors.solve(-columns[None, :, : equations.count])[0]
        curved = _size(again - (1.0 - share) * linear.correction, z)
        if curved > NONLINEAR * _size(step, z) and curved > ON_ORBIT:
            return None
        return z + step + (again if share == 1.0 else 0.0)


def _weighed(equations: PeriodicEquations, values: np.ndarray) -> np.ndarray:
    """Return values (points, equations, columns) as real Fourier amplitudes, harmonics weighed down by their square.

    An orbit's noise is weighed up by as much where it is differentiated twice.
    """
    amplitudes = np.fft.rfft(values, axis=0) / len(values)
    harmonic = np.arange(len(amplitudes)) / equations.grid.periods
    amplitudes /= (1.0 + harmonic**2)[:, None, None]
    return np.concatenate([amplitudes.real, amplitudes.imag])


def _size(change: np.ndarray, z: np.ndarray) -> float:
    """Return the largest change (points, states) in units of the range of each state of an orbit."""
    spread = np.ptp(z, axis=0)
    return float(np.max(np.abs(change) / np.where(spread > 0.0, spread, 1.0)))
