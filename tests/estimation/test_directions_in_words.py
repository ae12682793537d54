"""Directions of parameters in words: exponents, sums, combinations."""

from fractions import Fraction

import numpy as np
import pytest

from bayesperiodic.estimation.laplace import (
    by_powers,
    by_sums,
    combinations,
    exponents,
    in_words,
    reduced,
    undetermined,
)

NAMES = ["a", "b", "c"]
BOTH = np.array([True, True, True])
NONE = ~BOTH


def test_reduced_directions_span_the_same_space_with_few_parameters():
    generator = np.random.default_rng(0)
    basis = np.array([[1.0, 2.0, 0.0, 0.0], [0.0, 0.0, 1.0, -3.0]])
    mixed = np.array([[3.0, 0.5], [1.0, -2.0]]) @ basis
    found = reduced(mixed)
    assert found == pytest.approx(basis)
    assert mixed == pytest.approx(np.array([[3.0, 0.5], [1.0, -2.0]]) @ basis), "the argument is not changed"
    many = reduced(generator.standard_normal((3, 6)))
    assert many[:, :3] == pytest.approx(np.eye(3), abs=1e-9)
    # An entry of 4 % of the largest is no pivot, one of 6 % is.
    assert reduced(np.array([[0.04, 1.0]])) == pytest.approx(np.array([[0.04, 1.0]]))
    assert reduced(np.array([[0.06, 1.2]])) == pytest.approx(np.array([[0.05, 1.0]]))
    assert reduced(np.array([[0.06, 1.0]])) == pytest.approx(np.array([[1.0, 1.0 / 0.06]]))


@pytest.mark.parametrize(
    ("direction", "expected"),
    [
        ([2.0, -1.0], [2, -1]),
        ([-2.0, 1.0], [2, -1]),
        ([0.5, 0.5, 1.0], [1, 1, 2]),
        ([1.0, 0.049], [1, 0]),
        ([3.0, 2.0], [Fraction(3, 2), 1]),
        ([4.0, 3.0], [Fraction(4, 3), 1]),
        ([1.0, 0.935], None),
        ([1.0, 0.945], [1, 1]),
        ([2.10, 1.0], [2, 1]),
        ([1.0, 0.14], None),
        ([4.0, 1.0], [4, 1]),
        ([6.0, 1.0], None),
        ([4.0, 1.0, 3.0], [4, 1, 3]),
        ([0.0, -3.0, 3.0], [0, 1, -1]),
    ],
)
def test_exponents_are_fractions_with_denominators_up_to_four(direction, expected):
    assert exponents(np.array(direction)) == expected


@pytest.mark.parametrize(
    ("direction", "logarithmic", "expected"),
    [
        ([1.0, 1.0, 0.0], BOTH, ["b/a"]),
        ([1.0, -1.0, 0.0], BOTH, ["a*b"]),
        ([1.0, -2.0, 0.0], BOTH, ["a**2*b"]),
        ([-2.0, 1.0, 0.0], BOTH, ["a*b**2"]),
        ([2.0, 1.0, 1.0], BOTH, ["a/b**2", "c/b"]),
        ([1.0, 0.0, 0.0], BOTH, []),
        ([1.0, 1.0, 0.0], np.array([True, False, True]), []),
        ([1.0, 0.14, 0.0], BOTH, []),
        ([1.0, -1.0, 0.0], NONE, ["a + b"]),
        ([1.0, 1.0, 0.0], NONE, ["a - b"]),
        ([1.0, 4.0, 0.0], NONE, ["b - 4*a"]),
        ([1.0, 0.5, -0.2], NONE, ["a - 2*b", "a + 5*c"]),
        ([1.0, 0.945, 0.0], NONE, ["a - b"]),
        ([1.0, 0.94, 0.0], NONE, ["a - 1.06*b"]),
        ([1.0, 1.0, 0.0], np.array([False, False, True]), ["a - b"]),
    ],
)
def test_combinations_do_not_change_along_the_direction(direction, logarithmic, expected):
    assert combinations(np.array(direction), NAMES, logarithmic) == expected


