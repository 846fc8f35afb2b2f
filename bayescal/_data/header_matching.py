"""Matching of a file's headers to an instrument's columns: the rules, as tables, and the user's options.

A header has several possible readings as a name and a unit ("Temp (°C)", "gyro_z_dps", 'angle/"'); one counts only if
the quantity that is expected there has a unit of its kind. So "Temp_C" is a temperature in °C, since nothing else that
is written C is a temperature. A header with one reading is taken, with a flag; one that looks like a column is
proposed. Further columns are kept if they have a unit: an effect of the user may need them; none is a reason to refuse.
"""

from __future__ import annotations

import contextlib
import re
import unicodedata
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from bayescal._core.errors import InputError
from bayescal._core.flag import Flag
from bayescal._data.column import RESERVED_NAMES, UNCERTAINTY, Column
from bayescal._data.read_options import (
    InstrumentLike,
    ReadOptions,
    expected_columns,
    names_in,
    output_name,
    unit_of,
)
from bayescal._data.unit_conversion import (
    ANY,
    WHERE_EXPECTED,
    base_unit,
    fixed_unit,
    is_convertible,
    parse,
    pretty,
    same_dimension,
    unit_in,
)
from bayescal._tables.raw_table import (
    BRACKETS,
    UNIT_SEARCH_CHARACTERS,
    Header,
    Objections,
    Table,
    called,
    in_one_line,
    load_whole,
    option,
    readings_of,
)

# Further names of columns that many instruments have, the likeliest tier first, tiers parted by bars; a single letter
# is a symbol, whose case matters.
NAMES = {
    "time": "t timestamp time_stamp date_time datetime epoch unix_time utc time_utc utc_time | date_and_time "
    "time_and_date zeitstempel datum_uhrzeit datum_zeit scan_time | sample_time start_time local_time | elapsed "
    "elapsed_time relative_time messzeit laufzeit sekunden seconds temps x_value millis zeit uhrzeit time_of_day heure "
    "aika | date datum | horodatage fecha_hora fecha_y_hora data_ora data_e_ora data_hora tidsstempel tijdstip "
    "aikaleima",
    "temperature": "T temperatur thermometer",
    "supply_voltage": "supply supply_v v_supply vsupply vcc vdd power_supply | battery battery_voltage v_bat vbat ubat "
    "u_bat versorgung versorgungsspannung betriebsspannung alimentation tension_d_alimentation",
    "run": "run_no run_nr run_number run_id test_run",
    "device": "device_id serial serial_no serial_number sn",
}
# Names of columns of labels, where their values are labels too: text or whole numbers, each for a while; words for a
# count, such as "no." or "id", are removed from a name before.
LABELS = {
    "run": "run run_label test_run cycle zyklus lauf laufnummer messung messreihe versuch versuchsnummer durchgang "
    "durchlauf essai passage sweep trial test repetition wiederholung mounting montage aufspannung einspannung setup",
    "device": "device dut unit sensor serial sensor_sn sn prufling pruefling seriennummer serien geraet gerat capteur "
    "serie",
    "axis": "axis achse axe",
}
COUNTED = frozenset(["no", "nr", "n", "number", "num", "nummer", "numero", "id", "de", "du"])
# Texts in place of a unit where there is none.
NO_UNIT = frozenset(
    ["", "1", "-", "#", "no", "no.", "nr", "nr.", "n", "№", "id", "text", "label", "index", "none"]
)
MIN_READINGS_PER_LABEL = 3.0  # readings, on average, that have one label before the next
# Beginnings of names in logs, by the unit of their column.
BEGINNINGS = {
    "deg/s": ("gyr", "rate", "omega", "gx", "gy", "gz", "wx", "wy", "wz"),
    "ug": ("acc", "ax", "ay", "az"),
    "rad": ("tilt", "angle", "incl", "roll", "pitch"),
}
# Names of a column of dates beside one of times of day, in languages that write both with points.
DAYS = (
    *("date", "datum", "day", "tag", "dato", "dag", "data", "giorno", "fecha", "dia", "jour"),
    *("paiva", "paivamaara", "pvm"),
)
RAW = ("V", "Hz", "A", "count")  # units of a raw output, which a nominal scale turns into another
# Units of channels on the output's own axis; one in another unit, such as a drive voltage, is of the same sensor.
MOTION = ("m/s^2", "rad/s", "rad", "uT", "count")
WORDS = frozenset(  # units that may be other words
    ["min", "day", "days", "bar", "rev", "count", "counts", "second", "minute", "hour", "degree"]
    + ["atm", "psi", "gram", "grams", "lb", "cc", "kp", "mol"]
)
_AXIS = re.compile(
    r"(?:^|[\W_\d])[xyzXYZ](?=$|[\W_])|(?<=[a-z])[XYZ](?=$|[\W_])|^[xyz](?=acc|gyr|mag)"
)


