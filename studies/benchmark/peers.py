"""Methods of other packages: SciPy, diffrax on JAX, and harmonic balance by `harmonicbalance`.

solve_ivp has compiled right-hand sides, solve_bvp those of NumPy. diffrax runs compiled, in double precision, with
gradients by its own adjoint. The Fourier series of `harmonicbalance` have one unknown, so it is applied to the Duffing
oscillator only. A package that is not installed gives a row without times.
"""

import contextlib
import importlib.util
import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_bvp, solve_ivp
from scipy.interpolate import CubicSpline

from studies.benchmark.contenders import SLOW_DRAWS, SLOW_REPEATS, Contest
from studies.benchmark.integration import EQUILIBRIUM, ESTIMATE, LOOSE, PREDICTED, TABLE, TIMED_CYCLES, Peer
from studies.benchmark.kernels import JAX, NUMPY, FirstOrder
from studies.benchmark.problems import DUFFING
from studies.timing import Action

LSODA, RADAU, BVP = "LSODA", "Radau", "solve_bvp"
INITIAL = (LSODA, RADAU)
# Relative tolerances of SciPy and of diffrax.
TOLERANCES, RELATIVE = tuple(10.0**-k for k in range(3, 13)), tuple(10.0**-k for k in range(4, 12))
NODES, MOST_NODES = 201, 50_000
HARMONICS = (1, 3, 5, 7, 9, 11, 15, 21, 31)
BALANCE = "harmonic balance from the estimate's orbit"
DIFFRAX = "diffrax"
DIFFRAX_SHOOTING, DIFFRAX_GRADIENT = "diffrax shooting from the predicted orbit", "diffrax shooting, value and gradient"
DIFFRAX_ROWS = (f"{DIFFRAX} {EQUILIBRIUM}", f"{DIFFRAX} {ESTIMATE}", DIFFRAX_SHOOTING, DIFFRAX_GRADIENT)
NEEDED = ("diffrax", "jax")
# Its explicit method; the implicit Kvaerno5 takes several times as long on every problem here, the stiff one too.
METHOD = "Tsit5"
MOST_STEPS = 100_000


def add_scipy(contest: Contest, *, quick: bool = False) -> None:
    """Add solve_ivp (but for a quick run) and solve_bvp."""
    for method in () if quick else INITIAL:
        methods, error = contest.reference.tuned(partial(Initial, method=method), TOLERANCES, 1)
        contest.add_until_steady(method, methods, error, "rtol")
    for start in (ESTIMATE,) if quick else (EQUILIBRIUM, ESTIMATE):
        tuned = contest.reference.tuned(partial(Boundary, start=start), TOLERANCES, SLOW_DRAWS)
        contest.add_methods(f"{BVP} {start}", *tuned, "tol")


@dataclass(frozen=True)
class Initial(Peer):
    """solve_ivp through cycles of one experiment; the absolute tolerances are relative to the states' sizes."""

    method: str

    def cycles(self, p: np.ndarray, start: np.ndarray, count: int) -> float:
        """Return the log-likelihood of the last of so many cycles; NaN if SciPy fails."""
        case = self.case
        options = {"jac": case.compiled.jacobian_in_time} if self.method == RADAU else {}
        solved = solve_ivp(  # type: ignore[call-overload]
            case.compiled.rates_in_time, (0.0, count * case.period), start, self.method,
            (count - 1) * case.period + case.times, rtol=self.setting, atol=self.setting * case.scale,
            args=(p, self.table, case.period), **options,
        )  # fmt: skip
        return case.log_likelihood_of(p, solved.y.T) if solved.success else np.nan

    def __call__(self, p: np.ndarray) -> float:
        """Return the log-likelihood after one cycle from the steady state; NaN for failure."""
        found = self.discretised.shoot(p, PREDICTED, LOOSE)
        return self.cycles(p, self.discretised.orbit, 1) if found else np.nan

    def prepared(self, p: np.ndarray, start: np.ndarray) -> Callable[[], Any]:
        """Return the integration through `TIMED_CYCLES` cycles."""
        return partial(self.cycles, p, start, TIMED_CYCLES)


