"""The validation record: certified and computed values, NIST's data sets, and the installation."""

from __future__ import annotations

import hashlib
import math
import platform
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.validation import examples, nist_strd

NIST = "NIST StRD"
# Ten times the largest error of any set, as processors round differently.
PARAMETER_RTOL, SD_RTOL = 1e-7, 1e-6
HEAD = ("clause", "what is tested", "quantity", "certified", "value", "difference", "tolerance", "")
WIDTHS = (0.1, 0.34, 0.15, 0.09, 0.09, 0.09, 0.08, 0.06)  # widths of columns, share of the page
NIST_HEAD = ("set", "κ", "P", "parameters", "tolerance", "", "standard deviations", "tolerance", "")


class Row(NamedTuple):
    """A computed value and the certified value."""

    standard: str
    clause: str
    tested: str
    quantity: str
    certified: float
    value: float
    tolerance: float

    @property
    def passed(self) -> bool:
        return abs(self.value - self.certified) <= self.tolerance

    @property
    def cells(self) -> list[str]:
        """Return the cells of the row as text."""
        values = (ws.number(value, 7) for value in (self.certified, self.value))
        differences = (ws.number(v, 2) for v in (self.value - self.certified, self.tolerance))
        outcome = "passed" if self.passed else "FAILED"
        return [self.clause, self.tested, self.quantity, *values, *differences, outcome]


class Section(NamedTuple):
    """A part of the document: a table, with the widths of its columns as shares of the page."""

    title: str
    notes: Sequence[str]
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    widths: Sequence[float]


@cache
def load_clauses() -> dict[str, Any]:
    """Return the content of clauses.toml: standards, and clauses with their certified values."""
    return tomllib.loads(Path(__file__).with_name("clauses.toml").read_text("utf-8"))


@ws.renamed(data="to_json_data")
@dataclass(frozen=True)
class ValidationRecord:
    """Result of a validation.

    Attributes:
        rows: all values.
        nist: condition number κ and number P of lost digits, by NIST data set.
        standards: names of the standards that were run.
        installation: date, versions, machine and digests.
    """

    rows: tuple[Row, ...]
    nist: dict[str, tuple[float, float]]
    standards: tuple[str, ...]
    installation: dict[str, str]

    @property
    def failed(self) -> list[Row]:
        return [row for row in self.rows if not row.passed]

    def rows_of(self, standard: str) -> list[Row]:
        return [row for row in self.rows if row.standard == standard]

    def __str__(self) -> str:
        by_standard = ((name, self.rows_of(name)) for name in self.standards)
        counts = (
            (n, len({r.clause for r in o}), len(o), sum(not r.passed for r in o))
            for n, o in by_standard
        )
        head = ["standard", "clauses", "values", "failed"]
        table = ws.make_table(head, [[*map(str, row)] for row in counts])
        return "\n".join([str(table), *(" ".join((r.standard, *r.cells)) for r in self.failed)])

    def to_json_data(self) -> dict[str, Any]:
        """Return the record as JSON data."""
        rows = [{**row._asdict(), "passed": row.passed} for row in self.rows]
        nist = {name: {"condition": k, "performance": p} for name, (k, p) in self.nist.items()}
        head = {"schema": "bayescal.validation/1", "passed": not self.failed}
        return head | {"installation": self.installation, "rows": rows, "nist": nist}

    def sections(self) -> Iterator[Section]:
        """Yield the sections of the document: the installation, each standard, NIST's sets."""
        summary = f"{len(self.rows)} values: {len(self.failed) or 'none'} failed."
        yield Section("Installation", [summary], ["", ""], [*self.installation.items()], [0.2, 0.8])
        for standard in load_clauses()["standards"]:
            rows = self.rows_of(standard["name"])
            texts = [None, *(row.tested for row in rows)]
            is_same = [row.tested == text for row, text in zip(rows, texts, strict=False)]
            cells = [
                ["", "", *r.cells[2:]] if s else r.cells for r, s in zip(rows, is_same, strict=True)
            ]
            notes = [f"Not answered: {text}." for text in standard["not_answered"]]
            if rows:
                yield Section(standard["title"], notes, HEAD, cells, WIDTHS)
        cells_by_set = {name: [name, f"{k:.1e}", f"{p:.2f}"] for name, (k, p) in self.nist.items()}
        for row in self.rows_of(NIST):
            cells_by_set[row.clause] += [f"{row.value:.1e}", f"{row.tolerance:.0e}", row.cells[-1]]
        rows = [[*cells, *[""] * (len(NIST_HEAD) - len(cells))] for cells in cells_by_set.values()]
        if rows:
            title, widths = "NIST Statistical Reference Datasets, regression", [1 / 9] * 9
            yield Section(title, [nist_strd.ABOUT], NIST_HEAD, rows, widths)


