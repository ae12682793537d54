import numpy as np
import pytest
from numba import njit

from bayesperiodic.models.code_generation import without_gathers
from bayesperiodic.models.library import duffing


def quotient(rows, out):
    flat, result = rows.reshape(rows.size), out.reshape(out.size)
    for i in range(out.shape[0]):
        result[i] = flat[7 * i] / (1.0 + flat[7 * i + 2])


def quotient_without(rows, out):
    without_gathers()
    flat, result = rows.reshape(rows.size), out.reshape(out.size)
    for i in range(out.shape[0]):
        result[i] = flat[7 * i] / (1.0 + flat[7 * i + 2])


def test_strided_columns_are_loaded_without_gathers_by_vectorised_code():
    rows = np.random.default_rng(1).uniform(size=(101, 7))
    found = []
    for function in (quotient, quotient_without):
        compiled = njit("void(float64[:,::1], float64[:,::1])", error_model="numpy")(function)
        out = np.empty((101, 1))
        compiled(rows, out)
        assert np.array_equal(out[:, 0], rows[:, 0] / (1.0 + rows[:, 2]))
        (text,) = compiled.inspect_asm().values()
        found.append((text.count("vgather"), text.count("vdivpd")))
    if not found[0][0]:
        pytest.skip("this processor has no gathers, or LLVM takes none")
    assert found[1][0] == 0 and found[1][1] > 0


def test_generated_functions_take_no_gathers():
    sources = [
        duffing.symbolic.kernel_source(),
        duffing.symbolic.vjp_source((1,)),
        duffing.symbolic.jacobian_change_source(),
    ]
    for source in sources:
        assert (
            source.count("without_gathers()") == source.count("(states, inputs, parameters, tau, frequency, out)") > 0
        )
