"""The rig of the landing gear study: fourteen experiments with an imposed displacement, and what is recorded.

Everything is SYNTHETIC. A servo-hydraulic actuator moves the axle about a mean compression of 0.12 m. Its oil supply
limits the speed to 0.25 m/s (2.9 kW at the largest force), 2π · frequency · half stroke, so that large strokes are slow
and fast ones small. The motion is a sine with the harmonics of a servo valve, 0.4 % second and 0.3 % third. Recorded
are displacement, force on the axle and gas pressure through 40 cycles at 353.275 samples a cycle, each sample with its
own normal noise: of full scale (0.2 m, 20 kN, 2.5 MPa) 0.02 % for the displacement, 0.3 % for force and pressure.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np

import bayesperiodic as bp
from studies.landing_gear.truth import damper, parameters

MEAN_COMPRESSION = 0.12
SPEED_LIMIT = 0.25
HARMONICS = {1: 1.0, 2: 0.004j, 3: 0.003}
CYCLES, RECORDED = 40, 14_131
# [s], [K]
STRETCH, SETTLED, ROUNDS = 4.0, 1e-5, 12
FULL_SCALE = {"displacement": 0.2, "force": 2e4, "pressure": 2.5e6}
NOISE_SHARE = {"displacement": 2e-4, "force": 3e-3, "pressure": 3e-3}
NOISE = {channel: NOISE_SHARE[channel] * FULL_SCALE[channel] for channel in FULL_SCALE}

# Parameters of a gear that are not those of `GEAR`, with their values.
Changed = frozenset[tuple[str, float]]
SAME: Changed = frozenset()


@dataclass(frozen=True)
class Run:
    """One experiment of the rig.

    Attributes
    ----------
    frequency : float
        [Hz].
    stroke : float
        Half of it, the displacement's amplitude [m].
    """

    frequency: float
    stroke: float

    @property
    def name(self) -> str:
        """What it is called in tables, figures and parameters."""
        return f"{self.frequency:g} Hz {1e3 * self.stroke:g} mm"

    @property
    def speed(self) -> float:
        """The largest speed of the sine [m/s]."""
        return 2 * np.pi * self.frequency * self.stroke


RUNS = tuple(
    Run(frequency, 1e-3 * stroke)
    for frequency, stroke in (
        (0.05, 80), (0.1, 80), (0.2, 80), (0.2, 30), (0.4, 80), (0.5, 60), (0.5, 3),
        (1.0, 36), (1.0, 18), (2.0, 18), (2.0, 3), (3.0, 4), (4.0, 8), (6.0, 4),
    )
)  # fmt: skip


def measure(run: Run, effects: Iterable[str], seed: int, changed: Changed = SAME) -> bp.Recording:
    """Return what the instruments record in one experiment, of a gear with some parameters changed."""
    clean = steady(run, frozenset(effects), changed)
    generator = np.random.default_rng([zlib.crc32(run.name.encode()), seed])
    signals = {**clean.inputs, **clean.outputs}
    noisy = {name: signals[name] + NOISE[name] * generator.standard_normal(RECORDED) for name in NOISE}
    return bp.Recording(
        clean.time,
        {name: noisy[name] for name in ("force", "pressure")},
        {"displacement": noisy["displacement"]},
        name=run.name,
        synthetic=True,
    )


@cache
def steady(run: Run, effects: frozenset[str], changed: Changed = SAME) -> bp.Recording:
    """Return 40 steady cycles without noise, by time integration.

    One cycle is integrated with a sample at each phase that the recorded ones have: their number, 14,131, and that of
    the cycles have no common divisor, so that sample k of the recording is that of phase 40·k mod 14,131.
    """
    cycle = integrate_steady(run, effects, RECORDED, changed)
    phase = np.arange(RECORDED) * CYCLES % RECORDED
    return bp.Recording(
        np.arange(RECORDED) * CYCLES / (RECORDED * run.frequency),
        {name: values[phase] for name, values in cycle.outputs.items()},
        {name: values[phase] for name, values in cycle.inputs.items()},
        name=run.name,
        synthetic=True,
    )


def integrate_steady(run: Run, effects: frozenset[str], samples: int, changed: Changed = SAME) -> bp.Recording:
    """Return one steady cycle without noise, end point excluded, by `bp.simulate`.

    The gas takes minutes to reach its mean temperature, to which its distance falls by the same factor in every cycle.
    So the integration starts again from the limit that three stretches foretell (Aitken), until it stays there.
    """
    values = parameters(effects) | dict(changed)
    start = {"T": -values["theta17"]}
    if "flexure" in effects:
        start["q"] = MEAN_COMPRESSION + run.stroke
    stretch = int(np.ceil(STRETCH * run.frequency))
    for _ in range(ROUNDS):
        found = _integrate(run, effects, values, start, 3 * stretch, 1).outputs
        first, second, third = found["temperature"][stretch::stretch]
        bend = first - 2 * second + third
        limit = third - (third - second) ** 2 / bend if bend else third
        settled = abs(limit - start["T"]) < SETTLED
        start["T"] = limit
        if "flexure" in effects:
            start["q"] = found["compression"][-1]
        if settled:
            # What is wrong with the starting speed dies out within milliseconds.
            two = _integrate(run, effects, values, start, 2, samples)
            return two.between(two.time[samples], two.time[2 * samples - 1])
    raise RuntimeError(f"{run.name}: the gas temperature has not settled.")


def _integrate(
    run: Run, effects: frozenset[str], values: dict[str, float], start: dict[str, float], cycles: int, samples: int
) -> bp.Recording:
    """Return so many cycles with so many samples each."""
    phase = 2j * np.pi * np.arange(16)[:, None] / 16 * list(HARMONICS)
    shape = (np.exp(phase) @ list(HARMONICS.values())).real
    return bp.simulate(
        damper(effects),
        values,
        {"displacement": MEAN_COMPRESSION + run.stroke * shape},
        frequency=run.frequency,
        duration=(cycles + 0.5 / samples) / run.frequency,
        sampling_rate=samples * run.frequency,
        start=start,
    )
