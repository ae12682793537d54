"""Multiple shooting on the same recording, for comparison: segments with free initial states, by SciPy."""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

import bayesperiodic as bp
from studies.harvester import beam

DEGREE, COUPLING = 7, 4
# Drive periods in a segment.
LENGTHS_OF_SEGMENTS = (1.0, 1.5, 2.0)
# Runge-Kutta steps a period, and how many of them lie between two compared instants.
STEPS, EVERY = 80, 2
# Displacements from which the initial state of a segment is sought, in units of the largest one.
STARTS = np.linspace(-1.0, 1.0, 25)
# Of these, so many with the smallest residuals are improved.
IMPROVED = 3
# Iterations for the initial states: first, and at every other value of the parameters; outer iterations.
FIRST, INNER, OUTER = 6, 2, 10
CHANGE = 1e-4  # of the squares or the parameters, at which the iteration ends
# Step lengths tried, and a ridge in units of the largest squared slope.
LENGTHS, RIDGE = (1.0, 0.3), 1e-12
# Order of the parameters in the sensitivities, after the three initial states.
NAMES = [name for name in beam.parameters(DEGREE, COUPLING) if name not in ("laser_gain", "offset")]


class Segments(NamedTuple):
    """Parts of a recording, one in each row."""

    step: float  # s
    drive: np.ndarray  # at half steps, (segments, 2·steps + 1)
    base: np.ndarray  # at the compared instants, (segments, instants), as velocity and voltage
    velocity: np.ndarray
    voltage: np.ndarray


class Shot(NamedTuple):
    """An estimate by multiple shooting."""

    theta: dict[str, float]
    covariance: np.ndarray  # of least squares, in the order of `theta`
    unexplained: dict[str, float]  # fractions of the variance
    segments: int
    evaluations: int


def segments_of(recordings: list[bp.Recording], periods: float, frequency: float) -> Segments:
    """Return consecutive segments of so many drive periods, of a drive of some frequency [Hz]."""
    steps = round(STEPS * periods)
    step = 1.0 / (frequency * STEPS)
    parts: list[list[np.ndarray]] = [[], [], [], []]
    for one in recordings:
        count = int((one.time[-1] - one.time[0]) / (steps * step))
        first = one.time[0] + steps * step * np.arange(count)
        half = first[:, None] + 0.5 * step * np.arange(2 * steps + 1)
        at = half[:, :: 2 * EVERY]
        parts[0].append(CubicSpline(one.time, one.inputs["drive"])(half))
        parts[1].append(CubicSpline(one.time, one.inputs["base"])(at))
        for part, name in zip(parts[2:], ("velocity", "voltage"), strict=True):
            part.append(CubicSpline(one.time, one.outputs[name])(at))
    return Segments(step, *(np.concatenate(part) for part in parts))


def _rates(p: dict[str, float], z: np.ndarray, drive: np.ndarray) -> np.ndarray:
    """Return the rates (segments, 3, 1 + columns) of the states, in the first column, and of their sensitivities."""
    x, y, v = z[:, 0, 0], z[:, 1, 0], z[:, 2, 0]
    powers = x[:, None] ** np.arange(max(DEGREE, COUPLING) + 1)
    force = np.array([0.0, *(p[f"f{k}"] for k in range(1, DEGREE + 1))])
    piezo = np.array([p[f"s{k}"] for k in range(COUPLING + 1)])
    element = powers[:, : COUPLING + 1] @ piezo
    slope = powers[:, :DEGREE] @ (force[1:] * np.arange(1, DEGREE + 1))
    bend = powers[:, :COUPLING] @ (piezo[1:] * np.arange(1, COUPLING + 1))
    result = np.empty_like(z)
    result[:, 0] = z[:, 1]
    result[:, 1, 0] = powers[:, : DEGREE + 1] @ force - (p["damping"] + p["cubic_damping"] * y * y) * y
    result[:, 1, 0] -= p["back"] * v + p["drive_gain"] * drive
    result[:, 2, 0] = -p["decay"] * v - element * y
    s = z[:, :, 1:]
    fading = p["damping"] + 3.0 * p["cubic_damping"] * y * y
    result[:, 1, 1:] = slope[:, None] * s[:, 0] - fading[:, None] * s[:, 1] - p["back"] * s[:, 2]
    result[:, 2, 1:] = -(bend * y)[:, None] * s[:, 0] - element[:, None] * s[:, 1] - p["decay"] * s[:, 2]
    if s.shape[2] > 3:
        k = 4 + DEGREE
        result[:, 1, 4:k] += powers[:, 1 : DEGREE + 1]
        result[:, 2, k : k + COUPLING + 1] -= powers[:, : COUPLING + 1] * y[:, None]
        k += COUPLING + 1
        result[:, 1, k : k + 4] -= np.stack([y, y**3, v, drive], axis=1)
        result[:, 2, k + 4] -= v
    return result


