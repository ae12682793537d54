from studies.common import remembered


def test_cached_part_is_recomputed_for_another_source(tmp_path):
    made = []

    def make():
        made.append(len(made))
        return made[-1], lambda: "pickled by value"

    path = tmp_path / "parts" / "A.pkl"
    assert [remembered(path, source, make)[0] for source in ("first", "first", "second")] == [0, 0, 1]
    assert remembered(path, "second", make)[1]() == "pickled by value"
    assert [file.name for file in path.parent.iterdir()] == ["A.pkl"]
