"""A beam of 100 degrees of freedom with a friction joint and a stop, against an integrator with exact friction."""

import numpy as np
import pytest

import bayesperiodic as bp
from studies.structure import beam

EVERY = 16


@pytest.mark.slow
@pytest.mark.parametrize(("frequency", "force", "error"), [(5.0, 0.5, 0.01), (5.5, 3.0, 0.002), (6.5, 3.0, 0.002)])
def test_accelerations_are_those_of_exact_friction_and_contact(frequency, force, error):
    """To the rounding of the elements; with the small force the joint sticks for most of the time."""
    mass, stiffness = beam.matrices()
    joint = bp.elements.Element("joint", bp.elements.jenkins, beam.place(beam.JOINT), {"width": 0.05})
    stop = bp.elements.Element("stop", bp.elements.gap, beam.place(beam.STOP), {"width": 2e-5})
    sensors = {"middle": beam.MIDDLE, "outer": beam.SECOND}
    model = bp.Model.from_matrices(
        "beam", mass=mass, stiffness=stiffness, damping={"alpha": mass, "beta": stiffness},
        forces={"force": beam.place(beam.FORCED)}, elements=[joint, stop],
        outputs={name: (beam.place(part), "acceleration") for name, part in sensors.items()},
    )  # fmt: skip
    motion = beam.integrated(frequency, force, EVERY)
    samples = beam.STEPS_PER_PERIOD // EVERY
    wave = force * np.cos(2 * np.pi * np.arange(samples) / samples)
    solved = bp.solve_periodic(model, beam.TRUTH, {"force": wave}, frequency=frequency, samples=samples)
    for name in sensors:
        # The first value of the integrator is that after the first steps.
        exact = np.roll(getattr(motion, name)[-samples:], 1)
        assert np.sqrt(np.mean((solved.outputs[name] - exact) ** 2)) < error * np.ptp(exact)
