"""The house: its rooms, what stands in each, which way imports point, what is public."""

from __future__ import annotations

import ast
import re
import tomllib
from collections import Counter
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import pytest

import bayescal
from bayescal_models import INSTRUMENTS

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "bayescal"
MODELS = ROOT / "models" / "bayescal_models"

# From the ground up: a module imports from its own room and from those before it, wherever in the file that stands.
ROOMS = [
    *("_core", "_tables", "_data", "_model", "effects", "_inference", "_calibration"),
    *("_use", "_search", "_report", "plot", "_cli", "__main__", "workshop", "_annexes"),
]
FILES = ("plot", "__main__", "workshop")  # that stand for themselves and hand on what a room has


class Import(NamedTuple):
    """One import of a module of this package, seen in another."""

    importer: str
    imported: str
    line: int


@cache
def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text("utf-8"))


def name_of(file: Path, package: Path = PACKAGE) -> str:
    """`_calibration.fit` for _calibration/fit.py, `effects` for effects/__init__.py, `bayescal` for the face of all."""
    parts = file.relative_to(package).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__") or package.name


MODULES = {name_of(file): file for file in sorted(PACKAGE.rglob("*.py"))}
INSTRUMENT_MODULES = {name_of(file, MODELS): file for file in sorted(MODELS.rglob("*.py"))}


def imported_names(node: ast.AST, package: str) -> Iterator[str]:
    """Full dotted names of `package` that a statement imports, if any."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names if alias.name.split(".")[0] == package)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, f"line {node.lineno}: write relative imports in full"
        if (node.module or "").split(".")[0] == package:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def imports_of(name: str, modules: dict[str, Path], package: str) -> Iterator[Import]:
    """Every import of the package's own modules: at the top, in a function, for types."""
    for node in ast.walk(parsed(modules[name])):
        for asked in imported_names(node, package):
            inner = asked.removeprefix(package).removeprefix(".")
            while inner and inner not in modules:  # an attribute of a module: the module counts
                inner = inner.rpartition(".")[0]
            yield Import(name, inner or package, getattr(node, "lineno", 0))


@cache
def imports() -> list[Import]:
    return [found for name in MODULES for found in imports_of(name, MODULES, "bayescal")]


def room_of(module: str) -> str:
    return module.split(".")[0]


def test_every_module_stands_in_a_room() -> None:
    found = {room_of(name) for name in MODULES} - {"bayescal"}
    assert found == set(ROOMS), (
        "give a new room its place in ROOMS, take one that is gone out of it"
    )


def test_imports_point_down() -> None:
    floor = {room: i for i, room in enumerate(ROOMS)} | {"bayescal": -1}
    upward = {
        f"bayescal/{found.importer} line {found.line} imports {found.imported} above it"
        for found in imports()
        if found.importer != "bayescal"
        and floor[room_of(found.imported)] > floor[room_of(found.importer)]
    }
    assert not upward, "\n".join(sorted(upward))


@pytest.mark.parametrize(
    ("modules", "package"), [(MODULES, "bayescal"), (INSTRUMENT_MODULES, "bayescal_models")]
)
def test_no_modules_import_each_other(modules: dict[str, Path], package: str) -> None:
    graph = {
        name: {i.imported for i in imports_of(name, modules, package) if i.imported != name}
        for name in modules
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"a circle of imports: {' → '.join(error.args[1])}")


def test_names_are_unique() -> None:
    """One name for one thing: a class, and a file, is found by its name alone."""
    files, classes = Counter(name.rpartition(".")[2] for name in MODULES if "." in name), Counter()
    for file in MODULES.values():
        tree = parsed(file)
        classes.update(node.name for node in tree.body if isinstance(node, ast.ClassDef))
    twice = {name for name, count in (files + classes).items() if count > 1}
    assert not twice, f"these names stand for two things: {sorted(twice)}"


def constants() -> Iterator[tuple[str, list[str], str]]:
    """Numbers at the top of modules: the module, their names, and their lines with a comment above."""
    for name, file in MODULES.items():
        lines = file.read_text("utf-8").splitlines()
        for node in parsed(file).body:
            if not isinstance(node, ast.Assign):
                continue
            targets = [t for one in node.targets for t in getattr(one, "elts", [one])]
            names = [t.id for t in targets if isinstance(t, ast.Name) and t.id.isupper()]
            try:
                value = ast.literal_eval(node.value)
            except ValueError:
                continue
            values = value if isinstance(value, tuple) and value else (value,)
            if names and all(isinstance(v, int | float) for v in values):
                assert node.end_lineno is not None
                above = [
                    line
                    for line in lines[node.lineno - 2 : node.lineno - 1]
                    if line.startswith("#")
                ]
                yield name, names, "\n".join([*above, *lines[node.lineno - 1 : node.end_lineno]])


