"""NPZ files: their arrays, and members that are repeated, of another version, damaged, or too large."""

import io
import zipfile

import numpy as np
import pytest

from bayesperiodic.data.formats import npz

X = np.arange(6.0)


def member(array, version=None):
    """Return the content of an array."""
    content = io.BytesIO()
    np.lib.format.write_array(content, array, version)
    return content.getvalue()


def written(path, members):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members:
            archive.writestr(name, content)
    return path


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_array_whose_name_is_repeated_is_listed_once_and_refused(tmp_path):
    """Others before and after it are read, and have their sizes."""
    members = [("t.npy", member(X)), ("x.npy", member(X)), ("x.npy", member(2 * X)), ("y.npy", member(X.reshape(2, 3)))]
    whole = npz.contents(written(tmp_path / "run.npz", members), [])
    assert [(one.name, one.samples) for one in whole.channels] == [("t", 6), ("x", 6), ("y", 6)]
    t, x, y = whole.channels
    assert np.array_equal(t.values(), X) and np.array_equal(y.values(), X.reshape(2, 3))
    with pytest.raises(ValueError, match="it has two arrays 'x'"):
        x.values()


@pytest.mark.parametrize(
    "content, samples, reason",
    [
        (member(X)[:-8], 6, "its array 'x' has another size than its header says"),
        (member(X) + b"1", 6, "its array 'x' has another size than its header says"),
        (member(X, (2, 0)), 6, None),
        (member(X, (3, 0)), 0, "it is a table with named columns"),
        (member(np.array([1, "a"], dtype=object)), 2, "Object arrays cannot be loaded when allow_pickle=False"),
        (b"no array", 0, "magic string is not correct"),
    ],
)
def test_members_have_the_size_of_their_header_and_plain_arrays(tmp_path, content, samples, reason):
    (x,) = npz.contents(written(tmp_path / "run.npz", [("x.npy", content)]), []).channels
    assert x.samples == samples
    if reason is None:
        assert np.array_equal(x.values(), X)
    else:
        with pytest.raises(ValueError, match=reason):
            x.values()


@pytest.mark.parametrize("limit, refused", [(len(member(X)) - 1, True), (len(member(X)), False)])
def test_arrays_are_limited(tmp_path, monkeypatch, limit, refused):
    monkeypatch.setattr(npz, "LARGEST_ARRAY", limit)
    (x,) = npz.contents(written(tmp_path / "run.npz", [("x.npy", member(X))]), []).channels
    if refused:
        with pytest.raises(ValueError, match="its array 'x' has more than 1.75e-07 GB; read the part that you need"):
            x.values()
    else:
        assert np.array_equal(x.values(), X)
