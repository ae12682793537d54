"""`solve_periodic`: find a periodic equilibrium state, with fallbacks."""

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from bayesperiodic import _checks, _fourier
from bayesperiodic.models.integration import integration_kernels
from bayesperiodic.models.model import Model, parameter_vector
from bayesperiodic.periodic.arclength import INPUTS, ParametrisedEquations, solve_autonomous, trace
from bayesperiodic.periodic.compiled import CONVERGED, NOT_FINITE, NOT_RESOLVED, OTHER_ORBIT, SINGULAR, STATUSES
from bayesperiodic.periodic.condensed import (
    LARGEST_OUTPUT_CHANGE,
    MOST_ELEMENT_POINTS,
    CondensedEquations,
    equations_for,
)
from bayesperiodic.periodic.condensed_solution import described
from bayesperiodic.periodic.equations import PeriodicEquations, Solved
from bayesperiodic.periodic.isolation import MANY_CYCLES, has_neighbours
from bayesperiodic.periodic.schemes import Scheme
from bayesperiodic.periodic.singular_terms import singular_term
from bayesperiodic.periodic.solution import NEWTON, PeriodicSolution, as_guess, describe, resolution_warning

SOFTEST = 1e-3
SHARPENING = 2.0
SMALLEST_SHARPENING = 1.02


def raise_amplitude(equations: PeriodicEquations, parameters: np.ndarray, static: np.ndarray) -> np.ndarray | None:
    """Continue the solution while the variation of the inputs about their means grows from zero; None if that fails."""
    if not equations.model.inputs:
        return None
    mean, width = np.zeros_like(equations.inputs), len(equations.model.inputs)
    mean[:, :width] = equations.inputs[:, :width].mean(axis=0)
    start = replace(equations, inputs=mean)
    scaled = ParametrisedEquations(start, parameters, (INPUTS,), equations.inputs - mean)
    beginning = start.solve(parameters, static)
    columns = start.residual_jacobian(beginning.z, parameters)
    if beginning.code != CONVERGED or not (factors := start.factors(columns)).regular:
        return None
    linear = factors.solve(scaled.slopes(np.zeros(1), beginning.z, columns)[0])
    *_, last = trace(scaled, beginning.z, np.zeros(1), until=1.0, step=0.1, size=np.ptp(linear, axis=0))
    return last.z if last.values[0] == 1.0 else None


def sharpen(equations: PeriodicEquations, parameters: np.ndarray, guess: np.ndarray) -> np.ndarray | None:
    """Solve with softened signs first and sharpen them step by step; None if that fails or there are none."""
    if not equations.model.smooth_signs:
        return None
    soft = replace(equations, model=equations.model.softened)
    solved = soft.solve(np.append(parameters, SOFTEST), guess)
    if solved.code != CONVERGED:
        return None
    sharpness, factor, z = SOFTEST, SHARPENING, solved.z
    while sharpness < 1.0:
        next_sharpness = min(1.0, sharpness * factor)
        solved = soft.solve(np.append(parameters, next_sharpness), z)
        if solved.code == CONVERGED:
            sharpness, z, factor = next_sharpness, solved.z, min(factor**2, SHARPENING)
        else:
            factor = np.sqrt(factor)
            if factor < SMALLEST_SHARPENING:
                return None
    return z


PERIODS = 40
SETTLING_CYCLES = 120
NUDGES = (0.1, 1e-4, 1e-7, 1e-10)
REFINEMENTS = (1, 4, 16)  # of the grid, until the integration does not overflow


