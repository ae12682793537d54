"""MAT files: fields of structures by their path, objects refused with what to type in MATLAB."""

import io
import pathlib
import pickle
import struct
import tracemalloc
import warnings

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse

import bayesperiodic as bp
from bayesperiodic.data.formats import mat
from tests.data.test_damaged_files import damaged

TIME = 0.01 * np.arange(50)
SWING = np.sin(5 * TIME)
NESTED = {
    "data": {"t": TIME, "x": SWING, "deep": {"n": np.arange(50, dtype=np.int16), "note": "text"}, "z": SWING + 1j},
    "y": 2 * SWING,
}
# Files that MATLAB 6.1 to 7.4 has written on several systems.
MATLAB = pathlib.Path(scipy.io.__file__).parent / "matlab/tests/data"


def element(kind, content, order="<"):
    return struct.pack(f"{order}II", kind, len(content)) + content + bytes(-len(content) % 8)


def opaque(name, kind, order="<"):
    """Return an object as MATLAB stores it: flags, name, system of types, class and a reference."""
    reference = element(6, struct.pack(f"{order}II", 13, 0), order) + element(5, struct.pack(f"{order}ii", 2, 1), order)
    reference += element(1, b"", order) + element(6, struct.pack(f"{order}II", 0xDD000000, 2), order)
    parts = element(6, struct.pack(f"{order}II", 17, 0), order)
    for text in (name, "MCOS", kind):
        parts += element(1, text.encode(), order)
    return element(14, parts + element(14, reference, order), order)


@pytest.fixture
def saved(tmp_path):
    def save(columns, compressed=False, more=b""):
        content = io.BytesIO()
        scipy.io.savemat(content, columns, do_compression=compressed)
        (tmp_path / "run.mat").write_bytes(content.getvalue() + more)
        return tmp_path / "run.mat"

    return save


@pytest.mark.parametrize("compressed", [True, False])
def test_fields_of_structures_are_read_by_their_path(saved, compressed):
    path = saved(NESTED, compressed)
    run = bp.Recording.from_file(path, time="data.t", outputs={"x": "data.x", "n": "data.deep.n"}, inputs={"y": "y"})
    assert np.array_equal(run.time, TIME) and np.array_equal(run.outputs["x"], SWING)
    assert run.outputs["n"].tolist() == [*range(50)] and np.array_equal(run.inputs["y"], 2 * SWING)
    sizes = {one.name: one.samples for one in mat.contents(path, []).channels}
    assert sizes["data.x"] == sizes["data.deep.n"] == sizes["y"] == 50
    with pytest.raises(ValueError, match=r"its variable 'data.z' is no array of real numbers, but complex"):
        bp.Recording.from_file(path, time="data.t", outputs={"z": "data.z"})
    with pytest.raises(ValueError, match=r"column of run.mat: must be one of .*Did you mean 'data.x'"):
        bp.Recording.from_file(path, time="data.t", outputs={"x": "data.X"})


def test_fields_of_structures_of_version_7_3(tmp_path):
    with h5py.File(tmp_path / "run.mat", "w", userblock_size=512) as file:
        for name, values in {"data/t": TIME, "data/deep/x": SWING, "#refs#/a": TIME, "y": SWING}.items():
            file[name] = values[None]
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["data"].attrs["MATLAB_class"] = file["data/deep"].attrs["MATLAB_class"] = np.bytes_("struct")
    run = bp.Recording.from_file(tmp_path / "run.mat", time="data.t", outputs={"x": "data.deep.x"})
    assert np.array_equal(run.time, TIME) and np.array_equal(run.outputs["x"], SWING)
    assert [one.name for one in bp.inspect(tmp_path / "run.mat").channels] == ["data", "y", "data.t", "data.deep.x"]


