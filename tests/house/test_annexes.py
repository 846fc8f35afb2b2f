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

# What one annex has from another: the workbench offers what these decide and write.
FROM_OTHERS = {("workbench", "imu"), ("workbench", "metrology")}

# What annexes still have from behind the two faces, `bayescal` and `bayescal.workshop`: a list that gets shorter.
BEHIND = {
    "fleet": """
        _calibration.claim: Claim
        _calibration.judgement: noiseless
        _core: deadline
        _core.importance_weights: smoothed
        _core.jax_setup: obey_no_folder
        _core.settings: settings unusual
        _data.column: ConvertedColumns Place Source
        _data.column_conversion: convert_columns
        _data.dataset_checks: backward_time same_temperature
        _data.header_matching: MatchedFile
        _data.read_options: ExpectedColumns InstrumentLike output_name unit_of unused_options
        _inference: trust
        _inference.newton: ByValues climb gaussian_fit
        _inference.method: Method
        _inference.problem: Problem
        _inference.record: Record
        _inference.sampling: around_mode prior_share propose
        _model.frame: Frame build_frame reference_name reference_of
        _model.parameters: Layout bind
        _model.unknowns: Unknowns
        _search.discover: structures_over
        _search.library: Library
        _search.own_files: in_a_file
        _search.posterior: Posterior
        _search.walk: explore
        _tables.cells: Cells
        _tables.open_table: MAX_BYTES READ
        _tables.formats: arrow_cells arrow_headers
        _tables.raw_table: Table as_format load_whole refuse_large
    """,
    "imu": """
        _calibration.sensor_noise: FILTER_QUANTILE
        _cli.output: coefficients_text
        _core: deadline
        _core.inverse: stepped
        _core.jit: compiled
        _core.parallel: on_one_thread
        _data.pose_rows: ACROSS AXES DIRECTION MAGNITUDE MAGNITUDE_READ OF RATE TURNED ellipsoid magnitude
        _data.records: equal_runs
        _inference.problem: Problem
        _report.plot_colours: GREY
        _use.compensation_program: AGAIN STIMULUS inputs_at_fit
    """,
    "metrology": """
        _calibration.prior_influence: NotMeasured coefficients_not_measured not_measured
        _use.budget: notes_on
        _use.compensation_program: PAST averaged_over limits
        _use.operating_equation: ALL_DRAWS STIMULUS equation_in_use
    """,
    "workbench": """
        _calibration.check: covariates_of place_in_words
        _calibration.summary: null_directions unknown_rows
        _core: deadline
        _model.effect: with_forms
        _model.formula: Formula
        _model.installed: GROUP installed_names
        _report.plot_colours: BLUE CYCLE GREEN ORANGE PURPLE RED SKY
        _report.report: Pictures
        _report.whole_folder: AGAIN
        _search.calibrate: Loop QUICK step_of
        _search.discover: SEARCH
        _search.gate: judged
        _search.noise_laws: laws_over
        _search.own_files: in_a_file
        _search.search_path: Step steps_table
        _search.structures: SIZE_FACTORS Structure
    """,
}


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
            yield from [("", node.attr, where)] * (node.value.id in ("bc", "bayescal"))


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
    """And on nothing behind them but what is listed, of which nothing is left out that is no longer needed."""
    found: dict[str, dict[str, set[str]]] = {annex: {} for annex in BEHIND}
    for module in MODULES:
        for of, name, _ in imported(module):
            behind = of not in ("", "workshop") and not annex_of(f"{of}.{name}")
            if behind and (annex := annex_of(module)):
                found[annex].setdefault(of, set()).add(name)
    listed = {
        annex: {of: {*names.split()} for of, names in re.findall(r"(\S+):(.*)", text)}
        for annex, text in BEHIND.items()
    }
    assert found == listed


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
from bayescal._cli.main import command

def called(*words):
    sys.argv[1:] = words
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        status = command()
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
    assert f"bayescal.{name} is of an annex that is not there" in unnamed
