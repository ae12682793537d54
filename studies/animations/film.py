"""Animated GIF files: the colours, and writing completely or not at all."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.artist import Artist
from matplotlib.figure import Figure

from studies import common

# Of Okabe and Ito.
BLUE, VERMILLION, SKY, ORANGE = "#0072B2", "#D55E00", "#56B4E9", "#E69F00"
GREY = "#999999"
# A whole number of hundredths of a second per frame, the unit of the format.
FRAMES_PER_SECOND = 10
QUICK = 8
DOTS_PER_INCH = 80
# A readable size where the picture is shown at half of its size.
STYLE: Any = {
    "font.size": 14.0, "axes.titlesize": 15.0, "figure.titlesize": 17.0, "lines.linewidth": 2.2,
    "axes.spines.top": False, "axes.spines.right": False,
}  # fmt: skip


def drawn(count: int, *, quick: bool) -> int:
    """Return how many of an animation's frames are drawn: all, or every `QUICK`-th."""
    return -(-count // QUICK) if quick else count


def save(path: Path, figure: Figure, draw: Callable[[int], None], count: int, *, quick: bool) -> None:
    """Write the figure as an animation, and close it; `draw` changes the figure to a frame, by its number."""
    path.parent.mkdir(parents=True, exist_ok=True)

    def update(number: int) -> list[Artist]:
        draw(QUICK * number if quick else number)
        return []

    # The layout of the first frame stays.
    figure.canvas.draw()
    figure.set_layout_engine("none")
    animation = FuncAnimation(figure, update, frames=drawn(count, quick=quick), init_func=list)
    with common.written_whole(path) as draft:
        animation.save(draft, PillowWriter(fps=FRAMES_PER_SECOND), dpi=DOTS_PER_INCH)
    plt.close(figure)


def smooth(fraction: float) -> float:
    """Return a fraction of a movement that starts and stops smoothly."""
    return float(0.5 - 0.5 * np.cos(np.pi * np.clip(fraction, 0.0, 1.0)))
