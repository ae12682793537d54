"""Newton's method converges to an unstable periodic solution; time integration from the same solution departs.

m x'' + c x' + k x + k3 x³ = F cos ωt has three periodic solutions at 0.22 Hz, of which the middle one is unstable.
"""

from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

import bayesperiodic as bp
from studies.animations import film

VALUES = {"m": 1.0, "c": 0.1, "k": 1.0, "k3": 0.5}
FREQUENCY, AMPLITUDE = 0.22, 0.4
SAMPLES = 128
TAU = 2 * np.pi * np.arange(SAMPLES) / SAMPLES
FORCE = {"force": AMPLITUDE * np.cos(TAU)}
# A guess larger than all three solutions, with waves.
GUESS = 1.8 * np.cos(TAU - 2.7) + 0.15 * np.cos(5 * TAU)
ACCURACY, MOST_ITERATIONS = 1e-10, 20
# Decimals of the start of the integration; samples per forcing period; its length.
DECIMALS, RATE, PERIODS = 3, 64, 24
# Distance from the orbit below which the linearised equations give the growth [m].
LINEAR = 0.1


class Iterates(NamedTuple):
    """Newton's method: every iterate is a whole period."""

    x: np.ndarray  # (iterations + 1, samples): Displacement [m]
    rate: np.ndarray  # The same shape: Velocity [m/s]
    residuals: np.ndarray  # (iterations + 1,): Largest residual of the equation of motion [N]


class Departure(NamedTuple):
    """Time integration from the unstable solution."""

    x: np.ndarray  # (PERIODS · RATE + 1,): Displacement [m]
    rate: np.ndarray  # The same shape: Velocity [m/s]
    distances: np.ndarray  # (PERIODS + 1,): From the orbit's state once a period; rates in units of ω
    growth: float  # Factor per period while the distance is small


def iterate() -> Iterates:
    """Return the iterates of the damped Newton method of `solve_periodic`, which returns only the last.

    Fourier collocation on the grid; the step is halved until the residual decreases.
    """
    omega = 2 * np.pi * FREQUENCY
    waves = np.fft.fftfreq(SAMPLES, 1.0 / SAMPLES)[:, None]
    spectrum = np.fft.fft(np.eye(SAMPLES), axis=0)
    first = omega * np.fft.ifft(1j * waves * (np.abs(waves) < SAMPLES / 2) * spectrum, axis=0).real
    second = omega**2 * np.fft.ifft(-(waves**2) * spectrum, axis=0).real
    linear = VALUES["m"] * second + VALUES["c"] * first + VALUES["k"] * np.eye(SAMPLES)

    def residual(x: np.ndarray) -> np.ndarray:
        return linear @ x + VALUES["k3"] * x**3 - FORCE["force"]

    iterates = [GUESS]
    residuals = [float(np.abs(residual(GUESS)).max())]
    while residuals[-1] > ACCURACY:
        if len(iterates) > MOST_ITERATIONS:
            raise RuntimeError("Newton's method did not converge from this guess.")
        x, damping = iterates[-1], 1.0
        step = -np.linalg.solve(linear + np.diag(3 * VALUES["k3"] * x**2), residual(x))
        while damping > 1e-3 and np.abs(residual(x + damping * step)).max() > (1 - 0.1 * damping) * residuals[-1]:
            damping /= 2
        iterates.append(x + damping * step)
        residuals.append(float(np.abs(residual(iterates[-1])).max()))
    every = np.array(iterates)
    return Iterates(every, every @ first.T, np.array(residuals))


