"""Which header means which column: what has one reading is taken and said, what looks like a column is offered."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

from bayescal._core.errors import InputError
from bayescal._data.column import UNCERTAINTY, Column
from bayescal._data.column_matching import (
    InstrumentLike,
    ReadOptions,
    expected_columns,
    output_name,
)
from bayescal._data.header_reading import Reading, plain, readings_of, unit_behind, unit_in
from bayescal._data.unit_conversion import pretty, same_dimension
from bayescal._data.unit_parsing import ANY
from bayescal._tables.problems import Problem, Problems, option
from bayescal._tables.raw_table import Header, Table, in_one_line

# Further names of columns that many instruments have, the likeliest first; a single letter counts as it is written.
_SYNONYMS: dict[str, tuple[tuple[str, ...], ...]] = {
    "time": (
        ("t", "timestamp", "time_stamp", "date_time", "datetime", "epoch", "unix_time", "utc", "time_utc", "utc_time"),
        ("date_and_time", "time_and_date", "zeitstempel", "datum_uhrzeit", "datum_zeit", "scan_time"),
        ("sample_time", "start_time", "local_time"),
        ("elapsed", "elapsed_time", "relative_time", "x_value", "millis", "zeit", "uhrzeit", "time_of_day", "heure"),
        ("date", "datum"),
    ),
    "temperature": (("T", "temperatur", "thermometer"),),
    "run": (("run_no", "run_nr", "run_number", "run_id", "test_run"),),
    "device": (("device_id", "serial", "serial_no", "serial_number", "sn"),),
}  # fmt: skip
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
        position = _named(headers, in_one_line(theirs))
        if position is not None:
            free.discard(position)
            kinds = _kinds(ours, expected, raw_unit)
            found = _fitting(headers[position], kinds, options.units)
            own = {headers[position].name, headers[position].raw}
            name = headers[position].name if in_one_line(theirs) in own else in_one_line(theirs)
            take(position, found or Reading(name, headers[position].unit), name, ours)
    exact = {headers[i].name for i in free}
    named = _by_name(headers)
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
        found = _candidates(column, headers, named, free, kinds, options.units)
        if len(found) == 1:
            position, reading = found.popitem()
            free.discard(position)
            take(position, reading, name, name)
    for i in free:
        reading = unit_behind(headers[i])
        if reading and reading.name not in expected:
            take(i, reading, reading.name, reading.name)
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
    yield from map(set, _SYNONYMS.get(column.name, ()))


def _by_name(headers: Sequence[Header]) -> dict[str, list[int]]:
    """Where the headers are of which one reading has a name, as names are compared."""
    found: dict[str, list[int]] = {}
    for i, header in enumerate(headers):
        for name in {_compared(reading) for reading in readings_of(header)}:
            found.setdefault(name, []).append(i)
    return found


def _compared(reading: Reading) -> str:
    """The name of a reading as names are compared; a single letter is a symbol, whose case matters."""
    name = reading.name.strip()
    return name if len(name) == 1 else plain(name)


def _candidates(
    column: Column,
    headers: Sequence[Header],
    named: Mapping[str, list[int]],
    free: Collection[int],
    kinds: tuple[str, ...],
    given: Mapping[str, str],
) -> dict[int, Reading]:
    """The free headers that can be read as a column: under its own name, else under other names that it has."""
    for names in _names(column):
        at = sorted({i for name in names for i in named.get(name, ()) if i in free})
        found = {i: r for i in at if (r := next(_meant(headers[i], names, kinds, given), None))}
        if found:
            return found
    return {}


def _meant(
    header: Header, names: set[str], kinds: tuple[str, ...], given: Mapping[str, str]
) -> Iterator[Reading]:
    """The reading of a header as a column of one of these names, in a unit of its kind or in none."""
    for reading in sorted(readings_of(header), key=lambda r: r.unit is None):  # "T (°)" has one
        if _compared(reading) not in names:
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
    table: Table,
    column: Column,
    alike: Sequence[Header],
    instrument: str,
    one: bool,
    options: ReadOptions,
    output: str,
) -> Problem:
    """The problem that a file has no such column, with the headers that look like it."""
    asked = f"{column.name} [{column.example}]" if column.unit else column.name
    names = ", ".join(header.raw or "(no name)" for header in table.headers)
    told, chosen = "", ""
    if alike:
        told = f"{', '.join(h.raw for h in alike[:4])} look{'s' * (len(alike) == 1)} like it. "
        chosen = option("--columns", f"{column.name}={alike[0].raw}")
        raw = next((r.unit for r in readings_of(alike[0]) if _raw(r.unit or "")), None)
        if (
            raw
            and options.nominal_scale is None
            and column.unit not in (None, ANY)
            and not _fits(raw, (column.unit,))
        ):
            per = f"({column.unit})" if "/" in column.unit else column.unit
            chosen += f" {option('--nominal-scale', f'NUMBER {unit_in(raw, (ANY,))}/{per}')}"
            told += "The nominal scale says what one unit of output is of it; --nominal-zero what it is at zero. "
        if len(alike) > 1 and column.name == output:
            together = ",".join(h.name for h in alike if "," not in h.name)
            told += (
                f"Together, as channels of one unit: calibrate {option('--channels', together)}. "
            )
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
        option=chosen if one else "",
        column=column.name,
        sentence=sentence,
    )


def _alike(column: Column, headers: list[Header], raw_output: bool) -> list[Header]:
    """Headers that may mean a column: by a name nearly its own, by what is usual, or by their unit."""
    names = {h.raw: {plain(r.name) for r in readings_of(h)} for h in headers}
    known = [name for own in names.values() for name in own]
    word = plain(column.name)
    close = {
        *difflib.get_close_matches(word, known, 1, 0.75),
        *(n for n in known if word in n.split("_")),
    }
    kinds = (column.unit or "",)
    fitting = [h for h in headers if any(_fits(r.unit or "", kinds) for r in readings_of(h))]
    fits = {h.raw for h in fitting}
    if near := [h for h in headers if not names[h.raw].isdisjoint(close)]:
        return [h for h in near if h.raw in fits] or near
    if column.unit is None:
        return []
    usual = [w for unit, w in _LIKELY.items() if column.unit == ANY or _same(unit, column.unit)]
    named = [h for h in headers for words in usual if plain(h.name).startswith(words)]
    raw = (
        [h for h in headers if any(_raw(r.unit or "") for r in readings_of(h))]
        if raw_output
        else []
    )
    return [h for h in named if h.raw in fits] or named or fitting or raw


def _raw(unit: str) -> bool:
    """Whether a unit is one of a sensor's raw output, which a nominal scale turns into another."""
    known = unit_in(unit, (ANY,))
    return bool(known) and any(_same(str(known), kind) for kind in ("V", "Hz", "A", "count"))