def test_every_number_has_its_reason_beside_it() -> None:
    bare = [(module, *names) for module, names, text in constants() if "#" not in text]
    assert not bare, "say in a comment why it is this number, or what it is of"


def test_every_module_says_what_it_holds() -> None:
    silent = [n for n, f in MODULES.items() if not ast.get_docstring(parsed(f))]
    assert not silent


def test_rooms_say_what_lives_there_and_hand_nothing_on() -> None:
    for room in ROOMS:
        if room in FILES:
            continue
        tree = parsed(MODULES[room])
        assert ast.get_docstring(tree), f"bayescal/{room}/__init__.py: say what lives here"
        assert room == "effects" or len(tree.body) == 1, (
            f"bayescal/{room}/__init__.py: no re-exports"
        )


@pytest.mark.parametrize("name", sorted(bayescal.__all__))
def test_a_public_name_loads(name: str) -> None:
    assert getattr(bayescal, name) is not None


def test_an_unknown_public_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="bayescal attribute colour"):
        bayescal.colour  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


def test_instruments_use_only_the_public_face() -> None:
    private = [
        f"{file.relative_to(ROOT)} line {getattr(node, 'lineno', 0)} imports {asked}"
        for file in sorted(MODELS.rglob("*.py"))
        for node in ast.walk(parsed(file))
        for asked in imported_names(node, "bayescal")
        if any(part.startswith("_") for part in asked.split("."))
    ]
    assert not private, "\n".join(private)


def test_the_framework_knows_no_instrument() -> None:
    knowing = [
        f"bayescal/{name} line {getattr(node, 'lineno', 0)} imports {asked}"
        for name, file in MODULES.items()
        for node in ast.walk(parsed(file))
        for asked in imported_names(node, "bayescal_models")
    ]
    assert not knowing, "\n".join(knowing)


def test_one_version() -> None:
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text("utf-8"), re.MULTILINE)
    assert cited is not None and cited[1] == bayescal.__version__


def test_what_python_311_needs_stands_in_one_file() -> None:
    asking = {name for name, file in MODULES.items() if "version_info" in file.read_text("utf-8")}
    assert asking == {"_core.python311"}


def test_every_instrument_is_offered_to_the_command_line() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    offered = project["entry-points"]["bayescal.instruments"]
    assert offered == {name: f"bayescal_models.{name}:INSTRUMENT" for name in INSTRUMENTS}


@pytest.mark.parametrize("group", ["bayescal.pair_selections"])
def test_what_is_offered_beside_an_instrument_is_there(group: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    for name, place in project["entry-points"][group].items():
        module, _, attribute = place.partition(":")
        assert name in INSTRUMENTS
        assert callable(getattr(import_module(module), attribute))


# Lines of Python that each part may have: lowered by whoever takes lines out, never raised. What needs more room takes
# it from the same part first.
CEILINGS = {
    "bayescal/_core": 2_005,
    "bayescal/_tables": 1_459,
    "bayescal/_data": 4_085,
    "bayescal/_model": 5_312,
    "bayescal/effects": 650,
    "bayescal/_inference": 5_929,
    "bayescal/_calibration": 4_429,
    "bayescal/_use": 2_737,
    "bayescal/_search": 5_621,
    "bayescal/_report": 1_601,
    "bayescal/_cli": 1_658,
    "bayescal/_annexes/fleet": 1_670,
    "bayescal/_annexes/imu": 2_680,
    "bayescal/_annexes/metrology": 1_568,
    "bayescal/_annexes/validation": 726,
    "bayescal/_annexes/workbench": 2_402,
    "models": 8_130,
    "tests": 22_439,
    "benchmarks": 10_606,
}
WORDS = 47_621  # of docs/, README.md and CHANGELOG.md together


@pytest.mark.parametrize("part", CEILINGS)
def test_a_part_is_below_its_ceiling(part: str) -> None:
    lines = sum(len(f.read_text("utf-8").splitlines()) for f in (ROOT / part).rglob("*.py"))
    assert lines <= CEILINGS[part], f"{part} has {lines} lines: take out what it no longer needs"


def test_documentation_is_below_its_ceiling() -> None:
    pages = [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "CHANGELOG.md"]
    words = sum(len(page.read_text("utf-8").split()) for page in pages)
    assert words <= WORDS, f"{words} words"