def run_of(p: dict[str, float], given: Segments, starts: np.ndarray, columns: int) -> np.ndarray:
    """Return states and sensitivities (segments, instants, 3, 1 + columns), by a Runge-Kutta method of order four."""
    z = np.zeros((len(starts), 3, 1 + columns))
    z[:, :, 0] = starts
    if columns:
        z[:, :, 1:4] = np.eye(3)
    path, h = [z], given.step
    for k in range(given.drive.shape[1] // 2):
        here, middle, there = given.drive[:, 2 * k : 2 * k + 3].T
        a = _rates(p, z, here)
        b = _rates(p, z + 0.5 * h * a, middle)
        c = _rates(p, z + 0.5 * h * b, middle)
        z = z + h / 6.0 * (a + 2.0 * (b + c) + _rates(p, z + h * c, there))
        if (k + 1) % EVERY == 0:
            path.append(z)
    return np.stack(path, axis=1)


def _step(slopes: np.ndarray, missed: np.ndarray) -> np.ndarray:
    """Return Gauss-Newton steps (segments, 3)."""
    size = np.sqrt(np.sum(slopes**2, axis=1)) + np.finfo(float).tiny
    scaled = slopes / size[:, None]
    normal = scaled.transpose(0, 2, 1) @ scaled + RIDGE * np.eye(3)
    return -np.linalg.solve(normal, scaled.transpose(0, 2, 1) @ missed[:, :, None])[:, :, 0] / size


class _Projected:
    """Residuals as a function of the parameters alone: initial states are eliminated (variable projection)."""

    def __init__(self, given: Segments, theta: dict[str, float], scale: np.ndarray, reach: float):
        self.given, self.names, self.scale = given, [*theta], scale
        self.sd = np.array([given.velocity.std(), given.voltage.std()])
        self.best, self.states, self.at = np.inf, np.empty(0), np.empty(0)
        trials = []
        for x in reach * STARTS:
            y = given.velocity[:, 0] - theta["laser_gain"] * given.base[:, 0]
            start = np.stack([np.full(y.size, x), y, given.voltage[:, 0] - theta["offset"]], axis=1)
            trials.append((start, self._squares(theta, start)))
        order = np.argsort([squares for _, squares in trials], axis=0)
        every, at = np.stack([start for start, _ in trials]), np.arange(order.shape[1])
        improved = [self._improved(theta, every[order[k], at], FIRST) for k in range(IMPROVED)]
        best = np.argmin([squares for _, squares in improved], axis=0)
        self.starts = np.stack([start for start, _ in improved])[best, at]

    def _residuals(self, p: dict[str, float], path: np.ndarray) -> np.ndarray:
        """Return the weighted residuals (segments, instants, 2)."""
        y = path[:, :, 1, 0] + p["laser_gain"] * self.given.base - self.given.velocity
        return np.stack([y, path[:, :, 2, 0] + p["offset"] - self.given.voltage], axis=2) / self.sd

    def _squares(self, p: dict[str, float], starts: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.sum(self._residuals(p, run_of(p, self.given, starts, 0)) ** 2, axis=(1, 2))
        return np.where(np.isfinite(squares), squares, np.inf)

    def values(self, q: np.ndarray) -> dict[str, float]:
        """Return the parameters."""
        return dict(zip(self.names, (self.scale * q).tolist(), strict=True))

    def _improved(self, p: dict[str, float], starts: np.ndarray, rounds: int) -> tuple[np.ndarray, np.ndarray]:
        """Return better initial states, by damped Gauss-Newton iterations, and the squares of each segment."""
        squares = self._squares(p, starts)
        for _ in range(rounds):
            with np.errstate(over="ignore", invalid="ignore"):
                path = run_of(p, self.given, starts, 3)
                slopes = (path[:, :, 1:, 1:] / self.sd[:, None]).reshape(len(starts), -1, 3)
                missed = self._residuals(p, path).reshape(len(starts), -1)
                step = _step(np.nan_to_num(slopes), np.nan_to_num(missed))
            before = starts
            for length in LENGTHS:
                trial = before + length * step
                there = self._squares(p, trial)
                better = there < squares
                starts, squares = np.where(better[:, None], trial, starts), np.where(better, there, squares)
        return starts, squares

    def residuals(self, q: np.ndarray) -> np.ndarray:
        """Return the residuals at the best initial states."""
        p = self.values(q)
        self.at, self.states = q.copy(), self._improved(p, self.starts, INNER)[0]
        residuals = self._residuals(p, run_of(p, self.given, self.states, 0)).ravel()
        if (total := float(residuals @ residuals)) < self.best:
            self.best, self.starts = total, self.states
        return residuals

    def slopes(self, q: np.ndarray) -> np.ndarray:
        """Return the derivatives of the residuals, orthogonal to those by the initial states (L. Kaufman, 1975)."""
        if not np.array_equal(q, self.at):
            self.residuals(q)
        path = run_of(self.values(q), self.given, self.states, 3 + len(NAMES))
        shape = (*path.shape[:2], 2)
        whole = np.zeros((*shape, len(self.names)))
        for k, name in enumerate(NAMES):
            whole[..., self.names.index(name)] = path[:, :, 1:, 4 + k]
        whole[:, :, 0, self.names.index("laser_gain")] = self.given.base
        whole[:, :, 1, self.names.index("offset")] = 1.0
        whole = (whole / self.sd[:, None] * self.scale).reshape(shape[0], -1, len(self.names))
        basis = np.linalg.qr((path[:, :, 1:, 1:4] / self.sd[:, None]).reshape(shape[0], -1, 3))[0]
        whole -= basis @ (basis.transpose(0, 2, 1) @ whole)
        return whole.reshape(-1, len(self.names))


def estimate(given: Segments, theta: dict[str, float], scale: dict[str, float], reach: float) -> Shot:
    """Return the estimate from all segments, from starting values; `reach` is the largest displacement."""
    steps = np.array([scale[name] for name in theta])
    problem = _Projected(given, theta, steps, reach)
    done = least_squares(
        problem.residuals,
        np.array([*theta.values()]) / steps,
        problem.slopes,
        x_scale="jac",
        max_nfev=OUTER,
        ftol=CHANGE,
        xtol=CHANGE,
    )
    residuals = problem.residuals(done.x).reshape(-1, 2)
    free = residuals.size - 3 * len(given.drive) - len(theta)
    slopes = problem.slopes(done.x)
    inverse = np.linalg.inv(slopes.T @ slopes) * float(np.sum(residuals**2)) / free
    left = dict(zip(("velocity", "voltage"), np.mean(residuals**2, axis=0).tolist(), strict=True))
    return Shot(problem.values(done.x), inverse * np.outer(steps, steps), left, len(given.drive), int(done.nfev))
