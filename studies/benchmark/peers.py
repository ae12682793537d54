"""Methods of other packages: diffrax on JAX, and harmonic balance by `harmonicbalance`.

diffrax runs compiled, in double precision, with gradients by its own adjoint. The Fourier series of `harmonicbalance`
have one unknown, so it is applied to the Duffing oscillator only. A package that is not installed gives a row without
times.
"""

import contextlib
import importlib.util
import io
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numpy as np

from studies.benchmark.contenders import SLOW_DRAWS, SLOW_REPEATS, Compiled, Contest, integrate, seconds_until_steady
from studies.benchmark.equations import JAX, FirstOrder
from studies.benchmark.integration import EQUILIBRIUM, ESTIMATE, LOOSE, PREDICTED, STEADY, Discretised, loosest
from studies.benchmark.problems import DUFFING, Case
from studies.timing import Action

HARMONICS = (1, 3, 5, 7, 9, 11, 15, 21, 31)


def balance_missing() -> str:
    """Return a note if the package is not installed, else an empty string."""
    lacking = importlib.util.find_spec("harmonicbalance") is None
    return 'harmonicbalance is not installed (pip install "bayesperiodic[benchmark]")' if lacking else ""


@dataclass(frozen=True)
class Balanced:
    """One experiment of the Duffing oscillator by so many harmonics, from the orbit at the estimate."""

    discretised: Discretised  # Where the orbit comes from
    harmonics: int

    @property
    def _case(self) -> Case:
        return self.discretised.case

    @cached_property
    def _force(self) -> Any:
        return self._series(self._case.experiment.inputs["force"])

    @cached_property
    def _start(self) -> Any:
        samples = self._case.experiment.samples
        if not self.discretised.shoot(self._case.estimate, PREDICTED, LOOSE):
            raise RuntimeError("The orbit at the estimate was not found.")
        return self._series(self.discretised.states(np.arange(samples) * self._case.period / samples)[0])

    def _series(self, values: np.ndarray) -> Any:
        """Return the Fourier series of samples over a period."""
        from harmonicbalance.fourier import Fourier

        amplitudes, count = np.fft.rfft(values) / len(values), self.harmonics
        cosines, sines = 2 * amplitudes.real[1 : count + 1], -2 * amplitudes.imag[1 : count + 1]
        return Fourier(amplitudes[0].real, cosines, sines, 2 * np.pi / self._case.period, count)

    def __call__(self, p: np.ndarray) -> float:
        """Return the log-likelihood; NaN where it does not converge."""
        from harmonicbalance.solvers import fouriersolve

        m, c, k, k3 = p[:4]
        sign = _sign_of_derivatives()

        def residual(x: Any) -> Any:
            speed = sign * x.dt()
            return m * (sign * speed.dt()) + c * speed + k * x + k3 * x**3 - self._force

        with contextlib.redirect_stdout(io.StringIO()):  # It prints its time.
            found, account = fouriersolve(residual, self._start)
        if not account.success:
            return np.nan
        case, samples = self._case, self._case.experiment.samples
        amplitudes = np.zeros(samples // 2 + 1, dtype=complex)
        amplitudes[0] = found.coeff_dc
        amplitudes[1 : self.harmonics + 1] = 0.5 * (found.coeffs_cos - 1j * found.coeffs_sin)
        return case.log_likelihood(np.fft.irfft(amplitudes * samples, samples)[:, None])


@cache
def _sign_of_derivatives() -> float:
    """Return the sign with which the package's derivative is that by time; in version 0.2.0 it is −1."""
    from harmonicbalance.fourier import Fourier

    return float(np.sign(Fourier(0.0, np.zeros(1), np.ones(1), 1.0, 1).dt().coeffs_cos[0]))


def tune_balanced(one: Discretised, parameters: np.ndarray, exact: np.ndarray, allowed: float) -> Balanced | None:
    """Return the fewest harmonics that are accurate enough at the draws; None if there are none."""
    return loosest(partial(Balanced, one), HARMONICS, parameters, exact, allowed)


NEEDED = ("diffrax", "jax")
# Its explicit method; the implicit Kvaerno5 takes several times as long on every problem here, the stiff one too.
METHOD = "Tsit5"
RELATIVE = tuple(10.0**-k for k in range(4, 12))
TABLE = 16_384
TIMED_CYCLES = 2
MOST_STEPS = 100_000
CHORDS = 1


def diffrax_missing() -> str:
    """Return a note if the package is not installed, else an empty string."""
    lacking = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    return f'{lacking[0]} is not installed (pip install "bayesperiodic[benchmark]")' if lacking else ""


@dataclass(frozen=True)
class Traced:
    """One model's integration for JAX."""

    model: Any

    @cached_property
    def flow(self) -> Callable[..., Any]:
        """(p, y, table, period, start, times, rtol, scale) -> states (times, size), from the first time on."""
        import diffrax
        import jax
        import jax.numpy as jnp

        jax.config.update("jax_enable_x64", True)
        rates = FirstOrder(self.model, ()).function(JAX, FirstOrder(self.model, ()).rates)
        solver = getattr(diffrax, METHOD)()

        def slope(t: Any, y: Any, arguments: Any) -> Any:
            p, table, period = arguments
            at = (t / period - jnp.floor(t / period)) * TABLE
            k = jnp.floor(at).astype(int)
            s = at - k
            weights = jnp.stack(
                [
                    -s * (s - 1) * (s - 2) / 6, (s + 1) * (s - 1) * (s - 2) / 2, -(s + 1) * s * (s - 2) / 2,
                    (s + 1) * s * (s - 1) / 6,
                ]
            )  # fmt: skip
            return rates(y, weights @ table[(k + jnp.arange(-1, 3)) % TABLE], p)

        def flow(p: Any, y: Any, table: Any, period: Any, times: Any, end: Any, relative: Any, scale: Any) -> Any:
            solved = diffrax.diffeqsolve(
                diffrax.ODETerm(slope), solver, 0.0, end, period / 1000, y, (p, table, period),
                saveat=diffrax.SaveAt(ts=times, t1=True), max_steps=MOST_STEPS, throw=False,
                stepsize_controller=diffrax.PIDController(rtol=relative, atol=relative * scale),
            )  # fmt: skip
            return solved.ys

        return flow

    @cached_property
    def compiled(self) -> Callable[..., Any]:
        """The flow alone."""
        import jax

        return jax.jit(self.flow)

    @cached_property
    def outputs(self) -> Callable[..., Any]:
        """(y, u, p) -> outputs (samples, channels), from columns."""
        return FirstOrder(self.model, ()).function(JAX, FirstOrder(self.model, ()).outputs)


@cache
def traced(model: Any) -> Traced:
    """Return one model's integration."""
    return Traced(model)


@dataclass(frozen=True)
class Integrated:
    """One experiment by diffrax with a relative tolerance, by chord steps from the predicted orbit."""

    discretised: Discretised  # Where starts and the matrix of the chord steps come from
    relative: float

    @property
    def _case(self) -> Case:
        return self.discretised.case

    @cached_property
    def _table(self) -> np.ndarray:
        return self._case.table(TABLE)

    @cached_property
    def _samples(self) -> np.ndarray:
        count = self._case.experiment.samples
        return np.arange(count) * (self._case.period / count)

    @cached_property
    def parts(self) -> tuple[Any, ...]:
        """Arguments of the log-likelihood by shooting besides p."""
        anchor, case = self.discretised.anchor, self._case
        assert anchor is not None
        data = np.stack([case.experiment.outputs[channel] for channel in case.model.outputs], axis=-1)
        return _on_device(
            *anchor, case.estimate, np.array(self.discretised.columns), self._table, np.array(case.period),
            self._samples, np.array(self.relative), case.scale, case.signals.T.copy(), data, case.spectral_weights,
        )  # fmt: skip

    def __call__(self, p: np.ndarray) -> float:
        """Return the log-likelihood by shooting."""
        return float(_value(self._case.model)(p, *self.parts)) + self._case.constant

    def value_and_gradient(self, p: np.ndarray) -> tuple[float, np.ndarray]:
        """Return it with its gradient by θ."""
        value, by_p = _both(self._case.model)(p, *self.parts)
        return float(value) + self._case.constant, np.asarray(by_p)[self.discretised.columns] @ self._case.slopes

    def seconds(self, p: np.ndarray, start: str, count: float) -> float:
        """Return the seconds until steady: those of a few cycles, times as many as it takes."""
        case, y = self._case, self.discretised.start(p, start)
        end, run = TIMED_CYCLES * case.period, traced(case.model).compiled
        times = (TIMED_CYCLES - 1) * case.period + self._samples
        arguments = _on_device(p, y, self._table, case.period, times, end, self.relative, case.scale)
        run(*arguments).block_until_ready()
        before = time.perf_counter()
        run(*arguments).block_until_ready()
        return (time.perf_counter() - before) * max(count, 1.0) / TIMED_CYCLES


def _on_device(*arrays: Any) -> tuple[Any, ...]:
    import jax

    jax.config.update("jax_enable_x64", True)
    return tuple(jax.device_put(array) for array in arrays)


def log_likelihood(model: Any) -> Callable[..., Any]:
    """Return a function that JAX traces: p and `Integrated.parts` to the log-likelihood without its constant."""
    import jax.numpy as jnp

    flow, outputs = traced(model).flow, traced(model).outputs

    def value(
        p: Any, orbit: Any, inverse: Any, slopes: Any, estimate: Any, columns: Any, table: Any, period: Any,
        samples: Any, relative: Any, scale: Any, signals: Any, data: Any, weights: Any,
    ) -> Any:  # fmt: skip
        y = orbit + slopes @ (p[columns] - estimate[columns])
        for _ in range(CHORDS):
            ends = flow(p, y, table, period, samples[:1], period, relative, scale)
            y = y + inverse @ (ends[-1] - y)
        states = flow(p, y, table, period, samples, period, relative, scale)[: samples.size]
        residuals = data - outputs(states.T, signals, p).T
        return -jnp.sum(weights * jnp.abs(jnp.fft.rfft(residuals, axis=0)) ** 2)

    return value


@cache
def _value(model: Any) -> Callable[..., Any]:
    import jax

    return jax.jit(log_likelihood(model))


@cache
def _both(model: Any) -> Callable[..., Any]:
    import jax

    return jax.jit(jax.value_and_grad(log_likelihood(model)))


def tune_diffrax(one: Discretised, parameters: np.ndarray, exact: np.ndarray, allowed: float) -> Integrated | None:
    """Return diffrax with the loosest tolerance that is accurate enough at the draws; None if there is none."""
    return loosest(partial(Integrated, one), RELATIVE, parameters, exact, allowed)


DIFFRAX = "diffrax"
DIFFRAX_ROWS = tuple(
    f"{DIFFRAX} {what}"
    for what in (EQUILIBRIUM, ESTIMATE, "shooting from the predicted orbit", "shooting, value and gradient")
)
BALANCE = "harmonic balance from the estimate's orbit"


def add_peers(contest: Contest, compiled: Compiled) -> None:
    """Add diffrax, and harmonic balance on the problem that its package can state."""
    if diffrax_missing():
        for name in DIFFRAX_ROWS:
            contest.refuse(name, diffrax_missing())
    else:
        _add_diffrax(contest, compiled)
    if contest.setting.name == DUFFING:
        _add_balance(contest, compiled)


def _discretised(compiled: Compiled) -> list[Any]:
    return [method.discretised for method in next(iter(compiled.values()))]


def _add_diffrax(contest: Contest, compiled: Compiled) -> None:
    reference, every = contest.reference, _discretised(compiled)
    tuned = reference.tuned(lambda k, *rest: tune_diffrax(every[k], *rest), 1)
    if tuned is None:
        for name in DIFFRAX_ROWS:
            contest.refuse(name, "not accurate enough at any tolerance")
        return
    ready, error = tuned
    tolerances = [one.relative for one in ready]
    note = f"{METHOD}, rtol {min(tolerances):.0e} … {max(tolerances):.0e}"
    for name, start in zip(DIFFRAX_ROWS[:2], (EQUILIBRIUM, ESTIMATE), strict=True):
        if (STEADY, start) not in compiled:
            contest.refuse(name, "not steady within 5000 cycles")
            continue
        seconds = partial(seconds_until_steady, contest, ready, start, [m.sweeps for m in compiled[STEADY, start]])
        contest.add(name, error, Action(seconds, 1, 1), f"{note}; 2 cycles timed, scaled to the number needed")
    action = Action(partial(integrate, contest, ready, SLOW_DRAWS), SLOW_DRAWS, SLOW_REPEATS)
    contest.add(DIFFRAX_ROWS[2], error, action, f"{note}, one chord step")
    by_theta = np.sum([one.value_and_gradient(p[0])[1] for one, p in zip(ready, reference.parameters, strict=True)], 0)
    off = contest.gradient_error(by_theta + contest.setting.problem.joint_prior.gradient(contest.setting.theta[0]))
    both = Action(partial(_gradients, contest, ready), 1, SLOW_REPEATS)
    contest.add(DIFFRAX_ROWS[3], error, both, f"{note}, one chord step, by its adjoint", off)


def _gradients(contest: Contest, ready: Sequence[Integrated]) -> None:
    for one, p in zip(ready, contest.reference.parameters, strict=True):
        one.value_and_gradient(p[0])


def _add_balance(contest: Contest, compiled: Compiled) -> None:
    if balance_missing():
        contest.refuse(BALANCE, balance_missing())
        return
    every = _discretised(compiled)
    tuned = contest.reference.tuned(lambda k, *rest: tune_balanced(every[k], *rest))
    if tuned is None:
        contest.refuse(BALANCE, "not accurate enough with any number of harmonics, or not converged")
        return
    ready, error = tuned
    note = f"harmonicbalance, {min(o.harmonics for o in ready)} … {max(o.harmonics for o in ready)} harmonics"
    action = Action(partial(integrate, contest, ready, SLOW_DRAWS), SLOW_DRAWS, SLOW_REPEATS)
    contest.add(BALANCE, error, action, note)
