"""Units in names of columns: quantities, brackets, and words that may be units."""

import pytest

from bayesperiodic.data.formats import header_units


@pytest.mark.parametrize(
    "text, name, quantity",
    [
        ("N", "F", True), ("N", "Force left", True), ("N", "KRAFT", True), ("N", "f", False), ("N", "Fx", False),
        ("N", "F [N]", True),
        ("N", "F(t) (N)", True), ("N", "F / N", True), ("N", "re-force", False), ("m", "Weg", True),
        ("m", "Position 2", True),
        ("g", "a", True), ("g", "acc", True), ("g", "A", False), ("s", "t", True), ("s", "T", False),
        ("s", "Zeit", True),
        ("mm", "weg", False), ("mm", "", False), ("N", "", False), ("K", "T", True), ("K", "Temp.", True),
    ],
)  # fmt: skip
def test_quantities_of_units_of_one_letter(text, name, quantity):
    """A word that the name begins with in any case, or a letter that is the whole name."""
    assert header_units._is_quantity(text, name) is quantity


@pytest.mark.parametrize(
    "name, unit",
    [
        ("ab <mm>", "mm?"), ("ab {kN}", "kN?"), ("[mm] ab", "mm?"), ("(ms) time", "ms?"), ("time <min>", "min?"),
        ("<h> time", "h?"),
        ("ab <min>", ""), ("ab <N>", ""), ("time_min", "min?"), ("x_min", ""), ("x ms", "ms?"), ("x, us", "us?"),
        ("t.h", "h?"),
        ("x", ""), ("", ""), ("ms", ""), ("time", ""), ("a" * 297 + " ms", "ms?"), ("a" * 298 + " ms", ""),
    ],
)  # fmt: skip
def test_words_of_a_name_that_may_be_units(name, unit):
    assert header_units._possible(name) == unit


@pytest.mark.parametrize(
    "style, texts, names, meant",
    [
        ("[", ["mm"], ["x [mm]"], True), ("[", ["smoot"], ["x [smoot]"], False),
        ("[", ["smoot", "mm"], ["x", "y"], True),
        ("[", ["1"], ["x [1]"], False), ("[", ["1, 2", "mm"], ["x", "y"], False),
        ("(", ["smoot", "mm"], ["x", "y"], False),
        ("(", ["mm"], ["x (mm)"], True), ("(", ["N"], ["x (N)"], False), ("(", ["N"], ["Force (N)"], True),
        ("(", ["N", "m"], ["qa (N)", "qb (m)"], True), ("(", ["N", "m"], ["q (N)", "qb (m)"], False),
        ("(", ["N", "N"], ["qa (N)", "qb (N)"], False), ("(", ["N", "m"], ["qa (N)", "qb (m)", "qc"], False),
        ("(", ["N", "mm"], ["qa (N)", "qb (mm)", "qc"], True), ("(", ["N", "left"], ["qa (N)", "qb (left)"], False),
        ("(", ["N", "mm", "left"], ["qa (N)", "qb (mm)", "qc (left)"], False),
    ],
)  # fmt: skip
def test_units_are_meant_where_they_are_known_and_evident_or_differ(style, texts, names, meant):
    assert header_units._is_meant(style, 0, dict(enumerate(texts)), names) is meant


@pytest.mark.parametrize(
    "texts, mostly",
    [
        (["s", "one"], False), (["s", "mm", "one"], True), (["-"], False), ([], False), (["-", "s"], True),
        (["", "s"], True), (["", ""], False),
    ],
)  # fmt: skip
def test_rows_are_mostly_units_if_more_than_half_are(texts, mostly):
    assert header_units.mostly_known(texts) is mostly


def test_units_beyond_ascii_of_another_encoding_are_refused():
    texts = {0: "µm", 2: "æm", 3: "smoot", 4: "°C"}
    assert header_units.in_other_encoding(texts) == {
        2: "its unit 'æm' in an encoding that is not known; give encoding="
    }
