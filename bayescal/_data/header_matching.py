"""A file's headers understood for an instrument: the rules, as tables, and what the user says beside them.

A header has several possible readings as a name and a unit ("Temp (°C)", "gyro_z_dps", 'angle/"'); one counts only if
the quantity that is expected there has a unit of its kind. So "Temp_C" is a temperature in °C, since nothing else that
is written C is a temperature. What has one reading is taken and said; what looks like a column is offered. Columns that
no instrument asked for are kept if they have a unit: an effect of the user may need them; no file is refused for them.
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
from bayescal._data.column import TAKEN, UNCERTAINTY, Column
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
    alike,
    base_unit,
    fixed_unit,
    parse,
    pretty,
    same_dimension,
    spelled,
    unit_in,
)
from bayescal._tables.raw_table import (
    BRACKETS,
    LONGEST_UNIT,
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
# Names under which labels are known where their values are labels too: text or whole numbers, each for a while; what
# says that it is counted, such as "no." or "id", is left out of a name before.
LABELS = {
    "run": "run run_label test_run cycle zyklus lauf laufnummer messung messreihe versuch versuchsnummer durchgang "
    "durchlauf essai passage sweep trial test repetition wiederholung mounting montage aufspannung einspannung setup",
    "device": "device dut unit sensor serial sensor_sn sn prufling pruefling seriennummer serien geraet gerat capteur "
    "serie",
    "axis": "axis achse axe",
}
COUNTED = frozenset(["no", "nr", "n", "number", "num", "nummer", "numero", "id", "de", "du"])
# What a chamber was told, which is no thermometer's reading: never proposed for one.
COMMANDED = "setpoint set soll sollwert solltemperatur consigne target command commanded demand"
# What stands in place of a unit where there is none.
NO_UNIT = frozenset(
    ["", "1", "-", "#", "no", "no.", "nr", "nr.", "n", "№", "id", "text", "label", "index", "none"]
)
MIN_READINGS_PER_LABEL = 3.0  # readings, on average, that have one label before the next
# How names begin under which what is missing is logged, by its unit.
BEGINNINGS = {
    "deg/s": ("gyr", "rate", "omega", "gx", "gy", "gz", "wx", "wy", "wz"),
    "ug": ("acc", "ax", "ay", "az"),
    "rad": ("tilt", "angle", "incl", "roll", "pitch"),
}
# A column of days beside one of times of day, in the languages of those who write both with points.
DAYS = (
    *("date", "datum", "day", "tag", "dato", "dag", "data", "giorno", "fecha", "dia", "jour"),
    *("paiva", "paivamaara", "pvm"),
)
RAW = ("V", "Hz", "A", "count")  # units of a raw output, which a nominal scale turns into another
# What a channel of the output's own axis is in; one in another unit, such as a drive voltage, is of the same sensor.
MOTION = ("m/s^2", "rad/s", "rad", "uT", "count")
WORDS = frozenset(  # units that may be other words
    ["min", "day", "days", "bar", "rev", "count", "counts", "second", "minute", "hour", "degree"]
    + ["atm", "psi", "gram", "grams", "lb", "cc", "kp", "mol"]
)
_AXIS = re.compile(
    r"(?:^|[\W_\d])[xyzXYZ](?=$|[\W_])|(?<=[a-z])[XYZ](?=$|[\W_])|^[xyz](?=acc|gyr|mag)"
)


def unit_among(header: Header, kinds: tuple[str, ...]) -> str | None:
    """Return the unit of one of these kinds that a header has in one of its readings; None for none."""
    found = (unit_in(reading.unit or "", kinds) for reading in readings_of(header))
    return next(filter(None, found), None)


def unit_behind(header: Header) -> Header | None:
    """Return the reading of a header that ends in a unit of any quantity: in brackets, or of two letters behind _."""
    reading = None if header.unit else longest_unit(header)
    unit = (reading and reading.unit) or ""
    brackets = header.raw[-1:] in tuple(")]}>")
    return reading if unit and (brackets or (len(unit) > 1 and unit not in WORDS)) else None


def longest_unit(header: Header) -> Header | None:
    """The reading of a header with the longest unit, whatever its quantity; None where that may be half of one.

    So "Rate in deg/hr" is in °/h, not "Rate in deg" in h; "flow_L_min" is asked about.
    """
    known = [(r, unit) for r in readings_of(header) if (unit := unit_in(r.unit or "", (ANY,)))]
    if not known:
        return None
    reading, unit = max(known, key=lambda one: len(one[0].unit or ""))
    before = re.split(r"[\s_./]+", reading.name.strip())[1:]
    divides = parse(unit).powers.keys() in ({"s"}, {"m"})  # as what is measured is divided by
    half = divides and header.raw[-1:].isalnum() and any(unit_in(t, (ANY,)) for t in before[-1:])
    return None if half else replace(reading, unit=unit)


def like_a_unit(header: Header) -> str | None:
    """What a header without a known unit ends in that may be meant as one; None if there is nothing of that kind.

    That is what stands in brackets, unless it is a number, and behind a gap what is a unit where one is expected.
    """
    end = header.raw[-LONGEST_UNIT:]
    if found := next((f for p in BRACKETS if (f := p.fullmatch(end))), None):
        return None if found[2].strip().isdigit() else found[2].strip()
    known = {text for texts in WHERE_EXPECTED.values() for text in texts if text.isascii()}
    meant = known.difference(("G", "g")) | {"K"}
    return next((r.unit for r in readings_of(header) if r.unit in meant), None)


@lru_cache(maxsize=4096)  # each is asked for by many columns
def plain(name: str) -> str:
    """A name without what people write differently: case, spaces, "temp" for temperature."""
    bare = unicodedata.normalize("NFD", name)
    bare = "".join(c for c in bare if not unicodedata.combining(c))  # Prüfling as Prufling
    parted = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", bare)  # boardTemp as board_Temp
    words = re.sub(r"[^a-z0-9]+", "_", parted.lower()).strip("_").split("_")
    return "_".join("temperature" if word in ("temp", "tmp") else word for word in words)


def compared(reading: Header) -> str:
    """Return the name of a reading as names are compared."""
    name = reading.name.strip()
    return name if len(name) == 1 else plain(name)


def labels_in(header: Header) -> str | None:
    """Return which of our columns of labels a header names by one of the names in `LABELS`; None for none."""
    names = (plain(r.name) for r in readings_of(header) if (r.unit or "").lower() in NO_UNIT)
    nouns = {"_".join(word for word in name.split("_") if word not in COUNTED) for name in names}
    return next((ours for ours, those in LABELS.items() if nouns & {*those.split()}), None)


def like_labels(texts: np.ndarray, in_turn: bool = False) -> bool:
    """Whether a column's cells are labels: several, text or whole numbers, each for a while, or (devices) in turn."""
    levels = set(texts.tolist())
    blocks = len(levels) if in_turn else 1 + int(np.count_nonzero(texts[1:] != texts[:-1]))
    whole = all(re.fullmatch(r"[^.,]*[^\d.,][^.,]*|[+-]?\d+(?:[.,]0*)?", text) for text in levels)
    return whole and len(levels) > 1 and MIN_READINGS_PER_LABEL * blocks <= len(texts)