def integrate(x: np.ndarray, rate: np.ndarray) -> Departure:
    """Return the time integration from a solution's first state, rounded to `DECIMALS`."""
    start = {"x": round(float(x[0]), DECIMALS), "dx": round(float(rate[0]), DECIMALS)}
    run = bp.simulate(
        bp.models.duffing, VALUES, FORCE, frequency=FREQUENCY, duration=PERIODS / FREQUENCY,
        sampling_rate=RATE * FREQUENCY, start=start,
    )  # fmt: skip
    displacement = run.outputs["displacement"]
    # Fourth-order differences are good to 1e-5 of the velocity at this rate; the first velocity is the start's.
    velocity = np.gradient(displacement, 1.0 / (RATE * FREQUENCY), edge_order=2)
    inner = (8 * (displacement[3:-1] - displacement[1:-3]) - (displacement[4:] - displacement[:-4])) / 12
    velocity[2:-2] = inner * RATE * FREQUENCY
    velocity[0] = start["dx"]
    omega = 2 * np.pi * FREQUENCY
    distances = np.hypot(displacement[::RATE] - x[0], (velocity[::RATE] - rate[0]) / omega)
    near = np.flatnonzero(distances < LINEAR)
    # The component along the stable direction decays in the first periods.
    used = near[2:]
    growth = float(np.exp(np.polyfit(used, np.log(distances[used]), 1)[0]))
    return Departure(displacement, velocity, distances, growth)


def stable_solutions() -> list[bp.PeriodicSolution]:
    """Return the two stable solutions at the same frequency."""
    found = []
    for guess in (-0.4 * np.cos(TAU), 1.7 * np.cos(TAU - 0.8)):
        found.append(
            bp.solve_periodic(
                bp.models.duffing, VALUES, FORCE, frequency=FREQUENCY, samples=SAMPLES, scheme="fourier",
                guess={"x": guess},
            )
        )  # fmt: skip
    return found


class Scene(NamedTuple):
    """What the animation shows."""

    iterates: Iterates
    departure: Departure
    stable: list[bp.PeriodicSolution]
    multiplier: float  # Largest modulus


# Frames: of a Newton iteration, of a period and at the end.
MOVING, WAITING, LAST = 6, 2, 15
STEPS_PER_PERIOD = 4


def frames(scene: Scene) -> tuple[int, int]:
    """Return the number of frames of Newton's method, and of all."""
    first = (len(scene.iterates.x) - 1) * (MOVING + WAITING) + 2 * WAITING
    return first, first + PERIODS * STEPS_PER_PERIOD + LAST


def film_of(scene: Scene, path: Path, *, quick: bool) -> None:
    """Write the animation: Newton's method first, then the integration from its result."""
    with plt.rc_context(film.STYLE):
        figure, ((left, right), (below_left, below_right)) = plt.subplots(
            2, 2, figsize=(10.0, 7.2), height_ratios=(2.2, 1.0), layout="constrained"
        )
        figure.suptitle("An unstable periodic motion of a Duffing oscillator (synthetic data)")
        pull = _Pull(left, below_left, scene)
        leave = _Leave(right, below_right, scene)
        first, count = frames(scene)

        def draw(number: int) -> None:
            pull.draw(min(number, first) / (MOVING + WAITING))
            leave.draw(np.clip((number - first) / STEPS_PER_PERIOD, 0.0, PERIODS), visible=number >= first)

        film.save(path, figure, draw, count, quick=quick)


def _closed(wave: np.ndarray) -> np.ndarray:
    return np.append(wave, wave[0])


class _Pull:
    """Newton's iterates in the state plane, and their residuals."""

    def __init__(self, plane: Axes, below: Axes, scene: Scene) -> None:
        self.x, self.rate, self.residuals = scene.iterates
        _orbit(plane, scene)
        plane.set_title("Newton's method converges to it", color=film.BLUE, weight="bold")
        (self.curve,) = plane.plot([], [], color=film.BLUE, lw=3.5)
        self.text = plane.text(-2.1, 3.6, "", va="top", color=film.BLUE)
        count = len(self.residuals)
        below.set(yscale="log", xlim=(-0.5, count - 0.5), ylim=(1e-13, 1e2), yticks=[1e-12, 1e-8, 1e-4, 1.0])
        below.set(xlabel="Newton iteration", ylabel="residual [N]")
        (self.points,) = below.plot([], [], "o-", color=film.BLUE, ms=9)

    def draw(self, progress: float) -> None:
        """Draw the iterate, and between two of them the change from one to the other."""
        number = min(int(progress), len(self.x) - 1)
        following = min(number + 1, len(self.x) - 1)
        share = film.smooth((progress - number) * (MOVING + WAITING) / MOVING - WAITING / MOVING)
        between = [wave[number] + share * (wave[following] - wave[number]) for wave in (self.x, self.rate)]
        self.curve.set_data(*map(_closed, between))
        reached = following if share > 0.99 else number
        self.text.set_text(f"iteration {reached}")
        self.points.set_data(np.arange(reached + 1), self.residuals[: reached + 1])


