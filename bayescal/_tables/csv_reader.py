"""CSV as a table: what the first pass let pass is read in a second, a stretch of rows at a time."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from bayescal._core.quoting import csv_cell_read
from bayescal._tables.cells import Cells, numbers_of
from bayescal._tables.csv_scan import CsvScan, opened, ragged_rows, scan_csv
from bayescal._tables.raw_table import Header, Table, after

_ROWS = 100_000  # rows whose text is held at a time


def open_csv(path: Path, file: str, decimal: str = "") -> Table:
    """Look through a CSV file: comma, semicolon or tab between fields.

    Args:
        path: where it is.
        file: its name in messages.
        decimal: a point or a comma; empty for a point, or a comma where semicolons or tabs part the fields and a
            number such as 20,5 shows that it parts no thousands.

    Returns:
        The table; rows of unequal length are its `problems`.

    Raises:
        InputError: it is empty, in an encoding that cannot be told, or ends lines in a way that cannot be counted;
            the message names the row.
    """
    scan = scan_csv(path, file, decimal)
    return Table(
        file=file,
        headers=tuple(Header.parse(csv_cell_read(text)) for text in scan.header),
        rows=scan.lines - len(scan.blanks),
        sha256=scan.sha256,
        load=lambda wanted: _load(path, scan, wanted),
        place=scan.place,
        notes=_notes(scan),
        problems=ragged_rows(scan),
        readable=len(scan.passed_over) == len(scan.ragged),
    )


def _notes(scan: CsvScan) -> tuple[str, ...]:
    """How a file was read that is not UTF-8 with decimal points."""
    notes = []
    if scan.encoding != "utf-8":
        notes.append(f"{scan.file}: read as {scan.encoding}")
    if scan.decimal == ",":
        notes.append(f"{scan.file}: its numbers have decimal commas")
    if scan.above:
        notes.append(
            f"{scan.file}: its columns are named in row {scan.named}; what stands above it is left out"
        )
    if scan.first - scan.named > 1:
        notes.append(f"{scan.file}: its units are taken from row {scan.named + 1}")
    return tuple(notes)


@dataclass(frozen=True)
class CsvLines:
    """Some lines of a file as they stand.

    Attributes:
        lines: with their ends; blank ones among them.
        table: their readings; None for the header.
        separator: between fields.
        decimal: between the whole and its parts.
        before: of the header: the lines above it.
        behind: of the header: the row of units below it, and such.
    """

    lines: list[bytes]
    table: Table | None
    separator: str
    decimal: str = "."
    before: list[bytes] = field(default_factory=list)
    behind: list[bytes] = field(default_factory=list)


def csv_parts(path: Path, file: str, rows: int, decimal: str = "") -> Iterator[CsvLines]:
    """A file that `open_csv` let pass, a stretch of rows at a time: its header first, then its readings.

    Args:
        path: where it is.
        file: its name in messages.
        rows: readings in a stretch, at most.
        decimal: as `open_csv` takes it.
    """
    scan = scan_csv(path, file, decimal)
    headers = tuple(Header.parse(csv_cell_read(text)) for text in scan.header)
    done = 0
    with opened(path, scan.encoding) as handle:
        above: list[bytes] = []
        while handle.tell() < scan.offset:
            above.append(handle.readline())
        named = scan.named - 1
        before, header, behind = above[:named], above[named], above[named + 1 :]
        yield CsvLines([header], None, scan.separator, before=before, behind=behind)
        while lines := list(islice(handle, rows)):
            while not any(line.strip() for line in lines) and (more := handle.readline()):
                lines.append(more)  # a stretch of blank lines is no table
            count = sum(bool(line.strip()) for line in lines)
            if count:

                def load(wanted: Mapping[int, bool], lines=lines) -> dict[int, Cells]:
                    return _cells(lines, scan, wanted)

                table = Table(
                    file=file,
                    headers=headers,
                    rows=count,
                    sha256=scan.sha256,
                    load=load,
                    place=after(done, scan.place),
                )
                yield CsvLines(lines, table, scan.separator, scan.decimal or ".")
            done += count


def _load(path: Path, scan: CsvScan, wanted: Mapping[int, bool]) -> dict[int, Cells]:
    with opened(path, scan.encoding) as handle:
        handle.seek(scan.offset)
        return _cells(handle, scan, wanted)


def _cells(handle: Iterable[bytes], scan: CsvScan, wanted: Mapping[int, bool]) -> dict[int, Cells]:
    """The wanted columns, a stretch of rows at a time, so that only one stretch is held as text."""
    parts: dict[int, list[Cells]] = {position: [] for position in wanted}
    lines = iter(handle)
    if scan.passed_over:
        numbered = enumerate(lines, scan.first)
        lines = (line for row, line in numbered if row not in scan.passed_over)
    while stretch := list(islice(lines, _ROWS)):
        fields = _fields([line for line in stretch if line.strip(scan.blank)], scan)
        for position, number in wanted.items():
            texts = fields[position :: len(scan.header)]
            labels = [] if number else [csv_cell_read(text.strip()) for text in texts]
            parts[position].append(
                numbers_of(texts, scan.decimal) if number else Cells(np.array(labels, dtype=object))
            )
    return {position: Cells.joined(found) for position, found in parts.items()}


def _fields(lines: Sequence[bytes], scan: CsvScan) -> list[str]:
    """The fields of rows, one row after the other."""
    text = scan.text(b"".join(lines)).replace("\r\n", "\n").removesuffix("\n")
    if '"' in text:
        rows = csv.reader(text.split("\n"), delimiter=scan.separator)
        return [field for row in rows for field in row]
    return text.replace("\n", scan.separator).split(scan.separator) if lines else []
