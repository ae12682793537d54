"""A chaotic section of the driven pendulum, an unstable orbit of period 3 found in it, and the points passing by it."""

from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch
from matplotlib.patheffects import withStroke

import bayesperiodic as bp
from studies.animations import film
from studies.pendulum import recording as pendulum_recording

RECORDED, QUICK_RECORDED = 20_000, 6_000
PERIOD = 3
# Points within this distance of the orbit's first point pass by it [rad, 5 rad/s]; they are followed for this long.
NEAR, RATE_SCALE = 0.05, 5.0
FOLLOWED = 2 * PERIOD


class Scene(NamedTuple):
    """What the animation shows."""

    points: np.ndarray  # (count, 2): The section
    orbit: np.ndarray  # (PERIOD, 2): The orbit's points
    passing: np.ndarray  # (FOLLOWED + 1, passages, 2): The points that begin near the orbit, return by return
    multiplier: float  # Of the model's orbit, the largest
    spread: np.ndarray  # (FOLLOWED + 1,): Median distance from the orbit


def find(recorded: int, seed: int) -> Scene:
    """Return the section of a simulated recording, and the least unstable of the orbits found in it.

    Of the mirror images it is the one with positive winding number; its first point is that of the least angle.
    """
    section = pendulum_recording.section_of(pendulum_recording.simulate(recorded, seed))
    turning = [orbit for orbit in bp.find_orbits(section, periods=[PERIOD]) if (orbit.winding or 0) > 0]
    least = min(turning, key=lambda orbit: abs(orbit.eigenvalues[0]))
    [orbit] = bp.polish_orbits(bp.models.pendulum, [least], pendulum_recording.TRUTH, samples=200)
    assert orbit.solution is not None
    orbit_points = np.roll(orbit.points, -int(np.argmin(orbit.points[:, 0])), axis=0)
    away = _distances(section.points, orbit_points[0])
    begins = np.flatnonzero(away[:-FOLLOWED] < NEAR)
    passing = np.stack([section.points[begins + shift] for shift in range(FOLLOWED + 1)])
    spread = np.array([np.median(_distances(one, orbit_points[i % PERIOD])) for i, one in enumerate(passing)])
    return Scene(section.points, orbit_points, passing, float(np.abs(orbit.solution.multipliers).max()), spread)


def _distances(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    angle = (points[:, 0] - centre[0] + np.pi) % (2 * np.pi) - np.pi
    return np.hypot(angle, (points[:, 1] - centre[1]) / RATE_SCALE)


# Frames: of the section, of the orbit, of a return and at the end.
FILLING, APPEARING, HOPPING, LAST = 50, 12, 9, 10
FRAMES = FILLING + APPEARING + (FOLLOWED + 1) * HOPPING + LAST


def film_of(scene: Scene, path: Path, *, quick: bool) -> None:
    """Write the animation: the section fills, the orbit appears, and the passing points hop along it and depart."""
    with plt.rc_context(film.STYLE):
        figure, axes = plt.subplots(figsize=(9.0, 7.2), layout="constrained")
        figure.suptitle("A chaotic pendulum, seen once a drive period (synthetic data)")
        axes.set(xlim=(-np.pi, np.pi), ylim=(-17.5, 18.5), xlabel="angle [rad]", ylabel="rate [rad/s]")
        axes.set_xticks([-np.pi, 0.0, np.pi], ["−π", "0", "π"])
        title = axes.set_title(" ")
        (dust,) = axes.plot([], [], ".", ms=3.2, mew=0.0, color=film.SKY)
        (before,) = axes.plot([], [], "o", ms=5, mew=0.0, color=film.ORANGE, zorder=4)
        (cloud,) = axes.plot([], [], "o", mec="white", mew=0.6, color=film.VERMILLION, zorder=5)
        marks = _orbit(axes, scene.orbit)

        def draw(number: int) -> None:
            count = round(len(scene.points) * min((number + 1) / FILLING, 1.0) ** 2.5)
            dust.set_data(*scene.points[:count].T)
            hop = (number - FILLING - APPEARING) / HOPPING
            for mark in marks:
                mark.set_visible(number >= FILLING)
            for artist in (cloud, before):
                artist.set_visible(hop >= 0.0)
            if hop >= 0.0:
                step = min(int(hop), FOLLOWED)
                cloud.set_data(*scene.passing[step].T)
                before.set_data(*scene.passing[:step].reshape(-1, 2).T)
                # A flash at each return.
                cloud.set_markersize(8.0 + 10.0 * max(0.0, 1.0 - 2.0 * (hop - step)))
                title.set_text(f"Points near 1 follow the orbit, then leave it: after {step} period{'s' * (step != 1)}")
                title.set_color(film.VERMILLION)
            elif number >= FILLING:
                title.set_text(f"An unstable orbit of period {PERIOD}, found in these points")
                title.set_color("black")
            else:
                title.set_text(f"The section fills: {count:,} points")
                title.set_color(film.BLUE)

        film.save(path, figure, draw, FRAMES, quick=quick)


def _orbit(axes: Axes, points: np.ndarray) -> list[Artist]:
    """Draw the orbit's points, numbered outside, and arrows from each to the next."""
    marks: list[Artist] = list(axes.plot(*points.T, "o", ms=19, mfc="none", mec="black", mew=2.5, zorder=6))
    away = (points - points.mean(axis=0)) / np.array([1.0, RATE_SCALE])
    for number, (start, end) in enumerate(zip(points, np.roll(points, -1, axis=0), strict=True)):
        arrow = FancyArrowPatch(
            tuple(start), tuple(end), connectionstyle="arc3,rad=-0.35", arrowstyle="-|>", mutation_scale=20,
            shrinkA=11, shrinkB=11, lw=2.0, color="black", zorder=3,
        )  # fmt: skip
        marks.append(axes.add_patch(arrow))
        offset = 24.0 * away[number] / np.hypot(*away[number])
        name = axes.annotate(
            f"{number + 1}", tuple(start), tuple(offset), textcoords="offset points", ha="center", va="center",
            weight="bold", size=18, zorder=7, path_effects=[withStroke(linewidth=4.0, foreground="white")],
        )  # fmt: skip
        marks.append(name)
    return marks


def make(path: Path, seed: int, *, quick: bool) -> dict[str, Any]:
    """Write the animation, and return the numbers behind it."""
    scene = find(QUICK_RECORDED if quick else RECORDED, seed)
    film_of(scene, path, quick=quick)
    return {
        "points": len(scene.points),
        "period": PERIOD,
        "orbit": scene.orbit.tolist(),
        "multiplier": scene.multiplier,
        "passages": scene.passing.shape[1],
        "spread": scene.spread.tolist(),
        "frames": film.drawn(FRAMES, quick=quick),
        "bytes": path.stat().st_size,
    }
