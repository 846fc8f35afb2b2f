"""Which header means which column: what has one reading is taken and said, what looks like a column is offered."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

from bayescal._core.errors import InputError
from bayescal._readings.column import Column
from bayescal._readings.column_matching import (
    InstrumentLike,
    ReadOptions,
    expected_columns,
    output_name,
)
from bayescal._readings.header_reading import Reading, plain, readings_of, unit_in
from bayescal._readings.unit_conversion import pretty, same_dimension
from bayescal._readings.unit_parsing import ANY
from bayescal._tables.problems import Problem, Problems, option
from bayescal._tables.raw_table import Header, Table

# Further names of columns that many instruments have; a single letter counts as it is written.
_SYNONYMS = {
    "time": ("t", "timestamp", "time_stamp", "date_time", "datetime", "date", "epoch", "unix_time")
    + ("utc", "time_utc", "utc_time"),
    "temperature": ("T",),
    "run": ("run_no", "run_nr", "run_number", "run_id", "test_run"),
    "device": ("device_id", "serial", "serial_no", "serial_number", "sn"),
}
# What is logged under a name that begins so, for a column that is missing.
_LIKELY = {
    "deg/s": ("gyr", "rate", "omega", "gx", "gy", "gz", "wx", "wy", "wz"),
    "ug": ("acc", "ax", "ay", "az"),
    "rad": ("tilt", "angle", "incl", "roll", "pitch"),
}


def understood(table: Table, instrument: InstrumentLike, options: ReadOptions) -> Table:
    """The table with the headers that have one reading as columns of the instrument, and notes that say so.

    A column that the file holds under its own name, or that `columns=` names, is not looked for.
    """
    expected = expected_columns(instrument)
    headers, notes = list(table.headers), list(table.notes)
    raw_unit = _raw_unit(instrument, options)

    def take(position: int, reading: Reading, name: str, say: str) -> None:
        old = headers[position]
        headers[position] = Header(old.raw, name, reading.unit)
        if (reading.unit, name) != (old.unit, old.name):
            unit = f" in {pretty(reading.unit)}" if reading.unit else ""
            notes.append(f"{table.file}: read {old.raw!r} as {say}{unit}")

    free = set(range(len(headers)))
    for ours, theirs in options.columns.items():
        position = _named(headers, theirs.strip())
        if position is not None:
            free.discard(position)
            kinds = _kinds(ours, expected, raw_unit)
            found = _fitting(headers[position], kinds, options.units)
            own = {headers[position].name, headers[position].raw}
            name = headers[position].name if theirs.strip() in own else theirs.strip()
            take(position, found or Reading(name, headers[position].unit), name, ours)
    exact = {headers[i].name for i in free}
    for name, column in expected.items():
        kinds = _kinds(name, expected, raw_unit)
        if name in options.columns:
            continue
        if not exact.isdisjoint((name, *column.also)):
            candidates = [
                (i, Reading(h.name, h.unit)) for i in free if (h := headers[i]).name == name
            ]
            for i, reading in candidates:
                unit = reading.unit and unit_in(reading.unit, kinds)
                take(i, reading._replace(unit=unit or reading.unit), name, name)
            free -= {i for i, _ in candidates}
            continue
        found = _candidates(column, {i: headers[i] for i in sorted(free)}, kinds, options.units)
        if len(found) == 1:
            position, reading = found.popitem()
            free.discard(position)
            take(position, reading, name, name)
    for i in free:
        header = headers[i]
        for reading in readings_of(header):
            further = reading.unit and reading.name not in expected and header.raw[-1] in ")]}"
            if further and not header.unit and unit_in(reading.unit or "", (ANY,)):
                take(i, reading, reading.name, reading.name)
                break
    return replace(table, headers=tuple(headers), notes=tuple(notes))


def _raw_unit(instrument: InstrumentLike, options: ReadOptions) -> dict[str, str]:
    """The unit of a raw output, which the nominal scale converts."""
    scale = options.nominal_scale or instrument.nominal_scale
    names = (output_name(instrument), "output_uncertainty")
    return dict.fromkeys(names, scale.unit) if scale else {}


def _kinds(name: str, expected: Mapping[str, Column], raw: Mapping[str, str]) -> tuple[str, ...]:
    """Units of the kinds that a column may be in; "any" for one that no instrument knows; none for a label."""
    column = expected.get(name)
    if column is not None and column.unit is None:
        return ()
    unit = ANY if column is None or column.unit is None else column.unit
    return (unit, raw[name]) if name in raw and unit != ANY else (unit,)


def _named(headers: list[Header], name: str) -> int | None:
    """Where a header is that a user calls so: all of it, its name, or its name in one of its readings."""
    for names in (
        lambda h: [h.raw],
        lambda h: [h.name],
        lambda h: [r.name for r in readings_of(h)],
    ):
        found = [i for i, header in enumerate(headers) if name in names(header)]
        if len(found) == 1:
            return found[0]
    return None


def _names(column: Column) -> Iterator[set[str]]:
    """The names that a column may have in a file: first its own, then others."""
    yield {plain(n) for n in (column.name, *column.also)}
    if column.name in _SYNONYMS:
        yield set(_SYNONYMS[column.name])


def _candidates(
    column: Column, headers: Mapping[int, Header], kinds: tuple[str, ...], given: Mapping[str, str]
) -> dict[int, Reading]:
    """The headers that can be read as a column: under its own name, else under other names that it has."""
    for names in _names(column):
        found = {
            i: r for i, h in headers.items() if (r := next(_meant(h, names, kinds, given), None))
        }
        if found:
            return found
    return {}


def _meant(
    header: Header, names: set[str], kinds: tuple[str, ...], given: Mapping[str, str]
) -> Iterator[Reading]:
    """The reading of a header as a column of one of these names, in a unit of its kind or in none."""
    for reading in readings_of(header):
        name = reading.name.strip()
        if (name if len(name) == 1 else plain(name)) not in names:
            continue
        if reading.unit is None:
            yield reading
        elif unit := unit_in(reading.unit, kinds):
            yield reading._replace(unit=unit)
        elif header.raw in given or reading.name in given:
            unit = given.get(reading.name, "")
            yield reading._replace(unit=unit if unit_in(unit, (ANY,)) else None)


def _fitting(header: Header, kinds: tuple[str, ...], given: Mapping[str, str]) -> Reading | None:
    """The reading of a header with a unit of its kind, if it has just one."""
    found = {
        unit: reading._replace(unit=unit)
        for reading in readings_of(header)
        if reading.unit
        and (unit := unit_in(reading.unit, kinds))
        and any(map(str.isalpha, pretty(unit)))
    }
    return found.popitem()[1] if len(found) == 1 and header.raw not in given else None


def _missing_column(
    table: Table, column: Column, alike: Sequence[Header], instrument: str
) -> Problem:
    """The problem that a file has no such column, with the headers that look like it."""
    asked = f"{column.name} [{column.example}]" if column.unit else column.name
    names = ", ".join(header.raw or "(no name)" for header in table.headers)
    told, chosen = "", ""
    if alike:
        told = f"{', '.join(h.raw for h in alike[:4])} look{'s' * (len(alike) == 1)} like it. "
        chosen = option("--columns", f"{column.name}={alike[0].raw}")
    meaning = f" ({column.meaning})" if column.meaning else ""
    mapped = alike[0].raw if alike else "…"
    shown = chosen or f"--columns {column.name}=…"
    sentence = (
        f"{table.file!r} lacks the column {column.name!r}{meaning} that {instrument!r} needs; it "
        f"has: {names}. {told}Add a column {asked!r}, or say which one it is with "
        f"columns={{{column.name!r}: {mapped!r}}} ({shown})"
    )
    return Problem(
        table.file,
        "no such column",
        asked,
        f"{told}Add such a column, or say which it is",
        option=chosen if len(alike) == 1 else "",
        column=column.name,
        sentence=sentence,
    )


def _alike(column: Column, headers: list[Header]) -> list[Header]:
    """Headers that may mean a column: by a name nearly its own, by what is usual, or by their unit."""
    close = difflib.get_close_matches(plain(column.name), [plain(h.name) for h in headers], 1, 0.75)
    if close:
        return [h for h in headers if plain(h.name) in close]
    if column.unit is None:
        return []
    kinds = (column.unit,)
    usual = [w for unit, w in _LIKELY.items() if column.unit == ANY or _same(unit, column.unit)]
    named = [h for h in headers for words in usual if plain(h.name).startswith(words)]
    fitting = [h for h in headers if any(unit_in(r.unit or "", kinds) for r in readings_of(h))]
    return [h for h in named if h in fitting] or named or fitting


def _same(a: str, b: str) -> bool:
    try:
        return same_dimension(a, b)
    except InputError:
        return False


def note_missing(
    table: Table,
    expected: Mapping[str, Column],
    positions: Mapping[str, int],
    instrument: str,
    problems: Problems,
    said: Collection[str] = (),
) -> dict[str, tuple[int, Header]]:
    """Note the columns that the instrument needs and a file has not; those that one header looks like, and where.

    Columns whose header the user has said are not among them: that the file lacks it is a problem already.
    """
    offered: dict[str, tuple[int, Header]] = {}
    taken = {positions[name] for name in expected if name in positions}
    for name, column in expected.items():
        if not column.required or name in positions or name in said:
            continue
        if column.default is None:
            free = [h for i, h in enumerate(table.headers) if h.name and i not in taken]
            alike = _alike(column, free)
            problems.append(_missing_column(table, column, alike, instrument))
            if len(alike) == 1:
                like = alike[0]
                reading = _fitting(like, (column.unit or "1",), {})
                named = like if reading is None else Header(like.raw, like.name, reading.unit)
                offered[name] = (table.headers.index(like), named)
    return offered
