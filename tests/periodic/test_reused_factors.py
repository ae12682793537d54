"""Solves that start with the factors of an anchor, on the landing gear, whose equations are singular at theta16 = 0."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.periodic.batch import Anchor, Batch
from bayesperiodic.periodic.equations import PeriodicEquations
from tests.known import GEAR, grid

NAMES = list(GEAR)
FREE = [NAMES.index(name) for name in ("theta4", "theta6", "theta16")]
THETA = np.array([GEAR[name] for name in NAMES])
SAMPLES = 400
# Frequency [Hz], force amplitude about 4.5 kN [N], displacement amplitude about 0.12 m [m].
RUNS = ((0.05, 1500.0, 0.080), (0.3, 1100.0, 0.048), (1.0, 700.0, 0.021), (6.0, 600.0, 0.0021))


def rig(drive: str, scheme: str) -> list[PeriodicEquations]:
    wave = np.cos(2 * np.pi * grid(SAMPLES))
    return [
        PeriodicEquations.build(
            bp.models.landing_gear(drive),
            {drive: 4500.0 + force * wave if drive == "force" else 0.12 + stroke * wave},
            frequency=frequency,
            samples=SAMPLES,
            scheme=scheme,
            periods=1,
            winding=0,
        )
        for frequency, force, stroke in RUNS
    ]


@pytest.mark.parametrize(
    "spread",
    [(5e-6, 1e-5, 1e-2), (0.05, 0.05, 0.05), (5e-6, 1e-5, 2.0), (5e-6, 1e-5, 5.0)],
    ids=["posterior", "5 %", "theta16 twice its value", "theta16 five times its value"],
)
@pytest.mark.parametrize("scheme", ["backward2", "central2"])
@pytest.mark.parametrize("drive", ["force", "displacement"])
def test_solves_with_reused_factors_equal_solves_from_scratch(drive, scheme, spread):
    """Spreads are standard deviations relative to theta4, theta6 and theta16; many theta16 are negative.

    At theta16 = -0.006 the smallest singular value is 1/350 of the anchor's, and 350 times as much is left after a step
    of 1e-9 with the anchor's factors, unless the step minds the softest direction.
    """
    sets = rig(drive, scheme)
    anchors = [Anchor.at(e, THETA, e.solve(THETA, e.static_guess(THETA)).z) for e in sets]
    parameters = np.tile(THETA, (60, 1))
    parameters[:, FREE] *= 1.0 + np.array(spread) * np.random.default_rng(1).standard_normal((60, 3))
    parameters[:, NAMES.index("theta11")] = -1e5 * parameters[:, NAMES.index("theta4")]
    found = Batch(sets, anchors).solve(parameters, keep=True, polish=True)
    assert not found.status.any()
    for equations, z in zip(sets, found.z, strict=True):
        for i in (3, 17, 40):
            alone = equations.solve(parameters[i], equations.static_guess(parameters[i]))
            assert alone.code == 0
            assert np.all(np.abs(z[i] - alone.z).max(axis=0) <= 1e-7 * np.abs(alone.z).max(axis=0))