def integrate(
    equations: PeriodicEquations,
    parameters: np.ndarray,
    start: np.ndarray,
    inputs: np.ndarray,
    steps: int,
    kept: int,
    samples: int,
) -> np.ndarray | None:
    """Integrate by the classical fourth-order Runge-Kutta method in `samples` steps a period; None if states overflow.

    `start` (size,) contains the states and then the rates of the second-order ones at tau = 0; `inputs`
    (2·samples·periods, 3·inputs) u, u̇, ü at half steps over one response period, which is repeated. The result (kept,
    size) contains `start`'s variables before each of the last steps.
    """
    orders, function = (
        np.array(list(equations.model.orders.values())),
        equations.model.kernels.residual_jacobian.address,
    )
    path = np.empty((kept, orders.sum()))
    given = np.array(start, dtype=float), np.ascontiguousarray(inputs), samples, parameters
    solved = integration_kernels().runge_kutta(function, *given, equations.frequency, orders, steps, path)
    return path if solved else None


def settled_period(equations: PeriodicEquations, parameters: np.ndarray, start: np.ndarray) -> np.ndarray | None:
    """Return z (points, states) over the last of `PERIODS` response periods, integrated from rest at start[0].

    None if the integration fails or an angle does not advance by its winding number.
    """
    grid, count = equations.grid, equations.count
    second = [i for i, state in enumerate(equations.model.states) if equations.model.orders[state] == 2]
    half = _fourier.on_grid(_fourier.coefficients(equations.inputs.T), 2 * grid.points).T
    state, steps = np.concatenate([start[0], equations.drift[second] * equations.frequency]), PERIODS * grid.points
    path = integrate(equations, parameters, state, half, steps, grid.points, grid.samples)
    if path is None:
        return None
    z = path[:, :count] - equations.drift * (grid.tau[:, None] + (PERIODS - 1) * grid.periods)
    angles = equations.drift != 0.0
    turns = [state in equations.model.angles for state in equations.model.states]
    z[:, turns] -= 2 * np.pi * np.round(z[0, turns] / (2 * np.pi))
    slip = np.abs(z[-1] - z[0])[angles]
    return None if np.any(slip > np.pi) else z