def units_among(header: Header, kinds: tuple[str, ...]) -> dict[str, Header]:
    """Return the units of these kinds that a header has, each with its reading."""
    pairs = ((unit_in(reading.unit or "", kinds), reading) for reading in readings_of(header))
    return {unit: replace(reading, unit=unit) for unit, reading in pairs if unit}


def unit_behind(header: Header) -> Header | None:
    """Return the reading of a header that ends in a unit of any quantity: in brackets, or of two letters behind _."""
    reading = None if header.unit else longest_unit(header)
    unit = (reading and reading.unit) or ""
    brackets = header.raw[-1:] in tuple(")]}>")
    return reading if unit and (brackets or (len(unit) > 1 and unit not in WORDS)) else None


def longest_unit(header: Header) -> Header | None:
    """Return the reading of a header with the longest unit, of any quantity; None where that may be half of a unit.

    So "Rate in deg/hr" is in °/h, not "Rate in deg" in h; "flow_L_min" is left open.
    """
    candidates = [(r, unit) for r in readings_of(header) if (unit := unit_in(r.unit or "", (ANY,)))]
    if not candidates:
        return None
    reading, unit = max(candidates, key=lambda pair: len(pair[0].unit or ""))
    before = re.split(r"[\s_./]+", reading.name.strip())[1:]
    divides = parse(unit).powers.keys() in ({"s"}, {"m"})  # a usual denominator
    half = divides and header.raw[-1:].isalnum() and any(unit_in(t, (ANY,)) for t in before[-1:])
    return None if half else replace(reading, unit=unit)


def unit_like_ending(header: Header) -> str | None:
    """Return the end of a header without a known unit that may be meant as a unit; None if there is none.

    That is a text in brackets, unless it is a number, and behind a gap a unit as it is written where one is expected.
    """
    end = header.raw[-UNIT_SEARCH_CHARACTERS:]
    if bracketed := next((f for p in BRACKETS if (f := p.fullmatch(end))), None):
        return None if bracketed[2].strip().isdigit() else bracketed[2].strip()
    spellings = {text for texts in WHERE_EXPECTED.values() for text in texts if text.isascii()}
    meant = spellings.difference(("G", "g")) | {"K"}
    return next((r.unit for r in readings_of(header) if r.unit in meant), None)


@lru_cache(maxsize=4096)  # each is asked for by many columns
def plain(name: str) -> str:
    """Return a name normalised for comparison: case, accents, spaces, "temp" for temperature."""
    bare = unicodedata.normalize("NFD", name)
    bare = "".join(c for c in bare if not unicodedata.combining(c))  # Prüfling as Prufling
    parted = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", bare)  # boardTemp as board_Temp
    words = re.sub(r"[^a-z0-9]+", "_", parted.lower()).strip("_").split("_")
    return "_".join("temperature" if word in ("temp", "tmp") else word for word in words)


def compared(reading: Header) -> str:
    """Return the name of a reading, normalised; a symbol of one letter as it is."""
    name = reading.name.strip()
    return name if len(name) == 1 else plain(name)


