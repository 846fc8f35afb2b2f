"""The benchmarks: every name has a module, and the code that they give to other processes can be run."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from benchmarks import __main__ as command
from benchmarks.stated import differing

ROOT = Path(__file__).resolve().parents[2]
OWN = ("bayescal", "benchmarks")  # and bayescal_models
FILES = sorted((ROOT / "benchmarks").rglob("*.py"))


def functions_of(module: str) -> set[str]:
    """Names at the top of a module, without running it."""
    spec = find_spec(module)
    assert spec is not None and spec.origin is not None, f"no module {module}"
    found: set[str] = set()
    for node in ast.parse(Path(spec.origin).read_text("utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign):
            found |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return found


@pytest.mark.parametrize("name", command.MODULES)
def test_a_name_has_its_module(name: str) -> None:
    assert {"main", "BANKS", "render"} & functions_of(f"benchmarks.{command.MODULES[name]}")


def test_code_for_other_processes_names_what_is_there() -> None:
    found = [
        (module, name)
        for file in FILES
        for module, name in re.findall(
            r'"[^"\n]*from (benchmarks[\w.]*) import (\w+)', file.read_text("utf-8")
        )
    ]
    assert found, "no code for other processes was found"
    assert all(name in functions_of(module) for module, name in found), found


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.stem)
def test_what_a_benchmark_imports_is_there(file: Path) -> None:
    """Of this repository's own packages: a name that moves away is noticed before a benchmark is run."""
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(OWN):
            module = import_module(node.module or "")
            for alias in node.names:
                inside = hasattr(module, alias.name) or find_spec(f"{node.module}.{alias.name}")
                assert inside, f"{file.name}: no {alias.name} in {node.module}"


# Pages that are rendered say what the committed results say.


def test_pages_are_as_the_results_have_them() -> None:
    assert list(differing()) == []