@dataclass(frozen=True)
class Boundary(Peer):
    """solve_bvp with periodic conditions on one experiment, from the states at the estimate or at equilibrium."""

    start: str

    @cached_property
    def _signals(self) -> CubicSpline:
        times = np.arange(TABLE + 1) * (self.case.period / TABLE)
        return CubicSpline(times, np.vstack([self.table, self.table[:1]])[:, :-1], bc_type="periodic")

    @cached_property
    def _guess(self) -> tuple[np.ndarray, np.ndarray]:
        """The mesh (nodes,) and the states (size, nodes) on it; at the estimate those that solve_bvp ends with."""
        case, times = self.case, np.linspace(0.0, self.case.period, NODES)
        if self.start == EQUILIBRIUM:
            return times, np.repeat(case.start[:, None], NODES, axis=1)
        self.discretised.shoot(case.estimate, PREDICTED, LOOSE)
        guess = times, self.discretised.states(times)
        found = self._solve(case.estimate, *guess)
        return (found.x, found.y) if found.success else guess

    def _solve(self, p: np.ndarray, times: np.ndarray, guess: np.ndarray) -> Any:
        size, (f, by_y) = len(guess), functions(self.case.model)

        def inputs(t: np.ndarray) -> np.ndarray:
            return np.vstack([self._signals(t).T, t * self.case.experiment.frequency])

        def rates(t: np.ndarray, y: np.ndarray) -> np.ndarray:
            out = np.empty_like(y)
            f(y, inputs(t), p, out)
            return out

        def jacobian(t: np.ndarray, y: np.ndarray) -> np.ndarray:
            out = np.empty((size, *y.shape))
            by_y(y, inputs(t), p, out)
            return out

        return solve_bvp(
            rates, lambda a, b: a - b, times, guess, tol=self.setting, fun_jac=jacobian,
            bc_jac=lambda *_: (np.eye(size), -np.eye(size)), max_nodes=MOST_NODES,
        )  # fmt: skip

    def __call__(self, p: np.ndarray) -> float:
        """Return the log-likelihood; NaN for failure."""
        found = self._solve(p, *self._guess)
        return self.case.log_likelihood_of(p, found.sol(self.case.times).T) if found.success else np.nan


@cache
def functions(model: Any) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return the rates of a model and their derivatives by y, on whole arrays."""
    first = FirstOrder(model, ())
    return first.function(NUMPY, first.rates), first.function(NUMPY, first.by_states(first.rates))


def missing(*packages: str) -> str:
    """Return a note on the first of the packages that is not installed, else an empty string."""
    lacking = [name for name in packages if importlib.util.find_spec(name) is None]
    return f'{lacking[0]} is not installed (pip install "bayesperiodic[benchmark]")' if lacking else ""


def add_peers(contest: Contest) -> None:
    """Add diffrax, and harmonic balance on the problem that its package can state."""
    if note := missing(*NEEDED):
        for name in DIFFRAX_ROWS:
            contest.add(name, note=note)
    else:
        _add_diffrax(contest)
    if contest.setting.name == DUFFING:
        if note := missing("harmonicbalance"):
            contest.add(BALANCE, note=note)
        else:
            contest.add_methods(BALANCE, *contest.reference.tuned(Balanced, HARMONICS), "harmonicbalance, harmonics")


def _add_diffrax(contest: Contest) -> None:
    methods, error = contest.reference.tuned(Integrated, RELATIVE, 1)
    contest.add_until_steady(DIFFRAX, methods, error, f"{METHOD}, rtol")
    contest.add_methods(DIFFRAX_SHOOTING, methods, error, f"{METHOD}, one chord step, rtol")
    run = partial(contest.value_and_gradient, 0, [method.value_and_gradient for method in methods])
    off = contest.gradient_error(run()[1]) if methods else None
    contest.add(DIFFRAX_GRADIENT, error, Action(run, 1, SLOW_REPEATS), "one chord step, by its adjoint", off)


@dataclass(frozen=True)
class Balanced(Peer):
    """Harmonic balance of one experiment of the Duffing oscillator, from the orbit at the estimate."""

    @cached_property
    def _force(self) -> Any:
        return self._series(self.case.experiment.inputs["force"])

    @cached_property
    def _start(self) -> Any:
        if not self.discretised.shoot(self.case.estimate, PREDICTED, LOOSE):
            raise RuntimeError("The orbit at the estimate was not found.")
        return self._series(self.discretised.states(self.case.times)[0])

    def _series(self, values: np.ndarray) -> Any:
        from harmonicbalance.fourier import Fourier

        amplitudes, count = np.fft.rfft(values) / len(values), self.setting
        cosines, sines = 2 * amplitudes.real[1 : count + 1], -2 * amplitudes.imag[1 : count + 1]
        return Fourier(amplitudes[0].real, cosines, sines, 2 * np.pi / self.case.period, count)

    def __call__(self, p: np.ndarray) -> float:
        """Return the log-likelihood; NaN where it does not converge."""
        from harmonicbalance.solvers import fouriersolve

        m, c, k, k3 = p[:4]
        sign = _sign_of_derivatives()

        def residual(x: Any) -> Any:
            speed = sign * x.dt()
            return m * (sign * speed.dt()) + c * speed + k * x + k3 * x**3 - self._force

        with contextlib.redirect_stdout(io.StringIO()):  # The solver prints its time.
            found, account = fouriersolve(residual, self._start)
        if not account.success:
            return np.nan
        samples = self.case.experiment.samples
        amplitudes = np.zeros(samples // 2 + 1, dtype=complex)
        amplitudes[0] = found.coeff_dc
        amplitudes[1 : self.setting + 1] = 0.5 * (found.coeffs_cos - 1j * found.coeffs_sin)
        return self.case.log_likelihood(np.fft.irfft(amplitudes * samples, samples)[:, None])


@cache
def _sign_of_derivatives() -> float:
    """Return the sign with which the package's derivative is that by time; in version 0.2.0 it is −1."""
    from harmonicbalance.fourier import Fourier

    return float(np.sign(Fourier(0.0, np.zeros(1), np.ones(1), 1.0, 1).dt().coeffs_cos[0]))