@dataclass(frozen=True)
class ColumnRule:
    """How the header of one column is known: its units are of `kinds` ("any" where no instrument knows it)."""

    column: Column
    kinds: tuple[str, ...]
    output: bool = False

    @property
    def tiers(self) -> list[frozenset[str]]:
        """Names as which it is known, the likeliest first: its own, then further ones."""
        own = frozenset(map(plain, (self.column.name, *self.column.also)))
        further = NAMES.get(self.column.name, "").split("|")
        return [own, *(frozenset(tier.split()) for tier in further)]

    def among(
        self, headers: Sequence[Header], free: Collection[int], given: Mapping[str, str]
    ) -> dict[int, Header]:
        """Return the free headers that can be read as it, under the likeliest of its names that there are.

        `given` are units that the user says.
        """
        tried = (
            {i: r for i in sorted(free) if (r := self._reading(headers[i], names, given))}
            for names in self.tiers
        )
        return next(filter(None, tried), {})

    def _reading(
        self, header: Header, names: Collection[str], given: Mapping[str, str]
    ) -> Header | None:
        """The reading of a header under one of these names, in a unit of its kind or in none."""
        for reading in sorted(readings_of(header), key=lambda r: r.unit is None):  # "T (°)" has one
            if compared(reading) not in names:
                continue
            if reading.unit is None:
                return reading
            if unit := unit_in(reading.unit, self.kinds):
                return replace(reading, unit=unit)
            if header.raw in given or reading.name in given:
                unit = given.get(reading.name, "")
                return replace(reading, unit=unit if unit_in(unit, (ANY,)) else None)
        return None

    def fitting(self, header: Header, given: Mapping[str, str]) -> Header | None:
        """The reading of a header, whatever its name, with a unit of its kind, if it has just one."""
        if ANY in self.kinds:
            return None if header.raw in given else longest_unit(header)
        found = {
            unit: replace(reading, unit=unit)
            for reading in readings_of(header)
            if reading.unit and (unit := unit_in(reading.unit, self.kinds)) and not unit.isdigit()
        }
        return found.popitem()[1] if len(found) == 1 and header.raw not in given else None

    def candidates(self, headers: Sequence[Header]) -> list[Header]:
        """Return the headers that may mean it: in a unit of its kind, else in none; of these those that share a word
        with its name, if any does."""
        word, told = plain(self.column.name), frozenset(COMMANDED.split())
        if word.startswith("temperature"):
            headers = [h for h in headers if told.isdisjoint(plain(h.name).split("_"))]
        tiers = (MOTION, self.kinds) if ANY in self.kinds else (self.kinds, RAW * self.output)
        tried = ([h for h in headers if unit_among(h, kinds)] for kinds in tiers)
        unknown = [h for h in headers if not longest_unit(h)]
        fitting = next(filter(None, tried), [])
        named = [h for h in (fitting or unknown) if _share_a_word(plain(h.name), word)]
        unsaid = [h for h in unknown if self.column.unit and not like_a_unit(h)]
        return named or fitting or unsaid

    def could_be(self, header: Header) -> bool:
        """Whether a header names it in part; of a label or a known uncertainty none does."""
        if self.column.unit is None or self.column.name == UNCERTAINTY:
            return False
        own, *further = self.tiers
        names = own.union(n for tier in further for n in tier if len(n) > 2)
        parts = set(plain(self.column.name).split("_"))
        words = (plain(reading.name) for reading in readings_of(header))
        return any(name in names or parts <= set(name.split("_")) for name in words)


