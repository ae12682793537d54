import ast
import inspect
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

import bayesperiodic as bp
from tests import layout


def modules() -> dict[str, Path]:
    root = layout.ROOT / "bayesperiodic"
    return {path.relative_to(root).as_posix(): path for path in sorted(root.rglob("*.py"))}


def test_a_constant_has_one_value():
    values = defaultdict(lambda: defaultdict(list))
    for module, path in modules().items():
        for name, value in layout.constants(path):
            values[name][value].append(module)
    several = {name: dict(places) for name, places in values.items() if len(places) > 1}
    assert not several, "say in the name what the constant limits, or import the one that is meant"


def test_variables_are_called_by_nouns():
    vague = [
        f"{module}:{node.lineno} {name}"
        for module, path in modules().items()
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if (name := getattr(node, "id", getattr(node, "arg", ""))) in ("own", "found")
        and module != "plot/terms.py"  # a parameter of the public `plot.missing_terms`
    ]
    assert not vague


def test_a_class_name_stands_for_one_class():
    places = defaultdict(list)
    for module, path in modules().items():
        for name in layout.classes(path):
            places[name].append(module)
    assert not {name: where for name, where in places.items() if len(where) > 1}


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


def test_names_of_an_identification_load_no_tables_plots_samplers_or_distributions():
    names = "models Model Experiment Recording Normal Problem map_estimate sample identifiability predict load"
    slow = ["pandas", "xarray", "arviz", "emcee", "matplotlib", "pint", "scipy.stats", "scipy.optimize"]
    program = (
        f"import sys; from bayesperiodic import {', '.join(names.split())};"
        f"print([m for m in {slow} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_listing_the_studies_compiles_nothing():
    program = "from studies.__main__ import main; main([]); import sys; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("False\n")
