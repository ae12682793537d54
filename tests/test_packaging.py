"""Source distribution and wheel: built, installed into a folder of their own, and used outside the clone."""

import ast
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WITHOUT_IMPORT = {"h5netcdf": "the engine by which xarray reads and writes netCDF"}
OF_OTHERS = {"llvmlite": "numba requires the one version that it works with"}
FIRST_SOLVE = """
import sys
sys.path.insert(0, sys.argv[1])
import numpy as np
import bayesperiodic as bp
assert bp.__file__.startswith(sys.argv[1]), bp.__file__
force = {"force": np.cos(2 * np.pi * np.arange(64) / 64)}
values = {"m": 1.0, "c": 0.2, "k": 1.0, "k3": 0.5}
solution = bp.solve_periodic(bp.models.duffing, values, force, frequency=0.1, samples=64)
assert solution.status == "converged"
"""


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Return the source distribution and the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "build", "-o", str(folder), str(ROOT)], check=True, capture_output=True)
    return next(folder.glob("*.tar.gz")), next(folder.glob("*.whl"))


def test_every_required_distribution_is_imported_and_every_import_is_required():
    imported = set()
    for path in (ROOT / "bayesperiodic").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                imported.add(node.module.split(".")[0])
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    required = {re.match(r"[\w-]+", line)[0] for line in project["dependencies"]}
    optional = {re.match(r"[\w-]+", line)[0] for lines in project["optional-dependencies"].values() for line in lines}
    assert required - imported == WITHOUT_IMPORT.keys()
    known = required | optional | sys.stdlib_module_names | {"bayesperiodic"}
    assert imported - known == OF_OTHERS.keys()


@pytest.mark.document
def test_distributions_hold_the_package_and_nothing_else(built):
    source, wheel = built
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "bayesperiodic").rglob("*.py")}
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert modules <= names
    assert {name.split("/")[0] for name in names} == {"bayesperiodic"}
    assert "bayesperiodic/py.typed" in names
    with tarfile.open(source) as archive:
        inside = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    assert modules <= inside
    assert not any(name.startswith(("tests", "studies", "figures")) for name in inside)


@pytest.mark.document
def test_the_wheel_solves_outside_the_clone(built, tmp_path):
    site = tmp_path / "site"
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(site), str(built[1])]
    subprocess.run(install, check=True)
    subprocess.run([sys.executable, "-c", FIRST_SOLVE, str(site)], check=True, cwd=tmp_path)
