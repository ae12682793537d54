import json

import numpy as np
import pytest

from studies.__main__ import main
from studies.coverage import cases, run


@pytest.mark.slow
def test_quick_run(tmp_path):
    assert main(["coverage", "--out", str(tmp_path), "--quick"]) == 0
    found = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert set(found["cases"]) == set(cases.CASES) and found["data_sets"] == {"laplace": 2, "robust": 2, "draws": 1}
    assert not any(one["errors"] for one in found["cases"].values())
    assert all(share in (0.0, 0.5, 1.0) for *_, shares in run.rows(found["cases"]) for share in shares.values())
    assert (tmp_path / "coverage.png").is_file()


def test_the_band_is_that_of_the_binomial_distribution():
    """Of 200 right intervals at 90 %, 169 or fewer cover with a probability of 0.8 %, 168 or fewer with 0.5 %."""
    low, high = run.band(200)
    assert 200 * low == pytest.approx(168.0, abs=1.0) and 200 * high == pytest.approx(190.0, abs=1.0)


def test_shares_outside_the_band_are_in_bold():
    found = {
        "a case": {"covered": {"k": {"laplace": 0.5, "robust": 0.9, "draws": 0.9}}, "misspecified": 0.0, "errors": []}
    }
    bands = dict.fromkeys(run.KINDS, [0.84, 0.95])
    assert run.page_rows(found, bands) == ["| a case | k | **50** | 90 | 90 |"]
    assert "50.0% *" in run.table(found, bands) and "90.0%\n" not in run.table(found, bands)


def test_the_target_of_the_missing_term_is_the_best_fit_to_data_without_noise():
    """The cubic term adds stiffness: three quarters of k3 for one harmonic of amplitude 1, more with the others."""
    case = cases.missing_cubic(np.random.default_rng(1))
    assert 1.0 + 0.75 * 0.3 < case.truth["k"] < 2.0 and case.truth["c"] > 0.0
