"""Arrays are read only if they are in the file itself. The other files here are harmless ones of the tests."""

import io
import json
import re

import h5py
import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic import _hdf5, _io
from tests.test__io import changed

NUMBERS = np.arange(1.0, 33.0)


def experiment():
    return bp.Experiment("run", 2.0, {"x": np.cos(2 * np.pi * np.arange(32) / 32)}, samples=32)


@pytest.fixture
def other(tmp_path):
    """Return a file with numbers, which no result must contain."""
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = NUMBERS
    NUMBERS.tofile(tmp_path / "other.bin")
    return tmp_path


def referring(group, name, how, folder):
    """Replace an array by one that refers to other data."""
    shape, kind = group[name].shape, group[name].dtype
    del group[name]
    if how == "virtual dataset":
        layout = h5py.VirtualLayout(shape, kind)
        layout[...] = h5py.VirtualSource(str(folder / "other.h5"), "x", shape)
        group.create_virtual_dataset(name, layout)
    elif how == "external storage":
        group.create_dataset(name, shape, kind, external=[(str(folder / "other.bin"), 0, 8 * int(np.prod(shape)))])
    elif how == "external link":
        group[name] = h5py.ExternalLink(str(folder / "other.h5"), "x")
    elif how == "soft link":
        group["of another name"] = np.ones(shape)
        group[name] = h5py.SoftLink(f"{group.name}/of another name")
    elif how == "link to nothing":
        group[name] = h5py.SoftLink("/nothing")
    elif how == "not written":
        group.create_dataset(name, shape, kind)
    elif how == "partly written":
        group.create_dataset(name, (32, *shape), kind, chunks=(1, *shape))[0] = 1.0
    elif how == "compressed":  # 6 kB of 8 MB
        group.create_dataset(name, data=np.zeros(1_000_000), compression="gzip")
    else:
        group.create_group(name)


HOW = [
    "virtual dataset", "external storage", "external link", "soft link", "link to nothing", "not written",
    "partly written", "compressed", "group",
]  # fmt: skip


@pytest.mark.parametrize("how", HOW)
def test_result_with_an_array_that_is_not_in_it_is_refused(other, how):
    path = other / "run.h5"
    experiment().save(path)
    with changed(path) as file:
        group = file[_io.ARRAYS]
        referring(group, max(group, key=lambda name: group[name].size), how, other)
    with pytest.raises(ValueError, match=r"path: must be a file written by save\(\), got .*(variable|array) '"):
        bp.load(path)


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("where", ["posterior/k", "arrays/0"])
def test_posterior_with_an_array_that_is_not_in_it_is_refused(solved, other, how, where):
    """Also if the array is one that the header does not name, because xarray looks at all."""
    path, (group, _, name) = other / "posterior.nc", where.rpartition("/")
    solved[2].save(path)
    with changed(path) as file:
        if where not in file:
            file[where] = NUMBERS
        referring(file[group], name, how, other)
        if how == "group":
            file[group][name][name] = h5py.SoftLink("/posterior")
    with pytest.raises(ValueError, match=r"path: must be a file written by save\(\), got .*(variable|array) '"):
        bp.load(path)


@pytest.mark.parametrize("how", ["external link", "soft link"])
def test_group_of_arrays_that_is_a_link_is_refused(other, how):
    path = other / "run.h5"
    experiment().save(path)
    with h5py.File(other / "other.h5", "a") as file:
        for number in range(10):
            file[f"{_io.ARRAYS}/{number}"] = NUMBERS
    with changed(path) as file:
        file.move(_io.ARRAYS, "elsewhere")
        file[_io.ARRAYS] = (
            h5py.SoftLink("/elsewhere") if how == "soft link" else h5py.ExternalLink(str(other / "other.h5"), "arrays")
        )
    with pytest.raises(ValueError, match="its variable 'arrays' is missing or not in this file, but a link"):
        bp.load(path)


@pytest.mark.parametrize("how", HOW)
def test_arrays_that_the_header_does_not_name_are_not_read(other, how, monkeypatch):
    path = other / "run.h5"
    experiment().save(path)
    with changed(path) as file:
        file[f"{_io.ARRAYS}/unused"] = NUMBERS
        referring(file[_io.ARRAYS], "unused", how, other)
    assert np.array_equal(bp.load(path).outputs["x"], experiment().outputs["x"])


@pytest.mark.parametrize("key", ["../arrays/0", "/arrays/0", ".", "", "0/..", 7, None, ["0"]])
def test_names_of_arrays_are_no_paths(other, key):
    path = other / "run.h5"
    experiment().save(path)
    with changed(path) as file:
        text = re.sub(r'\{"array": "\d+"\}', json.dumps({"array": key}), file.attrs[_io.HEADER])
        file.attrs[_io.HEADER] = text
    with pytest.raises(ValueError, match="path: must be a file written by save"):
        bp.load(path)