class Traced(NamedTuple):
    """Functions of one model for JAX."""

    flow: Callable[..., Any]  # (p, y, table, period, times, end, rtol, scale) -> states (times + end, size), compiled
    log_likelihood: Callable[..., Any]  # p and `Integrated.parts` to it without its constant, by one chord step
    value: Callable[..., Any]  # The same, compiled
    both: Callable[..., Any]  # With the gradient by p, compiled


@cache
def traced(model: Any) -> Traced:
    """Return the functions of a model."""
    import diffrax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    first, solver = FirstOrder(model, ()), getattr(diffrax, METHOD)()
    rates, outputs = first.function(JAX, first.rates), first.function(JAX, first.outputs)

    def slope(t: Any, y: Any, arguments: Any) -> Any:
        p, table, period = arguments
        at = (t / period - jnp.floor(t / period)) * TABLE
        k = jnp.floor(at).astype(int)
        s = at - k
        weights = jnp.stack([
            -s * (s - 1) * (s - 2) / 6, (s + 1) * (s - 1) * (s - 2) / 2, -(s + 1) * s * (s - 2) / 2,
            (s + 1) * s * (s - 1) / 6,
        ])  # fmt: skip
        return rates(y, weights @ table[(k + jnp.arange(-1, 3)) % TABLE], p)

    def flow(p: Any, y: Any, table: Any, period: Any, times: Any, end: Any, relative: Any, scale: Any) -> Any:
        return diffrax.diffeqsolve(
            diffrax.ODETerm(slope), solver, 0.0, end, period / 1000, y, (p, table, period),
            saveat=diffrax.SaveAt(ts=times, t1=True), max_steps=MOST_STEPS, throw=False,
            stepsize_controller=diffrax.PIDController(rtol=relative, atol=relative * scale),
        ).ys  # fmt: skip

    def log_likelihood(
        p: Any, orbit: Any, inverse: Any, slopes: Any, estimate: Any, columns: Any, table: Any, period: Any,
        samples: Any, relative: Any, scale: Any, signals: Any, data: Any, weights: Any,
    ) -> Any:  # fmt: skip
        y = orbit + slopes @ (p[columns] - estimate[columns])
        ends = flow(p, y, table, period, samples[:1], period, relative, scale)
        y = y + inverse @ (ends[-1] - y)
        states = flow(p, y, table, period, samples, period, relative, scale)[: samples.size]
        residuals = data - outputs(states.T, signals, p).T
        return -jnp.sum(weights * jnp.abs(jnp.fft.rfft(residuals, axis=0)) ** 2)

    return Traced(jax.jit(flow), log_likelihood, jax.jit(log_likelihood), jax.jit(jax.value_and_grad(log_likelihood)))


@dataclass(frozen=True)
class Integrated(Peer):
    """One experiment by diffrax with a relative tolerance, by chord steps from the predicted orbit."""

    @cached_property
    def parts(self) -> tuple[Any, ...]:
        """Arguments of the log-likelihood by shooting besides p."""
        anchor, case = self.discretised.anchor, self.case
        assert anchor is not None
        return _on_device(
            *anchor, case.estimate, np.array(self.discretised.columns), self.table, np.array(case.period), case.times,
            np.array(self.setting), case.scale, case.signals.T.copy(), case.data, case.spectral_weights,
        )  # fmt: skip

    def __call__(self, p: np.ndarray) -> float:
        """Return the log-likelihood by shooting."""
        return float(traced(self.case.model).value(p, *self.parts)) + self.case.constant

    def value_and_gradient(self, p: np.ndarray) -> tuple[float, np.ndarray]:
        """Return it with its gradient by θ."""
        value, by_p = traced(self.case.model).both(p, *self.parts)
        return float(value) + self.case.constant, np.asarray(by_p)[self.discretised.columns] @ self.case.slopes

    def prepared(self, p: np.ndarray, start: np.ndarray) -> Callable[[], Any]:
        """Return the integration through `TIMED_CYCLES` cycles, compiled."""
        case, flow = self.case, traced(self.case.model).flow
        times, end = (TIMED_CYCLES - 1) * case.period + case.times, TIMED_CYCLES * case.period
        arguments = _on_device(p, start, self.table, case.period, times, end, self.setting, case.scale)

        def run() -> None:
            flow(*arguments).block_until_ready()

        run()
        return run


def _on_device(*arrays: Any) -> tuple[Any, ...]:
    import jax

    jax.config.update("jax_enable_x64", True)
    return tuple(jax.device_put(array) for array in arrays)
