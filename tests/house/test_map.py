"""ARCHITECTURE.md is a map of what is there: its files, names and rooms exist, and are what the page says they are.

A row of a table names places in its last cell: a file, then names in it.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "ARCHITECTURE.md").read_text("utf-8")


class Place(NamedTuple):
    """A file, and a name in it; "" for the file as a whole."""

    file: Path
    name: str


def file_of(text: str) -> Path:
    """A path as the page has it: below the package, or below the repository."""
    inner = ROOT / "bayescal" / text
    return inner if inner.exists() else ROOT / text


def rows_of(text: str) -> list[list[str]]:
    """Cells of the rows of all tables, without heads and rules."""
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in text.splitlines()
        if line.startswith("|")
    ]
    return [row for i, row in enumerate(rows) if not (is_rule(row) or is_rule(rows[i + 1 : i + 2]))]


def is_rule(row: list[str] | list[list[str]]) -> bool:
    cells = row[0] if row and isinstance(row[0], list) else row
    return bool(cells) and set("".join(map(str, cells))) == {"-"}


def places(cell: str) -> list[Place]:
    found: list[Place] = []
    for quoted in re.findall(r"`([^`]+)`", cell):
        if "/" in quoted:
            found.append(Place(file_of(quoted), ""))
        else:
            found.append(Place(found[-1].file, quoted))
    return found


@cache
def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text("utf-8"))


def defined(place: Place) -> ast.AST | None:
    """The statement that defines a name at the top of a file."""
    for node in parsed(place.file).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == place.name:
            return node
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(t, ast.Name) and t.id == place.name for t in targets):
            return node
    return None


TABLES = rows_of(PAGE)


@pytest.mark.parametrize("row", TABLES, ids=lambda row: row[0].replace("*", ""))
def test_a_row_names_what_is_there(row: list[str]) -> None:
    asked, where = row[0], row[-1]
    named = places(where)
    assert named, f"ARCHITECTURE.md, {asked!r}: name a place"
    for place in named:
        shown = place.file.relative_to(ROOT)
        gone = f"ARCHITECTURE.md, row {asked!r}: name what took the place of"
        assert place.file.is_file(), f"{gone} {shown}"
        assert not place.name or defined(place), f"{gone} {place.name} in {shown}"
