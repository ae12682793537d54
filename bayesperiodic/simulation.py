"""Simulated recordings by time integration, independent of the periodic solver."""

from collections.abc import Callable, Mapping
from functools import cache

import numpy as np
from scipy.integrate import DOP853, solve_ivp

from bayesperiodic import _checks, _fourier
from bayesperiodic.data.recording import Recording
from bayesperiodic.models.integration import complete_states, integration_kernels
from bayesperiodic.models.model import Model, parameter_vector

RELATIVE_TOLERANCE = 1e-10
SIXTH_ORDER = {
    1: ((-3, -1 / 60), (-2, 3 / 20), (-1, -3 / 4), (1, 3 / 4), (2, -3 / 20), (3, 1 / 60)),
    2: ((-3, 1 / 90), (-2, -3 / 20), (-1, 3 / 2), (0, -49 / 18), (1, 3 / 2), (2, -3 / 20), (3, 1 / 90)),
}
DIFFERENCE_STEP = 2e-3
# In forcing periods.
LONGEST_STEP, TRIAL = 0.05, 3.0
# Largest number of steps between two output times.
STEPS_EACH = 100_000
# Steady cycles: periods of a transient, number of transients, Newton iterations; tolerance and difference step.
TRANSIENT_PERIODS, TRANSIENTS, CYCLE_ITERATIONS = 5, 12, 12
CYCLE_TOLERANCE, STATE_STEP = 1e-9, 1e-5

UNBOUNDED = "The motion may be unbounded; check the signs and units of the parameters, and the start."

Signal = np.ndarray | Callable[[np.ndarray], np.ndarray]


def simulate(
    model: Model,
    parameters: Mapping[str, float],
    inputs: Mapping[str, Signal] | None = None,
    *,
    frequency: float,
    duration: float,
    sampling_rate: float,
    start: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
    seed: int | None = None,
) -> Recording:
    """Simulate a recording by time integration of a model; the recording is marked as synthetic.

    Parameters
    ----------
    model : Model
    parameters : mapping of str to float
        A value for every parameter.
    inputs : mapping of str to array (samples,) or callable
        One forcing period on an equidistant grid, end point excluded, which is repeated and differentiated spectrally;
        or a smooth function of arrays of time [s], which is differentiated by differences of sixth order with a step of
        0.2 % of the forcing period.
    frequency, duration, sampling_rate : float
        Forcing frequency [Hz], duration [s] and sampling rate [Hz].
    start : mapping of str to float, optional
        States at time 0, and first derivatives of second-order states, such as ``dx``; the others are zero.
    noise, seed : mapping of str to float and int, optional
        Standard deviation of independent normal noise on outputs and inputs, and the seed of its generator.

    Returns
    -------
    Recording
        With the model's outputs and inputs.

    Raises
    ------
    ValueError
        For unknown or missing names, and values that are not finite or not positive.
    RuntimeError
        If the integration fails.

    Examples
    --------
    >>> run = bp.simulate(bp.models.duffing, {"m": 1, "c": 0.2, "k": 1, "k3": 0}, {"force": np.ones(8)},
    ...                   frequency=0.2, duration=100, sampling_rate=10)
    >>> round(float(run.outputs["displacement"][-1]), 3)
    1.0
    """
    _checks.instance("model", model, Model)
    frequency = _checks.positive("frequency", frequency)
    samples = int(_checks.positive("duration", duration) * _checks.positive("sampling_rate", sampling_rate)) + 1
    time = np.arange(samples) / sampling_rate
    system = _FirstOrder(model, parameters, inputs or {}, frequency)
    noise = _checks.optional_mapping("noise", noise, "{'displacement': 0.01}")
    for name in noise:
        _checks.one_of("noise", name, (*model.outputs, *model.inputs))
    integrate = _integrate_periodic if all(isinstance(s, _Periodic) for s in system.signals) else _integrate
    channels = system.outputs(time, integrate(system, system.start(start), time))
    generator = np.random.default_rng(None if seed is None else _checks.integer("seed", seed, 0))
    measured_inputs = {name: signal(time)[0] for name, signal in zip(model.inputs, system.signals, strict=True)}
    for name, sd in noise.items():
        target = channels if name in channels else measured_inputs
        target[name] = target[name] + _checks.finite_number(f"noise[{name!r}]", sd) * generator.standard_normal(samples)
    return Recording(time, channels, measured_inputs, name=f"synthetic {model.name}", synthetic=True)


