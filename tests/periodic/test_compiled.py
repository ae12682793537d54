"""Compiled functions are rebuilt when a source that they call changes."""

from functools import cache

from bayesperiodic.periodic import compiled

ORIGINAL = compiled._kernels
CALLED = """from numba import njit


@njit("float64(float64)", cache=CACHE)
def shifted(x):
    return x + {added} + SIZES[0]
"""
CALLING = """from numba import njit


@njit("float64(float64)", cache=CACHE)
def twice(x):
    return 2.0 * shifted(x)
"""


def test_changed_kernels_recompile_their_callers(monkeypatch, tmp_path):
    monkeypatch.setenv("BAYESPERIODIC_CACHE", str(tmp_path))
    for added, states in ((1.0, 0), (3.0, 0), (3.0, 2), (1.0, 0)):
        texts = {"linear": CALLED.format(added=added), "newton": CALLING}
        monkeypatch.setattr(compiled, "source", texts.__getitem__)
        monkeypatch.setattr(compiled, "_kernels", cache(ORIGINAL.__wrapped__))
        caller = compiled.kernels("newton", states, (1, 1, 1))
        assert caller.twice(1.0) == 2.0 * (1.0 + added + states)