def test_an_array_that_is_named_many_times_is_read_once(other, monkeypatch):
    """A short header must not become a large result."""
    path, read = other / "run.h5", []
    experiment().save(path)
    with changed(path) as file:
        group = file[_io.ARRAYS]
        group.create_dataset("numbers", data=np.ones(10_000))
        for number in range(100):
            group[f"same {number}"] = group["numbers"]  # hard links
        header = {"sequence": [{"array": "numbers"}] * 1000}
        file.attrs[_io.HEADER] = json.dumps(header)
    check = _hdf5._check
    monkeypatch.setattr(_hdf5, "_check", lambda item, *given: read.append(item.name) or check(item, *given))
    with pytest.raises(ValueError, match="it contains a tuple"):
        bp.load(path)
    assert len(read) == 1
    with changed(path) as file:
        file.attrs[_io.HEADER] = json.dumps({"sequence": [{"array": f"same {n}"} for n in range(100)]})
    with pytest.raises(ValueError, match="has more bytes than the file"):
        bp.load(path)
    assert len(read) < 5


def test_texts_that_refer_to_one_long_text_are_refused():
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file.create_dataset("texts", data=["a" * 1000] * 10, dtype=h5py.string_dtype())
    _hdf5.check_all(content.getvalue())
    with (
        h5py.File(content, "r") as file,
        pytest.raises(ValueError, match="its array 'texts' has more than 5e-06 GB; ask"),
    ):
        _hdf5.values(file["texts"], 5000.0, "ask")


def test_file_above_the_limit_is_refused_before_it_is_read_unless_asked(other, monkeypatch):
    path = other / "run.h5"
    experiment().save(path)
    size = path.stat().st_size
    with monkeypatch.context() as patch:
        patch.setattr(_io, "read_sealed", None)
        with pytest.raises(ValueError, match=rf"path: must be a file of at most 1e-06 GB.*largest={size}\) reads it"):
            bp.load(path, largest=1000)
    assert bp.load(path, largest=size).name == "run"
    for bad in (0, -1.0, "2 GB", None, np.nan):
        with pytest.raises(ValueError, match="largest: must be"):
            bp.load(path, largest=bad)


def test_size_is_checked_before_memory_is_allocated(other, monkeypatch):
    """An array of a terabyte in a file of some kilobytes."""
    path = other / "run.h5"
    experiment().save(path)
    with changed(path) as file:
        group = file[_io.ARRAYS]
        name = max(group, key=lambda name: group[name].size)
        del group[name]
        group.create_dataset(name, (2**37,), "f8", chunks=(2**17,), compression="gzip")
    assert path.stat().st_size < 100_000
    with pytest.raises(ValueError, match="has more bytes than the file"):
        bp.load(path)


RUN = {"seed": 5, "ensembles": 2, "walkers": 8, "max_steps": 50, "progress": False}


@pytest.fixture(scope="module")
def checkpoint(solved, tmp_path_factory):
    """Return the bytes of a checkpoint."""
    path = tmp_path_factory.mktemp("checkpoint") / "run.h5"
    bp.sample(*solved[:2], checkpoint=path, **RUN)
    return path.read_bytes()


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("name", ["chain", "log_prob", "accepted"])
def test_checkpoint_with_an_array_that_is_not_in_it_is_refused(solved, checkpoint, other, how, name):
    path = other / "run.h5"
    path.write_bytes(checkpoint)
    with changed(path) as file:
        referring(file["mcmc"], name, how, other)
    with pytest.raises(ValueError, match="checkpoint: must be an intact file, got .*(variable|array|Unable|must)"):
        bp.sample(*solved[:2], checkpoint=path, **RUN)


def test_checkpoint_of_an_interrupted_run_contains_the_steps_made_and_no_more():
    from bayesperiodic.sampling.checkpoint import MemoryBackend

    backend = MemoryBackend()
    backend.reset(8, 2)
    backend.grow(100, None)
    with backend.content() as content:
        assert backend.file["mcmc/chain"].shape[0] == 0
        _hdf5.check_all(bytes(content))


def test_mat_file_that_refers_to_data_of_its_own_by_a_link_is_refused(other):
    path = other / "run.mat"
    with h5py.File(path, "w") as file:
        file["t"], file["y"] = NUMBERS[None], NUMBERS[None]
        file["x"] = h5py.SoftLink("/y")
    with pytest.raises(ValueError, match="path: must be a MAT file .*run.mat.*variable 'x' is missing or not in this"):
        bp.Recording.from_mat(path, time="t", outputs={"x": "x"})
    assert bp.Recording.from_mat(path, time="t", outputs={"x": "y"}).outputs["x"].size == 32


def test_virtual_array_of_a_mat_file_is_refused(other):
    path = other / "run.mat"
    layout = h5py.VirtualLayout((32,), float)
    layout[:] = h5py.VirtualSource(str(other / "other.h5"), "x", (32,))
    with h5py.File(path, "w") as file:
        file["t"] = NUMBERS
        file.create_virtual_dataset("x", layout)
    with pytest.raises(ValueError, match="path: must be a MAT file .*run.mat.*'x' is not an array in this file, but"):
        bp.Recording.from_mat(path, time="t", outputs={"x": "x"})