def labels_in(header: Header) -> str | None:
    """Return the column of labels that a header names by one of the names in `LABELS`; None for none."""
    names = (plain(r.name) for r in readings_of(header) if (r.unit or "").lower() in NO_UNIT)
    nouns = {"_".join(word for word in name.split("_") if word not in COUNTED) for name in names}
    return next((ours for ours, those in LABELS.items() if nouns & {*those.split()}), None)


def are_labels(texts: np.ndarray, in_turn: bool = False) -> bool:
    """Return whether cells are labels: several, text or whole numbers, each for a while, or (devices) in turn."""
    levels = set(texts.tolist())
    blocks = len(levels) if in_turn else 1 + int(np.count_nonzero(texts[1:] != texts[:-1]))
    whole = all(re.fullmatch(r"[^.,]*[^\d.,][^.,]*|[+-]?\d+(?:[.,]0*)?", text) for text in levels)
    return whole and len(levels) > 1 and MIN_READINGS_PER_LABEL * blocks <= len(texts)


@dataclass(frozen=True)
class ColumnRule:
    """Rule by which the header of a column is matched: its units are of `kinds` ("any" for further columns)."""

    column: Column
    kinds: tuple[str, ...]
    output: bool = False

    @property
    def tiers(self) -> list[frozenset[str]]:
        """Return the names of the column, the likeliest first: its own, then further ones."""
        own_names = frozenset(map(plain, (self.column.name, *self.column.also)))
        further = NAMES.get(self.column.name, "").split("|")
        return [own_names, *(frozenset(tier.split()) for tier in further)]

    def matches(
        self, headers: Sequence[Header], free: Collection[int], user_units: Mapping[str, str]
    ) -> dict[int, Header]:
        """Return the free headers that can be read as the column, under the likeliest of its names that occur.

        `user_units` are units that the user gives.
        """
        tried = (
            {i: r for i in sorted(free) if (r := self._reading(headers[i], names, user_units))}
            for names in self.tiers
        )
        return next(filter(None, tried), {})

    def _reading(
        self, header: Header, names: Collection[str], user_units: Mapping[str, str]
    ) -> Header | None:
        """Return the reading of a header under one of these names, in a unit of the column's kind or in none."""
        for reading in sorted(readings_of(header), key=lambda r: r.unit is None):  # "T (°)" has one
            if compared(reading) not in names:
                continue
            if reading.unit is None:
                return reading
            if unit := unit_in(reading.unit, self.kinds):
                return replace(reading, unit=unit)
            if header.raw in user_units or reading.name in user_units:
                unit = user_units.get(reading.name, "")
                return replace(reading, unit=unit if unit_in(unit, (ANY,)) else None)
        return None

    def sole_reading(self, header: Header, units: Mapping[str, str]) -> Header | None:
        """Return the one reading of a header, of any name, with a unit of the column's kind; None if not just one."""
        if ANY in self.kinds:
            return None if header.raw in units else longest_unit(header)
        readings = units_among(header, self.kinds)
        readings.pop("1", None)
        return readings.popitem()[1] if len(readings) == 1 and header.raw not in units else None

    def candidates(self, headers: Sequence[Header]) -> list[Header]:
        """Return the headers that may mean the column: in a unit of its kind, else in none; of these those that share a
        word with its name, if any does."""
        word = plain(self.column.name)
        tiers = (MOTION, self.kinds) if ANY in self.kinds else (self.kinds, RAW * self.output)
        tried = ([h for h in headers if units_among(h, kinds)] for kinds in tiers)
        unknown = [h for h in headers if not longest_unit(h)]
        fitting = next(filter(None, tried), [])
        named = [h for h in (fitting or unknown) if _share_a_word(plain(h.name), word)]
        unsaid = [h for h in unknown if self.column.unit and not unit_like_ending(h)]
        return named or fitting or unsaid

    def could_mean(self, header: Header) -> bool:
        """Return whether a header contains a name of the column; never for a label or a known uncertainty."""
        if self.column.unit is None or self.column.name == UNCERTAINTY:
            return False
        own_names, *further = self.tiers
        names = own_names.union(n for tier in further for n in tier if len(n) > 2)
        parts = set(plain(self.column.name).split("_"))
        words = (plain(reading.name) for reading in readings_of(header))
        return any(name in names or parts <= set(name.split("_")) for name in words)


