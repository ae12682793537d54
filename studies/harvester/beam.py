"""Equations of the beam, its experiments, and starting values by regression of the equations on waveforms."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

import bayesperiodic as bp

# Parameters of both equations but those of the polynomials, and their units; u is the unit of the laser's velocity.
OTHERS = {
    "damping": "1/s", "cubic_damping": "s/u²", "back": "u/(V s)", "drive_gain": "u s/m", "decay": "1/s",
    "laser_gain": "u s/m", "offset": "V",
}  # fmt: skip
UNITS = {"velocity": "u", "voltage": "V", "drive": "m/s²", "base": "m/s", "x": "u s", "v": "V"}
# Of the simulated recording.
SYNTHETIC = {
    "f1": 2224.0, "f2": -2690.0, "f3": -1.034e5, "f4": 3.21e4, "f5": 1.189e6, "f6": -1.03e5, "f7": -5.23e6,
    "s0": -0.633, "s1": 0.98, "s2": -11.8, "s3": -8.4, "s4": 96.3, "damping": 0.88, "cubic_damping": 0.012,
    "back": 91.4, "drive_gain": 14.55, "decay": 6.31, "laser_gain": 18.3, "offset": 0.0,
}  # fmt: skip
# Harmonics of the forcing in derivatives of waveforms, and phases a period.
HIGHEST, PHASES = 16, 64
# Grid points a period, relative spread of priors, and random starts of the regression.
SAMPLES, SPREAD, STARTS = 128, 0.5, 6
POSITIVE = ("damping", "cubic_damping", "back", "drive_gain", "decay", "laser_gain")
DIFFERENCE = 1.5e-8  # of derivatives by gain and delays
SMALLEST = 0.1  # of priors' standard deviations, as a fraction of the term's size


def polynomials(degree: int, coupling: int) -> tuple[list[str], list[str]]:
    """Return the names of the coefficients of restoring force and coupling."""
    return [f"f{k}" for k in range(1, degree + 1)], [f"s{k}" for k in range(coupling + 1)]


def units_of(degree: int, coupling: int) -> dict[str, str]:
    """Return the units of all parameters."""
    force = {f"f{k}": "1/s²" if k == 1 else f"1/(u^{k - 1} s^{k + 1})" for k in range(1, degree + 1)}
    return OTHERS | force | {f"s{k}": "V/(u s)" if k == 0 else f"V/(u^{k + 1} s^{k + 1})" for k in range(coupling + 1)}


def parameters(degree: int, coupling: int) -> list[str]:
    """Return the names of all parameters."""
    force, piezo = polynomials(degree, coupling)
    return [*force, *piezo, *OTHERS]


def model(degree: int, coupling: int) -> bp.Model:
    """Return a beam with polynomials of these degrees: x relative to the base, from the unstable equilibrium, and v.

    The laser sees the velocity of the base too; `drive_gain` contains the unit of the laser.
    """
    force, piezo = polynomials(degree, coupling)
    spring = " + ".join(f"{name}*x**{k}" for k, name in enumerate(force, start=1))
    element = " + ".join(f"{name}*x**{k}" if k else name for k, name in enumerate(piezo))
    return bp.Model(
        "harvester",
        states=["x", "v"],
        inputs=["drive", "base"],
        parameters=parameters(degree, coupling),
        equations=[
            f"ddx + damping*dx + cubic_damping*dx**3 - ({spring}) + back*v + drive_gain*drive",
            f"dv + decay*v + ({element})*dx",
        ],
        outputs={"velocity": "dx + laser_gain*base", "voltage": "v + offset"},
        units=UNITS,
    )


class Start(NamedTuple):
    """Starting values, and what they leave of the two equations, as fractions of rms acceleration and rate of v."""

    values: dict[str, float]
    velocity_delay: float  # s
    voltage_delay: float  # s
    left: tuple[float, float]
    reach: float  # largest displacement, in units of the laser times s


class _Waves(NamedTuple):
    """Fourier amplitudes (harmonics,) of the channels of an orbit, which has `samples` phases."""

    samples: int
    rates: np.ndarray  # factors of derivatives, i times the angular frequency [1/s]
    velocity: np.ndarray
    voltage: np.ndarray
    drive: np.ndarray
    base: np.ndarray  # velocity of the base, of mean zero

    def signals(self, gain: float, late: float, later: float) -> np.ndarray:
        """Return displacement, velocity, acceleration, voltage, its derivative, and the drive, (6, samples).

        Those of the beam relative to the base have mean zero, and the delays of velocity and voltage are removed.
        """
        velocity = self.velocity * np.exp(self.rates * late) - gain * self.base
        velocity[0] = 0.0
        displacement = velocity / np.where(self.rates == 0.0, 1.0, self.rates)
        voltage = self.voltage * np.exp(self.rates * later)
        amplitudes = [displacement, velocity, velocity * self.rates, voltage, voltage * self.rates, self.drive]
        return np.fft.irfft(amplitudes, self.samples)


def _waves(orbit: bp.Orbit) -> _Waves:
    run = orbit.experiment(samples=PHASES, whole=True, model_error=True)
    channels = [run.outputs["velocity"], run.outputs["voltage"], run.inputs["drive"]]
    rates = 2j * np.pi * orbit.frequency / orbit.period * np.arange(HIGHEST * orbit.period + 1)
    velocity, voltage, drive = np.fft.rfft(channels)[:, : rates.size]
    base = np.append(0.0, drive[1:] / rates[1:])
    return _Waves(channels[0].size, rates, velocity, voltage, drive, base)


def start_from(orbits: list[bp.Orbit], degree: int, coupling: int, *, delays: bool, seed: int) -> Start:
    """Return starting values by least squares of both equations on the waveforms.

    Both are linear in the parameters, but for the gain of the laser, the mean displacement of each orbit, which is not
    measured, and, with `delays`, those of velocity and voltage against the drive.
    """
    waves, generator = [_waves(orbit) for orbit in orbits], np.random.default_rng(seed)
    velocity, base = (
        float(np.std(np.concatenate([np.fft.irfft(one, w.samples) for w, one in zip(waves, some, strict=True)])))
        for some in ([w.velocity for w in waves], [w.base for w in waves])
    )
    size, gain = velocity / (2.0 * np.pi * orbits[0].frequency), velocity / base
    ends, scale = [], (size, gain)
    for attempt in range(STARTS):
        means = generator.normal(0.0, size, len(waves)) if attempt else np.zeros(len(waves))
        first = np.concatenate([means / size, [0.5], [0.0, 0.0] if delays else []])
        ends.append(least_squares(_residuals, first, _jacobian, args=(waves, degree, coupling, scale)))
    best = min(ends, key=lambda end: float(end.cost))
    return _as_start(best.x, waves, degree, coupling, scale)


def _residuals(z: np.ndarray, *problem: Any) -> np.ndarray:
    return np.concatenate(_equations(z, *problem)[2])


def _jacobian(z: np.ndarray, waves: list[_Waves], *others: Any) -> np.ndarray:
    """Return the derivatives of the residuals by z: by means in Kaufman's approximation, by others by differences.

    The approximation leaves out what is orthogonal to the residuals, so that the gradient is exact.
    """
    degree, coupling, scale = others
    left, acceleration, right, change, x = _terms(z, waves, *others)
    force, piezo, residuals, _ = _equations(z, waves, *others)
    spring = np.polynomial.Polynomial(force[: degree + 1]).deriv()(x)
    element = np.polynomial.Polynomial(piezo[2:]).deriv()(x) * right[:, 2]
    orbit = np.repeat(np.arange(len(waves)), [w.samples for w in waves])
    moved = scale[0] * (np.eye(len(waves)) - 1.0 / len(waves))[orbit]
    parts = []
    for terms, slope, target in ((left, spring, acceleration), (right, element, change)):
        q, _ = np.linalg.qr(terms)
        by_means = slope[:, None] * moved
        parts.append((q @ (q.T @ by_means) - by_means) / target.std())
    here, columns = np.concatenate(residuals), [np.concatenate(parts)]
    for k in range(len(waves), z.size):
        step = DIFFERENCE * max(1.0, abs(z[k])) * (np.arange(z.size) == k)
        columns.append((_residuals(z + step, waves, *others) - here)[:, None] / step[k])
    return np.hstack(columns)


def _equations(
    z: np.ndarray, waves: list[_Waves], degree: int, coupling: int, scale: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], np.ndarray]:
    """Return the coefficients of both equations, the relative residuals, and the displacements."""
    left, acceleration, right, change, x = _terms(z, waves, degree, coupling, scale)
    force, piezo = (np.linalg.lstsq(m, t, rcond=None)[0] for m, t in ((left, acceleration), (right, change)))
    residuals = [(t - m @ c) / t.std() for m, c, t in ((left, force, acceleration), (right, piezo, change))]
    return force, piezo, residuals, x


def _terms(
    z: np.ndarray, waves: list[_Waves], degree: int, coupling: int, scale: tuple[float, float]
) -> tuple[np.ndarray, ...]:
    """Return terms and left-hand side of the equation of x, of that of v, and the displacements."""
    count = len(waves)
    means, gain = scale[0] * (z[:count] - z[:count].mean()), scale[1] * z[count]
    late, later = 1e-3 * z[count + 1 :] if z.size > count + 1 else (0.0, 0.0)
    blocks = []
    for mean, w in zip(means, waves, strict=True):
        x, rate, acceleration, v, change, drive = w.signals(gain, late, later)
        x += mean
        powers = np.vander(x, max(degree, coupling) + 1, increasing=True)
        left = np.column_stack([powers[:, : degree + 1], rate, v, drive])
        right = np.column_stack([v, np.ones(v.size), rate[:, None] * powers[:, : coupling + 1]])
        blocks.append((left, acceleration, right, change, x))
    return tuple(np.concatenate(parts) for parts in zip(*blocks, strict=True))


def _as_start(z: np.ndarray, waves: list[_Waves], degree: int, coupling: int, scale: tuple[float, float]) -> Start:
    """Return the coefficients as parameters of the model, with x from the unstable equilibrium."""
    force, piezo, residuals, x = _equations(z, waves, degree, coupling, scale)
    spring, element = np.polynomial.Polynomial(force[: degree + 1]), np.polynomial.Polynomial(-piezo[2:])
    roots = [r.real for r in spring.roots() if abs(r.imag) < 1e-9 and spring.deriv()(r.real) > 0.0]
    shift = np.polynomial.Polynomial([min(roots, key=abs, default=0.0), 1.0])
    spring, element = spring(shift), element(shift)
    names, couplings = polynomials(degree, coupling)
    values = dict(zip(names, spring.coef[1:].tolist(), strict=True))
    values |= dict(zip(couplings, element.coef.tolist(), strict=True))
    values |= {
        "damping": max(-force[degree + 1], 0.5), "cubic_damping": 0.003, "back": -force[degree + 2],
        "drive_gain": -force[degree + 3], "decay": -piezo[0], "laser_gain": scale[1] * z[len(waves)], "offset": 0.0,
    }  # fmt: skip
    late = 1e-3 * z[len(waves) + 1 :] if z.size > len(waves) + 1 else (0.0, 0.0)
    rms = tuple(float(np.std(r)) for r in residuals)
    return Start(values, float(late[0]), float(late[1]), (rms[0], rms[1]), float(np.abs(x).max()))


def priors_about(start: Start) -> dict[str, Any]:
    """Return priors about starting values: a factor of 1.6 for positive ones, half the size for others."""
    priors: dict[str, Any] = {}
    for name, value in start.values.items():
        if name == "cubic_damping":
            priors[name] = bp.LogNormal(value, 2.0 * SPREAD)
        elif name in POSITIVE:
            priors[name] = bp.LogNormal(abs(value), SPREAD)
        elif name == "offset":
            priors[name] = bp.Normal(0.0, 0.01)
        else:
            power = int(name[1:])
            first = start.values["f1"] * start.reach if name[0] == "f" else start.values["s0"]
            priors[name] = bp.Normal(value, max(SPREAD * abs(value), SMALLEST * abs(first) / start.reach**power))
    return priors


def error_of(orbit: bp.Orbit) -> float:
    """Return the largest standard error of a channel, rms over the period, as a fraction of its standard deviation."""
    assert orbit.waveform is not None
    values, sd = orbit.waveform.values, orbit.waveform.sd
    return max(float(np.sqrt(np.mean(sd[n] ** 2)) / np.std(values[n])) for n in orbit.waveform.outputs)


def experiment(orbit: bp.Orbit) -> bp.Experiment:
    """Return the orbit as an experiment, by the Fourier components of its waveform."""
    return orbit.experiment(samples=SAMPLES, whole=True, model_error=True)


def shifted(run: bp.Experiment, velocity: float, voltage: float) -> bp.Experiment:
    """Return the experiment of an orbit with the delays [s] of velocity and voltage against the drive removed."""
    rate = 2j * np.pi * run.frequency / run.periods
    outputs = {}
    for name, late in (("velocity", velocity), ("voltage", voltage)):
        amplitudes = np.fft.rfft(run.outputs[name])
        outputs[name] = np.fft.irfft(amplitudes * np.exp(rate * np.arange(amplitudes.size) * late), run.time.size)
    return replace(run, outputs=outputs)
