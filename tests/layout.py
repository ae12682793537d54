"""Size of the package: files, lines, functions and public signatures, printed by ``python -m tests.layout``; names."""

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import bayesperiodic as bp

ROOT = Path(__file__).parents[1]


def lines(folder: str) -> dict[str, int]:
    """Return the number of lines of each Python file in a folder of the repository."""
    return {
        path.relative_to(ROOT).as_posix(): len(path.read_text("utf-8").splitlines())
        for path in sorted((ROOT / folder).rglob("*.py"))
    }


def function_lines(path: Path) -> Iterator[tuple[str, int]]:
    """Yield the name of each function in a file and the number of lines of its body without the docstring."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            body = node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body
            yield node.name, body[-1].end_lineno - body[0].lineno + 1 if body else 0


def longest_functions() -> dict[str, int]:
    """Return the body lengths of all functions outside `_kernels`, longest first."""
    found = {
        f"{path.relative_to(ROOT).as_posix()}:{name}": length
        for path in sorted((ROOT / "bayesperiodic").rglob("*.py"))
        if "_kernels" not in path.parts
        for name, length in function_lines(path)
    }
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def public_parameters() -> dict[str, int]:
    """Return the number of parameters of every public function, public method and constructor, most first.

    Constructors of results are not counted: the package calls them, not its user.
    """
    found = {}
    for name in bp.__all__:
        for path, function in _callables(name, getattr(bp, name)):
            counted = [p for p in inspect.signature(function).parameters.values() if p.name not in ("self", "cls")]
            found[path] = len(counted)
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _callables(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if inspect.ismodule(value):
        for member in getattr(value, "__all__", ()):
            yield from _callables(f"{name}.{member}", getattr(value, member))
    elif inspect.isclass(value):
        if not hasattr(value, "save") or name == "Experiment":
            yield name, value
        for member, function in inspect.getmembers(value, callable):
            if not member.startswith("_") and getattr(function, "__module__", "").startswith("bayesperiodic"):
                yield f"{name}.{member}", function
    elif inspect.isfunction(value):
        yield name, value


def constants(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the name and the expression of each constant that a file defines at its top level."""
    for node in ast.parse(path.read_text("utf-8")).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                for name, value in _assigned(target, node.value):
                    if name.strip("_").isupper():
                        yield name, value


def _assigned(target: ast.expr, value: ast.expr) -> Iterator[tuple[str, str]]:
    if isinstance(target, ast.Name):
        yield target.id, ast.unparse(value)
    elif isinstance(target, ast.Tuple):
        each = value.elts if isinstance(value, ast.Tuple) else [value] * len(target.elts)
        for k, (part, of) in enumerate(zip(target.elts, each, strict=True)):
            for name, text in _assigned(part, of):
                yield name, text if of is not value else f"{text}[{k}]"


def classes(path: Path) -> Iterator[str]:
    """Yield the names of the classes that a file defines."""
    return (node.name for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.ClassDef))


def main() -> None:
    """Print the counts."""
    for folder in ("bayesperiodic", "studies", "tests"):
        counts = lines(folder)
        longest = max(counts, key=counts.__getitem__)
        print(
            f"{folder}: {len(counts)} files, {sum(counts.values()):,} lines, median {median(counts.values()):.0f}, "
            f"longest {longest} ({counts[longest]})"
        )
    print("longest functions outside _kernels (lines of the body without the docstring):")
    for name, length in list(longest_functions().items())[:5]:
        print(f"  {length:3d} {name}")
    print("most parameters of public functions:")
    for name, count in list(public_parameters().items())[:12]:
        print(f"  {count:3d} {name}")


if __name__ == "__main__":
    main()
