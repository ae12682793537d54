"""The commands that check files, and estimate, sample and report from a problem file."""

import os
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

import bayesperiodic as bp
from bayesperiodic import __main__ as command
from tests.known import LINEAR, linear_experiment
from tests.layout import ROOT

PRIORS = {"k": bp.Normal(800.0, 60.0), "c": bp.LogNormal(30.0, 0.5), "coulomb": bp.Normal(20.0, 10.0)}
OPTIONS = {"seed": 3, "ensembles": 2, "walkers": 10, "max_steps": 60}


def run(*arguments, **variables):
    """Run a command in another process."""
    return subprocess.run(
        [sys.executable, "-m", "bayesperiodic", *map(str, arguments)], capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | variables,
    )  # fmt: skip


@pytest.fixture(scope="module")
def problem():
    return bp.Problem(LINEAR, [linear_experiment([900.0, 40.0, 25.0], 3.0, seed=1)], priors=PRIORS)


@pytest.fixture(scope="module")
def results(problem, tmp_path_factory):
    """Return the path of a problem file whose results a process has written, and the process."""
    path = tmp_path_factory.mktemp("archive") / "a problem.v1.toml"
    problem.to_toml(path)
    options = "".join(f"{name} = {value}\n" for name, value in OPTIONS.items())
    text = path.read_text("utf-8").replace("seed = 1\n", f"{options}\n[map_estimate]\nstarts = 2\nseed = 5\n")
    path.write_text(text, encoding="utf-8")
    return path, run("fit", path, PYTHONHASHSEED="7")


def test_the_command_draws_the_posterior_of_python_bit_for_bit(problem, results):
    path, done = results
    fit = bp.map_estimate(problem, starts=2, seed=5, progress=False)
    posterior = bp.sample(problem, fit, **OPTIONS, progress=False)
    again, drawn = (bp.load(path.with_name(f"a problem.v1{end}")) for end in (".fit.h5", ".posterior.nc"))
    assert again.theta == fit.theta and again.covariance.equals(fit.covariance)
    for group in ("posterior", "sample_stats", "log_likelihood"):
        for name, values in posterior.tree[group].data_vars.items():
            assert np.array_equal(values, drawn.tree[group][name], equal_nan=True), name
    assert str(fit) in done.stdout and str(posterior) in done.stdout and repr(problem) in done.stdout


def test_draws_that_have_not_converged_are_an_exit_status(results):
    path, done = results
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == f"error: {path}: not converged: Posterior; see above."


def test_no_result_is_replaced(results, capsys):
    path, _ = results
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    assert command.main(["fit", str(path)]) == 1
    assert "a problem.v1.fit.h5'; move or remove it." in capsys.readouterr().err
    assert {file.name: file.read_bytes() for file in path.parent.iterdir()} == before


def test_report_is_that_of_the_saved_results_and_is_not_replaced(results, capsys, tmp_path):
    path, _ = results
    archive = tmp_path / "moved"
    archive.mkdir()
    for file in path.parent.iterdir():
        (archive / file.name).write_bytes(file.read_bytes())
    assert command.main(["report", str(archive / path.name)]) == 0
    page = archive / "a problem.v1.html"
    assert "MCMC" in page.read_text("utf-8") and f"Written: {page}." in capsys.readouterr().out
    assert command.main(["report", str(archive / path.name)]) == 1
    assert "move or remove it" in capsys.readouterr().err