class _Leave:
    """The integrated motion in the state plane, and its distance from the orbit once a period."""

    def __init__(self, plane: Axes, below: Axes, scene: Scene) -> None:
        self.departure = scene.departure
        for solution in scene.stable:
            x = solution.states["x"]
            rate = np.gradient(np.append(x[-1:], _closed(x)), 1.0 / (FREQUENCY * SAMPLES))
            plane.plot(_closed(x), _closed(rate[1:-1]), color=film.GREY, lw=1.6)
        _orbit(plane, scene)
        plane.set_title("time integration leaves it", color=film.VERMILLION, weight="bold")
        (self.trail,) = plane.plot([], [], color=film.VERMILLION, lw=2.6)
        (self.dot,) = plane.plot([], [], "o", color=film.VERMILLION, ms=13, mec="white")
        for height, label in ((0.0, "stable"), (-2.1, "stable")):
            plane.text(0.0, height, label, ha="center", va="bottom" if height else "center", color="0.4", size=12)
        self.text = plane.text(-2.1, 3.6, "", va="top", color=film.VERMILLION)
        distances = scene.departure.distances
        near = np.flatnonzero(distances < LINEAR)
        line = distances[near[-1]] * scene.multiplier ** (np.arange(PERIODS + 1.0) - near[-1])
        below.plot(np.arange(PERIODS + 1), line, color="black", lw=1.6, ls="--")
        below.text(24.0, 4e-4, f"× {scene.multiplier:.2f} a period:\nFloquet multiplier", ha="right", va="center")
        below.set(yscale="log", xlim=(-0.5, PERIODS + 0.5), ylim=(5e-5, 1e1), yticks=[1e-4, 1e-2, 1.0])
        below.set(xlabel="time [forcing periods]", ylabel="distance [m]")
        (self.points,) = below.plot([], [], "o", color=film.VERMILLION, ms=9)

    def draw(self, period: float, *, visible: bool) -> None:
        """Draw the motion up to a time, with its last period."""
        for artist in (self.trail, self.dot, self.points, self.text):
            artist.set_visible(visible)
        stop = round(period * RATE)
        shown = slice(max(0, stop - RATE), stop + 1)
        self.trail.set_data(self.departure.x[shown], self.departure.rate[shown])
        self.dot.set_data(self.departure.x[stop : stop + 1], self.departure.rate[stop : stop + 1])
        count = int(period) + 1
        self.text.set_text(f"period {count - 1}")
        self.points.set_data(np.arange(count), self.departure.distances[:count])


def _orbit(plane: Axes, scene: Scene) -> None:
    """Draw the unstable solution in the state plane."""
    plane.plot(_closed(scene.iterates.x[-1]), _closed(scene.iterates.rate[-1]), color="black", ls=(0, (3, 2)), lw=1.8)
    plane.text(0.0, 1.62, "unstable", ha="center", va="top", size=12)
    plane.set(xlim=(-2.2, 2.2), ylim=(-3.6, 3.6), xlabel="displacement [m]", ylabel="velocity [m/s]")


def make(path: Path, *, quick: bool) -> dict[str, Any]:
    """Write the animation, and return the numbers behind it."""
    iterates = iterate()
    solution = bp.solve_periodic(
        bp.models.duffing, VALUES, FORCE, frequency=FREQUENCY, samples=SAMPLES, scheme="fourier", guess={"x": GUESS}
    )
    scene = Scene(
        iterates,
        integrate(iterates.x[-1], iterates.rate[-1]),
        stable_solutions(),
        float(np.abs(solution.multipliers).max()),
    )
    film_of(scene, path, quick=quick)
    return {
        "residuals_n": iterates.residuals.tolist(),
        "difference_from_solve_periodic_m": float(np.abs(iterates.x[-1] - solution.states["x"]).max()),
        "multiplier": scene.multiplier,
        "distances_m": scene.departure.distances.tolist(),
        "growth_per_period": scene.departure.growth,
        "frames": film.drawn(frames(scene)[1], quick=quick),
        "bytes": path.stat().st_size,
    }