def _fits(unit: str, kinds: tuple[str, ...]) -> bool:
    """Whether a unit is of these kinds; one that is of another kind too (deg) is not."""
    other = bool(unit_in(unit, (ANY,))) and not any(
        _same(unit, kind) for kind in kinds if kind != ANY
    )
    return bool(unit_in(unit, kinds)) and (ANY in kinds or not other)


def _same(a: str, b: str) -> bool:
    try:
        return same_dimension(a, b)
    except InputError:
        return False


def note_missing(
    table: Table,
    expected: Mapping[str, Column],
    positions: Mapping[str, int],
    instrument: InstrumentLike,
    problems: Problems,
    options: ReadOptions,
) -> tuple[dict[str, tuple[int, Header]], set[int]]:
    """Note the columns that the instrument needs and a file has not.

    Columns whose header the user has said are not among them: that the file lacks it is a problem already.

    Returns:
        Those that one header looks like, and where; and where all headers stand that look like one.
    """
    offered: dict[str, tuple[int, Header]] = {}
    said, output = options.columns, output_name(instrument)
    taken = {positions[name] for name in expected if name in positions}
    free = [h for i, h in enumerate(table.headers) if h.name and i not in taken]
    lacking = [
        c
        for name, c in expected.items()
        if c.required and c.default is None and name not in positions and name not in said
    ]
    alike = {c.name: _alike(c, free, c.name == output) for c in lacking}
    place = {h.raw: i for i, h in reversed([*enumerate(table.headers)])}
    single = [found[0].raw for found in alike.values() if len(found) == 1]
    for column in lacking:
        found = alike[column.name]
        one = len(found) == 1 and single.count(found[0].raw) == 1  # no column is proposed for two
        problems.append(
            _missing_column(table, column, found, instrument.name, one, options, output)
        )
        if one:
            like, kinds = (
                found[0],
                (column.unit or "1", *("V", "Hz", "A", "count") * (column.name == output)),
            )
            reading = _fitting(like, kinds, {})
            named = like if reading is None else Header(like.raw, like.name, reading.unit)
            offered[column.name] = (place[like.raw], named)
    return offered, {place[h.raw] for found in alike.values() for h in found}


def could_be(
    header: Header, expected: Mapping[str, Column], positions: Mapping[str, int]
) -> str | None:
    """The column that the instrument could use, which the file lacks and a header names in part; None for none."""
    for name, column in expected.items():
        lacking = column.required and column.default is None  # which is said of the file
        if column.unit is None or name in positions or lacking or name == UNCERTAINTY:
            continue
        own = {plain(n) for n in (name, *column.also)} | {
            n for ns in _SYNONYMS.get(name, ()) for n in ns if len(n) > 2
        }
        for reading in readings_of(header):
            words = plain(reading.name)
            if words in own or set(plain(name).split("_")) <= set(words.split("_")):
                return name
    return None