@pytest.mark.parametrize(
    "kind, values, stored, reason",
    [
        ("double", np.arange(6.0).reshape(2, 3), {}, None), ("logical", np.array([[1, 0, 1]], dtype="u1"), {}, None),
        ("int16", np.array([[1, -2]], dtype="i2"), {}, None), (None, np.arange(4.0)[None], {}, None),
        ("double", np.array([0, 5], dtype="u8"), {"MATLAB_empty": np.uint8(1)}, "but double"),
        ("char", np.array([[97, 98]], dtype="u2"), {"MATLAB_int_decode": 2}, "but char"),
        ("cell", np.array([[1, 2]], dtype="u8"), {}, "but cell"),
    ],
)  # fmt: skip
def test_variables_of_version_7_3_are_transposed_and_of_numbers(tmp_path, kind, values, stored, reason):
    """HDF5 has the dimensions of MATLAB in reverse order; of an empty array it has the size in place of the values."""
    with h5py.File(tmp_path / "run.mat", "w", userblock_size=512) as file:
        file["a/x"], file["x"] = values, values
        for one in (file["x"], file["a/x"]):
            one.attrs.update(({"MATLAB_class": np.bytes_(kind)} if kind else {}) | stored)
    channels = mat.contents(tmp_path / "run.mat", []).channels
    assert [(one.name, one.samples) for one in channels if one.samples] == [("x", values.size), ("a.x", values.size)]
    for one in channels:
        if reason or one.name == "a":
            with pytest.raises(ValueError, match=f"its variable 'x' is empty or no array of numbers, {reason}|'a'"):
                one.values()
        else:
            assert np.array_equal(one.values(), values.T)


@pytest.mark.parametrize("filled", [True, False])
def test_sparse_matrices_of_version_7_3_are_those_of_scipy(tmp_path, filled):
    """By columns: starts, rows and values, of which an empty matrix has the starts only."""
    matrix = scipy.sparse.random(7, 5, 0.4 if filled else 0.0, "csc", random_state=1)
    with h5py.File(tmp_path / "run.mat", "w", userblock_size=512) as file:
        for path in ("A", "data/A"):
            group = file.create_group(path)
            group["jc"] = matrix.indptr.astype("u8")
            if filled:
                group["ir"], group["data"] = matrix.indices.astype("u8"), matrix.data
            group.attrs.update({"MATLAB_class": np.bytes_("double"), "MATLAB_sparse": np.uint64(7)})
        file["data/t"], file["z"] = TIME, TIME
    channels = {one.name: one for one in mat.contents(tmp_path / "run.mat", []).channels if one.samples}
    assert {name: one.samples for name, one in channels.items()} == {"A": 35, "data.A": 35, "data.t": 50, "z": 50}
    for name in ("A", "data.A"):
        assert np.array_equal(channels[name].values(), matrix.toarray())


def matrix(name, kind, parts):
    """Return a variable of one row and one column."""
    head = element(6, struct.pack("<II", kind, 0)) + element(5, struct.pack("<ii", 1, 1)) + element(1, name)
    return element(14, head + parts)


START = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H2s", 0x0100, b"IM")
NUMBER = matrix(b"", 6, element(9, struct.pack("<d", 2.5)))


@pytest.mark.parametrize(
    "content, reason",
    [
        (matrix(b"s", 2, element(5, struct.pack("<i", 2)) + element(1, b"a\0a\0") + NUMBER + NUMBER),
         "has two fields of"),
        (matrix(b"s", 2, element(5, struct.pack("<i", 0)) + element(1, b"a\0") + NUMBER), "has names of 0 characters"),
        (matrix(b"s", 2, element(5, struct.pack("<i", 2)) + element(1, b"a\0") + element(9, bytes(8))),
         "a field of type 9"),
        (element(9, bytes(8)), "contains an element of type 9"),
        (matrix(b"x", 6, element(9, bytes(16))), "'x' has another size than its header says"),
        (matrix(b"x", 6, element(9, bytes(8)) * 2), "'x' has another size than its header says"),
        (2 * matrix(b"x", 6, element(9, bytes(8))), "it has two variables 'x'"),
    ],
)  # fmt: skip
def test_files_that_contradict_their_description_are_refused(tmp_path, content, reason):
    """Of MathWorks: fields are matrices whose names differ and end with a zero."""
    (tmp_path / "run.mat").write_bytes(START + content)
    with pytest.raises(ValueError, match=f"must be a MAT file .*run.mat.*{reason}"):
        bp.Recording.from_file(tmp_path / "run.mat", sampling_rate=1.0, outputs={"x": "x"})


