"""Every public name is documented in full: what it does, takes, gives back and raises, with an example that runs.

Public are `bayesperiodic.__all__`, the `__all__` of `elements`, `measurements`, `models`, `noise` and `plot`, and the
methods and properties of their classes without a leading underscore. The rules, in the sections of numpydoc:

- Parameters (of a result: Attributes) names exactly the arguments (the fields), arrays with their shapes.
- Returns or Yields is there where something is returned. A property says it in its summary, with an array's shape.
- Raises names every exception that the body raises, or that a private helper of the same module or class raises which
  it calls; a call of `bayesperiodic._checks` raises a ValueError. Warns is there where these warn.
- Examples is there for every function and class, calls the function, and skips nothing; pytest runs it.

A method that overrides a documented one needs no more than a summary; one without arguments needs no Returns if its
summary begins with "Return". What a value means, its unit and its source are for the reader to judge.
"""

import ast
import dataclasses
import doctest
import inspect
import itertools
import re
import textwrap
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest

import bayesperiodic as bp
from tests import findings

MODULES = {
    "": bp,
    "elements.": bp.elements,
    "measurements.": bp.measurements,
    "models.": bp.models,
    "noise.": bp.noise,
    "plot.": bp.plot,
}
NAMES = {
    f"{prefix}{name}": getattr(module, name)
    for prefix, module in MODULES.items()
    for name in module.__all__
    if not inspect.ismodule(getattr(module, name))
}
FUNCTIONS = {name: value for name, value in NAMES.items() if inspect.isfunction(value)}
CLASSES = {name: value for name, value in NAMES.items() if inspect.isclass(value)}
MODELS = {name: value for name, value in NAMES.items() if isinstance(value, bp.Model)}
CONSTANTS = {"plot.COLOURS"}


def own_members(cls: type) -> Iterator[tuple[str, Any]]:
    """Yield the public members that a class of the package, or a base of it in the package, defines."""
    for name in dir(cls):
        home = next((c for c in cls.__mro__ if name in vars(c)), object)
        if not name.startswith("_") and home.__module__.startswith("bayesperiodic"):
            yield name, vars(home)[name]


def overrides(cls: type, name: str) -> bool:
    """Return whether a documented method of a base class has this name."""
    return sum(name in vars(c) for c in cls.__mro__ if c.__module__.startswith("bayesperiodic")) > 1


def plain(member: Any) -> Any:
    """Return the function of a class method or static method."""
    return member.__func__ if isinstance(member, classmethod | staticmethod) else member


MEMBERS = {f"{c}.{name}": (cls, name, member) for c, cls in CLASSES.items() for name, member in own_members(cls)}
METHODS = {n: (cls, m, plain(f)) for n, (cls, m, f) in MEMBERS.items() if inspect.isfunction(plain(f))}
PROPERTIES = {n: f for n, (_, _, f) in MEMBERS.items() if isinstance(f, property | cached_property)}


def sections(text: str | None) -> dict[str, str]:
    """Return the text of a numpydoc docstring by heading, with "" for the part above the first heading."""
    parts = re.split(r"^(\w[\w ]*)\n-{3,}\n", inspect.cleandoc(text or "") + "\n", flags=re.MULTILINE)
    return {"": parts[0]} | dict(zip(parts[1::2], parts[2::2], strict=True))


def entries(section: str) -> dict[str, str]:
    """Return the type of every name of a section."""
    found = {}
    for line in section.splitlines():
        if line and not line.startswith(" "):
            names, _, kind = line.partition(" : ")
            found.update(dict.fromkeys((name.strip(" *") for name in names.split(",")), kind))
    return found


def shapeless(section: str) -> list[str]:
    """Return the arrays of a section without a shape."""
    return [name for name, kind in entries(section).items() if "array" in kind and "(" not in kind.split("array")[1]]


def arguments(function: Any) -> set[str]:
    return set(inspect.signature(function).parameters) - {"self", "cls"}


def raised(function: Any, cls: type | None = None, seen: set[Any] | None = None) -> set[str]:
    """Return the exceptions, and "warns", that a function and the private helpers that it calls raise."""
    function, seen = inspect.unwrap(function), set() if seen is None else seen
    if function in seen:
        return set()
    seen.add(function)
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    found = {node.exc.func.id for node in ast.walk(tree) if isinstance(node, ast.Raise) and _is_made(node.exc)}
    for call in (node.func for node in ast.walk(tree) if isinstance(node, ast.Call)):
        helper = None
        if isinstance(call, ast.Name) and call.id.startswith("_"):
            helper = function.__globals__.get(call.id)
        elif isinstance(call, ast.Attribute) and isinstance(call.value, ast.Name):
            found |= {"ValueError"} if call.value.id == "_checks" else set()
            found |= {"warns"} if (call.value.id, call.attr) == ("warnings", "warn") else set()
            if call.value.id in ("self", "cls") and call.attr.startswith("_") and cls is not None:
                helper = plain(inspect.getattr_static(cls, call.attr, None))
        if inspect.isfunction(helper) and helper.__module__ == function.__module__:
            found |= raised(helper, cls, seen)
    return found


def _is_made(exception: ast.expr | None) -> bool:
    return isinstance(exception, ast.Call) and isinstance(exception.func, ast.Name) and exception.func.id[0] != "_"


