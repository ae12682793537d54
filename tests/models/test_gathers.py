import numpy as np
import pytest
from numba import njit

from bayesperiodic.models.code_generation import as_vector, without_gathers
from bayesperiodic.models.library import duffing, pendulum


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


def test_a_vector_has_the_entries_of_its_array_and_keeps_their_memory():
    @njit("float64(float64[:,::1], float64[::1])")
    def total(rows, zeros):
        own = rows + 1.0
        vector = as_vector(own)  # `own` ends here
        total = 0.0
        for _ in range(20):
            other = zeros.copy()  # takes any memory that is free
            for k in range(vector.size):
                total += vector[k] * (k + 1.0) + other[k]
        return total

    rows = np.random.default_rng(2).uniform(size=(50, 20))
    expected = 20 * np.sum((rows.ravel() + 1.0) * np.arange(1, 1001))
    assert total(rows, np.zeros(1000)) == pytest.approx(expected, rel=1e-12)


def test_a_strided_array_is_no_vector():
    with pytest.raises(AssertionError, match="as_vector: must be C-contiguous, got layout 'A'"):
        njit("float64(float64[:,:])")(lambda rows: as_vector(rows)[0])


def test_a_model_without_smooth_signs_compiles_no_function_for_them():
    assert "def transitions(" not in duffing.symbolic.kernel_source()
    assert "def transitions(" in pendulum.symbolic.kernel_source()
