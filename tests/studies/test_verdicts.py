import contextlib
import io
import json
from concurrent.futures import ThreadPoolExecutor

import pytest

from studies import common
from studies.__main__ import main
from studies.verdicts import run as verdicts
from studies.verdicts.cases import CASES, examine


def run(folder, *arguments):
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["verdicts", "--out", str(folder), "--quick", *arguments]) == 0
    return json.loads((folder / "results.json").read_text(encoding="utf-8")), printed.getvalue()


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Return the folder, the results and the printed account of a quick run."""
    folder = tmp_path_factory.mktemp("verdicts")
    return folder, *run(folder)


@pytest.mark.slow
def test_every_verdict_of_the_quick_gallery_is_correct(quick):
    _, results, printed = quick
    assert set(results) == {*verdicts.QUICK, "study"}
    for name in verdicts.QUICK:
        case = results[name]
        assert case["right"] and case["named"] and case["converged"] and not case["wrong"], (name, case["wrong"])
    assert "SYNTHETIC" in printed and "WRONG" not in printed
    assert results["misspecified"]["verdicts"]["identifiability"] == {"k": "determined", "c": "determined"}
    assert results["misspecified"]["verdicts"]["predict"]["all"] == "misspecified"
    assert results["linear"]["numbers"]["joint"]["pareto_k"][0] < 0.5


@pytest.mark.slow
def test_contraction_of_a_dominating_prior_is_the_expected_one(quick):
    """Data ± 7.1 and prior ± 3 N s/m: contraction 1/(1 + 7.1²/3²) = 0.15, the variance estimated (± 40 %)."""
    _, results, _ = quick
    value, error = results["prior_dominated"]["numbers"]["c"]["contraction"]
    assert 0.0 < error < 0.05
    assert value == pytest.approx(0.15, abs=0.06 + 4 * error)


@pytest.mark.slow
def test_figures_are_drawn(quick):
    folder, _, _ = quick
    found = {path.name: path.stat().st_size for path in folder.glob("*.png")}
    assert set(found) == {"gallery.png", "product_ridge.png"} and max(found.values()) < 200_000


def test_replicates_are_saved_one_by_one_and_resumed(tmp_path, monkeypatch):
    """A line that was cut off, and one of another version of the cases, are done again; the others are not."""
    calls = []
    fake = {"right": True, "named": True, "warned": False, "converged": True, "wrong": {}, "verdicts": {}, "seconds": 1}
    monkeypatch.setattr(common, "workers", lambda: ThreadPoolExecutor(1))
    monkeypatch.setattr(
        verdicts,
        "replicate",
        lambda task: (
            calls.append(task)
            or dict(zip(("case", "kind", "number", "seed"), task, strict=True)) | {"source": verdicts.source()} | fake
        ),
    )
    assert main(["verdicts", "--out", str(tmp_path), "--quick", "--replicates", "2"]) == 0
    counts = json.loads((tmp_path / "replicates" / "results.json").read_text(encoding="utf-8"))["cases"]
    assert set(counts) == set(verdicts.QUICK)
    assert all(one[kind]["right"] == one[kind]["replicates"] == 2 for one in counts.values() for kind in one)
    calls.clear()
    first = verdicts.replicates(tmp_path, ("linear",), 2, 1)
    assert len(first) == len(calls) == 4
    path = tmp_path / verdicts.FILE
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], lines[1].replace(verdicts.source(), "other"), lines[2], lines[3][:9]]))
    calls.clear()
    assert verdicts.replicates(tmp_path, ("linear",), 2, 1) == first
    assert len(calls) == 2
    assert len(path.read_text().splitlines()) == 5


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The data do not change under")
def test_counts_report_wrong_and_changed_verdicts():
    outcome = examine("scaling_symmetry", 0, 0, drawless=True)
    assert outcome.posterior is None and not outcome.wrong and outcome.named
    line = {"case": "scaling_symmetry", "kind": "data", "number": 0, "seed": 1} | outcome.line()
    other = line | {
        "kind": "sampler", "right": False, "named": False,
        "wrong": {"identifiability m": "determined"},
        "verdicts": {"identifiability": line["verdicts"]["identifiability"] | {"m": "determined"}},
    }  # fmt: skip
    found = verdicts.summary([line, line | {"kind": "sampler"}, other], ["scaling_symmetry"])["scaling_symmetry"]
    assert found["data"]["right_share"] == [1.0, pytest.approx(0.47, abs=0.01)]
    assert found["sampler"]["right"] == 1 and found["sampler"]["wrong"] == {"identifiability m: determined": 1}
    assert found["sampler"]["verdicts_that_flip"] == {"identifiability m": ["determined", "only in combination"]}
    assert "1 times identifiability m" in verdicts.account_of_replicates({"scaling_symmetry": found})


def test_failed_replicate_is_counted_and_reported(monkeypatch):
    def fails(*_, **__):
        raise RuntimeError("no orbit")

    monkeypatch.setattr(verdicts, "examine", fails)
    line = verdicts.replicate(("linear", "data", 0, 1))
    assert line["error"] == "RuntimeError: no orbit"
    counts = verdicts._counts([line])
    assert counts["right"] == 0 and counts["errors"] == ["RuntimeError: no orbit"] and counts["seconds_each"] is None


def test_every_case_states_its_expected_verdicts():
    for name, make in CASES.items():
        case = make()
        assert set(case.fault) <= set(case.expected), name
        assert case.shown in case.truth and set(case.problem(1).names) <= set(case.truth), name