def test_structures_are_searched_eight_deep_and_arrays_of_them_are_not(tmp_path):
    one = element(5, struct.pack("<i", 2)) + element(1, b"a\0")
    nested = NUMBER
    for _ in range(10):
        nested = matrix(b"", 2, one + nested)
    several = element(6, struct.pack("<II", 2, 0)) + element(5, struct.pack("<ii", 1, 2)) + element(1, b"m")
    content = START + matrix(b"s", 2, one + nested) + element(14, several + one + NUMBER + NUMBER)
    (tmp_path / "run.mat").write_bytes(content)
    assert {one.name: one.samples for one in mat.contents(tmp_path / "run.mat", []).channels} == {"s": 1, "m": 2}
    inner = NUMBER
    for _ in range(7):
        inner = matrix(b"", 2, one + inner)
    (tmp_path / "run.mat").write_bytes(START + matrix(b"s", 2, one + inner))
    _, deepest = mat.contents(tmp_path / "run.mat", []).channels
    assert (deepest.name, deepest.values().tolist()) == ("s" + ".a" * 8, [[2.5]])


def test_an_empty_field_does_not_hide_those_after_it(tmp_path):
    """Of a structure, an empty field is a matrix without content; also as the only member of a structure in it."""
    fields = element(5, struct.pack("<i", 2)) + element(1, b"a\0b\0")
    inner = matrix(b"", 2, fields + element(14, b"") + matrix(b"", 6, element(9, struct.pack("<d", 2.5))))
    (tmp_path / "run.mat").write_bytes(START + matrix(b"s", 2, fields + element(14, b"") + inner))
    _, value = mat.contents(tmp_path / "run.mat", []).channels
    assert (value.name, value.samples, value.values().tolist()) == ("s.b.b", 1, [[2.5]])


@pytest.mark.parametrize(
    "kind, typed",
    [
        ("table", "s = table2struct(T, 'ToScalar', true)"), ("timetable", "seconds(T.Properties.RowTimes"),
        ("timeseries", "t = T.Time"), ("datetime", "t = seconds(T - T(1))"), ("MyClass", "x = double(T.x)"),
    ],
)  # fmt: skip
def test_objects_are_refused_with_what_to_type_in_matlab(saved, tmp_path, kind, typed):
    path = saved({"y": SWING}, more=opaque("T", kind))
    with pytest.raises(
        ValueError, match=f"column 'T' of run.mat: must be usable, got a MATLAB object .{kind}."
    ) as error:
        bp.Recording.from_file(path, sampling_rate=1.0, outputs={"x": "T"})
    assert typed in str(error.value) and typed in str(bp.inspect(path))
    assert np.array_equal(bp.Recording.from_file(path, sampling_rate=1.0, outputs={"y": "y"}).outputs["y"], SWING)
    with h5py.File(tmp_path / "new.mat", "w", userblock_size=512) as file:
        file["T"] = np.array([[0xDD000000, 2, 1, 1, 1, 1]], dtype=np.uint32)
        file["T"].attrs.update({"MATLAB_class": np.bytes_(kind), "MATLAB_object_decode": 3})
    with pytest.raises(ValueError, match=f"must be usable, got a MATLAB object .{kind}."):
        bp.Recording.from_file(tmp_path / "new.mat", sampling_rate=1.0, outputs={"x": "T"})


