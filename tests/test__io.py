import dataclasses
import importlib
import io
import json
import os
import pkgutil
import re
import subprocess
import sys
import typing
from contextlib import contextmanager

import h5py
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import bayesperiodic as bp
from bayesperiodic import _io
from tests.known import grid


def same(a, b):
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, pd.DataFrame):
        return a.equals(b)
    if isinstance(a, xr.DataTree):
        return a.identical(b)
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(same(getattr(a, f), getattr(b, f)) for f in a.__dataclass_fields__)
    return a == b or (isinstance(a, float) and np.isnan(a) and np.isnan(b))


def results(solved):
    problem, fit, posterior = solved
    solution = bp.solve_periodic(
        bp.models.duffing,
        {"m": 1, "c": 0.2, "k": 1, "k3": 0.5},
        {"force": np.cos(2 * np.pi * grid(64))},
        frequency=0.2,
        samples=64,
    )
    recording = bp.Recording.from_arrays(np.arange(9.0), {"y": np.sin(np.arange(9.0))})
    return [
        recording,
        problem.experiments[0],
        solution,
        fit,
        posterior,
        bp.compare(problem, fit, posterior),
        bp.predict(problem, posterior, draws=20),
    ]


def test_every_result_reads_back_as_it_was(solved, tmp_path):
    for result in results(solved):
        result.save(tmp_path / "result.h5")
        assert same(result, bp.load(tmp_path / "result.h5")), type(result).__name__


def test_saved_posterior_opens_in_xarray(solved, tmp_path):
    posterior = solved[2]
    posterior.save(tmp_path / "posterior.nc")
    with xr.open_datatree(tmp_path / "posterior.nc", engine="h5netcdf") as tree:
        assert np.array_equal(tree["posterior"]["k"].values, posterior.data["posterior"]["k"].values)


def test_failed_save_keeps_the_old_file(solved, tmp_path, monkeypatch):
    fit = solved[1]
    fit.save(tmp_path / "fit.h5")
    before = (tmp_path / "fit.h5").read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        fit.save(tmp_path / "fit.h5")
    assert (tmp_path / "fit.h5").read_bytes() == before
    assert os.listdir(tmp_path) == ["fit.h5"]


def test_other_files_are_refused(tmp_path):
    (tmp_path / "text.h5").write_text("text")
    with pytest.raises(ValueError, match="path: must be a file written by save\\(\\), got"):
        bp.load(tmp_path / "text.h5")
    with pytest.raises(FileNotFoundError, match="path: must be an existing file, got"):
        bp.load(tmp_path / "nothing.h5")


@contextmanager
def changed(path):
    """Provide a saved file for changes, after which its checksum is computed again."""
    content = io.BytesIO(_io.read_sealed(path))
    with h5py.File(content, "a") as file:
        yield file
    _io.write_sealed(path, content.getbuffer())