@pytest.mark.parametrize(
    ("direction", "logarithmic", "expected"),
    [
        ([1.0, -2.0, 0.0], BOTH, "a -> a·t, b -> b·t^-2"),
        ([1.0, 0.14, 0.0], BOTH, "a -> a·t, b -> b·t^0.14"),
        ([0.0, 2.0, 1.0], BOTH, "b -> b·t, c -> c·t^0.5"),
        ([1.0, -2.0, 0.0], NONE, "a -> a - 0.5·t, b -> b + t"),
        ([1.0, 1.0, 0.0], NONE, "a -> a + t, b -> b + t"),
        ([1.0, 1.0, 0.0], np.array([True, False, True]), "a -> a·t, b -> b + ln t"),
        ([1.0, 2.0, -0.5], np.array([False, True, False]), "a -> a + 0.5·ln t, b -> b·t, c -> c - 0.25·ln t"),
        ([1.0, 0.04, 0.0], NONE, "a -> a + t"),
    ],
)
def test_joint_changes_in_words(direction, logarithmic, expected):
    assert in_words(np.array(direction), NAMES, logarithmic) == expected


def test_powers_of_a_factor_change_the_largest_by_ten_percent():
    theta = np.array([2.0, -3.0, 5.0])
    text, there = by_powers(np.array([1.0, -2.0, 0.0]), theta, NAMES)
    assert text == "a -> a·t, b -> b·t^-2"
    assert there == pytest.approx([2.0 * 1.1**0.5, -3.0 / 1.1, 5.0])
    for unfit in ([1.0, 0.14, 0.0], [1.0, 0.0, 1.0], [1e-9, 1.0, 0.0]):
        text, there = by_powers(np.array(unfit), np.array([2.0, 3.0, 0.0]), NAMES)
        assert text == "" and there.tolist() == [2.0, 3.0, 0.0]


def test_sums_change_no_parameter_by_more_than_ten_percent():
    theta = np.array([2.0, 0.0, 5.0])
    text, there = by_sums(np.array([3.0, -1.5, 0.0]), theta, NAMES)
    assert text == "a -> a + t, b -> b - 0.5·t"
    assert there == pytest.approx(theta + 0.1 * np.array([2.0, -1.0, 0.0]))
    text, there = by_sums(np.array([0.0, -1.0, 8.0]), theta, NAMES)
    assert text == "b -> b + t, c -> c - 8·t"
    assert there == pytest.approx(theta + 0.1 * np.array([0.0, 5.0 / 8.0, -5.0]))


def vanishing(residuals, theta, names, logarithmic):
    """Return the directions along which residuals(θ) do not change, by central differences."""
    theta = np.array(theta)
    columns = [(residuals(theta + e) - residuals(theta - e)) / 2e-6 for e in 1e-6 * np.eye(theta.size)]
    jacobian = np.array(columns).T
    change = lambda there: float(np.linalg.norm(residuals(there) - residuals(theta)))  # noqa: E731
    return undetermined(jacobian.T @ jacobian, theta, names, np.array(logarithmic), change)


def test_directions_without_information_are_named_by_sums_or_powers_or_as_combinations():
    assert vanishing(lambda t: np.array([t[0] * t[1], t[2]]), [2.0, 3.0, 1.0], NAMES, BOTH) == (
        "a -> a·t, b -> b·t^-1",
    )
    assert vanishing(lambda t: np.array([t[0] - 2 * t[1]]), [2.0, 3.0], ["a", "b"], [False, False]) == (
        "a -> a + t, b -> b + 0.5·t",
    )
    assert vanishing(lambda t: np.array([t[0] + np.sin(t[1]), t[2]]), [2.0, 0.5, 1.0], NAMES, NONE) == (
        "a combination of a and b",
    )
    found = vanishing(lambda t: np.array([t[0] + np.sin(t[1]) + t[2] ** 3]), [2.0, 0.5, 1.0], NAMES, NONE)
    assert set(found) <= {"a combination of a and b", "a combination of a and c", "a combination of b and c"}
    assert len(found) == 2
    assert vanishing(lambda t: np.array([t[1]]), [2.0, 3.0], ["a", "b"], [True, True]) == (
        "a: no output depends on it",
    )
    assert undetermined(np.zeros((1, 1)), np.ones(1), ["a"], np.array([True]), abs) == ("a: no output depends on it",)
    assert vanishing(lambda t: t, [2.0, 0.0], ["a", "b"], [True, False]) == ()