def validate(standards: Sequence[str] = ()) -> ValidationRecord:
    """Compare computed examples with certified values, for the given standards or for all standards.

    Raises:
        InputError: a standard has no examples here.
    """
    names = [*(item["name"] for item in load_clauses()["standards"]), NIST]
    if unknown_names := [name for name in standards if name not in names]:
        raise bc.InputError(f"--standard {unknown_names[0]!r} is not one of {', '.join(names)}")
    chosen_names = tuple(name for name in names if name in (standards or names))
    clauses = [item for item in load_clauses()["clauses"] if item["standard"] in chosen_names]
    rows = [row for clause in clauses for row in _evaluate_clause(clause)]
    performance = dict[str, tuple[float, float]]()
    kinds = ("linear", "nonlinear") if NIST in chosen_names else ()
    for name in (name for kind in kinds for name in nist_strd.load_certificates(kind)):
        with ws.track(f"{NIST}, {name}"):
            estimates = nist_strd.fit_data_set(name)
        performance[name] = estimates[0].condition_number, max(e.performance for e in estimates)
        maxima = [max(errors) for errors in zip(*(item.errors for item in estimates), strict=True)]
        labels = NIST, name, "largest relative error, from every start"
        rows.append(Row(*labels, "parameters", 0.0, maxima[0], PARAMETER_RTOL))
        if name not in nist_strd.NOISELESS_DATA_SETS:
            rows.append(Row(*labels, "standard deviations", 0.0, maxima[1], SD_RTOL))
    return ValidationRecord(tuple(rows), performance, chosen_names, describe_installation())


def _evaluate_clause(clause: dict[str, Any]) -> Iterator[Row]:
    """Yield a row per compared value of a clause of a standard; values are NaN if its example raises an error."""
    inputs = {name: examples.resolve(value) for name, value in clause["given"].items()}
    result, error_text = None, ""
    with ws.track(f"{clause['standard']}, {clause['clause']}"):
        try:
            result = getattr(examples, clause["example"])(**inputs)
        except bc.BayescalError as error:
            error_text = f" ({error})"
    for quantity, path, certified, tolerance in clause["rows"]:
        value = math.nan if error_text else float(examples.pick(result, path))
        labels = clause["standard"], clause["clause"], clause["tested"] + error_text, quantity
        yield Row(*labels, float(examples.resolve(certified)), value, tolerance)


def describe_installation() -> dict[str, str]:
    """Return date, versions, machine and file digests of this installation, by label."""
    entries = {"date": datetime.now(UTC).isoformat(timespec="seconds"), **ws.versions("jaxlib")}
    parts = platform.python_implementation(), platform.machine(), platform.platform()
    entries["machine"] = ", ".join(parts)
    specs = (find_spec(name) for name in ("bayescal", "bayescal_models"))
    roots = [Path(str(spec.origin)).parent for spec in specs if spec is not None]
    entries["SHA-256 of the package's files"] = hash_folders(*roots)
    entries["SHA-256 of the certified data"] = hash_folders(examples.DATA)
    return entries


def hash_folders(*folders: Path) -> str:
    """Return a SHA-256 over the paths and digests of all files in `folders`, in the order of their paths."""
    file_digests = hashlib.sha256()
    for folder in folders:
        for file in sorted(folder.rglob("*")):
            if file.is_file() and "__pycache__" not in file.parts:
                path = file.relative_to(folder.parent).as_posix()
                file_digests.update(f"{path} {ws.compute_sha256(file)}\n".encode())
    return file_digests.hexdigest()
