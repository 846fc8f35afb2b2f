"""Which header means which column: what has one reading is taken and said, what looks like a column is offered.

A file may call its columns otherwise (`columns=`), and leave their units out or get them wrong (`units=`). Columns that
no instrument asked for are kept if they have a unit: an effect of the user may need them; no file is refused for them.
"""

from __future__ import annotations

import contextlib
import difflib
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

from bayescal._core.errors import InputError
from bayescal._data.column import UNCERTAINTY, Column
from bayescal._data.header_reading import Reading, plain, readings_of, unit_behind, unit_in
from bayescal._data.read_options import (
    InstrumentLike,
    ReadOptions,
    expected_columns,
    output_name,
    unit_of,
)
from bayescal._data.unit_conversion import alike, fixed_unit, pretty, same_dimension
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


def matched(
    table: Table, instrument: InstrumentLike, options: ReadOptions, problems: Problems
) -> tuple[Table, dict[str, int]]:
    """The table with its headers understood, and our name of every column → its position in the file.

    A header means a column of the instrument if it has one reading as such, which a note says. A column that the file
    holds under its own name, or that `columns=` names, is not looked for.

    Args:
        table: the file.
        instrument: whose columns are expected.
        options: renamings and units.
        problems: to add to, where `columns=` names what the file lacks, two columns would be one, or a label carries
            a unit.
    """
    expected, raw_unit = expected_columns(instrument), _raw_unit(instrument, options)
    headers, notes = list(table.headers), list(table.notes)
    positions: dict[str, int] = {}

    def take(position: int, reading: Reading, name: str, say: str) -> None:
        old = headers[position]
        headers[position] = Header(old.raw, name, reading.unit)
        if (reading.unit, name) != (old.unit, old.name):
            unit = f" in {pretty(reading.unit)}" if reading.unit else ""
            notes.append(f"{table.file}: read {old.raw!r} as {say}{unit}")

    def problem(came: str, column: str, cure: str) -> None:
        problems.append(Problem(table.file, came, cure=cure, column=column))

    for ours, theirs in options.columns.items():
        asked = in_one_line(theirs)
        position = _named(headers, asked)
        if position is None:
            came = f"no such column, but columns={{{ours!r}: {theirs!r}}}"
            problem(came, theirs, f"It has: {names_in(table)}{near(theirs, table)}")
        elif position in positions.values():
            other = next(name for name, taken in positions.items() if taken == position)
            problem(f"both {other} and {ours} by columns= (--columns)", theirs, "Name one for each")
        else:
            positions[ours] = position
            header = headers[position]
            found = _fitting(header, _kinds(ours, expected, raw_unit), options.units)
            name = header.name if asked in (header.name, header.raw) else asked
            take(position, found or Reading(name, header.unit), name, ours)
    said = set(positions)
    free = set(range(len(headers))) - set(positions.values())
    exact = {headers[i].name: i for i in free}
    named = _by_name(headers)
    for name, column in expected.items():
        if name in options.columns:
            continue
        kinds, found = _kinds(name, expected, raw_unit), dict[int, Reading]()
        if name in exact:
            header = headers[exact[name]]
            unit = header.unit and unit_in(header.unit, kinds)
            found = {exact[name]: Reading(name, unit or header.unit)}
        elif exact.keys().isdisjoint(column.also):
            found = _candidates(column, headers, named, free, kinds, options.units)
        if len(found) == 1:
            positions[name], reading = found.popitem()
            free.discard(positions[name])
            take(positions[name], reading, name, name)
    for i in sorted(free):
        reading = unit_behind(headers[i])
        if reading and reading.name not in expected:
            take(i, reading, reading.name, reading.name)
        name = headers[i].name
        if name in positions:
            other = f"{name!r} beside {headers[positions[name]].raw!r}"
            other += ", which columns= names" if name in said else ""
            cure = f"Rename it, or leave {name!r} out of columns= (--columns)"
            problem(f"a second {other}", headers[i].raw, cure)
        elif name:
            positions[name] = i
    for name, column in expected.items():
        for other in (n for n in column.also if n in positions and n not in expected):
            if name in positions:
                first, second = (headers[positions[n]].raw for n in (name, other))
                problem(f"a second {name!r} beside {first!r}", second, "Remove one")
            else:
                positions[name] = positions.pop(other)
        if column.unit is None and name in positions:
            header = headers[positions[name]]
            if header.unit not in (None, "", "1", "-"):
                came, meant = f"carries the unit {header.unit}", f"a label (text) as {name!r}"
                cure = "Remove the unit, or rename the column"
                problems.append(Problem(table.file, came, meant, cure, column=header.raw))
    return replace(table, headers=tuple(headers), notes=tuple(notes)), positions


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
    advice, chosen = "", ""
    if alike:
        advice = f"{', '.join(h.raw for h in alike[:4])} look{'s' * (len(alike) == 1)} like it. "
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
            advice += "The nominal scale says what one unit of output is of it; --nominal-zero what it is at zero. "
        if len(alike) > 1 and column.name == output:
            together = ",".join(h.name for h in alike if "," not in h.name)
            advice += (
                f"Together, as channels of one unit: calibrate {option('--channels', together)}. "
            )
    meaning = f" ({column.meaning})" if column.meaning else ""
    mapped = alike[0].raw if alike else "…"
    shown = chosen or f"--columns {column.name}=…"
    sentence = (
        f"{table.file!r} lacks the column {column.name!r}{meaning} that {instrument!r} needs; it "
        f"has: {names}. {advice}Add a column {asked!r}, or say which one it is with "
        f"columns={{{column.name!r}: {mapped!r}}} ({shown})"
    )
    return Problem(
        table.file,
        "no such column",
        asked,
        f"{advice}Add such a column, or say which it is",
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
    usual = [w for unit, w in _LIKELY.items() if column.unit == ANY or alike(unit, column.unit)]
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
    return bool(known) and any(alike(str(known), kind) for kind in ("V", "Hz", "A", "count"))


def _fits(unit: str, kinds: tuple[str, ...]) -> bool:
    """Whether a unit is of these kinds; one that is of another kind too (deg) is not."""
    other = bool(unit_in(unit, (ANY,))) and not any(
        alike(unit, kind) for kind in kinds if kind != ANY
    )
    return bool(unit_in(unit, kinds)) and (ANY in kinds or not other)


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


def with_fixed_units(
    expected: Mapping[str, Column],
    table: Table,
    positions: Mapping[str, int],
    options: ReadOptions,
    problems: Problems,
) -> dict[str, Column]:
    """The columns with a unit in place of "any": the fixed unit of what the file has.

    A known uncertainty follows its output. What has no unit, or one that is none, is refused where
    the column is converted; a nominal scale for an output that may be anything is a problem here.
    """
    fixed = dict(expected)
    for name, column in expected.items():
        if column.unit != ANY or name not in positions:
            continue
        if options.nominal_scale is not None:
            came = "a nominal scale was given, but it is taken in the unit that it is in"
            cure = "Leave the scale out, or choose an instrument whose output has a unit"
            problems.append(Problem(table.file, came, cure=cure, column=name))
        if name == "output_uncertainty":
            fixed[name] = replace(column, unit=fixed["output"].unit)
            continue
        unit = unit_of(table.headers[positions[name]], name, options)
        with contextlib.suppress(InputError):
            fixed[name] = column if unit is None else replace(column, unit=fixed_unit(unit))
    return fixed


_AXIS = re.compile(
    r"(?:^|[\W_\d])[xyzXYZ](?=$|[\W_])|(?<=[a-z])[XYZ](?=$|[\W_])|^[xyz](?=acc|gyr|mag)"
)
# What a channel of the output's own axis is in; one in another unit, such as a drive voltage, is of the same sensor.
_MOTION = ("m/s^2", "rad/s", "rad", "uT", "count")


def channels_beside(output: str, columns: Mapping[str, str | None], unit: str | None) -> list[str]:
    """Columns that are channels of the unit whose output this is: of another axis, of its own and another motion, or
    of another number and alike.

    Channels of one unit see the same temperature and time, so that each follows the others, and causes none of them.

    Args:
        output: the file's name of the output, such as "acc_z" or "dut 3".
        columns: name → unit, of those that no instrument declares.
        unit: of the output.
    """
    numbered, axis = re.sub(r"\d+", "#", output), _axis(output)
    found = []
    for name, own in columns.items():
        alike = own and unit and same_dimension(own, unit) and re.sub(r"\d+", "#", name) == numbered
        another = axis and (its := _axis(name)) and (its != axis or _moves(own))
        if another or (alike and "#" in numbered):
            found.append(name)
    return found


def _axis(name: str) -> str:
    """The letter of the axis that a name ends in or begins with; "" if there is none."""
    found = _AXIS.findall(name)
    return found[-1][-1].lower() if found else ""


def _moves(unit: str | None) -> bool:
    """Whether a unit is of a motion or a field, or of none."""
    return unit is None or any(same_dimension(unit, motion) for motion in _MOTION)


def unused_options(tables: Sequence[Table], options: ReadOptions, problems: Problems) -> None:
    """Note each unit for a column that no file has, and each column to ignore: it was meant for one."""
    known = {
        name
        for t in tables
        for h in t.headers
        for name in (h.raw, *(r.name for r in readings_of(h)))
    }
    known |= set(options.columns)
    said = {name: f"units={{{name!r}: {unit!r}}}" for name, unit in options.units.items()}
    said |= {name: f"ignore=[{name!r}]" for name in options.ignore}
    for name, asked in said.items():
        if name not in known:
            came = f"no such column, but {asked}"
            others = "".join(f", nor has {t.file!r}" for t in tables[1:])
            cure = f"It has: {names_in(tables[0])}{near(name, tables[0])}{others}"
            problems.append(Problem(tables[0].file, came, cure=cure, column=name))


def names_in(table: Table) -> str:
    return ", ".join(header.raw or "(no name)" for header in table.headers)


def near(name: str, table: Table) -> str:
    names = {header.name.lower(): header.raw for header in table.headers if header.name}
    near = difflib.get_close_matches(name.lower(), names, 1)
    return f" (is {names[near[0]]!r} meant?)" if near else ""