def measured_cycle(equations: PeriodicEquations, parameters: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return z (points, states) and frequency [Hz] of the cycle that an autonomous model approaches; None without one.

    The integration starts near the equilibrium, at first within a tenth of it or of the unit of a state, then nearer:
    far outside a cycle that is small in its unit a motion may creep or overflow.
    """
    equilibrium = equations.static_guess(parameters)[0]
    cycles = (
        _cycle_from(equations, parameters, equilibrium + nudge * np.maximum(np.abs(equilibrium), 1.0))
        for nudge in NUDGES
    )
    return next((cycle for cycle in cycles if cycle is not None), None)


def _cycle_from(
    equations: PeriodicEquations, parameters: np.ndarray, states: np.ndarray
) -> tuple[np.ndarray, float] | None:
    """Return the same from states at rest.

    The cycle lies between the last two upward passages of the state of largest relative range through the middle of its
    range.
    """
    grid, count, orders = equations.grid, equations.count, equations.model.orders.values()
    start, path = np.concatenate([states, np.zeros(sum(orders) - count)]), None
    for finer in REFINEMENTS:  # stiff equations need shorter steps than the orbit
        samples = grid.samples * finer
        steps = SETTLING_CYCLES * samples
        path = integrate(equations, parameters, start, np.empty((2, 0)), steps, steps // 4, samples)
        if path is not None:
            break
    else:
        return None
    state = path[:, int(np.argmax(np.ptp(path[:, :count], axis=0) / (1.0 + np.abs(path[:, :count]).max(axis=0))))]
    height = state - 0.5 * (state.max() + state.min())
    passages = np.flatnonzero((height[:-1] < 0.0) & (height[1:] >= 0.0))
    if len(passages) < 2:
        return None
    times = passages - height[passages] / (height[passages + 1] - height[passages])
    at = np.linspace(times[-2], times[-1], grid.points, endpoint=False)
    z = np.stack([np.interp(at, np.arange(len(path)), path[:, s]) for s in range(count)], axis=-1)
    return z, equations.frequency * samples / float(times[-1] - times[-2])


GUESSES = ("static", "integration")
FEW_STEPS = 4
UNCERTAIN, SMALL_CHANGE = 0.3, 1e-6  # share of the range, of the largest value


def solve_periodic(
    model: Model,
    parameters: Mapping[str, float],
    inputs: Mapping[str, np.ndarray] | None = None,
    *,
    frequency: float,
    samples: int = 800,
    scheme: str | Scheme | None = None,
    periods: int = 1,
    winding: int | Mapping[str, int] = 0,
    guess: str | Mapping[str, np.ndarray] | PeriodicSolution = "static",
) -> PeriodicSolution:
    """Find a periodic equilibrium state, stable or unstable, and its sensitivities to every parameter.

    The equations are discretised with a cyclic difference scheme and solved by a damped Newton method with step
    halving ([1]_, eq. 2-4). If that fails, smooth signs are softened and sharpened again step by step; then, from the
    static guess, the variation of the inputs is raised from zero along the branch of solutions, and finally a short
    time integration is tried.

    Parameters
    ----------
    model : Model
    parameters : mapping of str to float
        A value for every parameter.
    inputs : mapping of str to array (samples·periods,), optional
        Every input over one response period, end point excluded; derivatives are taken spectrally.
    frequency : float
        Forcing frequency [Hz]; for an autonomous model the first guess of the orbit's frequency.
    samples : int
        Grid points per forcing period.
    scheme : str or Scheme, optional
        "central2" (accurate for smooth responses), "backward2" (better where the response has kinks), "central4" or
        "fourier" (collocation as in harmonic balance, the most accurate for smooth responses; few points suffice). By
        default "central4" for a model with a state of first order, whose even and odd points "central2" does not
        relate, and "central2" for other models.
    periods : int
        Forcing periods per response period.
    winding : int or mapping of str to int
        Turns that an angle advances per response period.
    guess : "static", "integration", mapping of str to array (samples·periods,), or PeriodicSolution
        The equilibrium under the mean inputs (sought from zero, or from powers of ten if the equations are singular
        there), the end of a short time integration from there, every state (turns of
        angles included), or an earlier solution, on any grid, of as many periods or a fraction of them. If the
        integration fails or does not lock to the winding number, the static guess is used. For an autonomous model
        "static" means an integration from near the equilibrium; the phase of its orbit is the closest to the guess.

    Returns
    -------
    PeriodicSolution
        With a `status`; a solve that fails does not raise.

    Raises
    ------
    ValueError
        For unknown or missing names, inputs of a wrong length or not finite, a frequency ≤ 0, too few samples for the
        scheme, a winding number of a state that is not an angle, a guess constant in time for an autonomous model.

    Warns
    -----
    UserWarning
        If the transition of a smooth sign takes fewer than four steps of the grid, if the estimated discretisation
        error of a state exceeds 30 % of its range, if the status is "not resolved", or if the trivial multiplier of an
        autonomous model's orbit is wrong by more than 10 %, if its cycles are not isolated, as those of conservative
        models (status "singular"), and if the equations are singular where the solve starts.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.

    Examples
    --------
    >>> response = bp.solve_periodic(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0}, force, frequency=0.1,
    ...                              samples=32, scheme="fourier")
    >>> response.status, response.stable
    ('converged', True)

    This spring is linear, so the amplitude is 1/abs(1 − ω² + 0.2iω):

    >>> omega, amplitude = 0.2 * np.pi, np.sqrt(2) * response.states["x"].std()
    >>> round(float(amplitude * np.hypot(1 - omega**2, 0.2 * omega)), 9)
    1.0

    An autonomous model, whose period is part of the solution:

    >>> orbit = bp.solve_periodic(bp.models.van_der_pol, {"mu": 0.5, "omega": 1}, frequency=0.15, scheme="central4")
    >>> round(orbit.period, 4)
    6.3807
    """
    _checks.instance("model", model, Model)
    equations = equations_for(
        model, inputs, frequency=frequency, samples=samples, scheme=scheme, periods=periods, winding=winding
    )
    theta = parameter_vector(model, parameters)
    if model.autonomous:
        equations, solved, found_by = solve_free(equations, theta, guess)
    else:
        solved, found_by = solve_driven(equations, theta, guess)
    solution = described(equations, theta, solved, found_by)
    in_family = model.autonomous and (not solution.converged or (solution.resolved and solution.stable is None))
    if in_family and is_one_of_many(equations, theta, guess if not solution.converged else solution):
        solution = describe(equations, theta, solved._replace(code=SINGULAR), found_by)
        warnings.warn(f"The cycles of {model.name!r} are not isolated: {MANY_CYCLES}", UserWarning, stacklevel=2)
    for text in _solution_warnings(equations, theta, solution, solved.z):
        warnings.warn(text, UserWarning, stacklevel=2)
    return solution


def is_one_of_many(
    equations: PeriodicEquations, theta: np.ndarray, guess: str | Mapping[str, np.ndarray] | PeriodicSolution
) -> bool:
    """Return whether the cycle of an autonomous model near a guess is not isolated, see `isolation`."""
    if isinstance(guess, str):
        cycle = measured_cycle(equations, theta)
        return cycle is not None and has_neighbours(equations, theta, *cycle)
    frequency = guess.frequency if isinstance(guess, PeriodicSolution) else equations.frequency
    return has_neighbours(equations, theta, as_guess(equations, guess), frequency)


def _solution_warnings(
    equations: PeriodicEquations, theta: np.ndarray, solution: PeriodicSolution, z: np.ndarray
) -> Iterator[str]:
    """Yield the warnings about a solution: what the grid does not resolve."""
    name, samples = solution.model, solution.samples
    if isinstance(equations, CondensedEquations):
        if solution.status == STATUSES[NOT_RESOLVED]:
            yield (
                f"The solution of {name!r} is not resolved: its outputs still change by more than "
                f"{LARGEST_OUTPUT_CHANGE:.0%} where the forces of the elements are evaluated at {MOST_ELEMENT_POINTS} "
                "points; make kinks smoother (width)."
            )
        return
    if solution.status == STATUSES[NOT_FINITE] and (term := singular_term(equations, z, theta)):
        yield (
            f"The equations of {name!r} are not finite at states that the solve starts from or reaches: {term}. Give "
            "guess={…} with states at which they are finite."
        )
    if solution.status == STATUSES[NOT_RESOLVED]:
        yield (
            f"The solution of {name!r} is not resolved: its values at even and odd points differ, or "
            f"{solution.scheme.name!r} does not relate them. Take more samples than {samples}, an odd number of them, "
            'or another scheme, such as "central4" or "backward2".'
        )
    if not solution.converged:
        return
    if text := resolution_warning(solution, f"The orbit of {name!r}"):
        yield text
    steps = _steps_of_transitions(equations, theta, z)
    if steps < FEW_STEPS:
        yield (
            f"The transition of a smooth sign of {name!r} takes {steps:.2g} steps of the grid; "
            f"{int(np.ceil(samples * FEW_STEPS / steps))} samples would resolve it. With fewer, the error may be far "
            "larger than error_estimate."
        )
    errors = solution.error_estimate() if np.isfinite(solution.scheme.order) else {}
    for (state, error), values in zip(errors.items(), z.T, strict=False):
        reached = np.abs(values).max()
        if reached > 0.0 and error > max(UNCERTAIN * np.ptp(values), SMALL_CHANGE * reached):
            yield (
                f"The discretisation error of {state!r} is estimated at {error / np.ptp(values):.0%} of its range, so "
                "that the grid determines the solution. At resonance without damping there is no periodic solution; "
                f"add damping, change the frequency, or take more samples than {samples} or a scheme of higher order."
            )
            return


def solve_driven(
    equations: PeriodicEquations, theta: np.ndarray, guess: str | Mapping[str, np.ndarray] | PeriodicSolution
) -> tuple[Solved, str]:
    """Solve a driven problem from any guess; return the solve and how it was found (`PeriodicSolution.found_by`).

    The status is "other orbit" if the solution repeats more often within the response period than the guess.
    """
    if isinstance(equations, CondensedEquations):
        _checks.one_of("guess", guess if isinstance(guess, str) else "static", ("static",))
        return equations.find(theta, None if isinstance(guess, str) else as_guess(equations, guess))
    if not isinstance(guess, str):
        start = as_guess(equations, guess)
        solved, found_by = solve_from(equations, theta, start)
        times, periods = equations.kernels.repetitions, equations.grid.periods
        if solved.code == CONVERGED and times(solved.z, periods) > times(start, periods):
            solved = solved._replace(code=OTHER_ORBIT)
        return solved, found_by
    _checks.one_of("guess", guess, GUESSES)
    if guess == "integration":
        settled = settled_period(equations, theta, equations.static_guess(theta))
        if settled is not None:
            return solve_from(equations, theta, settled)
    return solve_from(equations, theta, equations.static_guess(theta), at_rest=True)


def solve_from(
    equations: PeriodicEquations, theta: np.ndarray, start: np.ndarray, *, at_rest: bool = False
) -> tuple[Solved, str]:
    """Solve a driven problem from a guess, with all fallbacks if it is the static one; return the solve and its route.

    The first solve is returned if none converges.
    """
    routes: dict[str, Callable[[], np.ndarray | None]] = {
        NEWTON: lambda: start,
        "sharpness": lambda: sharpen(equations, theta, start),
    }
    if at_rest:
        routes["input amplitude"] = lambda: raise_amplitude(equations, theta, start)
        routes["time integration"] = lambda: settled_period(equations, theta, start)
    first = None
    for name, route in routes.items():
        if (guess := route()) is not None:
            solved = equations.checked(equations.solve(theta, guess))
            if solved.code == CONVERGED:
                return solved, name
            first = first or solved
    assert first is not None
    return first, NEWTON


def solve_free(
    equations: PeriodicEquations, theta: np.ndarray, guess: str | Mapping[str, np.ndarray] | PeriodicSolution
) -> tuple[PeriodicEquations, Solved, str]:
    """Solve for the orbit of an autonomous model; return the equations at its frequency, the solve, and how found."""
    frequency, found_by = equations.frequency, NEWTON
    if isinstance(guess, str):
        _checks.one_of("guess", guess, GUESSES)
        cycle = measured_cycle(equations, theta)
        if cycle is None:
            z = equations.static_guess(theta)
            return equations, Solved(z, OTHER_ORBIT, np.empty((0, 3))), "time integration"
        z, frequency = cycle
        found_by = "time integration"
    else:
        if isinstance(guess, PeriodicSolution):
            frequency = guess.frequency
        z = as_guess(equations, guess)
        if np.all(np.ptp(z, axis=0) == 0.0):
            raise ValueError(
                f"guess: must vary in time, got constant states; {equations.model.name!r} is autonomous, and the guess "
                "fixes the phase."
            )
    equations = replace(equations, frequency=frequency)
    solved = solve_autonomous(equations, theta, z, frequency)
    equations = equations.at_frequency(float(solved.values[0]))
    code = solved.code
    orbits = equations.bordered_kernels
    shorter = code == CONVERGED and orbits.has_shorter_period(solved.z)
    if shorter or (code != NOT_FINITE and orbits.has_shrunk(solved.z, z)):
        code = OTHER_ORBIT
    return equations, equations.checked(solved._replace(code=code)), found_by


def _steps_of_transitions(equations: PeriodicEquations, theta: np.ndarray, z: np.ndarray) -> float:
    """Return the fewest steps of the grid in which a smooth sign's argument goes from −1 to 1."""
    if not equations.model.smooth_signs:
        return np.inf
    arguments = equations.evaluate("transitions", z, theta)
    after = np.roll(arguments, -1, axis=0)
    crossing = (np.minimum(abs(arguments), abs(after)) < 1.0) | (arguments * after < 0.0)
    steepest = np.max(np.abs(after - arguments), where=crossing, initial=0.0)
    return 2.0 / steepest if steepest > 0 else np.inf
