import json

import pytest

import bayesperiodic as bp
from studies.__main__ import main
from studies.structure import beam, run


@pytest.mark.slow
def test_estimate_from_files_is_the_truth(tmp_path):
    """From the truth, each of five parameters within three standard deviations: 1.3 % of false alarms (fixed seed)."""
    run.write_files(tmp_path, 1)
    problem = run.problem_from(tmp_path)
    fit = bp.map_estimate(problem, start={name: beam.TRUTH[name] for name in run.PRIORS}, checks=False, progress=False)
    assert fit.status == "converged"
    assert all(abs(fit.theta[name] - beam.TRUTH[name]) < 3.0 * fit.sd[name] for name in run.PRIORS)


@pytest.mark.slow
def test_cost_of_chains_is_measured_by_stage(tmp_path, capsys):
    assert main(["structure", "--scaling", "--quick", "--out", str(tmp_path)]) == 0
    costs = json.loads((tmp_path / "scaling" / "results.json").read_text("utf-8"))["chains"]
    assert [*costs] == ["10", "30"] and all(value > 0.0 for stage in costs.values() for value in stage.values())
    assert "degrees of freedom" in capsys.readouterr().out
