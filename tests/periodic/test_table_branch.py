"""Branches through the points of tables, against a continuation and against solves from rest."""

import numpy as np
import pytest

import bayesperiodic as bp
from bayesperiodic.periodic.equations import PeriodicEquations
from bayesperiodic.periodic.table_branch import between, follow

TRUTH = {"m": 1.0, "c": 0.1, "k": 1.0, "k3": 0.3}
VECTOR = np.array([TRUTH[name] for name in bp.models.duffing.parameters])
SAMPLES = 64
F = np.linspace(0.1, 0.26, 30)


def table(frequencies, force=lambda f: 0.2):
    wave = np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES)
    settings = {"samples": SAMPLES, "scheme": "central4"}
    return [
        PeriodicEquations.build(bp.models.duffing, {"force": force(f) * wave}, frequency=f, **settings)
        for f in frequencies
    ]


def passages(rows, **more):
    z = rows[0].solve(VECTOR, rows[0].static_guess(VECTOR)).z
    return list(follow(rows, [VECTOR] * len(rows), 0, z, **more))


def amplitude(passage):
    return float(np.abs(np.fft.rfft(passage.z[:, 0])[1])) * 2 / SAMPLES


def test_folds_are_those_of_a_continuation():
    force = 0.2 * np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES)
    settings = {"frequency": 0.1, "samples": SAMPLES, "scheme": "central4"}
    start = bp.solve_periodic(bp.models.duffing, TRUTH, {"force": force}, **settings)
    branch = bp.continue_periodic(bp.models.duffing, start, "frequency", until=0.3, progress=False)
    expected = [fold.frequency for fold in branch.folds]
    up, down = passages(table(F)), passages(table(F[::-1]))
    assert [p.equations.frequency for p in up if p.is_fold] == pytest.approx(expected, rel=1e-8)
    assert [p.equations.frequency for p in down if p.is_fold] == pytest.approx(expected[::-1], rel=1e-8)


def test_every_point_is_passed_once_outside_the_folds_and_three_times_between_them():
    found = passages(table(F))
    low, high = sorted(p.equations.frequency for p in found if p.is_fold)
    for k, f in enumerate(F):
        sheets = [p.sheet for p in found if p.point == k]
        assert sheets == ([0, 1, 2] if low < f < high else [0] if f < low else [2])
        upper = [amplitude(p) for p in found if p.point == k]
        assert upper == sorted(upper, reverse=True)


def test_a_table_that_ends_before_the_fold_is_followed_beyond_it_and_back():
    found = passages(table(F[F < 0.195]))
    assert [p.sheet for p in found if p.is_fold] == [0, 1]
    assert found[-1].sheet == 2 and found[-1].point == np.count_nonzero(F < 0.195) - 1
    inside = passages(table(F[F < 0.195]), further=False)
    assert not any(p.is_fold for p in inside) and inside[-1].point == len(inside) - 1


def test_points_have_the_inputs_of_their_rows_where_these_change():
    rows = table(F, lambda f: 0.2 - 0.4 * (f - 0.1))
    for p in passages(rows):
        if not p.is_fold:
            assert p.equations is rows[p.point]
            assert p.equations.scaled_residual(p.z, VECTOR) < 1e-9
        else:  # On the line between its neighbours.
            force = 0.2 - 0.4 * (p.equations.frequency - 0.1)
            assert np.ptp(p.equations.inputs[:, 0]) / 2 == pytest.approx(force, rel=1e-9)
            exact = table([p.equations.frequency], lambda f, force=force: force)[0]
            assert p.equations.inputs == pytest.approx(exact.inputs, abs=1e-9)


def test_equations_between_two_rows_have_the_mean_inputs():
    first, second = table([0.1, 0.2], lambda f: f)
    middle, exact = between(first, second, 0.5), table([0.15], lambda f: f)[0]
    assert middle.frequency == pytest.approx(0.15) and middle.inputs == pytest.approx(exact.inputs, abs=1e-12)


def test_repeated_frequencies_are_points_of_the_same_sheet():
    found = passages(table([0.1, 0.12, 0.12, 0.14]), further=False)
    assert [p.point for p in found] == [0, 1, 2, 3] and found[1].z == pytest.approx(found[2].z, abs=1e-9)
