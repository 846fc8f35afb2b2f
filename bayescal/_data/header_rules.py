"""Which header means which column: the rules, as tables, and the one matcher that applies them.

A header has several possible readings as a name and a unit ("Temp (°C)", "gyro_z_dps", 'angle/"'); one counts only if
the quantity that is expected there has a unit of its kind. So "Temp_C" is a temperature in °C, since nothing else that
is written C is a temperature. What has one reading is taken and said; what looks like a column is offered.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from bayescal._data.column import UNCERTAINTY, Column
from bayescal._data.unit_conversion import (
    ANY,
    WHERE_EXPECTED,
    parse,
    same_dimension,
    unit_in,
)
from bayescal._tables.raw_table import Header

# Further names of columns that many instruments have, the likeliest tier first, tiers parted by bars; a single letter
# is a symbol, whose case matters.
NAMES = {
    "time": "t timestamp time_stamp date_time datetime epoch unix_time utc time_utc utc_time | date_and_time "
    "time_and_date zeitstempel datum_uhrzeit datum_zeit scan_time | sample_time start_time local_time | elapsed "
    "elapsed_time relative_time messzeit laufzeit sekunden seconds temps x_value millis zeit uhrzeit time_of_day heure "
    "| date datum",
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
_LONGEST = 80  # characters of a header, from its end, in which a unit is looked for
_BRACKETS = [
    re.compile(rf"(.+?)[\s_,:/]*\{a}\s*(.+?)\s*\{b}", re.DOTALL)
    for a, b in ("()", "[]", "{}", "<>")
]
_BEHIND_SLASH = re.compile(r"([^/]*?[^/\s])\s*/\s*(.+)", re.DOTALL)
_BEHIND_COMMA = re.compile(r"(.+?)\s*[,:;]\s*(.+)", re.DOTALL)
_BEHIND_IN = re.compile(r"(.+?)\s+in\s+(.+)", re.DOTALL)
_NUMBERED = re.compile(
    r"[(\[{<]|\d+(?![\d/])"
)  # no unit begins so: "Thermo 1 (°F)"; one may be 1/K
_AXIS = re.compile(
    r"(?:^|[\W_\d])[xyzXYZ](?=$|[\W_])|(?<=[a-z])[XYZ](?=$|[\W_])|^[xyz](?=acc|gyr|mag)"
)


@lru_cache(maxsize=4096)  # each is asked for by many columns
def readings_of(header: Header) -> tuple[Header, ...]:
    """Every way to part a header into a name and, if it has one, the text of a unit; the plainest first."""
    if header.unit:
        return (header,)
    found = [header]
    before, end = header.raw[:-_LONGEST], header.raw[-_LONGEST:]
    for pattern in (*_BRACKETS, _BEHIND_SLASH, _BEHIND_COMMA, _BEHIND_IN):
        if parts := pattern.fullmatch(end):
            unit = parts[2].strip()
            unit = unit[1:-1] if unit[:1] + unit[-1:] == "()" else unit.removeprefix("in ")
            found.append(Header(header.raw, (before + parts[1]).strip(), unit))
    for gap in re.finditer(r"[_\s.]+", end):
        name, unit = before + end[: gap.start()], end[gap.end() :]
        if name and unit and not _NUMBERED.match(unit):
            found.append(Header(header.raw, name, unit))
    return tuple(found)


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
    end = header.raw[-_LONGEST:]
    if found := next((f for p in _BRACKETS if (f := p.fullmatch(end))), None):
        return None if found[2].strip().isdigit() else found[2].strip()
    known = {text for texts in WHERE_EXPECTED.values() for text in texts if text.isascii()}
    meant = known.difference(("G", "g")) | {"K"}
    return next((r.unit for r in readings_of(header) if r.unit in meant), None)


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


def called(headers: Sequence[Header], name: str) -> int | None:
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
        self,
        headers: Sequence[Header],
        named: Sequence[Collection[str]],
        free: Collection[int],
        given: Mapping[str, str],
    ) -> dict[int, Header]:
        """Return the free headers that can be read as it, under the likeliest of its names that there are.

        `named` are the names in their readings, as names are compared, `given` units that the user says.
        """
        for names in self.tiers:
            at = [i for i in sorted(free) if not names.isdisjoint(named[i])]
            if found := {i: r for i in at if (r := self._reading(headers[i], names, given))}:
                return found
        return {}

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