def _share_a_word(theirs: str, ours: str) -> bool:
    """Return whether names share a word, or the beginning of one, of three letters or more, or one letter (an axis)."""
    words = [(a, b) for a in theirs.split("_") for b in ours.split("_") if a and b]
    return any(a == b or (min(len(a), len(b)) > 2 and b.startswith(a)) for a, b in words)


def channels_beside(output: str, columns: Mapping[str, str | None], unit: str | None) -> list[str]:
    """Return the columns that are channels of the unit whose output this is: of another axis, of its own axis and
    another motion, or of another number and the same quantity.

    Channels of one unit see the same temperature and time, so that each follows the others, and causes none of them.
    `columns` (name → unit) are those that no instrument declares.
    """
    numbered, axis = re.sub(r"\d+", "#", output), _axis(output)
    channels = []
    for name, their_unit in columns.items():
        same_unit = their_unit and unit and same_dimension(their_unit, unit)
        same_quantity = same_unit and re.sub(r"\d+", "#", name) == numbered
        moves = their_unit is None or any(same_dimension(their_unit, motion) for motion in MOTION)
        another = axis and (its := _axis(name)) and (its != axis or moves)
        if another or (same_quantity and "#" in numbered):
            channels.append(name)
    return channels


def _axis(name: str) -> str:
    """Return the letter of the axis that a name ends in or begins with; "" if there is none."""
    return next((text[-1].lower() for text in reversed(_AXIS.findall(name))), "")


MAX_SHOWN_HEADERS = 4  # of those that may be meant


