"""The house: the floors and what stands on them, what loads late, what is public."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

import bayescal

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "bayescal"
MODELS = ROOT / "models" / "bayescal_models"
LONGEST = 450  # lines; about 300 is the aim

# From the ground up. A module imports only what stands before it, on its own floor too.
FLOORS = {
    "ground": "_errors _startup _progress _batches _compile _triangle _optimise",
    "readings": "_units _column _table _plausible _write _match _extra_columns _admit "
    "_measurements _read_csv _read_binary _read",
    "parts of a model": "_prior _coefficient _frame _effect _noise "
    "effects.constant effects.temperature effects.thermal effects.thermometer effects.time effects.unknown "
    "effects.unknown_in_time "
    "effects _instrument _model",
    "the model as numbers": "_layout _composition _arrow _linear _laplace",
    "a calibration": "_calibration _store _tree _checkpoint _method _predict _score _directions _summary _text",
    "methods and their verb": "_promotion _importance _chains _least_squares _marginal _nuts "
    "_program_sites _program_affine _program_density _program _fit",
    "many devices": "_batch_draws _batch_devices _batch_split _batch_frames _batch_linear _batch_solve _population "
    "_batch_result _batch",
    "verbs on a calibration": "_susie_models _susie _candidates _blocks _regions _check "
    "_judgement _verification _discover _experiment _screen _template "
    "_folds _compare _spikes _trail _calibrate",
    "what the user takes away": "_in_use _inverse _export_graph _export_trace _export_text _export _export_about "
    "_compensate _compensate_files _budget",
    "for people": "_result _plot_style _plot_residuals _plot_error _plot_posterior _plot "
    "_report_chapter _report_figures _report_tables _report_words _report",
    "the public face": "bayescal",
    "the command line": "_doors _answers _options _commands _batch_command _cli",
}
ORDER = " ".join(FLOORS.values()).split()

# Imports inside a function: (importer, imported) and why they cannot stand at the top.
LATE = {
    ("_instrument", "_model"): "instrument.baseline() makes a model, which holds the instrument",
    ("_calibration", "_store"): "calibration.save() is a verb above it, offered as a method",
    ("_calibration", "_tree"): "names, units and replicated readings, made when first looked at",
    ("_calibration", "_text"): "printing is above it, offered as str()",
    ("_budget", "_text"): "as above",
    ("_check", "_text"): "as above",
    ("_compare", "_text"): "as above",
    ("_discover", "_text"): "as above",
    ("_trail", "_text"): "as above",
    ("_experiment", "_text"): "as above",
    ("_trail", "_plot"): "trail.save() draws, above it; Matplotlib loads only to draw",
    ("_trail", "_result"): "trail.save() writes the result, which is above it",
    ("_fit", "_store"): "loading is seldom",
    ("_fit", "_program"): "it loads NumPyro, which a default fit does without",
    ("_export_about", "bayescal"): "its version, which stands on the face",
}
LATE_ANYWHERE = {
    "_cli",
    "_commands",
    "_batch_command",
}  # their commands load what they need: `bayescal --help` answers at once


class Import(NamedTuple):
    """One import of a module of this package, seen in another."""

    importer: str
    imported: str
    line: int
    where: str  # "top", "function" or "types" (under TYPE_CHECKING)


def name_of(file: Path) -> str:
    """`_fit` for _fit.py, `effects` for effects/__init__.py, `bayescal` for the face of all."""
    parts = file.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__") or "bayescal"


MODULES = {name_of(file): file for file in sorted(PACKAGE.rglob("*.py"))}


def imported_names(node: ast.stmt, package: str) -> Iterator[str]:
    """Full dotted names of `package` that a statement imports, if any."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names if alias.name.split(".")[0] == package)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, f"line {node.lineno}: write relative imports in full"
        if (node.module or "").split(".")[0] == package:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def statements(body: list[ast.stmt], where: str = "top") -> Iterator[tuple[ast.stmt, str]]:
    """Every statement with the place where it stands."""
    for node in body:
        yield node, where
        inside = where
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            inside = "function"
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            inside = "types"
        for field in ("body", "orelse", "finalbody", "handlers"):
            below = "top" if inside == "types" and field == "orelse" else inside
            for child in getattr(node, field, []):
                if isinstance(child, ast.ExceptHandler):
                    yield from statements(child.body, below)
                else:
                    yield from statements([child], below)


