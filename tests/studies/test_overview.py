import json

import numpy as np
import pytest
from scipy.stats import chi2

import bayesperiodic as bp
from studies.__main__ import main
from studies.overview import run as overview
from studies.verdicts.cases import scaling_symmetry


@pytest.fixture(scope="module")
def fit():
    return bp.map_estimate(scaling_symmetry().problem(1), progress=False)


def test_ellipses_have_the_probabilities_of_a_normal_distribution(fit):
    names = [overview.MASS, overview.AIR]
    covariance = fit.covariance.loc[names, names].to_numpy(float)
    away = np.stack(overview.ellipses(fit)) - np.array([[fit.theta[name]] for name in names])
    squares = np.einsum("ik,ij,jk->k", away, np.linalg.inv(covariance), away).reshape(2, -1)[:, :-1]
    assert np.allclose(squares, chi2(2).ppf(overview.PROBABILITIES)[:, None])


@pytest.mark.document
def test_quick_run(tmp_path, capsys):
    assert main(["overview", "--quick", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "results.json").read_text("utf-8"))
    assert "synthetic" in capsys.readouterr().out and (tmp_path / "overview.png").is_file()
    assert len(results["folds_hz"]) == 2 and min(results["orbits"].values()) >= 1
    assert results["posterior"]["m"] == results["posterior"]["k3"] == "only in combination"
