"""Finding orbits at several noise levels, each on a core."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import bayesperiodic as bp
from studies.pendulum.recording import section_of, with_noise


@dataclass(frozen=True)
class Found:
    """What was found in one section.

    Attributes
    ----------
    section : PoincareSection
    chained, boxes : Orbits
        By the default method and by the paper's recipe.
    """

    section: bp.PoincareSection
    chained: bp.Orbits
    boxes: bp.Orbits


def search(recording: bp.Recording, noises: Sequence[float], seed: int, periods: Sequence[int]) -> dict[float, Found]:
    """Return what is found with each noise added to the recording, as a fraction of the attractor's size."""
    tasks = [(recording, noise, seed, tuple(periods)) for noise in dict.fromkeys(noises)]
    if len(tasks) == 1:
        return {noises[0]: _found(tasks[0])}
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(os.cpu_count() or 1, len(tasks)), mp_context=context) as pool:
        # The noisiest takes longest.
        found = dict(zip([t[1] for t in reversed(tasks)], pool.map(_found, reversed(tasks)), strict=True))
    return {noise: found[noise] for noise in noises}


def _found(task: tuple[bp.Recording, float, int, tuple[int, ...]]) -> Found:
    recording, noise, seed, periods = task
    section = section_of(with_noise(recording, noise, seed) if noise > 0.0 else recording)
    every = {method: bp.find_orbits(section, periods=periods, method=method) for method in ("chained", "boxes")}
    return Found(section, every["chained"], every["boxes"])
