"""The study of response tables."""

import json

import numpy as np
import pytest

from studies.__main__ import main
from studies.resonance import systems


def test_quick_run_covers_the_truth_and_is_faster_than_free_delays(tmp_path):
    folder = tmp_path / "resonance"
    assert main(["resonance", "--quick", "--out", str(folder)]) == 0
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    for kind in systems.KINDS:
        found = results[f"duffing: {kind}"]
        assert found["converged"] == 1.0
        assert max(found["sd over that of the prior"].values()) < 0.1
    assert results["speed"]["ratio"] > 2.0  # of processor times; 5.1 to 6.5 on two busy cores
    assert results["speed"]["finite, table"] == 1.0 and results["speed"]["finite, improvised"] > 0.9


def test_phases_determine_more_than_amplitudes_alone():
    sds = {
        kind: systems.replicate(("duffing", kind, 0, 1))["contraction"] for kind in (systems.AMPLITUDE, systems.PHASE)
    }
    assert all(sds[systems.PHASE][p] < sds[systems.AMPLITUDE][p] for p in ("c", "k", "k3"))


def test_the_averaged_equation_is_exact_for_a_linear_oscillator():
    omega = 2 * np.pi * np.linspace(0.1, 0.25, 30)
    amplitude = 0.2 / np.hypot(1.0 - omega**2, 0.1 * omega)
    given = {"f": omega / 2 / np.pi, "A": amplitude, "sd": np.full(30, 1e-3)}
    at, _ = systems.averaged(given, 0.2, {"c": 0.12, "k": 1.02, "k3": 1e-9})
    assert [at["c"], at["k"]] == pytest.approx([0.1, 1.0], rel=1e-4)
