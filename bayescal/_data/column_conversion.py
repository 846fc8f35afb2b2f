"""From a file's columns to an instrument's numbers; all that is wrong with them is noted before any of it is said."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bayescal._core.errors import InputError
from bayescal._data.column import TAKEN, Column, ConvertedColumns
from bayescal._data.column_matching import (
    InstrumentLike,
    ReadOptions,
    channels_beside,
    expected_columns,
    match,
    output_name,
    unit_of,
    with_fixed_units,
)
from bayescal._data.column_reader import ColumnReader
from bayescal._data.header_matching import could_be, note_missing, understood
from bayescal._data.header_reading import like_a_unit, plain, spelled, unit_in
from bayescal._data.unit_conversion import base_unit
from bayescal._data.unit_parsing import ANY
from bayescal._tables.problems import Problem, Problems, option
from bayescal._tables.raw_table import Table, load_whole

_DAYS = ("date", "datum", "day", "tag")  # a column of these beside one of times of day


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
    offered, proposed = note_missing(table, expected, positions, instrument, problems, options)
    expected = with_fixed_units(expected, table, positions, options, problems)
    others = {n: p for n, p in positions.items() if n in expected or p not in proposed}
    others = {} if options.only else others
    extra, flags = extra_columns(table, expected, others, options, problems)
    converted = ConvertedColumns(flags=[*table.notes, *flags])
    found = {n: c for n, c in (expected | extra).items() if n in positions}
    problems += table.problems
    found |= {n: expected[n] for n in offered}  # looked at already, whether or not they are meant
    positions |= {name: position for name, (position, _) in offered.items()}
    if not table.readable:
        found = {}
    day = _day_position(table, positions) if "time" in found else None
    wanted = {positions[n]: c.unit is not None for n, c in found.items()}
    cells = load_whole(table, wanted if day is None else {**wanted, day: True})
    if day is not None:
        cells[positions["time"]] = cells[positions["time"]].on_days(cells[day], options.date_order)
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
    _note_channels(table, converted, set(extra), positions, output_name(instrument))
    return converted


def _note_channels(
    table: Table,
    converted: ConvertedColumns,
    extra: set[str],
    positions: Mapping[str, int],
    output: str,
) -> None:
    """Note which of the columns that no instrument asked for are channels of the output's unit, and say so."""
    if output not in converted.values:
        return
    own = table.headers[positions[output]].name
    others = {n: u for n, u in converted.units.items() if n in extra}
    converted.beside.update(channels_beside(own, others, converted.units[output]))
    if converted.beside:
        names = ", ".join(sorted(converted.beside))
        converted.flags.append(
            f"{table.file}: {names}: other channels beside the output {own!r}, not taken as its causes (--covariates "
            "NAME, in Python covariates=, to let one be)"
        )


def _day_position(table: Table, positions: Mapping[str, int]) -> int | None:
    """Where a column of days stands beside one of times of day."""
    found = [
        i for i, h in enumerate(table.headers) if plain(h.name) in _DAYS and i != positions["time"]
    ]
    return found[0] if len(found) == 1 else None


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
    problems: Problems,
) -> tuple[dict[str, Column], list[str]]:
    """The columns beyond the instrument's that are kept, in base units, and why others are not.

    One that the instrument could use, or that ends in what may be a unit and is none known here, is a problem: what is
    left out is left out because somebody says so.
    """
    kept: dict[str, Column] = {}
    flags: list[str] = []
    without_unit: list[str] = []
    for name in (n for n in positions if n not in expected):
        header = table.headers[positions[name]]
        if not options.others.isdisjoint((header.name, header.raw)) or options.leaves_out(header):
            continue
        if plain(header.name) in _DAYS and "time" in positions:
            continue  # taken with the time of day
        unit = unit_of(header, name, options)
        if name in TAKEN:
            flags.append(f"{table.file}: column {header.raw!r} ignored: the name {name!r} is taken")
            continue
        try:
            base = base_unit(unit) if unit else None
        except InputError:
            base = None
        if base is not None:
            kept[name] = Column(name, base, required=False)
        elif unit or (unit := like_a_unit(header)) or could_be(header, expected, positions):
            problems.append(_unclear(table, positions[name], unit, expected, positions))
        else:
            without_unit.append(header.raw)
    without_unit += [
        f"column {i + 1}, without a name"
        for i, h in enumerate(table.headers)
        if not h.name and not options.only
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


def _unclear(
    table: Table,
    position: int,
    unit: str | None,
    expected: Mapping[str, Column],
    positions: Mapping[str, int],
) -> Problem:
    """The problem of a column that would be left out and may be of use: how to keep it, and how to leave it out."""
    header = table.headers[position]
    meant = could_be(header, expected, positions)
    kind = expected[meant].unit if meant else None
    known = unit_in(unit or "", (kind or ANY,)) or spelled(unit or "")
    came = f"ends in [{unit}], no unit known here" if unit else "has no unit"
    left = option("--ignore", header.raw)
    keep = option(
        "--unit", f"{header.raw}={known or expected[meant].example if meant else known or 'UNIT'}"
    )
    if meant:
        dates = meant == "time" and load_whole(table, {position: True})[position].dates
        keep = option("--columns", f"{meant}={header.raw}") + (f" {keep}" if not dates else "")
        cure = f"It may be {meant}: say so and in which unit, or leave the column out: {left}"
        return Problem(
            table.file, came, f"{meant} [{expected[meant].example}]", cure, keep, header.raw
        )
    other = left if known else keep
    cure = (
        f"Leave the column out, or say its unit: {other}"
        if not known
        else f"Say its unit, or leave the column out: {other}"
    )
    return Problem(table.file, came, "a unit known here", cure, keep if known else left, header.raw)
