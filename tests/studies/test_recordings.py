import json

import numpy as np
import pytest

from studies.__main__ import main
from studies.recordings import cases


def results_of(folder, *arguments):
    assert main(["recordings", "--out", str(folder), *arguments]) == 0
    return json.loads((folder / "results.json").read_text(encoding="utf-8"))


@pytest.mark.slow
def test_quick_run(tmp_path):
    """Of 40 good recordings with 1 % false alarms, more than three have one with a probability of 0.1 %."""
    found = results_of(tmp_path, "--quick")
    assert found["recordings"] == 40 and found["false_alarms"]["serious"] <= 0.075
    assert found["false_alarms"]["refused"] == 0.0 and (tmp_path / "power.png").is_file()
    assert set(found["faults"]) == set(cases.FAULTS)
    assert all(one["found"] is not None for one in found["faults"].values())
    assert found["faults"]["dropouts [share]"]["found"] < 0.01


def test_the_effect_of_an_outlier_is_that_of_one_sample():
    """An outlier of size s adds 2 s/N to an amplitude, whose standard error is σ·sqrt(2/N)."""
    _, effect = cases.faulty("outlier [amplitudes]", 1.0, 3, 1)
    samples = cases.SAMPLES * cases.COUNT
    largest = 2.0 / samples / (cases.NOISE * np.sqrt(2.0 / samples))
    assert 0.7 * largest < effect <= 1.0001 * largest