def assert_raises_documented(documented: dict[str, str], found: set[str]) -> None:
    assert found - {"warns"} <= set(entries(documented.get("Raises", "")))
    assert "warns" not in found or "Warns" in documented


def assert_example(documented: dict[str, str], called: str = "") -> None:
    examples = doctest.DocTestParser().get_examples(documented.get("Examples", ""))
    assert examples and called in "".join(example.source for example in examples)
    assert not any(doctest.SKIP in example.options for example in examples)


def test_every_public_name_is_a_function_class_model_or_constant():
    assert NAMES.keys() == {*FUNCTIONS, *CLASSES, *MODELS, *CONSTANTS}


@pytest.mark.parametrize("name", ["models", "noise", "plot"])
def test_module_docstrings_are_present(name):
    assert sections(getattr(bp, name).__doc__)[""].strip()


@pytest.mark.parametrize("name", FUNCTIONS)
def test_docstrings_of_functions_are_complete(name):
    function = FUNCTIONS[name]
    documented = sections(function.__doc__)
    assert documented[""].strip()
    assert set(entries(documented.get("Parameters", ""))) == arguments(function)
    assert not shapeless(documented.get("Parameters", ""))
    assert "Returns" in documented or "Yields" in documented
    assert_raises_documented(documented, raised(function))
    assert_example(documented, name.rpartition(".")[2] + "(")


@pytest.mark.parametrize("name", CLASSES)
def test_docstrings_of_classes_are_complete(name):
    cls = CLASSES[name]
    documented = sections(cls.__doc__)
    described = documented.get("Parameters", "") + documented.get("Attributes", "")
    wanted = {f.name for f in dataclasses.fields(cls)} if dataclasses.is_dataclass(cls) else arguments(cls)
    wanted = {name for name in wanted if not name.startswith("_")}
    assert documented[""].strip()
    assert wanted <= set(entries(described)) <= wanted | {m for m, _ in own_members(cls)}
    assert not shapeless(described)
    for maker in (cls.__init__, getattr(cls, "__post_init__", None)):
        if inspect.isfunction(maker) and _has_source(maker):
            assert_raises_documented(documented, raised(maker, cls))
    assert_example(documented)


def _has_source(function: Any) -> bool:
    """Return whether a function is hand-written: the __init__ of a dataclass is generated."""
    return function.__code__.co_filename == inspect.getsourcefile(inspect.getmodule(function))


@pytest.mark.parametrize("name", METHODS)
def test_docstrings_of_methods_are_complete(name):
    cls, method, function = METHODS[name]
    documented = sections(function.__doc__)
    assert documented[""].strip()
    if overrides(cls, method):
        return
    assert set(entries(documented.get("Parameters", ""))) == arguments(function)
    assert not shapeless(documented.get("Parameters", ""))
    gives = inspect.signature(function).return_annotation not in (None, "None")
    said = not arguments(function) and documented[""].startswith("Return")
    assert not gives or said or "Returns" in documented
    assert_raises_documented(documented, raised(function, cls))


@pytest.mark.parametrize("name", PROPERTIES)
def test_docstrings_of_properties_are_complete(name):
    prop = PROPERTIES[name]
    getter = prop.fget if isinstance(prop, property) else prop.func
    text = sections(prop.__doc__)[""].strip()
    assert text
    if "ndarray" in str(inspect.signature(getter).return_annotation):
        assert re.search(r"\([\w…, ·+]*,[\w…, ·+]*\)", text)


@pytest.mark.parametrize("name", MODELS)
def test_docstrings_of_models_are_complete(name):
    model = MODELS[name]
    documented = sections(model.__doc__)
    assert model.__doc__ != bp.Model.__doc__
    assert set(model.units) >= {*model.parameters, *model.states, *model.inputs, *model.outputs}
    missing = [n for n in (*model.parameters, *model.inputs) if not re.search(rf"\b{n}\b", documented[""])]
    assert not missing
    assert_example(documented, name)


def test_every_name_is_in_the_reference_once():
    listed = (Path(__file__).parents[1] / "docs" / "reference" / "api.rst").read_text("utf-8").split()
    assert [name for name in NAMES if listed.count(name) != 1] == []


@pytest.mark.parametrize("page", findings.pages(), ids=lambda page: page.name)
def test_pages_on_other_packages_are_those_of_the_scripts(page):
    """Made by `python -m tests.findings`."""
    assert page.read_text("utf-8") == findings.pages()[page]


def test_every_public_name_is_in_a_table_of_tasks():
    text = (findings.ROOT / "docs" / "reference" / "tasks.md").read_text("utf-8")
    rows = " ".join(line for line in text.splitlines() if line.startswith("| "))
    named = set(re.findall(r"\w+", " ".join(re.findall(r"`[^`]*`", rows))))
    assert sorted(set(bp.__all__) - named) == []


def test_rows_of_tables_have_as_many_cells_as_their_heads():
    for page in [*findings.ROOT.glob("*.md"), *findings.ROOT.glob("docs/**/*.md")]:
        lines = page.read_text("utf-8").splitlines()
        for k in (k for k, line in enumerate(lines) if re.fullmatch(r"\|( *:?-+:? *\|)+", line.strip())):
            rows = [lines[k - 1], *itertools.takewhile(lambda line: line.lstrip().startswith("|"), lines[k:])]
            cells = [len(re.findall(r"(?<!\\)\|", row)) for row in rows]
            assert set(cells) == {cells[1]}, f"{page.name}, line {k + 1}"
