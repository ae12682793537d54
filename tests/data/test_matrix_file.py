"""Matrices of files that other programs have written, or of texts by hand after the formats' descriptions."""

import io
import pickle
import zipfile

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse

import bayesperiodic as bp
from bayesperiodic.data.formats import npz

# Not symmetric and not square, so that no exchange of rows and columns is overlooked.
WIDE = np.array([[1.0, 0.0, -2.5], [0.0, 4.0, 3.0]])
SQUARE = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, 7.0], [5.0, -1.0, 1.0]])
SPARSE_FORMATS = ("csr", "csc", "coo", "dia", "bsr")
REAL = "%%MatrixMarket matrix {} real {}\n"


def market(text, folder):
    """Return the path of a text in the MatrixMarket format."""
    path = folder / "K.mtx"
    path.write_text(text)
    return path


def matlab(path, arrays):
    """Write arrays as MATLAB's version 7.3 does: in HDF5 with the axes exchanged, sparse ones as groups."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            if scipy.sparse.issparse(array):
                group, columns = file.create_group(name), array.tocsc()
                group.attrs["MATLAB_class"], group.attrs["MATLAB_sparse"] = (
                    np.bytes_("double"),
                    np.uint64(array.shape[0]),
                )
                group["jc"] = columns.indptr.astype(np.uint64)
                if array.nnz:
                    group["ir"], group["data"] = columns.indices.astype(np.uint64), columns.data
            else:
                file[name] = array.T
                file[name].attrs["MATLAB_class"] = np.bytes_("double")
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    with path.open("r+b") as file:
        file.write(head)
    return path


@pytest.mark.parametrize("given", [WIDE, SQUARE, WIDE.T])
def test_matrices_of_python_and_matlab_are_read_as_they_were_written(given, tmp_path):
    np.savez(tmp_path / "a.npz", K=given, M=np.eye(2))
    np.save(tmp_path / "a.npy", np.asfortranarray(given))
    scipy.io.savemat(tmp_path / "a.mat", {"K": given, "s": {"C": given}, "S": scipy.sparse.csc_array(given)})
    matlab(
        tmp_path / "b.mat", {"K": given, "S": scipy.sparse.csc_array(given), "empty": scipy.sparse.csc_array((2, 3))}
    )
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["K"], file["part/K"] = given, 2 * given
    scipy.io.mmwrite(tmp_path / "a.mtx", given)
    for file, name in [
        ("a.npy", None),
        ("a.mtx", None),
        ("a.npz", "K"),
        ("a.mat", "K"),
        ("a.mat", "s.C"),
        ("a.mat", "S"),
        ("b.mat", "K"),
        ("b.mat", "S"),
    ]:
        np.testing.assert_array_equal(bp.read_matrix(tmp_path / file, name), given)
    np.testing.assert_array_equal(bp.read_matrix(tmp_path / "a.h5", "part/K"), 2 * given)
    np.testing.assert_array_equal(bp.read_matrix(str(tmp_path / "b.mat"), "empty"), np.zeros((2, 3)))


@pytest.mark.parametrize("form", SPARSE_FORMATS)
def test_sparse_matrices_of_scipy_need_no_name(form, tmp_path):
    for kind in (scipy.sparse.csr_array, scipy.sparse.csr_matrix):
        scipy.sparse.save_npz(tmp_path / "K.npz", kind(WIDE).asformat(form))
        np.testing.assert_array_equal(bp.read_matrix(tmp_path / "K.npz"), WIDE)


def test_symmetric_matrix_of_one_triangle_is_whole(tmp_path):
    """Entries from one, of the lower triangle; arrays in columns."""
    whole = [[2.0, -1.0, 0.0], [-1.0, 3.0, 0.5], [0.0, 0.5, 4.0]]
    entries = "% FE model\n3 3 5\n1 1 2\n2 1 -1\n2 2 3.0\n3 2 5e-1\n3 3 4\n"
    assert bp.read_matrix(market(REAL.format("coordinate", "symmetric") + entries, tmp_path)).tolist() == whole
    columns = "3 3\n2\n-1\n0\n3\n.5\n4\n"
    assert bp.read_matrix(market(REAL.format("array", "symmetric") + columns, tmp_path)).tolist() == whole
    turning = REAL.format("coordinate", "skew-symmetric") + "2 2 1\n2 1 3\n"
    assert bp.read_matrix(market(turning, tmp_path)).tolist() == [[0.0, -3.0], [3.0, 0.0]]


@pytest.mark.parametrize("entries", ["1 1 2\n2 1 -1\n2 2 2\n", "1 1 2\n1 2 -1\n2 2 2\n"])
def test_one_triangle_of_a_general_matrix_is_warned_of(entries, tmp_path):
    path = market(REAL.format("coordinate", "general") + "2 2 3\n" + entries, tmp_path)
    with pytest.warns(UserWarning, match=r"K.mtx: all values of 'K' (above|below) the diagonal are zero; .* K \+ K.T"):
        assert (bp.read_matrix(path) != 0.0).sum() == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (REAL.format("coordinate", "symmetric") + "2 2 3\n1 1 2\n2 1 -1\n1 2 -1\n", "two values in one place or, of a"),
        (REAL.format("coordinate", "general") + "2 2 3\n1 1 2\n1 1 2\n2 2 1\n", r"two values in one place\)"),
        ("%%MatrixMarket matrix coordinate pattern general\n2 2 1\n1 1\n", "its values are pattern"),
        ("%%MatrixMarket matrix coordinate complex general\n2 2 1\n1 1 2 0\n", "its values are complex"),
        (REAL.format("coordinate", "general") + "2 2 3\n1 1 2\n", "must be a MatrixMarket file"),
        (REAL.format("coordinate", "general") + "2 2 1\n3 1 2\n", "must be a MatrixMarket file"),
        (REAL.format("coordinate", "general") + "99999999 99999999 1\n1 1 2\n", "more than 2.15 GB"),
        (REAL.format("coordinate", "general") + "2 2 9999999999\n1 1 2\n", "more than it has bytes"),
        ("%%MatrixMarket\n", "must be a MatrixMarket file"),
    ],
)
def test_other_or_damaged_files_of_matrix_market_are_refused(text, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        bp.read_matrix(market(text, tmp_path))


def test_units_are_converted_to_si(tmp_path):
    np.save(tmp_path / "K.npy", SQUARE)
    for unit, factor in {"N/mm": 1e3, "kN/m": 1e3, "t": 1e3, "N*s/mm": 1e3, "lb": 0.45359237, "kg": 1.0}.items():
        np.testing.assert_allclose(bp.read_matrix(tmp_path / "K.npy", unit=unit), factor * SQUARE, rtol=1e-14)
    for unit in ("newtonpermm", "dB", "N//mm"):
        with pytest.raises(ValueError, match="unit: must be a unit such as 'N/mm', got"):
            bp.read_matrix(tmp_path / "K.npy", unit=unit)


def test_messages_name_the_file_and_its_arrays(tmp_path):
    np.savez(tmp_path / "beam.npz", M=SQUARE, K=SQUARE, t=np.arange(3.0), note=np.array(["text"]))
    for name, message in {
        None: "name of a matrix in 'beam.npz': must be given, one of 'M', 'K', 't', 'note', got None",
        "k": "name of a matrix in 'beam.npz': must be one of 'M', 'K', 't', 'note', got 'k'. Did you mean 'K'?",
        "t": r"must be a matrix of real numbers, got 't' of shape \(3,\)",
        "note": "must be a matrix of real numbers, got 'note'",
    }.items():
        with pytest.raises(ValueError, match=message):
            bp.read_matrix(tmp_path / "beam.npz", name)
    (tmp_path / "K.csv").write_text("1,2\n3,4\n")
    with pytest.raises(ValueError, match="must be a MatrixMarket, NPZ, NPY, MAT or HDF5 file, got .*numpy.loadtxt"):
        bp.read_matrix(tmp_path / "K.csv")
    with pytest.raises(FileNotFoundError):
        bp.read_matrix(tmp_path / "none.mtx")
    with pytest.raises(ValueError, match=r"stiffness: must be a matrix, got 'K.mtx'; read a file by read_matrix"):
        bp.Model.from_matrices("x", mass=np.eye(2), stiffness="K.mtx", outputs={"x": (0, "displacement")})


def test_links_and_pickled_objects_are_not_followed(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["K"] = SQUARE
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["K"], file["linked"] = h5py.ExternalLink("other.h5", "K"), h5py.SoftLink("/K")
    for name in ("K", "linked"):
        with pytest.raises(ValueError, match="a link or data of another file"):
            bp.read_matrix(tmp_path / "a.h5", name)
    np.save(tmp_path / "a.npy", np.array([{}], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "a.npz", K=np.array([[{}]], dtype=object))
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(SQUARE))
    for file in ("a.npy", "a.npz", "a.pkl"):
        with pytest.raises(ValueError):
            bp.read_matrix(tmp_path / file)


def test_sparse_matrix_whose_places_are_wrong_is_refused(tmp_path):
    """A file whose matrix has one column less than its places need, and one with a shape that is too large."""
    scipy.sparse.save_npz(tmp_path / "K.npz", scipy.sparse.csr_array(SQUARE), compressed=False)
    with np.load(tmp_path / "K.npz") as stored:
        arrays = dict(stored)
    arrays["shape"] = np.array([len(SQUARE), len(SQUARE) - 1])
    np.savez(tmp_path / "K.npz", **arrays)
    with pytest.raises(ValueError, match="path: must be an NPZ file of a sparse matrix"):
        bp.read_matrix(tmp_path / "K.npz")
    arrays["shape"] = np.array([10**9, 10**9])
    np.savez(tmp_path / "K.npz", **arrays)
    with pytest.raises(ValueError, match="it has the shape"):
        bp.read_matrix(tmp_path / "K.npz")


@pytest.mark.parametrize(
    ("form", "name"),
    [("coo", "row"), ("coo", "col"), ("csr", "indices"), ("csr", "indptr"), ("bsr", "indptr"), ("dia", "offsets")],
)
def test_places_outside_of_a_sparse_matrix_are_refused_before_scipy_uses_them(form, name, tmp_path, monkeypatch):
    scipy.sparse.save_npz(tmp_path / "K.npz", scipy.sparse.coo_array(np.eye(2)).asformat(form), compressed=False)
    assert np.array_equal(bp.read_matrix(tmp_path / "K.npz"), np.eye(2))
    with np.load(tmp_path / "K.npz") as stored:
        arrays = dict(stored)
    arrays[name][-1] = -1 if name == "indptr" else 3
    np.savez(tmp_path / "K.npz", **arrays)
    monkeypatch.setattr(scipy.sparse, "load_npz", None)
    with pytest.raises(ValueError, match=f"its '{name}' "):
        bp.read_matrix(tmp_path / "K.npz")


@pytest.mark.parametrize("shape", [(20_000, 10_000), (200_000, 200_000), (2, 2), (2, 4)])
def test_size_of_an_array_is_that_of_its_header_before_memory_is_allocated(shape, tmp_path, monkeypatch):
    """Files with 6 numbers whose headers state up to 320 GB."""
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(content, {"descr": "<f8", "fortran_order": False, "shape": shape})
    content.write(np.zeros(6).tobytes())
    (tmp_path / "K.npy").write_bytes(content.getvalue())
    with zipfile.ZipFile(tmp_path / "K.npz", "w") as archive:
        archive.writestr("K.npy", content.getvalue())
    monkeypatch.setattr(np.lib.format, "read_array", None)
    for name in ("K.npy", "K.npz"):
        with pytest.raises(ValueError, match="its array 'K' has another size than its header says"):
            bp.read_matrix(tmp_path / name)


@pytest.mark.parametrize("name", ["K.npy", "K.npz"])
def test_array_above_the_limit_is_refused(name, tmp_path, monkeypatch):
    (np.save if name == "K.npy" else np.savez)(tmp_path / name, **{"arr" if name == "K.npy" else "K": np.eye(20)})
    assert np.array_equal(bp.read_matrix(tmp_path / name), np.eye(20))
    monkeypatch.setattr(npz, "LARGEST_ARRAY", 3200)
    with pytest.raises(ValueError, match="its array 'K' has more than"):
        bp.read_matrix(tmp_path / name)


@pytest.mark.parametrize("form", ["mtx", "npz", "sparse.npz", "npy", "mat", "7.3.mat", "h5"])
@pytest.mark.filterwarnings("ignore:K. all values")
def test_damaged_files_are_read_or_refused(form, tmp_path):
    """200 files of each format with bytes changed or cut off: a matrix or one ValueError."""
    path, random = tmp_path / f"K.{form}", np.random.default_rng(3)
    writers = {
        "mtx": lambda: scipy.io.mmwrite(path, scipy.sparse.coo_array(SQUARE)),
        "npz": lambda: np.savez(path, K=SQUARE),
        "sparse.npz": lambda: scipy.sparse.save_npz(path, scipy.sparse.csr_array(SQUARE), compressed=False),
        "npy": lambda: np.save(path, SQUARE),
        "mat": lambda: scipy.io.savemat(path, {"K": scipy.sparse.csc_array(SQUARE)}),
        "7.3.mat": lambda: matlab(path, {"K": scipy.sparse.csc_array(SQUARE)}),
        "h5": lambda: h5py.File(path, "w").create_dataset("K", data=SQUARE).file.close(),
    }
    writers[form]()
    whole, refused = path.read_bytes(), 0
    np.testing.assert_array_equal(bp.read_matrix(path), SQUARE)
    for number in range(200):
        content = bytearray(whole)
        for place in random.integers(0, len(content), 1 + number % 4):
            content[place] = random.integers(0, 256)
        path.write_bytes(content[: random.integers(1, len(content))] if number % 5 == 0 else content)
        try:
            assert bp.read_matrix(path).ndim == 2
        except ValueError as error:
            assert "must be" in str(error)
            refused += 1
    assert refused > 20