def _share_a_word(theirs: str, ours: str) -> bool:
    """Whether names share a word, or the beginning of one, of three letters or more; of one letter, such as an axis."""
    words = [(a, b) for a in theirs.split("_") for b in ours.split("_") if a and b]
    return any(a == b or (min(len(a), len(b)) > 2 and b.startswith(a)) for a, b in words)


def channels_beside(output: str, columns: Mapping[str, str | None], unit: str | None) -> list[str]:
    """Return the columns that are channels of the unit whose output this is: of another axis, of its own and another
    motion, or of another number and alike.

    Channels of one unit see the same temperature and time, so that each follows the others, and causes none of them.
    `columns` (name → unit) are those that no instrument declares.
    """
    numbered, axis = re.sub(r"\d+", "#", output), _axis(output)
    found = []
    for name, own in columns.items():
        alike = own and unit and same_dimension(own, unit) and re.sub(r"\d+", "#", name) == numbered
        moves = own is None or any(same_dimension(own, motion) for motion in MOTION)
        another = axis and (its := _axis(name)) and (its != axis or moves)
        if another or (alike and "#" in numbered):
            found.append(name)
    return found


def _axis(name: str) -> str:
    """The letter of the axis that a name ends in or begins with; "" if there is none."""
    return next((text[-1].lower() for text in reversed(_AXIS.findall(name))), "")


SHOWN_HEADERS = 4  # of those that may be meant


