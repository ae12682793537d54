"""A harmonic-balance package from PyPI, `harmonicbalance`, on the Duffing oscillator.

Its series are of one unknown, so that of the benchmark's problems it is written for this one.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np

from studies.benchmark.integration import LOOSE, PREDICTED, Discretised
from studies.benchmark.problems import Case

HARMONICS = (1, 3, 5, 7, 9, 11, 15, 21, 31)


def missing() -> str:
    """Return what to say where it is not installed, nothing where it is."""
    lacking = importlib.util.find_spec("harmonicbalance") is None
    return 'harmonicbalance is not installed (pip install "bayesperiodic[benchmark]")' if lacking else ""


@dataclass(frozen=True)
class Balanced:
    """One experiment of the Duffing oscillator by so many harmonics, from the orbit at the estimate.

    Attributes
    ----------
    discretised : Discretised
        Where the orbit comes from.
    harmonics : int
    """

    discretised: Discretised
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
            raise RuntimeError("The orbit at the estimate is not to be had.")
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
    """Return the fewest harmonics that are right enough at the draws; None if there are none."""
    for harmonics in HARMONICS:
        found = Balanced(one, harmonics)
        if np.max([abs(found(p) - e) for p, e in zip(parameters, exact, strict=True)]) <= allowed:
            return found
    return None