@pytest.mark.parametrize("path", sorted(MATLAB.glob("*.mat")), ids=lambda path: path.stem)
def test_files_that_matlab_has_written_are_shown_or_refused(path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            shown = bp.inspect(path)
        except ValueError as error:
            assert "must be" in str(error)
            return
    str(shown).encode("cp1252")
    stored = {}
    if not path.name.startswith(("testhdf5", "bad", "malformed", "corrupted")):
        stored = scipy.io.loadmat(path, struct_as_record=False, squeeze_me=True, mat_dtype=False)
    for channel in shown.channels:
        value = stored.get(channel.name)
        if not channel.refused and isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and value.ndim == 1:
            assert (channel.low, channel.high) == (value.min(), value.max())


@pytest.mark.parametrize("compressed", [True, False])
def test_damaged_file_is_refused_or_read_as_a_whole(saved, tmp_path, compressed):
    whole, generator = saved(NESTED, compressed, opaque("T", "table")).read_bytes(), np.random.default_rng(3)
    path = tmp_path / "run 7"
    for _ in range(200):
        path.write_bytes(damaged(whole, generator))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                bp.inspect(path, format="mat")
                run = bp.Recording.from_file(path, time="data.t", outputs={"x": "data.x", "y": "y"}, format="mat")
            except ValueError as error:
                assert "must" in str(error)
                continue
        assert run.time.size == 50


def test_compressed_variable_that_is_cut_off_is_named(saved):
    """The deflate stream of the last variable lacks its end, and the element that contains it says so."""
    path = saved({"y": SWING, "z": TIME}, compressed=True)
    content = path.read_bytes()
    start = content.rindex(struct.pack("<I", 15), 128, len(content))
    size = struct.unpack("<I", content[start + 4 : start + 8])[0] - 20
    path.write_bytes(content[: start + 4] + struct.pack("<I", size) + content[start + 8 : start + 8 + size])
    with pytest.raises(ValueError, match="variable 'z' is cut off"):
        bp.Recording.from_file(path, sampling_rate=1.0, outputs={"z": "z"})
    assert np.array_equal(bp.Recording.from_file(path, sampling_rate=1.0, outputs={"y": "y"}).outputs["y"], SWING)


@pytest.mark.parametrize("order", ["<", ">"])
def test_version_4_is_named_with_its_conversion(tmp_path, order):
    """Written after MathWorks' "MAT-File Format": type, rows, columns, real numbers, length of the name."""
    path = tmp_path / "run.mat"
    head = struct.pack(f"{order}5i", {"<": 0, ">": 1000}[order], 50, 1, 0, 2)
    path.write_bytes(head + b"x\0" + (SWING + np.pi).astype(f"{order}f8").tobytes())
    assert np.allclose(scipy.io.loadmat(path)["x"].ravel(), SWING + np.pi)
    with pytest.raises(ValueError, match=r"got '.*run.mat', a MAT file of version 4; .*save\('run.mat', '-v7'\)"):
        bp.inspect(path)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_pickle_is_named_and_never_unpickled(tmp_path, protocol):
    path = tmp_path / "run.mat"
    path.write_bytes(pickle.dumps({"x": SWING}, protocol))
    with pytest.raises(ValueError, match="a pickle of Python; load it by the program that wrote it, for from_arrays"):
        bp.inspect(path)


@pytest.mark.parametrize("seed", range(5))
def test_sparse_matrices_are_those_of_scipy(seed):
    matrix = scipy.sparse.random(7, 5, 0.4, "csc", random_state=seed)
    found = mat._dense("A", matrix.shape, matrix.indices, matrix.indptr, matrix.data)
    assert np.array_equal(found, matrix.toarray())


@pytest.mark.parametrize(
    "places, starts, values, reason",
    [
        ([0, 2], [0, 1, 2], [1.0, 2.0], ""), ([0, 3], [0, 1, 2], [1.0, 2.0], "rows beyond its size"),
        ([0, -1], [0, 1, 2], [1.0, 2.0], "rows beyond its size"),
        ([0, 2], [0, 1], [1.0, 2.0], "other starts of columns"),
        ([0, 2], [0, 1, 3], [1.0, 2.0], "other starts of columns"), ([0, 2], [1, 1, 2], [1.0, 2.0], "other starts of"),
        ([0, 2], [0, 2, 1], [1.0, 2.0], "other starts of columns"),
        ([2, 2], [0, 2, 2], [1.0, 2.0], "two values in one"),
        ([2, 2], [0, 1, 2], [1.0, 2.0], ""), ([0, 1], [0, 1, 1], [1.0, 2.0], ""), ([], [0, 0, 0], [], ""),
        ([0, 2], [0, 1, 2], [1.0j, 2.0], "is no matrix of real numbers"),
        ([0], [0, 1, 2], [1.0, 2.0], "other starts of"),
        ([0, 2], [0, 1, 2], [1.0], "other starts of columns"),
    ],
)  # fmt: skip
def test_places_of_sparse_matrices_are_checked(places, starts, values, reason):
    """Of three rows and two columns; values beyond those used are ignored."""
    arguments = "A", (3, 2), np.array(places, int), np.array(starts), np.array(values)
    if reason:
        with pytest.raises(ValueError, match=f"^its (matrix|variable) 'A' .*{reason}"):
            mat._dense(*arguments)
        return
    expected = np.zeros((3, 2))
    for column in range(2):
        for k in range(starts[column], starts[column + 1]):
            expected[places[k], column] = values[k]
    assert np.array_equal(mat._dense(*arguments), expected)


def test_matrices_of_more_than_the_limit_are_refused(monkeypatch):
    given = np.array([0]), np.array([0, 1, 1]), np.array([1.0])
    for limit, refused in ((48, False), (47, True)):
        monkeypatch.setattr(mat, "LARGEST_ARRAY", limit)
        if refused:
            with pytest.raises(
                ValueError, match="its matrix 'A' has more than 4.7e-08 GB; read the part that you need"
            ):
                mat._dense("A", (3, 2), *given)
        else:
            assert mat._dense("A", (3, 2), *given)[0, 0] == 1.0


def test_objects_of_matlab_are_refused_with_what_to_type():
    assert mat.object_refusal("duration", "s.d") == (
        "a MATLAB object (duration), whose format is not documented; in MATLAB: t = seconds(s.d); save('run.mat', 't', "
        "'-append')"
    )
    assert (
        "in MATLAB: save its numbers as plain arrays, such as x = double(s.x); save('run.mat', 'x')"
        in mat.object_refusal("odd", "s")
    )


@pytest.mark.parametrize("order", ["<", ">"])
def test_elements_are_padded_to_eight_bytes_and_small_ones_packed(order):
    """After MathWorks' description: compressed elements are not padded, and four bytes may stand in the head."""
    content = struct.pack(f"{order}II", 5, 3) + b"abc" + bytes(5) + struct.pack(f"{order}I", 2 << 16 | 1) + b"xy\0\0"
    content += struct.pack(f"{order}II", 15, 3) + b"zip" + struct.pack(f"{order}II", 9, 8) + b"12345678"
    found = [(kind, bytes(data)) for kind, data in mat._elements(memoryview(content), order)]
    assert found == [(5, b"abc"), (1, b"xy"), (15, b"zip"), (9, b"12345678")]
    with pytest.raises(ValueError, match="it is cut off"):
        list(mat._elements(memoryview(content)[:-1], order))


@pytest.mark.parametrize(
    "value, what",
    [("text", "of MATLAB class 4"), (np.array([1, "a"], dtype=object), "of MATLAB class 1"), (1j * TIME, "complex")],
)
def test_other_variables_are_refused_with_their_class(tmp_path, value, what):
    """MathWorks numbers the classes: cells are 1, texts are 4."""
    path = tmp_path / "run.mat"
    scipy.io.savemat(path, {"t": TIME, "v": value})
    with pytest.raises(ValueError, match=f"its variable 'v' is no array of real numbers, but {what}"):
        bp.Recording.from_mat(path, time="t", outputs={"x": "v"})


@pytest.mark.parametrize(
    "places, starts, values, reason",
    [
        ([0, 3], [0, 1, 2], [1.0, 2.0], "its matrix 'A' has rows beyond its size"),
        ([0, 2], [0, 1], [1.0, 2.0], "its matrix 'A' has other starts of columns than its size"), ([0, 2], [0, 1, 2],
        [1.0, 2.0], None),
    ],
)  # fmt: skip
@pytest.mark.parametrize("order", ["<", ">"])
def test_sparse_matrices_of_version_5_have_rows_starts_and_values(places, starts, values, reason, order):
    """In this order, of any type of numbers, after MathWorks' description."""
    kinds = (5, f"{order}i4", places), (12, f"{order}i8", starts), (9, f"{order}f8", values)
    parts = [(kind, memoryview(np.array(numbers, form).tobytes())) for kind, form, numbers in kinds]
    if reason:
        with pytest.raises(ValueError, match=f"^{reason}$"):
            mat._array("A", 5, [3, 2], iter(parts), order)
        return
    assert mat._array("A", 5, [3, 2], iter(parts), order).tolist() == [[1.0, 0.0], [0.0, 0.0], [0.0, 2.0]]
    with pytest.raises(ValueError, match="its variable 'A' is no array of real numbers, but complex"):
        mat._array("A", 5 | 0x800, [3, 2], iter(parts), order)


@pytest.mark.parametrize("shape", [(2, 3), (6, 1), (1, 6), (1, 2, 3), (0, 3), (-2, -3), (2, 2), (7,)])
def test_arrays_have_the_size_of_their_header_and_their_columns_in_turn(shape):
    given = np.arange(6.0)[: max(int(np.prod(shape)), 0)]
    parts = [(9, memoryview(given.tobytes()))]
    if shape in ((-2, -3), (7,)):
        with pytest.raises(ValueError, match="^its variable 'x' has another size than its header says$"):
            mat._array("x", 6, [*shape], iter(parts), "<")
        return
    assert np.array_equal(mat._array("x", 6, [*shape], iter(parts), "<"), given.reshape(shape, order="F"))
    with pytest.raises(ValueError, match="^its variable 'x' has another size than its header says$"):
        mat._array("x", 6, [*shape], iter(2 * parts), "<")


def test_variables_are_listed_without_unpacking_them(saved):
    """Of 8 MB of zeros, 4 kB are unpacked for the name and the size."""
    path = saved({"t": np.zeros(10**6), "x": np.ones((2, 5))}, compressed=True)
    tracemalloc.start()
    try:
        channels = mat.contents(path, []).channels
        assert tracemalloc.get_traced_memory()[1] < 10**6
    finally:
        tracemalloc.stop()
    assert [(one.name, one.samples) for one in channels] == [("t", 10**6), ("x", 10)]
    assert channels[1].values().tolist() == [[1.0] * 5] * 2 and not channels[0].values().any()


def test_compressed_variables_up_to_the_limit_are_read(saved, monkeypatch):
    """The first 4 kB, and as much as the limit says after them."""
    path = saved({"x": np.arange(1000.0)}, compressed=True)
    # Heads of the element and of the values, flags, shape and name, after MathWorks' description.
    size = 8 + 16 + 16 + 8 + 8 + 8 * 1000 - mat.HEADER_BYTES
    for limit, read in ((size, True), (size - 1, False)):
        monkeypatch.setattr(mat, "LARGEST_ARRAY", limit)
        (channel,) = mat.contents(path, []).channels
        if read:
            assert channel.values().ravel().tolist() == [*range(1000)]
        else:
            with pytest.raises(ValueError, match="its variable 'x' is cut off or has more than 3.96e-06 GB; read the"):
                channel.values()