@dataclass
class MatchedFile:
    """A file whose headers are matched to an instrument's columns.

    A header means a column of the instrument if it has one reading as such, which a note reports. A column that the
    file holds under its own name, or that `columns=` names, is not searched for.

    Attributes:
        table: the file, with the name and unit that each header means.
        instrument: whose columns are expected.
        options: of the user.
        problems: to add to.
        expected: the columns that are expected, by our names, in the units in which they are kept.
        positions: our name of every column → its position in the file.
    """

    table: Table
    instrument: InstrumentLike
    options: ReadOptions
    problems: Objections
    expected: dict[str, Column] = field(init=False)
    positions: dict[str, int] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        """Match the headers: by the user's options, by their names and units, then by their cells."""
        self.expected = expected_columns(self.instrument)
        self._headers, self._notes = list(self.table.headers), list(self.table.notes)
        self._free = set(range(len(self._headers)))
        self._take_named()
        named = set(self.positions)
        self._take_known()
        self._take_three_axes()
        self._take_by_cells()
        self._take_others(named)
        self.table = replace(self.table, headers=tuple(self._headers), notes=tuple(self._notes))
        for name, column in self.expected.items():
            unit = self.header(name).unit if name in self.positions else None
            meant = name in self.options.columns and not _known_unit(unit)
            if column.unit is None and not meant and (unit or "").lower() not in NO_UNIT:
                came, meant = f"carries the unit {unit}", f"a label (text) as {name!r}"
                cure = "Remove the unit, or rename the column"
                self.problem(self.header(name).raw, came, meant, cure)
        self._fix_units()

    def _take(self, position: int, reading: Header, name: str, why: str = "") -> None:
        """Take a header, in this reading, as our column `name`."""
        self._free.discard(position)
        self.positions[name] = position
        self._rename(position, reading, name + why)

    def _rename(self, position: int, reading: Header, say: str) -> None:
        old, self._headers[position] = self._headers[position], reading
        if reading != old:
            unit = f" in {pretty(reading.unit)}" if reading.unit else ""
            self._notes.append(f"{self.table.file}: read {old.raw!r} as {say}{unit}")

    def _take_named(self) -> None:
        """Take the columns that the user names."""
        for ours, theirs in self.options.columns.items():
            wanted_header = in_one_line(theirs)
            position = called(self._headers, wanted_header)
            if position is None:
                came = f"has no column {theirs!r} ({option('--columns', f'{ours}={theirs}')})"
                self.problem("", came, cure=f"It has: {names_in(self.table)}")
            elif position not in self._free:
                other = next(name for name, index in self.positions.items() if index == position)
                came = f"both {other} and {ours} by --columns"
                self.problem(theirs, came, cure="Name one for each")
            else:
                header = self._headers[position]
                reading = self.rule(ours).sole_reading(header, self.options.units)
                name = header.name if wanted_header in (header.name, header.raw) else wanted_header
                self._take(position, replace(reading or header, name=name), ours)

    def _take_known(self) -> None:
        """Take the columns of the instrument: by their own names, else by usual names with a fitting unit."""
        headers = self._headers
        exact = {headers[i].name: i for i in self._free}
        for name, column in self.expected.items():
            if name in self.options.columns:
                continue
            also = [n for n in column.also if n not in self.expected]
            own_names, rule = [n for n in (name, *also) if n in exact], self.rule(name)
            for second in own_names[1:]:
                first, other = headers[exact[own_names[0]]].raw, headers[exact[second]].raw
                self.problem(other, f"a second {name!r} beside {first!r}", cure="Remove one")
            if own_names:
                position = exact[own_names[0]]
                unit = unit_in(headers[position].unit or "", rule.kinds) or headers[position].unit
                self._take(position, replace(headers[position], unit=unit), name)
                continue
            matches = rule.matches(headers, self._free, self.options.units)
            if len(matches) == 1:
                position, reading = matches.popitem()
                self._take(position, replace(reading, name=name), name)

    def _take_three_axes(self) -> None:
        """Take the outputs of three axes: the one triple of headers in their dimension that differ only in x, y, z at
        the beginning or the end of their names."""
        outputs = getattr(self.instrument, "outputs", ())
        if not outputs or not {*self.positions, *self.options.columns}.isdisjoint(outputs):
            return
        triples = dict[str, dict[str, tuple[int, Header]]]()
        for i in sorted(self._free):
            header = self._headers[i]
            if header.raw not in self.options.units:
                header = longest_unit(header) or header
            unit, name = unit_of(header, "", self.options), header.name.lower()
            if name and unit and is_convertible(unit, str(self.expected[outputs[0]].unit)):
                for key, axis in ((f"{name[:-1]}?", name[-1]), (f"?{name[1:]}", name[0])):
                    triples.setdefault(key, {})[axis] = i, header
        whole = [triple for triple in triples.values() if triple.keys() >= {*"xyz"}]
        if len(whole) == 1:
            for axis in "xyz":
                position, header = whole[0][axis]
                self._take(position, replace(header, name=f"output_{axis}"), f"output_{axis}")

    def _take_by_cells(self) -> None:
        """Take labels by their names and cells."""
        for i in sorted(self._free):
            ours = labels_in(self._headers[i])
            if ours is None or ours in {*self.positions, *self.options.columns}:
                continue
            if self._holds_labels(i, ours == "device"):
                reading = replace(self._headers[i], name=ours, unit=None)
                self._take(i, reading, ours, ", as its values are labels")

    def _take_others(self, named: set[str]) -> None:
        """Name the other columns, those in `named` by the user, as the file does; without their units."""
        for i in sorted(self._free):
            reading = unit_behind(self._headers[i])
            if reading and reading.name not in self.expected:
                self._rename(i, reading, reading.name)
            name = self._headers[i].name
            if name in self.positions:
                other = f"{name!r} beside {self._headers[self.positions[name]].raw!r}"
                other += ", which --columns names" if name in named else ""
                cure = f"Rename it, or leave {name!r} out of --columns"
                self.problem(self._headers[i].raw, f"a second {other}", cure=cure)
            elif name:
                self.positions[name] = i

    def _fix_units(self) -> None:
        """Give columns a unit in place of "any": the fixed unit of what the file has; a known uncertainty its output's.

        A column without a valid unit is refused where it is converted; a nominal scale for an output of unit "any" is a
        problem here.
        """
        for name, column in self.expected.items():
            if column.unit != ANY or name not in self.positions:
                continue
            if self.options.nominal_scale is not None:
                came = "a nominal scale was given, but it is taken in the unit that it is in"
                cure = "Leave the scale out, or choose an instrument whose output has a unit"
                self.problem(name, came, cure=cure)
            unit = unit_of(self.header(name), name, self.options)
            if name == UNCERTAINTY:
                self.expected[name] = replace(column, unit=self.expected["output"].unit)
            elif unit is not None:
                with contextlib.suppress(InputError):
                    self.expected[name] = replace(column, unit=fixed_unit(unit))

    def _holds_labels(self, position: int, in_turn: bool = False) -> bool:
        """Return whether the cells of a column are labels."""
        if self.options.is_ignored(self.table.headers[position]):
            return False
        return are_labels(load_whole(self.table, {position: False})[position].values, in_turn)

    def rule(self, name: str) -> ColumnRule:
        """Return the rule by which the header of our column `name` is matched."""
        column, output = self.expected.get(name), output_name(self.instrument)
        if column is None:
            return ColumnRule(Column(name, ANY), (ANY,))
        scale = self.options.nominal_scale or self.instrument.nominal_scale
        kinds = () if column.unit is None else (column.unit,)
        if scale and name in (output, UNCERTAINTY) and column.unit != ANY:
            kinds = (*kinds, scale.unit)
        return ColumnRule(column, kinds, name == output)

    def header(self, name: str) -> Header:
        """Return the header of a column by our name."""
        return self.table.headers[self.positions[name]]

    def problem(self, column: str, came: str, *about: str, **details: Any) -> None:
        """Add a problem of a column, given by its header; arguments as of `Table.objection`."""
        self.problems.append(self.table.objection(column, came, *about, **details))

    def note_missing(self) -> bool:
        """Add a problem for each required column that the file lacks, with the headers that may be meant, if any.

        Returns whether one is lacking.
        """
        positions = {self.positions[name] for name in self.expected if name in self.positions}
        free = [h for i, h in enumerate(self.table.headers) if h.name and i not in positions]
        lacking = [
            column
            for name, column in self.expected.items()
            if _needed(column) and name not in self.positions and name not in self.options.columns
        ]
        has = f"It has: {names_in(self.table)}. "
        for column in lacking:
            self._note_lack(column, self.rule(column.name).candidates(free), has)
            has = ""  # once
        return bool(lacking)

    def _note_lack(self, column: Column, candidates: Sequence[Header], has: str) -> None:
        expected = f"{column.name} [{column.example}]" if column.unit else column.name
        expected += f" ({column.meaning})" * bool(column.meaning)
        if not candidates:
            self.problem(column.name, "no such column", expected, f"{has}Add such a column")
            return
        some = candidates[:MAX_SHOWN_HEADERS]
        choices = [self._as_column(column, header) for header in some]
        suggestion = choices[0] if len(choices) == 1 else f"({' or '.join(choices)})"
        names = ", ".join(header.raw for header in some)
        advice = f"{names} {'looks' if len(candidates) == 1 else 'look'} like it. "
        if "--nominal-scale" in suggestion:
            advice += "The nominal scale says what one unit of output is of it; --nominal-zero what it is at zero. "
        of_unit = {h.name: (longest_unit(h) or h).unit or "" for h in candidates}
        moving = [n for n, unit in of_unit.items() if any(is_convertible(unit, m) for m in MOTION)]
        if len(moving) > 1 and column.name == output_name(self.instrument):
            together = option("--channels", ",".join(moving))
            advice += f"Together, as channels of one unit: {together}. "
        cure = f"{has}{advice}Add such a column, or say which it is"
        self.problem(column.name, "no such column", expected, cure, suggestion)

    def _as_column(self, column: Column, header: Header) -> str:
        """Return the options that declare a header to be a column; unknown values are left to fill in."""
        options, rule = option("--columns", f"{column.name}={header.raw}"), self.rule(column.name)
        if column.unit is None or rule.sole_reading(header, {}):
            return options
        raw = next(iter(units_among(header, RAW)), None)
        if raw and rule.output and self.options.nominal_scale is None:
            per = f"({column.unit})" if "/" in column.unit else column.unit
            return f"{options} {option('--nominal-scale', f'NUMBER {raw}/{per}')}"
        return options if header.unit else f"{options} {option('--unit', f'{header.raw}=UNIT')}"

    def further_columns(self) -> tuple[dict[str, Column], list[str]]:
        """Return the columns beyond the instrument's that are kept, in base units, and flags of those ignored.

        One that the instrument could use, or that ends in an unknown text that may be a unit, is a problem: only the
        user excludes it.
        """
        columns, flags, file = dict[str, Column](), list[str](), self.table.file
        if self.options.only:
            return columns, flags
        without_unit = list[str]()
        for name, position in self.positions.items():
            header = self.table.headers[position]
            if name in self.expected or self.options.is_ignored(header):
                continue
            if plain(header.name) in DAYS and not header.unit and "time" in self.positions:
                continue  # taken with the time of day
            if name in RESERVED_NAMES:
                message = f"{file}: column {header.raw!r} ignored: the name {name!r} is taken"
                flags.append(Flag(message, "column.ignored", header.raw))
                continue
            unit = unit_of(header, name, self.options)
            if unit and is_convertible(unit, unit):  # it is a unit
                columns[name] = Column(name, base_unit(unit), required=False)
                continue
            unit, possible = unit or unit_like_ending(header), self._possible_column(header)
            text = (unit or "").lower()
            meant = text not in NO_UNIT or (possible and not text)
            if meant and (possible or _known_unit(unit) or not self._holds_labels(position)):
                self._note_unclear(header, unit, possible)
            else:
                without_unit.append(header.raw)
        numbered = enumerate(self.table.headers, 1)
        without_unit += [f"column {i}, without a name" for i, h in numbered if not h.name]
        if without_unit:
            needs_none = (n for n, c in self.expected.items() if c.unit is None or n == "time")
            lacking = [n for n in needs_none if n not in self.positions]
            meant = " or ".join(option("--columns", f"{n}={without_unit[0]}") for n in lacking)
            meant = f"to say what one is: {meant}; " * bool(lacking)
            message = (
                f"{file}: ignored, because they have no unit: {', '.join(without_unit)} "
                f"({meant}to keep one in addition to the instrument's, write 'name [unit]' or give units=)"
            )
            flags.append(Flag(message, "column.ignored", *without_unit))
        return columns, flags

    def _possible_column(self, header: Header) -> Column | None:
        """Return the first optional column that the file lacks and whose name a header contains; None for none."""
        lacking = (c for n, c in self.expected.items() if n not in self.positions)
        named = (c for c in lacking if not _needed(c) and self.rule(c.name).could_mean(header))
        return next(named, None)

    def _note_unclear(self, header: Header, unit: str | None, column: Column | None) -> None:
        """Add a problem for a column that would be ignored and may be of use: how to keep it, and how to exclude it."""
        known_unit = _known_unit(unit, (column and column.unit) or ANY)
        came = f"ends in [{unit}], no unit known here" if unit else "has no unit"
        ignore_option = option("--ignore", header.raw)
        keep = option("--unit", f"{header.raw}={known_unit or 'UNIT'}")
        expected, suggestion = "a unit known here", keep if known_unit else ignore_option
        if column:
            expected = f"{column.name} [{column.example}]"
            suggestion = f"{option('--columns', f'{column.name}={header.raw}')} {keep}"
        cure = f"Say what it is and its unit, {keep}, or leave the column out, {ignore_option}"
        self.problem(header.raw, came, expected, cure, suggestion)


def _known_unit(unit: str | None, kind: str = ANY) -> str | None:
    """Return the unit that a text may be meant as; None for none."""
    spelled = [name for name, texts in WHERE_EXPECTED.items() if unit in texts]
    return unit_in(unit or "", (kind,)) or (spelled[0] if len(spelled) == 1 else None)


def _needed(column: Column) -> bool:
    return column.required and column.default is None