def test_a_posterior_is_saved_beside_a_dask_client(solved, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(1, processes=False, protocol="tcp://", dashboard_address=None) as cluster:
        with distributed.Client(cluster):
            solved[2].save(tmp_path / "posterior.nc")
    assert same(bp.load(tmp_path / "posterior.nc"), solved[2])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs the limits of Unix")
def test_full_disk_is_an_error_and_leaves_the_old_file_alone(solved, tmp_path):
    import resource

    path = tmp_path / "posterior.h5"
    for result in solved[1:]:
        solved[0].experiments[0].save(path)
        before, (soft, hard) = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
        try:
            with pytest.raises(OSError, match="File too large"):
                result.save(path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert path.read_bytes() == before and os.listdir(tmp_path) == ["posterior.h5"]


def test_every_flipped_byte_is_noticed(solved, tmp_path):
    path, generator = tmp_path / "result.h5", np.random.default_rng(1)
    for result in solved[1:]:
        result.save(path)
        whole = path.read_bytes()
        for place in generator.integers(len(whole), size=200):
            damaged = bytearray(whole)
            damaged[place] ^= 1 << int(generator.integers(8))
            path.write_bytes(damaged)
            with pytest.raises(ValueError, match="path: must be a file written by save"):
                bp.load(path)


@pytest.mark.parametrize(
    "header",
    [
        "[" * 100_000, "{}", "3", '"text"', "null", '{"array": "7"}', '{"result": "MapEstimate"}', '{"tree": true}',
        '{"result": "MapEstimate", "module": "estimation.result", "fields": {}}', '{"mapping": [[[], 1]]}',
        '{"mapping": 3}', '{"sequence": 4}', '{"table": 5}', '{"result": {}, "fields": []}',
        '{"result": "Scheme", "module": "periodic.schemes", "fields": {"name": 1, "order": "x"}}',
        '{"result": "Experiment", "module": "data.experiment", "fields": '
        '{"name": "a", "frequency": {}, "outputs": 3, "samples": -1}}',
        '{"sequence": [{"result": "NoiseSplit", "module": "estimation.result", "fields": '
        '{"measurement": 1, "model": 2, "total": 3}}]}',
    ],
)  # fmt: skip
def test_made_up_files_are_refused_by_one_error(tmp_path, header):
    path = tmp_path / "run.h5"
    bp.Experiment("run", 2.0, {"x": [0.0, 1.0, 0.0, -1.0]}, samples=4).save(path)
    with changed(path) as file:
        del file.attrs["bayesperiodic_result"]
        file.attrs.create("bayesperiodic_result", header[:60_000])
    with pytest.raises(
        ValueError, match=r"path: must (be a file written by save\(\)|contain a result of this version)"
    ):
        bp.load(path)


def test_a_result_of_another_version_is_refused(tmp_path):
    path = tmp_path / "run.h5"
    experiment = bp.Experiment("run", 2.0, {"x": [0.0, 1.0, 0.0, -1.0]}, samples=4)
    experiment.save(path)
    with changed(path) as file:
        (key,) = [k for k in file.attrs if "frequency_se" in str(file.attrs[k])]
        file.attrs[key] = str(file.attrs[key]).replace('"frequency_se"', '"of_old"')
    with pytest.raises(ValueError, match="got other fields of Experiment; load it with"):
        bp.load(path)


def test_file_without_a_field_that_has_a_default_is_read(tmp_path):
    path = tmp_path / "run.h5"
    bp.Experiment("run", 2.0, {"x": [0.0, 1.0, 0.0, -1.0]}, samples=4).save(path)
    with changed(path) as file:
        (key,) = file.attrs
        header = json.loads(file.attrs[key])
        del header["fields"]["origin"]
        file.attrs[key] = json.dumps(header)
    assert bp.load(path).origin == 0.0


def test_error_names_the_missing_folder(tmp_path):
    experiment = bp.Experiment("run", 2.0, {"x": [0.0, 1.0, 0.0, -1.0]}, samples=4)
    with pytest.raises(FileNotFoundError, match="path: must be in an existing folder, got '.*nowhere.*run.h5'"):
        experiment.save(tmp_path / "nowhere" / "run.h5")


def classes_in_files() -> set[type]:
    """Return all results and the dataclasses that they contain."""
    for module in pkgutil.walk_packages(bp.__path__, "bayesperiodic."):
        if "_kernels" not in module.name:
            importlib.import_module(module.name)
    kinds = set()

    def visit(kind):
        for argument in typing.get_args(kind):
            visit(argument)
        if isinstance(kind, type) and kind.__module__.startswith("bayesperiodic.") and kind not in kinds:
            if dataclasses.is_dataclass(kind):
                kinds.add(kind)
                hints = typing.get_type_hints(
                    kind, localns={"pd": pd, "xr": xr}
                )  # which some modules import for types alone
                for field in dataclasses.fields(kind):
                    if field.metadata != _io.NOT_STORED:
                        visit(hints[field.name])
            for subclass in kind.__subclasses__():
                visit(subclass)

    visit(_io.Result)
    return kinds


def test_every_result_and_all_that_it_contains_can_be_loaded_from_the_module_that_defines_it():
    for kind in classes_in_files():
        assert _io._class(kind.__module__.removeprefix("bayesperiodic."), kind.__name__) is kind


def test_new_process_loads_a_result_whose_module_it_has_not_imported(solved, tmp_path):
    solved[1].save(tmp_path / "fit.h5")
    code = (
        "import sys, bayesperiodic as bp; assert 'bayesperiodic.estimation.result' not in sys.modules; "
        f"print(type(bp.load({str(tmp_path / 'fit.h5')!r})).__name__)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "MapEstimate"


@pytest.mark.parametrize(
    "module, kind",
    [
        ("", "MapEstimate"),
        ("antigravity", "MapEstimate"),
        ("subprocess", "Popen"),
        ("evil", "MapEstimate"),
        ("..evil", "MapEstimate"),
        ("../evil", "MapEstimate"),
        ("evil\n", "MapEstimate"),
        ("bayesperiodic.estimation.result", "MapEstimate"),
        ("estimation", "MapEstimate"),
        ("estimation.of_old", "MapEstimate"),
        ("estimation.result", "Popen"),
        ("estimation.result", "__import__"),
        ("estimation.result", "Experiment"),
        ("estimation.result", ["MapEstimate"]),
        ("_io", "Result"),
        ("periodic._kernels.newton", "MapEstimate"),
        (["estimation.result"], "MapEstimate"),
    ],
)
def test_file_cannot_import_or_create_other_classes(solved, tmp_path, monkeypatch, module, kind):
    (tmp_path / "evil.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    solved[1].save(tmp_path / "fit.h5")
    before = set(sys.modules)
    with changed(tmp_path / "fit.h5") as file:
        header = {"result": kind, "module": module, "fields": {"args": "true"}}
        file.attrs["bayesperiodic_result"] = json.dumps(header)
    message = f"path: must contain a result of this version of bayesperiodic, got class {str(kind)!r}; load it with"
    with pytest.raises(ValueError, match=re.escape(message)):
        bp.load(tmp_path / "fit.h5")
    assert set(sys.modules) == before


def test_result_of_an_earlier_version_without_modules_is_refused(solved, tmp_path):
    solved[1].save(tmp_path / "fit.h5")
    with changed(tmp_path / "fit.h5") as file:
        header = json.loads(file.attrs["bayesperiodic_result"])
        del header["module"]
        file.attrs["bayesperiodic_result"] = json.dumps(header)
    with pytest.raises(ValueError, match="result of this version of bayesperiodic, got class 'MapEstimate'; load it"):
        bp.load(tmp_path / "fit.h5")


def test_result_with_an_object_of_another_class_cannot_be_saved(tmp_path):
    class Experiment(bp.Experiment):
        pass

    run = Experiment("run", 2.0, {"x": [0.0, 1.0, 0.0, -1.0]}, samples=4)
    with pytest.raises(TypeError, match="result: must consist of plain data and results of bayesperiodic, got"):
        run.save(tmp_path / "run.h5")
