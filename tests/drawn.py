"""Draws for figures, and the texts of a figure where the renderer puts them."""

from itertools import combinations
from unittest import mock

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.text import Text

import bayesperiodic as bp

# Boxes of texts contain a little empty room, in pixels.
ROOM = 2.0


def posterior_of(draws, supports=None, modes=None, units=None, walkers=10):
    """Return a posterior with the given draws of each quantity, in two chains, and supports of priors."""
    group = {}
    for name, values in draws.items():
        attributes = {"units": (units or {}).get(name, "m")}
        if supports is not None:
            attributes[f"support of {name}"] = list(supports[name])
        group[name] = (("chain", "draw"), np.reshape(values, (2, -1)), attributes)
    index = np.arange(np.size(values) // 2)
    coords = {"step": ("draw", index // walkers), "walker": ("draw", index % walkers)}
    stats = {} if modes is None else {"mode": (("chain", "draw"), np.reshape(modes, (2, -1)))}
    tree = xr.DataTree.from_dict({"posterior": xr.Dataset(group, coords), "sample_stats": xr.Dataset(stats)})
    ones = dict.fromkeys(draws, 1.0)
    return bp.Posterior(tree, True, "made for a test", ones, ones, ones, 0.5, {}, 1, 1)


def population_of(draws):
    """Return a population of one parameter, with the given draws of the population's parameters [m]."""
    at = {"a": {"logarithmic": False, "unit": "m", "low": -np.inf, "high": np.inf}}
    empty = pd.DataFrame()
    times = dict.fromkeys(draws, 1.0)
    tree = posterior_of(draws).tree
    return bp.Population(tree, ("a",), at, {}, np.inf, {}, empty, empty, True, "made for a test", times, 1, 1, 1)


def texts(figure):
    """Return the texts that are drawn, each with the corners (4, 2) of its box in pixels."""
    drawn, draw = {}, Text.draw

    def recorded(self, renderer, *arguments, **keywords):
        if self.get_visible() and self.get_text().strip():
            drawn[self] = renderer
        return draw(self, renderer, *arguments, **keywords)

    with mock.patch.object(Text, "draw", recorded):
        figure.canvas.draw()
    return {text: corners(text, renderer) for text, renderer in drawn.items()}


def corners(text, renderer):
    """Return the corners of the box of a text, which may be turned."""
    box, angle = text.get_window_extent(renderer), text.get_rotation()
    with mock.patch.object(text, "_rotation", 0.0):
        plain = text.get_window_extent(renderer)
    cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    half = 0.5 * np.array([plain.width, plain.height])
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    centre = 0.5 * np.array([box.x0 + box.x1, box.y0 + box.y1])
    return centre + square @ np.array([[cosine, sine], [-sine, cosine]])


def overlap(one, other):
    """Return whether two rectangles overlap by more than the room: whether no side separates them."""
    for sides in (one, other):
        for k in range(2):
            normal = sides[k + 1] - sides[k]
            if length := np.linalg.norm(normal):
                a, b = one @ normal / length, other @ normal / length
                if min(a.max(), b.max()) - max(a.min(), b.min()) < ROOM:
                    return False
    return True


def faults(figure):
    """Return what is wrong with the texts of a figure: those beyond its edges, and pairs that overlap."""
    found, width, height = texts(figure), *figure.canvas.get_width_height()
    wrong = [
        f"clipped: {text.get_text()!r}"
        for text, box in found.items()
        if box.min() < -ROOM or (box.max(axis=0) > np.array([width, height]) + ROOM).any()
    ]
    for (one, a, low, high), (other, b, lowest, highest) in combinations(
        [(text, box, box.min(axis=0).tolist(), box.max(axis=0).tolist()) for text, box in found.items()], 2
    ):
        apart = low[0] > highest[0] or lowest[0] > high[0] or low[1] > highest[1] or lowest[1] > high[1]
        if not apart and overlap(a, b):
            wrong.append(f"overlap: {one.get_text()!r} and {other.get_text()!r}")
    return wrong