class _FirstOrder:
    """A model as ẏ = f(t, y), where y contains the states and the first derivatives of the second-order states."""

    def __init__(self, model: Model, parameters: Mapping[str, float], inputs: Mapping[str, Signal], frequency: float):
        self.model, self.frequency, self.count = model, frequency, len(model.states)
        self.theta = parameter_vector(model, parameters)
        _checks.same_names("inputs", inputs, model.inputs)
        self.signals = [_with_derivatives(name, inputs[name], frequency) for name in model.inputs]
        self.orders = np.array([model.orders[state] for state in model.states])
        self.second = np.flatnonzero(self.orders == 2)

    def start(self, given: Mapping[str, float] | None) -> np.ndarray:
        """Return y from the given states and rates; the others are zero."""
        names = [*self.model.states, *("d" + self.model.states[i] for i in self.second)]
        given = _checks.optional_mapping("start", given, "{'x': 0.1}")
        for name in given:
            _checks.one_of("start", name, names)
        return np.array([_checks.finite_number(f"start[{n!r}]", given.get(n, 0.0)) for n in names])

    def amplitudes(self) -> np.ndarray:
        """Return the complex amplitudes of u, u̇, ü, (harmonics, 3·inputs), up to the last harmonic of any input."""
        columns = [s.amplitudes[order] for order in range(3) for s in self.signals if isinstance(s, _Periodic)]
        table = np.zeros((max((c.size for c in columns), default=1), len(columns)), dtype=complex)
        for j, column in enumerate(columns):
            table[: column.size, j] = column
        size = np.abs(table)
        present = (size > 1e-15 * size.max(axis=0, initial=0.0)).any(axis=1)
        return table[: 1 + np.flatnonzero(present).max(initial=0)]

    def _inputs(self, time: np.ndarray) -> np.ndarray:
        signals = np.empty((len(self.signals), 3, time.size))
        for i, signal in enumerate(self.signals):
            signals[i] = signal(time)
        return np.ascontiguousarray(np.swapaxes(signals, 0, 1).reshape(-1, time.size).T)

    def states(self, time: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return q, q̇, q̈, (points, 3·states), with the highest derivatives solved from the equations."""
        given = self._inputs(time), self.theta, time * self.frequency, self.frequency
        return complete_states(self.model, y, *given)

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        """Return ẏ."""
        states = self.states(np.array([t]), y[None])[0]
        return np.concatenate([states[self.count : 2 * self.count], states[2 * self.count + self.second]])

    def outputs(self, time: np.ndarray, y: np.ndarray) -> dict[str, np.ndarray]:
        """Return the outputs by name, (points,) each."""
        given = self._inputs(time), self.theta, time * self.frequency, self.frequency
        columns = self.model.kernels.evaluate("outputs", self.states(time, y), *given)
        return dict(zip(self.model.outputs, columns.T, strict=True))


def _integrate(system: _FirstOrder, start: np.ndarray, time: np.ndarray) -> np.ndarray:
    step = LONGEST_STEP / system.frequency
    short = (time[0], min(time[-1], TRIAL / system.frequency))
    size = np.abs(solve_ivp(system, short, start, rtol=1e-3, max_step=step).y).max(axis=1)
    tolerances = {"rtol": RELATIVE_TOLERANCE, "atol": RELATIVE_TOLERANCE * (size + np.finfo(float).tiny)}
    result = solve_ivp(system, (time[0], time[-1]), start, "DOP853", time, max_step=step, **tolerances)
    if not result.success or not np.isfinite(result.y).all():
        raise RuntimeError(f"The time integration of {system.model.name!r} failed: {result.message} {UNBOUNDED}")
    return result.y.T


@cache
def _tableau() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return stages, nodes and error weights of the method of order 8, with the step's end as the last stage."""
    a = np.vstack([DOP853.A, DOP853.B])
    return a, np.append(DOP853.C, 1.0), np.stack([DOP853.E5, DOP853.E3])


def _integrate_periodic(system: _FirstOrder, start: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return the same as `_integrate` for inputs that are Fourier series, by compiled code."""
    amplitudes, tau, ones = system.amplitudes(), time * system.frequency, np.ones(start.size)
    function, dormand_prince = system.model.kernels.residual_jacobian.address, integration_kernels().dormand_prince

    def path(tau: np.ndarray, absolute: np.ndarray, relative: np.ndarray) -> np.ndarray:
        states = np.empty((tau.size, start.size))
        states[0] = start
        settings = (amplitudes, system.theta, system.frequency, system.orders, tau)
        return states[: dormand_prince(function, *settings, states, *_tableau(), absolute, relative, STEPS_EACH)]

    trial = path(np.linspace(0.0, min(tau[-1], TRIAL), 61), 1e-12 * ones, 1e-3 * ones)
    size, relative = np.abs(trial).max(axis=0) + np.finfo(float).tiny, RELATIVE_TOLERANCE * ones
    # The error of an angle is relative to one turn, not to its value.
    angles = [i for i, state in enumerate(system.model.states) if state in system.model.angles]
    size[angles], relative[angles] = np.maximum(size[angles], np.pi), 0.0
    states = path(tau, RELATIVE_TOLERANCE * size, relative)
    if len(states) < time.size or not np.isfinite(states).all():
        raise RuntimeError(
            f"The time integration of {system.model.name!r} failed at {time[len(states) - 1]:.6g} s, because the step "
            f"became too small. {UNBOUNDED}"
        )
    return states


class _Periodic:
    """A Fourier series and its first two derivatives as a function of time [s]."""

    def __init__(self, argument: str, signal: np.ndarray, frequency: float):
        values = _fourier.coefficients(_checks.finite_vector(argument, signal))
        self.frequency = frequency
        self.amplitudes = np.stack([_fourier.derivative(values, frequency, order) for order in range(3)])

    def __call__(self, time: np.ndarray) -> list[np.ndarray]:
        size = np.abs(self.amplitudes[0])
        present = np.flatnonzero(size > 1e-15 * size.max(initial=0.0))
        wave = np.exp(2j * np.pi * self.frequency * np.multiply.outer(present, time))
        return list((self.amplitudes[:, present] @ wave).real)


def _with_derivatives(name: str, signal: Signal, frequency: float) -> Callable[[np.ndarray], list[np.ndarray]]:
    if not callable(signal):
        return _Periodic(f"inputs[{name!r}]", signal, frequency)
    function, step = signal, DIFFERENCE_STEP / frequency

    def sampled(time: np.ndarray) -> list[np.ndarray]:
        derivatives = [np.asarray(function(time), dtype=float)]
        for order in (1, 2):
            terms = [weight * function(time + offset * step) for offset, weight in SIXTH_ORDER[order]]
            derivatives.append(np.sum(terms, axis=0) / step**order)
        return derivatives

    return sampled


class NotSettled(RuntimeError):
    """The simulated motion did not converge to a stable steady cycle."""


def steady_cycle(
    model: Model,
    parameters: Mapping[str, float],
    inputs: Mapping[str, np.ndarray],
    *,
    frequency: float,
    samples: int,
    start: Mapping[str, float] | None = None,
) -> dict[str, np.ndarray]:
    """Return one steady cycle (samples,) of every output, without noise; arguments as for `simulate`.

    Five cycles are integrated from the start. Then Newton's method solves for the state that is repeated after one
    cycle, which avoids long integrations of slow transients, such as thermal ones. Only a stable cycle is accepted;
    otherwise this is repeated, up to twelve times. Without a stable cycle, `NotSettled` is raised.
    """
    system = _FirstOrder(model, parameters, inputs, frequency)
    try:
        y = system.start(start)
        for _ in range(TRANSIENTS):
            y = _advanced(system, y, TRANSIENT_PERIODS)
            settled = _fixed_point(system, y)
            if settled is not None:
                time = np.arange(samples) / (samples * frequency)
                return system.outputs(time, _integrate_periodic(system, settled, time))
    except (RuntimeError, np.linalg.LinAlgError) as error:
        raise NotSettled(f"{model.name!r}: {error}") from error
    raise NotSettled(f"{model.name!r} does not converge to a stable cycle in {TRANSIENTS * TRANSIENT_PERIODS} periods.")


def _advanced(system: _FirstOrder, y: np.ndarray, periods: int) -> np.ndarray:
    return _integrate_periodic(system, y, np.array([0.0, periods / system.frequency]))[-1]


def _fixed_point(system: _FirstOrder, y: np.ndarray) -> np.ndarray | None:
    """Return the state near y that is repeated after one cycle; None if there is none or it is unstable."""
    identity = np.eye(y.size)
    for _ in range(CYCLE_ITERATIONS):
        scale = np.maximum(np.abs(y), np.abs(y).max() * STATE_STEP) + np.finfo(float).tiny
        end = _advanced(system, y, 1)
        moved = [_advanced(system, y + STATE_STEP * scale[i] * identity[i], 1) for i in range(y.size)]
        monodromy = np.stack([(m - end) / (STATE_STEP * s) for m, s in zip(moved, scale, strict=True)], axis=1)
        step = np.linalg.solve(identity - monodromy, end - y)
        if not np.isfinite(step).all():
            return None
        y = y + step
        if np.all(np.abs(step) <= CYCLE_TOLERANCE * scale):
            return y if np.abs(np.linalg.eigvals(monodromy)).max() < 1.0 else None
    return None
