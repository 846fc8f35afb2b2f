"""The house: its rooms, what stands in each, which way imports point, what is public."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import pytest

import bayescal

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "bayescal"
MODELS = ROOT / "models" / "bayescal_models"
LONGEST = 300  # lines of a file
TALLEST = 60  # lines of a function, its docstring included
MOST_IN_A_ROOM = 13  # modules
MOST_ROOMS = 28

# From the ground up. A module imports only what stands before it, wherever in the file the import stands.
ROOMS = {
    "_core": "version errors atomic_file formatting jax_setup progress parallel jit gaussian_algebra tridiagonal "
    "levenberg_marquardt null_space importance_weights",
    "_logs": "recorded px4_ulog ardupilot_bin ros_bag open_log",
    "_tables": "problems dates cells raw_table encoding csv_scan csv_reader parquet_netcdf spreadsheets write "
    "open_table mapping_file",
    "_readings": "unit_parsing unit_conversion header_reading column dataset_checks averaging column_matching "
    "header_matching column_reader column_conversion measurements read",
    "_recording": "time_in_runs rounding spikes set_aside allan_terms allan_fit allan_deviation",
    "_model": "static prior frame effect unknown_effect departure noise_laws correlated_noise instrument "
    "installed model parameters forward",
    "effects": "constant temperature thermal thermometer time",
    "_engine": "pieces terms record assembly whitening noise_slopes closed_form mode linear_model joint products "
    "sampling refinement",
    "_inference": "block_elimination gaussian laplace checkpoint method sampled_products importance_sampling "
    "nuts_chains trust least_squares marginal nuts",
    "_numpyro": "trace survey gaussian_sites marginal_density program_fit fit_program",
    "_calibration": "named_draws on_readings fitted description posterior_tree storage summary guards calibration "
    "predict fit evidence",
    "_diagnostics": "evidence_scale efficient_score prior_influence noise_in_time "
    "covariate_evidence part worst_region check_result check leave_group_out compare",
    "_search": "noise_laws plausible_sizes departures starts structures library scores walk posterior",
    "_discovery": "candidate discover preview next_experiment false_reports draft_effect own_files search_path gate "
    "calibrate describe",
    "_channels": "shared_shape channels calibrate_channels",
    "_compensation": "operating_equation posterior_moments inversion expression_graph jaxpr_to_graph inputs provenance "
    "compensation_program code_writer compensator compensate_file budget_notes budget",
    "_firmware": "thermal_polynomial autopilots parameters",
    "_population": "device_sums spread_draws population",
    "_fleet": "tailored weighted_draws devices device_refusals split_devices stacks closed_form fit_stack "
    "device_result batch_result partial_pooling fit_devices",
    "_finding": "shares find_devices fleet_table",
    "_partitions": "partitions request row_groups read_partition",
    "_cluster": "open_cluster engine fit_partition doubled run fleet_result population_tree fit_fleet fit_batch",
    "_plots": "colours style residuals allan search posterior",
    "_report": "result_json whole_folder under_way save_search section certificate d_si dcc figures tables sentences "
    "report",
    "_workbench.parts": "style work decimate pieces rows",
    "_workbench.panes": "fails_data fails_panel fails model missing error experiment allan take_away file describe "
    "tabs",
    "_workbench": "state origin script kept tree change search take_away session app start serve",
    "_cli": "options column_options console request saved output catalogue fitting calibrate deliverables "
    "batch main",
}
# What a user imports by name: each hands on what stands in this room, and so stands above it.
FACES = {"effects": "effects", "plot": "_plots", "bayescal": "_report"}


class Import(NamedTuple):
    """One import of a module of this package, seen in another."""

    importer: str
    imported: str
    line: int


def order() -> list[str]:
    """Every module, from the ground up; a room's own docstring stands before its modules."""
    found = []
    for room, modules in ROOMS.items():
        found += [] if room in FACES else [room]
        found += [f"{room}.{module}" for module in modules.split()]
        found += [face for face, below in FACES.items() if below == room]
    return found


ORDER = order()


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
    for node in ast.walk(ast.parse(modules[name].read_text("utf-8"))):
        for asked in imported_names(node, package):
            inner = asked.removeprefix(package).removeprefix(".")
            while inner and inner not in modules:  # an attribute of a module: the module counts
                inner = inner.rpartition(".")[0]
            yield Import(name, inner or package, getattr(node, "lineno", 0))


IMPORTS = [found for name in MODULES for found in imports_of(name, MODULES, "bayescal")]