def imports_of(name: str) -> Iterator[Import]:
    for node, where in statements(ast.parse(MODULES[name].read_text("utf-8")).body):
        for asked in imported_names(node, "bayescal"):
            inner = asked.removeprefix("bayescal").removeprefix(".")
            while inner and inner not in MODULES:  # an attribute of a module: the module counts
                inner = inner.rpartition(".")[0]
            yield Import(name, inner or "bayescal", node.lineno, where)


IMPORTS = [found for name in MODULES for found in imports_of(name)]


def test_every_module_has_a_floor() -> None:
    assert len(ORDER) == len(set(ORDER)), "a module stands on two floors"
    new, gone = set(MODULES) - set(ORDER), set(ORDER) - set(MODULES)
    assert not new, f"give these modules a place in FLOORS: {sorted(new)}"
    assert not gone, f"these modules are gone, take them out of FLOORS: {sorted(gone)}"


def test_imports_point_down() -> None:
    upward = [
        f"bayescal/{found.importer} line {found.line} imports {found.imported} above it"
        for found in IMPORTS
        if found.where == "top"
        and {found.importer, found.imported} <= set(ORDER)
        and ORDER.index(found.imported) >= ORDER.index(found.importer)
    ]
    assert not upward, "\n".join(upward)


def test_late_imports_are_listed() -> None:
    late = {
        (found.importer, found.imported)
        for found in IMPORTS
        if found.where == "function" and found.importer not in LATE_ANYWHERE
    }
    assert late <= set(LATE), f"move to the top, or list in LATE with a reason: {late - set(LATE)}"
    assert set(LATE) <= late, f"no longer late, take out of LATE: {set(LATE) - late}"


def test_the_public_names_are_a_list_kept_once() -> None:
    homes: dict[str, str] = {}
    for node, where in statements(ast.parse(MODULES["bayescal"].read_text("utf-8")).body):
        if where == "types" and isinstance(node, ast.ImportFrom):
            for alias in node.names:
                name = alias.name.removeprefix("_")  # a whole module may be public: `_plot as plot`
                assert alias.asname == name, f"line {node.lineno}: a public name is `X as X`"
                home = alias.name if node.module == "bayescal" else str(node.module)
                homes[name] = home.removeprefix("bayescal.")
    assert set(bayescal.__all__) == set(homes)
    assert homes == bayescal._HOMES


@pytest.mark.parametrize("name", sorted(bayescal.__all__))
def test_a_public_name_loads(name: str) -> None:
    assert getattr(bayescal, name) is not None


def test_an_unknown_public_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="'bayescal' has no public name 'colour'"):
        bayescal.colour  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


def test_instruments_use_only_the_public_face() -> None:
    private = [
        f"{file.relative_to(ROOT)} line {node.lineno} imports {asked}"
        for file in sorted(MODELS.rglob("*.py"))
        for node, _ in statements(ast.parse(file.read_text("utf-8")).body)
        for asked in imported_names(node, "bayescal")
        if any(part.startswith("_") for part in asked.split("."))
    ]
    assert not private, "\n".join(private)


def test_the_framework_knows_no_instrument() -> None:
    knowing = [
        f"bayescal/{name} line {node.lineno} imports {asked}"
        for name, file in MODULES.items()
        for node, _ in statements(ast.parse(file.read_text("utf-8")).body)
        for asked in imported_names(node, "bayescal_models")
    ]
    assert not knowing, "\n".join(knowing)


def test_files_can_be_read_in_one_sitting() -> None:
    folders = [PACKAGE, MODELS, ROOT / "tests", ROOT / "benchmarks"]
    lengths = {
        str(file.relative_to(ROOT)): len(file.read_text("utf-8").splitlines())
        for folder in folders
        for file in folder.rglob("*.py")
    }
    long = {name: length for name, length in lengths.items() if length > LONGEST}
    assert not long, f"split along the concept: {long}"


def test_one_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["version"] == bayescal.__version__


def test_every_instrument_is_offered_to_the_command_line() -> None:
    from bayescal_models import INSTRUMENTS

    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    offered = project["entry-points"]["bayescal.instruments"]
    assert offered == {name: f"bayescal_models.{name}:INSTRUMENT" for name in INSTRUMENTS}
