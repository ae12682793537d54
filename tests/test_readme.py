"""The README's code: every block runs, which takes minutes (``pytest -m document``)."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import bayesperiodic as bp
from studies.flutter import rig
from studies.pendulum import recording as pendulum_recording
from tests.known import LINEAR, linear_experiment

README = Path(__file__).parents[1] / "README.md"
pytestmark = pytest.mark.document


def blocks():
    """Return the headings that have code in Python, with their blocks."""
    found: dict[str, list[str]] = {}
    for part in re.split(r"^## ", README.read_text("utf-8"), flags=re.MULTILINE)[1:]:
        code = re.findall(r"^```python\n(.*?)^```", part, flags=re.MULTILINE | re.DOTALL)
        if code:
            found[part.splitlines()[0]] = code
    return found


BLOCKS = blocks()


def damper_file():
    """Write run.csv as a rig would have."""
    x = {"displacement": 0.0126 * np.cos(2 * np.pi * np.arange(64) / 64)}
    true = {"Kx": 770, "K": 300, "F0": 4, "Kw": 57, "rho": 27_000}
    run = bp.simulate(
        bp.models.dahl, true, x, frequency=0.84, duration=30, sampling_rate=100, noise={"force": 4.0}, seed=1
    )
    table = {"t": run.time, "x_mm": 1e3 * run.inputs["displacement"], "F": run.outputs["force"]}
    pd.DataFrame(table).to_csv("run.csv", index=False)
    return {"bp": bp}


def pendulum():
    recording = pendulum_recording.with_noise(pendulum_recording.simulate(3000, 1), 1e-3, 1)
    truth = pendulum_recording.TRUTH
    known = {name: value for name, value in truth.items() if name not in ("m", "l")}
    priors = {name: bp.LogNormal(1.1 * truth[name], 0.3) for name in ("m", "l")}
    return {"bp": bp, "recording": recording, "f": pendulum_recording.FREQUENCY, "known": known, "priors": priors}


def gear():
    """Two experiments of the landing gear and its known parameters."""
    from studies.landing_gear.rig import GEAR

    model, wave = bp.models.landing_gear("displacement"), np.cos(2 * np.pi * np.arange(200) / 200)
    found = []
    for name, frequency, stroke in (("run 1", 0.2, 0.08), ("run 2", 1.0, 0.018)):
        x = {"displacement": 0.12 + stroke * wave}
        outputs = bp.solve_periodic(model, GEAR, x, frequency=frequency, samples=200).outputs
        noisy = {n: y + 3e-3 * np.ptp(y) * np.random.default_rng(1).standard_normal(200) for n, y in outputs.items()}
        found.append(bp.Experiment(name, frequency, noisy, x, samples=200, synthetic=True))
    known = {name: value for name, value in GEAR.items() if name not in ("theta4", "theta11", "theta16", "theta17")}
    return {"bp": bp, "model": model, "experiments": found, "known": known}


def linear(noise="independent"):
    priors = {"k": bp.Normal(800.0, 60.0), "c": bp.LogNormal(30.0, 0.5), "coulomb": bp.Normal(20.0, 10.0)}
    problem = bp.Problem(LINEAR, [linear_experiment([900.0, 40.0, 25.0], 3.0, seed=1)], priors=priors, noise=noise)
    return {"bp": bp, "problem": problem, "fit": bp.map_estimate(problem, progress=False)}


def linear_draws():
    names = linear()
    return names | {"posterior": bp.sample(names["problem"], names["fit"], seed=1, progress=False)}


# Variables defined before the first block of each heading, and shortened versions of slow blocks.
BEFORE = {
    "Fifteen lines": dict,
    "Your recording, your model": damper_file,
    "A chaotic pendulum": pendulum,
    "A flutter rig's unstable cycles": lambda: {
        "bp": bp, "values": rig.RIG | rig.AUTHORS | rig.SENSORS,
    },
    "The periodic solver": dict,
    "More than one experiment, and more than histories": gear,
    "Draws that can be trusted": linear,
    "What the data cannot tell you": linear_draws,
    "Are the intervals what they say?": lambda: linear(bp.noise.Independent(prior=bp.InverseGamma(3.0, 20.0))),
}  # fmt: skip
SHORTER = {"replicates=1000": "replicates=2", "range(1, 6)": "range(1, 3)"}


def test_every_heading_with_code_has_its_setup():
    assert set(BLOCKS) == set(BEFORE)


@pytest.mark.parametrize("heading", BLOCKS)
def test_runs(heading, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = BEFORE[heading]()
    for code in BLOCKS[heading]:
        for printed, short in SHORTER.items():
            code = code.replace(printed, short)
        exec(compile(code, f"README, {heading}", "exec"), names)
    if heading == "Fifteen lines":
        assert names["fit"].converged and names["posterior"].converged
        assert Path("corner.png").stat().st_size > 1000 and Path("report.html").stat().st_size > 1000
        assert len([line for line in code.splitlines() if line]) <= 15


def test_code_of_shortened_readme_examples_exists():
    text = "".join(code for codes in BLOCKS.values() for code in codes)
    assert all(text.count(printed) == 1 for printed in SHORTER)
