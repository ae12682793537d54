import contextlib
import io
import json

import pytest
from scipy.stats import binom

from studies.__main__ import main
from studies.population.damper import DAMPER_NAMES, conditions, coverage


def test_conditions_of_a_test_are_those_in_its_name():
    """An inch is 25.4 mm and a pound-force 4.4482216 N by definition."""
    found = conditions("test_2_36lb_0.5Hz_1.5in")
    assert found == pytest.approx({"amplitude": 0.0381, "frequency": 0.5, "tension": 36 * 4.4482216}, rel=1e-5)


def test_coverage_counts_the_estimates_that_are_as_near_as_nine_tenths_of_them():
    """A two-sided p-value above 0.1 is an estimate within the 90 % interval; of a test without one nothing is known."""
    near, far = {"Kw": 0.11, "rho": 0.9, "all": 0.3}, {"Kw": 0.09, "rho": 0.5, "all": 0.001}
    rows = [{"p": near, "member": True}] * 9 + [{"p": far, "member": False}, {"p": None, "member": None}]
    found = coverage(rows)
    assert found["inside"] == {"Kw": 9, "rho": 10} and (found["of"], found["members"]) == (10, 9)
    low, high = found["likely_95"]
    assert binom.cdf(low - 1, 10, 0.9) < 0.025 <= binom.cdf(low, 10, 0.9) and high == 10
    assert set(found["inside"]) == set(DAMPER_NAMES)


@pytest.mark.slow
def test_a_quick_run_finds_what_differs_between_springs(tmp_path):
    """A member is called different in 1 % of populations at most; the stiffer spring is so by 30 %."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["population", "--quick", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["springs"]
    assert found["converged"] and found["tests"]["member"]["member"] and not found["tests"]["stiffer"]["member"]
    assert "No spread of k is seen" in found["verdicts"]["k"] and "not explained by noise" not in found["verdicts"]["k"]
    assert "friction damper are not used" in printed.getvalue()
