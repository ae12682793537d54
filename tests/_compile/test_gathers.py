import numpy as np
import pytest
from numba import njit

from bayesperiodic._compile import machine_code
from bayesperiodic._compile.code_generation import compiled
from bayesperiodic._compile.functions import as_vector
from bayesperiodic.models.library import duffing, pendulum
from tests.known import formula_model


def assembly(model, folder, monkeypatch):
    """Return the machine code of a model's functions as text."""
    monkeypatch.setenv("BAYESPERIODIC_CACHE", str(folder))
    return compiled(model.symbolic.kernel_source()).library.get_asm_str()


def test_strided_columns_are_loaded_without_gathers_by_vectorised_code(tmp_path, monkeypatch):
    model = formula_model("quotient", ["a"], lambda p, u, s: {"y": p.a * u.x / (1.0 + u.dx)})
    without = assembly(model, tmp_path / "without", monkeypatch)
    monkeypatch.setattr(machine_code, "NO_GATHER", "-prefer-no-gather")
    found = assembly(model, tmp_path / "with", monkeypatch)
    if not found.count("vgather"):
        pytest.skip("this processor has no gathers, or LLVM takes none")
    assert without.count("vgather") == 0 and without.count("vdivpd") > 0
    kernels, inputs = model.kernels, np.random.default_rng(1).uniform(size=(101, 3))
    out = kernels.evaluate("outputs", np.zeros((101, 3)), inputs, np.array([2.0]), np.zeros(101), 1.0)
    assert np.array_equal(out[:, 0], 2.0 * inputs[:, 0] / (1.0 + inputs[:, 1]))


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
