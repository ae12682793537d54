"""Periodic equilibrium states: `solve_periodic` and what it returns."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bayesperiodic import checks
from bayesperiodic.models.model import Model
from bayesperiodic.periodic.compiled import CONVERGED, SINGULAR, STATUSES
from bayesperiodic.periodic.equations import PeriodicEquations, Solved, winding_numbers
from bayesperiodic.periodic.schemes import Scheme
from bayesperiodic.store import Result


@dataclass(frozen=True)
class PeriodicSolution(Result):
    """A periodic equilibrium state, stable or unstable, or the account of a failed attempt to find one.

    Attributes
    ----------
    model : str
        The model's name.
    status : str
        "converged", "stalled", "singular", "not finite" or "other orbit".
    frequency : float
        Forcing frequency [Hz].
    samples, periods : int
        Grid points per forcing period, forcing periods per response period.
    winding : dict of str to int
        Turns of each angle per response period.
    scheme : str
    parameters : dict of str to float
    tau : array (points,)
        Time in forcing periods, end point excluded; points = samples · periods.
    states, inputs, outputs : dict of str to array (points,)
    sensitivities : dict of str to dict of str to array (points,)
        ∂output/∂parameter, ``sensitivities[output][parameter]`` (de Kraker et al. 1997, eq. 4); empty unless converged.
    state_sensitivities : dict of str to dict of str to array (points,)
        ∂state/∂parameter; empty unless converged.
    iterations : int
        Newton iterations.
    residual : float
        Largest residual, in units of the size of its equation's terms.
    history : array (iterations, 3)
        Scaled residual before each iteration, scaled full Newton step, damping factor.
    """

    model: str
    status: str
    frequency: float
    samples: int
    periods: int
    winding: dict[str, int]
    scheme: str
    parameters: dict[str, float]
    tau: np.ndarray
    states: dict[str, np.ndarray]
    inputs: dict[str, np.ndarray]
    outputs: dict[str, np.ndarray]
    sensitivities: dict[str, dict[str, np.ndarray]]
    state_sensitivities: dict[str, dict[str, np.ndarray]]
    iterations: int
    residual: float
    history: np.ndarray

    @property
    def converged(self) -> bool:
        """True if the status is "converged"."""
        return self.status == STATUSES[CONVERGED]

    def __repr__(self) -> str:
        return (
            f"PeriodicSolution({self.model!r}, {self.status!r}, frequency={self.frequency:.6g} Hz, "
            f"samples={self.samples}, periods={self.periods}, iterations={self.iterations}, "
            f"residual={self.residual:.1e})"
        )


def solve_periodic(
    model: Model,
    parameters: Mapping[str, float],
    inputs: Mapping[str, np.ndarray] | None = None,
    *,
    frequency: float,
    samples: int = 800,
    scheme: str | Scheme = "central2",
    periods: int = 1,
    winding: int | Mapping[str, int] = 0,
    guess: str | Mapping[str, np.ndarray] | PeriodicSolution = "static",
) -> PeriodicSolution:
    """Find a periodic equilibrium state, stable or unstable, and its sensitivities to every parameter.

    The equations are discretised with a cyclic difference scheme and solved by a damped Newton method with step
    halving ([1]_, eq. 2-4).

    Parameters
    ----------
    model : Model
    parameters : mapping of str to float
        A value for every parameter.
    inputs : mapping of str to array (samples·periods,), optional
        Every input over one response period, end point excluded; derivatives are taken spectrally.
    frequency : float
        Forcing frequency [Hz].
    samples : int
        Grid points per forcing period.
    scheme : str or Scheme
        "central2" (accurate for smooth responses) or "backward2" (calmer where the response has kinks).
    periods : int
        Forcing periods per response period.
    winding : int or mapping of str to int
        Turns that an angle advances per response period.
    guess : "static", mapping of str to array (samples·periods,), or PeriodicSolution
        The equilibrium under the mean inputs, every state (turns of angles included), or an earlier solution.

    Returns
    -------
    PeriodicSolution
        With a `status`; a solve that fails does not raise.

    Raises
    ------
    ValueError
        For unknown or missing names, inputs of a wrong length or not finite, a frequency ≤ 0, too few samples for the
        scheme, a winding number for what is no angle, an autonomous model.

    References
    ----------
    .. [1] A. de Kraker, G. Verbeek, N. van de Wouw, Parameter identification in nonlinear models using periodic
       equilibrium states, 1997.

    Examples
    --------
    >>> import numpy as np, bayesperiodic as bp
    >>> force = np.cos(2 * np.pi * np.arange(800) / 800)
    >>> solution = bp.solve_periodic(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0.5}, {"force": force},
    ...                              frequency=0.1)
    >>> solution.status
    'converged'
    """
    equations = PeriodicEquations.build(
        model, inputs, frequency=frequency, samples=samples, scheme=scheme, periods=periods, winding=winding
    )
    checks.same_names("parameters", parameters, model.parameters)
    theta = np.array([checks.finite_number(f"parameters[{n!r}]", parameters[n]) for n in model.parameters])
    solved = equations.solve(theta, _guess(equations, theta, guess))
    return describe(equations, theta, solved)


def describe(equations: PeriodicEquations, theta: np.ndarray, solved: Solved) -> PeriodicSolution:
    """Return a solve as a PeriodicSolution, with sensitivities if it converged."""
    model, grid = equations.model, equations.grid
    turns = equations.drift * grid.periods / (2 * np.pi)
    sensitivities, state_sensitivities = {}, {}
    code = solved.code
    if code == CONVERGED:
        derivative = equations.parameter_sensitivities(solved.z, theta)
        if derivative is None:
            code = SINGULAR
        else:
            sensitivities = _by_name(derivative.outputs, model.outputs, model.parameters)
            state_sensitivities = _by_name(derivative.states, model.states, model.parameters)
    states = equations.states(solved.z)
    outputs = equations.outputs(solved.z, theta)
    return PeriodicSolution(
        model=model.name,
        status=STATUSES[code],
        frequency=equations.frequency,
        samples=grid.samples,
        periods=grid.periods,
        winding=winding_numbers(
            model, {s: round(w) for s, w in zip(model.states, turns, strict=True) if s in model.angles}
        ),
        scheme=grid.scheme.name,
        parameters=dict(zip(model.parameters, theta.tolist(), strict=True)),
        tau=grid.tau,
        states={name: states[:, i].copy() for i, name in enumerate(model.states)},
        inputs={name: equations.inputs[:, i].copy() for i, name in enumerate(model.inputs)},
        outputs={name: outputs[:, i].copy() for i, name in enumerate(model.outputs)},
        sensitivities=sensitivities,
        state_sensitivities=state_sensitivities,
        iterations=len(solved.history),
        residual=equations.scaled_residual(solved.z, theta),
        history=solved.history,
    )


def periodic_part(equations: PeriodicEquations, states: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return z (points, states) from named states that carry their turns."""
    model, grid = equations.model, equations.grid
    checks.same_names("guess", states, model.states)
    z = np.stack([checks.finite_vector(f"guess[{n!r}]", states[n], grid.points) for n in model.states], axis=-1)
    return z - equations.drift * grid.tau[:, None]


def _guess(
    equations: PeriodicEquations, theta: np.ndarray, guess: str | Mapping[str, np.ndarray] | PeriodicSolution
) -> np.ndarray:
    if isinstance(guess, PeriodicSolution):
        return periodic_part(equations, guess.states)
    if isinstance(guess, Mapping):
        return periodic_part(equations, guess)
    checks.one_of("guess", guess, ["static"])
    return equations.static_guess(theta)


def _by_name(
    values: np.ndarray, rows: tuple[str, ...], directions: tuple[str, ...]
) -> dict[str, dict[str, np.ndarray]]:
    return {row: {name: values[d, :, r].copy() for d, name in enumerate(directions)} for r, row in enumerate(rows)}
