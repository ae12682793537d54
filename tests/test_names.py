import inspect
import subprocess
import sys

import pytest

import bayesperiodic as bp


@pytest.mark.parametrize("name", bp.__all__)
def test_every_public_name_is_there_and_documented(name):
    value = getattr(bp, name)
    assert inspect.getdoc(value)


@pytest.mark.parametrize("name", [name for name in bp.__all__ if inspect.ismodule(getattr(bp, name))])
def test_every_public_module_is_there_at_its_first_use(name):
    subprocess.run([sys.executable, "-c", f"import bayesperiodic as bp; bp.{name}"], check=True)


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="bayesperiodic attribute nothing"):
        bp.nothing  # noqa: B018


def test_import_alone_loads_nothing_heavy():
    heavy = ["numpy", "sympy", "numba", "scipy", "pandas", "xarray", "arviz", "emcee", "matplotlib", "h5py"]
    program = f"import sys, bayesperiodic; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_solving_loads_neither_the_sampler_nor_the_plots():
    program = (
        "import sys, bayesperiodic as bp; bp.solve_periodic, bp.Recording, bp.models.duffing;"
        "print([m for m in ('pandas', 'arviz', 'emcee', 'matplotlib', 'xarray') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_listing_the_studies_compiles_nothing():
    program = "from studies.__main__ import main; main([]); import sys; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("False\n")
