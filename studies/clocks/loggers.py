"""Two loggers: false alarms at one clock, clocks that differ, lost samples, two sampling rates; closed forms."""

import warnings
from collections import Counter
from typing import Any

import numpy as np

import bayesperiodic as bp
from studies import common

PPM = (0.0, 5.0, 20.0, 50.0, 100.0, 300.0)
LOSSES: dict[str, list[tuple[int, int]]] = {
    "7 samples": [(2000, 7)],
    "7, 15 and 40 samples": [(1500, 7), (3000, 15), (4500, 40)],
    "14 times one sample": [(400 * i + 200, 1) for i in range(14)],
}
# Recordings of one clock, in which an alarm would be false, for 200 of each other case.
ONE_CLOCK = 2.5
FREQUENCY, C, K = 0.2, 0.2, 1.0
OSCILLATOR = bp.Model(
    "oscillator", states=["x"], inputs=["force"], parameters=["c", "k"], equations=["ddx + c*dx + k*x - force"],
    outputs={"x": "x"},
)  # fmt: skip


def response(frequency: float) -> complex:
    """Return the amplitude of the displacement of a linear oscillator under a force of 0.5."""
    omega = 2 * np.pi * frequency
    return 0.5 / (K - omega**2 + 1j * omega * C)


def recording(
    seed: int, ppm: float = 0.0, cycles: int = 120, lost: list[tuple[int, int]] | None = None
) -> bp.Recording:
    """Return force and displacement, 50 samples a cycle, with two clocks and without samples that one has lost."""
    omega, generator = 2 * np.pi * FREQUENCY, np.random.default_rng(seed)
    time = np.arange(50 * cycles) / 10.0
    x = np.real(response(FREQUENCY) * np.exp(1j * omega * (1 + 1e-6 * ppm) * time))
    x += 0.01 * generator.standard_normal(time.size)
    x = np.delete(x, np.concatenate([np.arange(a, a + n) for a, n in lost or []] + [np.zeros(0, dtype=int)]))
    return bp.Recording.from_arrays(time[: x.size], {"x": x}, {"force": 0.5 * np.cos(omega * time)[: x.size]})


def outcome(run: bp.Recording, **arguments: Any) -> str:
    """Return what `fold` does: "refused", "warned" or "silent"."""
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        try:
            run.fold(32, harmonics={"x": 4, "force": 1}, **arguments)
        except ValueError:
            return "refused"
    return "warned" if raised else "silent"


def case_outcome(case: str, seed: int) -> str:
    """Return the outcome of one recording of a case, "… ppm" or a name of `LOSSES`."""
    lost = LOSSES.get(case)
    return outcome(recording(seed, lost=lost) if lost else recording(seed, float(case.split()[0]), 300))


def loggers(seed: int, count: int) -> dict[str, dict[str, int]]:
    """Return how often recordings of two clocks, with lost samples, and of one clock are refused or warned of."""
    sizes = dict.fromkeys([*(f"{ppm:g} ppm" for ppm in PPM), *LOSSES], count) | {"0 ppm": round(ONE_CLOCK * count)}
    tasks = [(case, seed + i) for case, size in sizes.items() for i in range(size)]
    outcomes = list(common.each(case_outcome, tasks))
    return {
        case: dict(Counter(out for (of, _), out in zip(tasks, outcomes, strict=True) if of == case)) for case in sizes
    }


def rates(seed: int, count: int) -> dict[str, float]:
    """Return the share of 90 % intervals of c that contain the truth: 50 Hz force, 4.7 Hz displacement, one clock."""
    inside = list(common.each(covered, [(seed + i,) for i in range(count)]))
    return {"coverage of c": float(np.mean(inside)), "data sets": count}


def covered(seed: int) -> bool:
    """Return whether the 90 % interval of c of one recording of two rates contains the truth."""
    omega, generator = 2 * np.pi * FREQUENCY, np.random.default_rng(seed)
    fast, slow = np.arange(0, 300, 0.02), 0.137 + np.arange(0, 299, 1 / 4.7)
    force = 0.5 * np.cos(omega * fast) + 0.02 * generator.standard_normal(fast.size)
    x = np.real(response(FREQUENCY) * np.exp(1j * omega * slow)) + 0.01 * generator.standard_normal(slow.size)
    both = bp.Recording.from_arrays({"force": fast, "x": slow}, {"x": x}, {"force": force})
    run = both.fold(32, frequency=FREQUENCY, harmonics={"x": 4, "force": 1})
    priors = {"c": bp.LogNormal(C, 1.0), "k": bp.LogNormal(K, 0.5)}
    problem = bp.Problem(OSCILLATOR, [run], priors=priors, scheme="fourier")
    fit = bp.map_estimate(problem, start={"c": C, "k": K}, checks=False, progress=False)
    low, high = fit.interval(0.9)["c"]
    return bool(low < C < high)