def test_report_of_an_estimate_alone_and_of_another_problem(problem, capsys, tmp_path):
    path = tmp_path / "problem.toml"
    problem.to_toml(path)
    assert command.main(["report", str(path)]) == 1
    assert "file: must have results, got no" in capsys.readouterr().err
    path.write_text(path.read_text("utf-8").replace("[sample]\nseed = 1\n", ""), encoding="utf-8")
    assert command.main(["fit", str(path)]) == 0
    assert sorted(file.suffix for file in tmp_path.iterdir()) == [".h5", ".h5", ".toml"]
    assert command.main(["report", str(path)]) == 0
    (tmp_path / "problem.html").unlink()
    problem.replace(noise=bp.noise.Independent(prior="flat")).to_toml(path)
    assert command.main(["report", str(path)]) == 1
    assert "got one of a problem with other noise" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seed = 1", "sed = 1", "sample: must be one of 'seed'"),
        ("seed = 1", "", r"sample: must have 'seed'."),
        ("seed = 1", 'seed = 1\nexecutor = "x"', "sample: must be one of 'seed'"),
        ("seed = 1", "seed = 1\n[map_estimate]\nproblem = 1", "map_estimate: must be one of 'start'"),
        ("seed = 1", "seed = 1\n[map_estimate]\nstart = {k = 1.0, q = 2.0}", "start"),
        ("seed = 1", "seed = 1\nwalkers = 3", "walkers"),
    ],
)
def test_wrong_options_are_refused_with_their_line(old, new, message, problem, capsys, tmp_path):
    path = tmp_path / "problem.toml"
    problem.to_toml(path)
    path.write_text(text := path.read_text("utf-8").replace(old, new), encoding="utf-8")
    lines = text.rstrip().split("\n")
    assert command.main(["fit", str(path)]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    expected = len(lines)
    assert error.startswith(f"error: {path}:{expected}: {message}")


def test_every_refusal_of_a_problem_file_is_an_error_with_its_line(problem, capsys, tmp_path):
    path = tmp_path / "problem.toml"
    problem.to_toml(path)
    path.write_text(text := path.read_text("utf-8").replace("sd = 60.0", "sd = -1"), encoding="utf-8")
    line = text[: text.index("sd = -1")].count("\n") + 1
    for name in ("fit", "check"):
        assert command.main([name, str(path)]) == 1
        assert f"error: {path}:{line}: sd: must be > 0, got -1.\n" in capsys.readouterr().err


def test_check_prints_the_problem_of_a_file_that_is_right(problem, capsys, tmp_path):
    problem.to_toml(tmp_path / "problem.toml")
    assert command.main(["check", str(tmp_path / "problem.toml")]) == 0
    assert capsys.readouterr().out == f"{problem!r}\n"


@pytest.fixture
def recording(tmp_path):
    """Return the path of a file with a channel that is stuck for a while."""
    t = np.arange(0, 60, 0.01)
    force, x = np.cos(2 * np.pi * t), 0.1 * np.sin(2 * np.pi * t) + 1e-3 * np.random.default_rng(1).normal(size=t.size)
    path = tmp_path / "run.csv"
    pd.DataFrame({"t": t, "F [N]": force, "x": x}).to_csv(path, index=False)
    stuck = np.where((t > 10) & (t < 12), force[1000], force)
    pd.DataFrame({"t": t, "F [N]": stuck, "x": x}).to_csv(tmp_path / "stuck.csv", index=False)
    return path


def test_check_prints_the_check_of_every_channel(recording, capsys):
    assert command.main(["check", str(recording)]) == 0
    seen = bp.Recording.from_file(recording, time="t", outputs={"f": "F [N]", "x": "x"}).check()
    assert capsys.readouterr().out == f"{seen}\n" and seen.frequency == pytest.approx(1.0, abs=1e-4)


def test_ruinous_faults_and_unreadable_files_are_an_exit_status(recording, capsys):
    stuck = recording.with_name("stuck.csv")
    assert command.main(["check", str(recording), str(stuck)]) == 1
    out = capsys.readouterr().out
    assert "Recording 'run'" in out and "ruinous: f is stuck" in out
    short = recording.with_name("short.csv")
    short.write_text("\n".join(recording.read_text("utf-8").split("\n")[:150]), encoding="utf-8")
    assert command.main(["check", str(short)]) == 1 and "no mean period" in capsys.readouterr().out
    assert command.main(["check", str(recording.with_name("none.csv")), str(recording)]) == 1
    streams = capsys.readouterr()
    assert "none.csv" in streams.err and "Recording 'run'" in streams.out


def test_check_needs_neither_units_nor_times_that_the_file_does_not_say(recording, capsys, tmp_path):
    """Units that are doubtful, and a column with one value; the check is that of the values as they are."""
    table = pd.read_csv(recording)
    expected = bp.Recording.from_arrays(table["t"], {"a": table["F [N]"], "x": table["x"]}).check()
    table = table.rename(columns={"F [N]": "a [g]"}).assign(start=[1.0] + [np.nan] * (len(table) - 1))
    with_times, without = tmp_path / "with.csv", tmp_path / "without.csv"
    table.to_csv(with_times, index=False)
    table.drop(columns="t").to_csv(without, index=False)
    table.rename(columns={"t": "clock"}).to_csv(tmp_path / "named.csv", index=False)
    for file, *options in (
        (with_times,), (without, "--sampling-rate", "100"), (tmp_path / "named.csv", "--time", "clock"),
    ):  # fmt: skip
        assert command.main(["check", str(file), *options]) == 0
        first, *rows = capsys.readouterr().out.splitlines()
        assert first.split(": ")[1] == str(expected).splitlines()[0].split(": ")[1]
        assert [row.split() for row in rows] == [row.split() for row in str(expected).splitlines()[1:]]
    assert command.main(["check", str(without)]) == 1
    assert "error: time: must be given or sampling_rate" in capsys.readouterr().err


def test_check_of_a_problem_file_is_that_of_its_recordings(recording, capsys):
    path = recording.with_name("problem.toml")
    entry = (
        '[[experiments]]\nrecording = "{}.csv"\ntime = "t"\ninputs = {{force = "F [N]"}}\noutputs = {{x = "x"}}\n{}\n'
    )
    path.write_text(
        entry.format("run", "fold = {frequency = [1.0, 1e-5]}") + entry.format("stuck", ""), encoding="utf-8"
    )
    assert command.main(["check", str(path)]) == 1
    read = {"time": "t", "inputs": {"force": "F [N]"}, "outputs": {"x": "x"}}
    checks = [
        bp.Recording.from_file(recording, **read).check(1.0),
        bp.Recording.from_file(recording.with_name("stuck.csv"), **read).check(),
    ]
    assert capsys.readouterr().out == "".join(f"{one}\n" for one in checks)
    path.write_text(entry.format("run", "fold = {frequency = []}"), encoding="utf-8")
    assert command.main(["check", str(path)]) == 1
    assert "error: frequency: must be a real number" in capsys.readouterr().err


def test_module_is_a_command_with_four_subcommands():
    done = run("--help")
    assert done.returncode == 0 and all(name in done.stdout for name in ("inspect", "check", "fit", "report"))
