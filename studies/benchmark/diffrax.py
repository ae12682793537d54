"""diffrax on JAX for one experiment: compiled, in double precision, with gradients by its own adjoint."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np

from studies.benchmark.equations import JAX, FirstOrder
from studies.benchmark.integration import Discretised
from studies.benchmark.problems import Case

NEEDED = ("diffrax", "jax")
# Its explicit method; the implicit Kvaerno5 takes several times as long on every problem here, the stiff one too.
METHOD = "Tsit5"
RELATIVE = tuple(10.0**-k for k in range(4, 12))
TABLE = 16_384
TIMED_CYCLES = 2
MOST_STEPS = 100_000
CHORDS = 1


def missing() -> str:
    """Return what to say where it is not installed, nothing where it is."""
    lacking = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    return f'{lacking[0]} is not installed (pip install "bayesperiodic[benchmark]")' if lacking else ""


@dataclass(frozen=True)
class Traced:
    """One model's integration as JAX sees it.

    Attributes
    ----------
    model : Model
    """

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
    """One experiment by diffrax with a relative tolerance, by chord steps from the predicted orbit.

    Attributes
    ----------
    discretised : Discretised
        Where starts and the matrix of the chord steps come from.
    relative : float
    """

    discretised: Discretised
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
        """What the log-likelihood by shooting takes besides p."""
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
    """Return diffrax with the loosest tolerance that is right enough at the draws; None if there is none."""
    for relative in RELATIVE:
        found = Integrated(one, relative)
        if np.max([abs(found(p) - e) for p, e in zip(parameters, exact, strict=True)]) <= allowed:
            return found
    return None
