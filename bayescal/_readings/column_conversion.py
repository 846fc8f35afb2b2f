"""From a file's columns to an instrument's numbers; all that is wrong with them is noted before any of it is said."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayescal._core.errors import InputError
from bayescal._readings.column import TAKEN, Column, ConvertedColumns
from bayescal._readings.column_matching import (
    InstrumentLike,
    ReadOptions,
    expected_columns,
    match,
    unit_of,
    with_fixed_units,
)
from bayescal._readings.column_reader import ColumnReader
from bayescal._readings.header_matching import note_missing, understood
from bayescal._readings.unit_conversion import base_unit
from bayescal._tables.problems import Problem, Problems
from bayescal._tables.raw_table import Table, load_whole


def convert_columns(
    table: Table,
    instrument: InstrumentLike,
    options: ReadOptions,
    problems: Problems | None = None,
) -> ConvertedColumns:
    """Check a file's columns and convert them.

    Args:
        table: the file.
        instrument: whose columns are expected.
        options: renamings, units, gravity, scale, and what becomes of missing readings.
        problems: to add to; the columns without any are converted all the same.

    Returns:
        Columns in the instrument's units, in its order, then what else was kept; of the rows without a missing
        reading, where such rows are dropped.

    Raises:
        InputError: a column, a unit or a cell cannot be used, and there are no `problems` to add to; the message
            names file, row and column.
    """
    own = Problems() if problems is None else problems
    before = len(own)
    converted = _converted(table, instrument, options, own)
    if problems is None:
        own.refuse()
    if converted.missing and len(own) == before:
        _drop(table, converted, own)
    if problems is None:
        own.refuse()
    return converted


def _converted(
    table: Table, instrument: InstrumentLike, options: ReadOptions, problems: Problems
) -> ConvertedColumns:
    expected = expected_columns(instrument)
    table = understood(table, instrument, options)
    positions = match(table, expected, options, problems)
    offered = note_missing(table, expected, positions, instrument.name, problems, options.columns)
    expected = with_fixed_units(expected, table, positions, options, problems)
    extra, flags = extra_columns(table, expected, positions, options)
    converted = ConvertedColumns(flags=[*table.notes, *flags])
    found = {n: c for n, c in (expected | extra).items() if n in positions}
    problems += table.problems
    found |= {n: expected[n] for n in offered}  # looked at already, whether or not they are meant
    positions |= {name: position for name, (position, _) in offered.items()}
    if not table.readable:
        found = {}
    cells = load_whole(table, {positions[n]: c.unit is not None for n, c in found.items()})
    readers = {
        name: ColumnReader(
            table=table,
            header=offered[name][1] if name in offered else table.headers[positions[name]],
            column=column,
            options=options,
            instrument=instrument,
            converted=converted,
            problems=problems,
        )
        for name, column in found.items()
    }
    for name, column in expected.items():
        if name in readers:
            readers[name].read(cells[positions[name]])
            converted.unread |= {name} - set(converted.values)
        if name not in converted.values and column.default is not None:
            kind = object if column.unit is None else np.float64
            converted.values[name] = np.full(table.rows, column.default, dtype=kind)
            converted.units[name] = column.unit
            converted.filled.add(name)
    for name in extra:
        if name in readers:
            readers[name].read_if_sound(cells[positions[name]])
    return converted


def _drop(table: Table, converted: ConvertedColumns, problems: Problems) -> None:
    """Leave the rows out in which a reading is missing, and say so; a problem if none would be left."""
    missing = {name: rows for name, (rows, _) in converted.missing.items()}
    gone = np.unique(np.concatenate(list(missing.values())))
    if len(gone) == table.rows:
        counts = ", ".join(f"{name} in {len(rows)}" for name, rows in missing.items())
        came = f"no row without a missing reading: {counts} of {table.rows} rows"
        problems.append(Problem(table.file, came))
        return
    converted.kept = np.setdiff1d(np.arange(table.rows), gone)
    converted.values = {name: v[converted.kept] for name, v in converted.values.items()}
    told = "; ".join(f"{name} in {_rows(table, rows)}" for name, rows in missing.items())
    converted.flags.append(
        f"{table.file}: {len(gone)} of {table.rows} rows dropped, where readings are missing: {told}"
    )


def _rows(table: Table, rows: np.ndarray) -> str:
    """Rows, the first few by number."""
    first = ", ".join(table.place(int(i)).removeprefix("row ") for i in rows[:3])
    if len(rows) == 1:
        return f"row {first}"
    return f"{len(rows)} rows ({first}{' …' * (len(rows) > 3)})"


def kept_table(table: Table, converted: ConvertedColumns) -> Table:
    """The table of the rows that were kept."""
    return table if converted.kept is None else table.take(converted.kept)


def extra_columns(
    table: Table,
    expected: Mapping[str, Column],
    positions: Mapping[str, int],
    options: ReadOptions,
) -> tuple[dict[str, Column], list[str]]:
    """The columns beyond the instrument's that are kept, in base units, and why others are not."""
    kept: dict[str, Column] = {}
    flags: list[str] = []
    without_unit: list[str] = []
    for name in (n for n in positions if n not in expected):
        header = table.headers[positions[name]]
        if not options.others.isdisjoint((header.name, header.raw)):
            continue
        unit = unit_of(header, name, options)
        if unit is None:
            without_unit.append(header.raw)
        elif name in TAKEN:
            flags.append(f"{table.file}: column {header.raw!r} ignored: the name {name!r} is taken")
        else:
            try:
                base = base_unit(unit)
            except InputError:
                flags.append(
                    f"{table.file}: column {header.raw!r} ignored: [{unit}] is no unit known here"
                )
            else:
                kept[name] = Column(name, base, required=False)
    without_unit += [
        f"column {i + 1}, without a name" for i, h in enumerate(table.headers) if not h.name
    ]
    if without_unit:
        needs_none = (n for n, c in expected.items() if c.unit is None or n == "time")
        lacking = [n for n in needs_none if n not in positions]
        meant = f"to say that one is {' or '.join(lacking)}: --columns NAME=HEADER; "
        flags.append(
            f"{table.file}: ignored, because they have no unit: {', '.join(without_unit)} "
            f"({meant if lacking else ''}to keep one beside the instrument's, write 'name [unit]' "
            "or give units=)"
        )
    return kept, flags
