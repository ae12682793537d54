"""Compiled functions are rebuilt when a source that they call changes."""

from functools import cache

from bayesperiodic.periodic import compiled

ORIGINAL = compiled._kernels
CALLED = """from numba import njit

STATES, REACH, WIDTH, HALF = 0, 0, 0, 0


@njit("float64(float64)", cache=CACHE)
def newton(x):
    return x + {added}
"""
CALLING = """from numba import njit

from bayesperiodic.periodic._kernels.newton import newton


@njit("float64(float64)", cache=CACHE)
def twice(x):
    return 2.0 * newton(x)
"""


def test_changed_kernels_recompile_their_callers(monkeypatch, tmp_path):
    monkeypatch.setenv("BAYESPERIODIC_CACHE", str(tmp_path))
    monkeypatch.setattr(compiled, "NAMES", ("newton",))
    for added in (1.0, 3.0, 1.0):
        texts = {"kernels.py": CALLED.format(added=added), "callers.py": CALLING}
        monkeypatch.setattr(compiled, "_text", texts.__getitem__)
        monkeypatch.setattr(compiled, "_kernels", cache(ORIGINAL.__wrapped__))
        caller = compiled._with_shared.__wrapped__("callers.py", ("twice",), compiled.ANY)
        assert caller.twice(1.0) == 2.0 * (1.0 + added)