def test_every_module_stands_in_a_room() -> None:
    assert len(ORDER) == len(set(ORDER)), "a module stands in two places"
    new, gone = set(MODULES) - set(ORDER), set(ORDER) - set(MODULES)
    assert not new, f"give these modules a place in ROOMS: {sorted(new)}"
    assert not gone, f"these modules are gone, take them out of ROOMS: {sorted(gone)}"


def test_rooms_are_few_and_small() -> None:
    assert len(ROOMS) <= MOST_ROOMS
    folders = [
        f
        for top in (PACKAGE, MODELS, ROOT / "tests", ROOT / "benchmarks")
        for f in (top, *top.rglob("*"))
    ]
    crowded = {
        str(folder.relative_to(ROOT)): count
        for folder in folders
        if folder.is_dir()
        and (count := len([f for f in folder.glob("*.py") if f.name != "__init__.py"]))
        > MOST_IN_A_ROOM
    }
    assert not crowded, f"more than {MOST_IN_A_ROOM} modules: {crowded}"


def test_imports_point_down() -> None:
    upward = {
        f"bayescal/{found.importer} line {found.line} imports {found.imported} above it"
        for found in IMPORTS
        if ORDER.index(found.imported) >= ORDER.index(found.importer)
    }
    assert not upward, "\n".join(sorted(upward))


def test_rooms_say_what_lives_there_and_hand_nothing_on() -> None:
    for room in ROOMS:
        tree = ast.parse(MODULES[room].read_text("utf-8"))
        assert ast.get_docstring(tree), f"bayescal/{room}/__init__.py: say what lives here"
        assert room in FACES or len(tree.body) == 1, f"bayescal/{room}/__init__.py: no re-exports"


def test_instruments_import_in_one_direction() -> None:
    graph = {
        name: {
            found.imported
            for found in imports_of(name, INSTRUMENT_MODULES, "bayescal_models")
            if found.imported != name
        }
        for name in INSTRUMENT_MODULES
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"a circle of imports: {' → '.join(error.args[1])}")


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
        for node in ast.walk(ast.parse(file.read_text("utf-8")))
        for asked in imported_names(node, "bayescal")
        if any(part.startswith("_") for part in asked.split("."))
    ]
    assert not private, "\n".join(private)


def test_the_framework_knows_no_instrument() -> None:
    knowing = [
        f"bayescal/{name} line {getattr(node, 'lineno', 0)} imports {asked}"
        for name, file in MODULES.items()
        for node in ast.walk(ast.parse(file.read_text("utf-8")))
        for asked in imported_names(node, "bayescal_models")
    ]
    assert not knowing, "\n".join(knowing)


def written_by_hand() -> dict[str, str]:
    """Texts of all Python files of the project, by their path."""
    folders = [ROOT / name for name in ("bayescal", "models", "benchmarks", "tests")]
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
    files += sorted((ROOT / "docs").glob("*.py"))
    return {str(file.relative_to(ROOT)): file.read_text("utf-8") for file in files}


def test_files_can_be_read_in_one_sitting() -> None:
    lengths = {name: len(text.splitlines()) for name, text in written_by_hand().items()}
    long = {name: length for name, length in lengths.items() if length > LONGEST}
    assert not long, f"split along the concept: {long}"


def test_functions_can_be_seen_at_once() -> None:
    lengths = {
        f"{name}, {node.name} in line {node.lineno}": node.end_lineno - node.lineno + 1
        for name, text in written_by_hand().items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None
    }
    tall = {name: length for name, length in lengths.items() if length > TALLEST}
    assert not tall, f"split along the concept: {tall}"


def test_one_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["version"] == bayescal.__version__
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text("utf-8"), re.MULTILINE)
    assert cited is not None and cited[1] == bayescal.__version__


def test_names_that_are_to_go_are_gone_in_the_version_that_was_said() -> None:
    renamed = set(bayescal._RENAMED)  # pyright: ignore[reportAttributeAccessIssue]
    assert not renamed or tuple(map(int, bayescal.__version__.split(".")[:2])) < (0, 3)


def test_every_instrument_is_offered_to_the_command_line() -> None:
    from bayescal_models import INSTRUMENTS

    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    offered = project["entry-points"]["bayescal.instruments"]
    assert offered == {name: f"bayescal_models.{name}:INSTRUMENT" for name in INSTRUMENTS}


@pytest.mark.parametrize("group", ["bayescal.demos", "bayescal.pair_selections"])
def test_what_is_offered_beside_an_instrument_is_there(group: str) -> None:
    from bayescal_models import INSTRUMENTS

    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    for name, place in project["entry-points"][group].items():
        module, _, attribute = place.partition(":")
        assert name in INSTRUMENTS
        assert callable(getattr(import_module(module), attribute))