@dataclass
class MatchedFile:
    """A file whose headers are understood, for an instrument.

    A header means a column of the instrument if it has one reading as such, which a note says. A column that the file
    holds under its own name, or that `columns=` names, is not looked for.

    Attributes:
        table: the file, with the name and unit that each header means.
        instrument: whose columns are expected.
        options: what the user says.
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
        """Match the headers: by what the user says, by their names and units, then by what their cells hold."""
        self.expected = expected_columns(self.instrument)
        self.options = self.options.of_file(self.table)
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
            meant = name in self.options.columns and not _known(unit)
            if column.unit is None and not meant and (unit or "").lower() not in NO_UNIT:
                came, meant = f"carries the unit {unit}", f"a label (text) as {name!r}"
                cure = "Remove the unit, or rename the column"
                self.problem(self.header(name).raw, came, meant, cure)
        self._fix_units()

    def _take(self, position: int, reading: Header, name: str, why: str = "") -> None:
        """Take a header for a column of ours, in this reading."""
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
            asked = in_one_line(theirs)
            position = called(self._headers, asked)
            if position is None:
                came = f"no such column, but {option('--columns', f'{ours}={theirs}')}"
                self.problem(theirs, came, cure=f"It has: {names_in(self.table)}")
            elif position not in self._free:
                other = next(name for name, taken in self.positions.items() if taken == position)
                came = f"both {other} and {ours} by --columns"
                self.problem(theirs, came, cure="Name one for each")
            else:
                header = self._headers[position]
                found = self.rule(ours).fitting(header, self.options.units)
                name = header.name if asked in (header.name, header.raw) else asked
                self._take(position, replace(found or header, name=name), ours)

    def _take_known(self) -> None:
        """Take the columns of the instrument: by their own names, else by names that are usual, with a fitting unit."""
        headers = self._headers
        exact = {headers[i].name: i for i in self._free}
        for name, column in self.expected.items():
            if name in self.options.columns:
                continue
            also = [n for n in column.also if n not in self.expected]
            own, rule = [n for n in (name, *also) if n in exact], self.rule(name)
            for second in own[1:]:
                first, other = headers[exact[own[0]]].raw, headers[exact[second]].raw
                self.problem(other, f"a second {name!r} beside {first!r}", cure="Remove one")
            if own:
                position = exact[own[0]]
                unit = unit_in(headers[position].unit or "", rule.kinds) or headers[position].unit
                self._take(position, replace(headers[position], unit=unit), name)
                continue
            found = rule.among(headers, self._free, self.options.units)
            if len(found) == 1:
                position, reading = found.popitem()
                self._take(position, replace(reading, name=name), name)

    def _take_three_axes(self) -> None:
        """Take the outputs of three axes: the one triple of headers in their dimension that are alike but for x, y, z
        at the beginning or the end of their names."""
        outputs = getattr(self.instrument, "outputs", ())
        if not outputs or not {*self.positions, *self.options.columns}.isdisjoint(outputs):
            return
        triples = dict[str, dict[str, tuple[int, Header]]]()
        for i in sorted(self._free):
            header = self._headers[i]
            if header.raw not in self.options.units:
                header = longest_unit(header) or header
            unit, name = unit_of(header, "", self.options), header.name.lower()
            if name and unit and alike(unit, str(self.expected[outputs[0]].unit)):
                for key, axis in ((f"{name[:-1]}?", name[-1]), (f"?{name[1:]}", name[0])):
                    triples.setdefault(key, {})[axis] = i, header
        whole = [found for found in triples.values() if found.keys() >= {*"xyz"}]
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

        What has no unit, or one that is none, is refused where the column is converted; a nominal scale for an output
        that may be anything is a problem here.
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
        """Whether the cells of a column are labels."""
        if self.options.leaves_out(self.table.headers[position]) or not self.table.readable:
            return False
        return like_labels(load_whole(self.table, {position: False})[position].values, in_turn)

    def rule(self, name: str) -> ColumnRule:
        """How the header of a column of ours is known."""
        column, output = self.expected.get(name), output_name(self.instrument)
        if column is None:
            return ColumnRule(Column(name, ANY), (ANY,))
        scale = self.options.nominal_scale or self.instrument.nominal_scale
        kinds = () if column.unit is None else (column.unit,)
        if scale and name in (output, UNCERTAINTY) and column.unit != ANY:
            kinds = (*kinds, scale.unit)
        return ColumnRule(column, kinds, name == output)

    def header(self, name: str) -> Header:
        """The header of a column by our name."""
        return self.table.headers[self.positions[name]]

    def problem(self, column: str, came: str, *about: str, **more: Any) -> None:
        """Note a problem of a column, given by its header; arguments as of `Table.objection`."""
        self.problems.append(self.table.objection(column, came, *about, **more))

    def note_missing(self) -> bool:
        """Note the columns that the instrument needs and the file lacks, with the headers that may be meant.

        Returns:
            Whether there are any.
        """
        taken = {self.positions[name] for name in self.expected if name in self.positions}
        free = [h for i, h in enumerate(self.table.headers) if h.name and i not in taken]
        lacking = [
            column
            for name, column in self.expected.items()
            if _needed(column) and name not in self.positions and name not in self.options.columns
        ]
        has = f"It has: {names_in(self.table)}. "
        for column in lacking:
            self._note_lack(column, self.rule(column.name).candidates(free), has)
            has = ""  # it is said once
        return bool(lacking)

    def _note_lack(self, column: Column, candidates: Sequence[Header], has: str) -> None:
        asked = f"{column.name} [{column.example}]" if column.unit else column.name
        asked += f" ({column.meaning})" * bool(column.meaning)
        if not candidates:
            self.problem(column.name, "no such column", asked, f"{has}Add such a column")
            return
        some = candidates[:SHOWN_HEADERS]
        choices = [self._as_column(column, header) for header in some]
        given = choices[0] if len(choices) == 1 else f"({' or '.join(choices)})"
        shown = ", ".join(header.raw for header in some)
        advice = f"{shown} {'looks' if len(candidates) == 1 else 'look'} like it. "
        if "--nominal-scale" in given:
            advice += "The nominal scale says what one unit of output is of it; --nominal-zero what it is at zero. "
        of_unit = {h.name: (longest_unit(h) or h).unit or "" for h in candidates}
        moving = [n for n, unit in of_unit.items() if any(alike(unit, m) for m in MOTION)]
        if len(moving) > 1 and column.name == output_name(self.instrument):
            together = option("--channels", ",".join(moving))
            advice += f"Together, as channels of one unit: {together}. "
        cure = f"{has}{advice}Add such a column, or say which it is"
        self.problem(column.name, "no such column", asked, cure, given)

    def _as_column(self, column: Column, header: Header) -> str:
        """Return the options that say that a header is a column; what the file cannot tell is left to fill in."""
        said, rule = option("--columns", f"{column.name}={header.raw}"), self.rule(column.name)
        if column.unit is None or rule.fitting(header, {}):
            return said
        raw = unit_among(header, RAW)
        if raw and rule.output and self.options.nominal_scale is None:
            per = f"({column.unit})" if "/" in column.unit else column.unit
            return f"{said} {option('--nominal-scale', f'NUMBER {raw}/{per}')}"
        return said if header.unit else f"{said} {option('--unit', f'{header.raw}=UNIT')}"

    def further_columns(self) -> tuple[dict[str, Column], list[str]]:
        """Return the columns beyond the instrument's that are kept, in base units, and why others are not.

        One that the instrument could use, or that ends in what may be a unit and is none known here, is a problem:
        what is left out is left out because somebody says so.
        """
        kept, flags, file = dict[str, Column](), list[str](), self.table.file
        if self.options.only:
            return kept, flags
        without_unit = list[str]()
        for name, position in self.positions.items():
            header = self.table.headers[position]
            if name in self.expected or self.options.leaves_out(header):
                continue
            if plain(header.name) in DAYS and not header.unit and "time" in self.positions:
                continue  # taken with the time of day
            if name in TAKEN:
                said = f"{file}: column {header.raw!r} ignored: the name {name!r} is taken"
                flags.append(Flag(said, "column.ignored", header.raw))
                continue
            unit = unit_of(header, name, self.options)
            if unit and alike(unit, unit):  # it is a unit
                kept[name] = Column(name, base_unit(unit), required=False)
                continue
            unit, could_be = unit or like_a_unit(header), self._could_be(header)
            text = (unit or "").lower()
            meant = text not in NO_UNIT or (could_be and not text)
            if meant and (could_be or _known(unit) or not self._holds_labels(position)):
                self._note_unclear(header, unit, could_be)
            else:
                without_unit.append(header.raw)
        nameless = (i for i, h in enumerate(self.table.headers) if not h.name)
        without_unit += [f"column {i + 1}, without a name" for i in nameless]
        if without_unit:
            needs_none = (n for n, c in self.expected.items() if c.unit is None or n == "time")
            lacking = [n for n in needs_none if n not in self.positions]
            meant = " or ".join(option("--columns", f"{n}={without_unit[0]}") for n in lacking)
            meant = f"to say what one is: {meant}; " * bool(lacking)
            said = (
                f"{file}: ignored, because they have no unit: {', '.join(without_unit)} "
                f"({meant}to keep one beside the instrument's, write 'name [unit]' or give units=)"
            )
            flags.append(Flag(said, "column.ignored", *without_unit))
        return kept, flags

    def _could_be(self, header: Header) -> Column | None:
        """Return the column, not one that the file must have, which it lacks and a header names in part."""
        lacking = (c for n, c in self.expected.items() if n not in self.positions)
        named = (c for c in lacking if not _needed(c) and self.rule(c.name).could_be(header))
        return next(named, None)

    def _note_unclear(self, header: Header, unit: str | None, column: Column | None) -> None:
        """Note a column that would be left out and may be of use: how to keep it, and how to leave it out."""
        known = _known(unit, (column and column.unit) or ANY)
        came = f"ends in [{unit}], no unit known here" if unit else "has no unit"
        left = option("--ignore", header.raw)
        keep = option("--unit", f"{header.raw}={known or 'UNIT'}")
        wanted, given = "a unit known here", keep if known else left
        if column:
            wanted = f"{column.name} [{column.example}]"
            given = f"{option('--columns', f'{column.name}={header.raw}')} {keep}"
        cure = f"Say what it is and its unit, {keep}, or leave the column out, {left}"
        self.problem(header.raw, came, wanted, cure, given)


def _known(unit: str | None, kind: str = ANY) -> str | None:
    """The unit that a text may be meant as; None for none."""
    return unit_in(unit or "", (kind,)) or spelled(unit or "")


def _needed(column: Column) -> bool:
    return column.required and column.default is None
