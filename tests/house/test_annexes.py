"""Annexes: which way imports point, what they have from the core, and what is left without one."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache

import pytest

import bayescal
from bayescal import workshop
from tests.house.test_architecture import MODULES, PACKAGE, parsed
from tests.house.test_startup import run_python

# What one annex has from another: a validation compares decisions.
FROM_OTHERS = {("validation", "metrology")}


def annex_of(module: str) -> str:
    """The annex that a module is of; of the core, none."""
    return module.split(".")[1] if module.startswith("_annexes.") else ""


@cache
def offered() -> dict[str, str]:
    """Public names of `bayescal` that are an annex', which loads with them: its name."""
    listed = r"^from \._annexes\.(\w+)\.\w+ import \(?\s*(\w+)"
    face = (PACKAGE / "__init__.pyi").read_text("utf-8")
    return {name: annex for annex, name in re.findall(listed, face, re.MULTILINE)}


@cache
def imported(module: str) -> list[tuple[str, str, str]]:
    """What a module has of this package, wherever that stands: module, name, and the line; public names too."""
    return [*_imported(module)]


def _imported(module: str) -> Iterator[tuple[str, str, str]]:
    for node in ast.walk(parsed(MODULES[module])):
        where = f"bayescal/{module} line {getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "bayescal":
            of = (node.module or "").removeprefix("bayescal").strip(".")
            yield from ((of, alias.name, where) for alias in node.names)
        elif isinstance(node, ast.Import):
            whole = (a.name.partition(".")[2] for a in node.names if a.name[:9] == "bayescal.")
            yield from ((*name.rpartition(".")[::2], where) for name in whole)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            faces = {"bc": "", "bayescal": "", "ws": "workshop"}
            if (face := faces.get(node.value.id)) is not None:
                yield face, node.attr, where


def test_the_core_imports_no_annex_and_one_annex_no_other() -> None:
    """A name of the public face that is an annex' is no way round."""
    wrong = []
    for module in MODULES:
        for of, name, where in imported(module):
            pair = annex_of(module), annex_of(f"{of}.{name}") if of else offered().get(name, "")
            if pair[1] and pair[0] != pair[1] and pair not in FROM_OTHERS:
                wrong.append(f"{where}: {of} {name}")
    assert not wrong, "\n".join(wrong)


def test_an_annex_is_built_on_the_two_faces() -> None:
    """`bayescal` and `bayescal.workshop`; and on nothing behind them."""
    behind = [
        f"{where}: {of} {name}"
        for module in MODULES
        if annex_of(module)
        for of, name, where in imported(module)
        if of not in ("", "workshop") and not annex_of(f"{of}.{name}")
    ]
    assert not behind, "\n".join(behind)


@pytest.mark.parametrize("name", sorted(workshop.__all__))
def test_a_name_of_the_workshop_loads_and_is_used(name: str) -> None:
    assert getattr(workshop, name) is not None
    assert name not in bayescal.__all__, "one face has it already"
    used = {n for m in MODULES if annex_of(m) for of, n, _ in imported(m) if of == "workshop"}
    assert name in used, "no annex has need of it: take it out"


WITHOUT = """
import contextlib, io, sys

class Removed:
    def find_spec(self, name, path=None, target=None):
        if name.startswith("bayescal._annexes.{annex}"):
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Removed())
import bayescal
from bayescal._cli.main import run_command

def called(*words):
    sys.argv[1:] = words
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        status = run_command()
    print(status, " ".join(said.getvalue().split()))

called("{command}", "readings.csv")
called("--help")
try:
    bayescal.{name}
except ImportError as error:
    print(error)
"""
OFFERED = [
    ("fleet", "batch", "fit_batch"),
    ("imu", "triad", "vector_correction"),
    ("metrology", "decide", "decide"),
    ("workbench", "workbench", "workbench"),
]


@pytest.mark.parametrize(("annex", "command", "name"), OFFERED)
def test_without_an_annex_its_command_and_its_names_say_so(
    annex: str, command: str, name: str
) -> None:
    told = run_python(WITHOUT.format(annex=annex, command=command, name=name))
    refused, listed, unnamed = told.splitlines()
    assert refused.startswith(f"2 bayescal: No such command '{command}'")
    assert "See: bayescal --help" in refused and "Traceback" not in refused
    assert listed.startswith("0 ") and "calibrate" in listed and f" {command} " not in listed
    assert f"bayescal.{name} needs a component that is not installed" in unnamed
