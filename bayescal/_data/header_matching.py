"""Matching of a file's headers to an instrument's columns, by tables of names and the user's options.

A header can be split into a name and a unit in several ways ("Temp (°C)", "gyro_z_dps", 'angle/"'); a split counts if
its unit has the dimension of the column. So "Temp_C" is a temperature in °C, because C stands for no other unit of
temperature. A header with exactly one valid split is matched, and a flag reports it; a similar header is proposed to
the user. Further columns with a unit are kept, since a user-defined effect may need them; they never cause an error.
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
    format_headers,
    output_name,
    unit_of,
)
from bayescal._data.unit_conversion import (
    ANY,
    CONTEXT_SPELLINGS,
    base_unit,
    fixed_unit,
    format_unit,
    is_convertible,
    parse,
    same_dimension,
    unit_in,
)
from bayescal._tables.raw_table import (
    BRACKETS,
    UNIT_SEARCH_CHARACTERS,
    Header,
    Objections,
    Table,
    find_header,
    list_splits,
    load_whole,
    option,
    to_one_line,
)

# Further names of common columns, in tiers separated by bars, the most probable tier first; a single letter is a
# case-sensitive symbol.
SYNONYMS = {
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
# Names of label columns, valid if the cells are labels too: text or integers that repeat in blocks. Words for a number,
# such as "no." or "id", are removed from a header before the comparison.
LABEL_NAMES = {
    "run": "run run_label test_run cycle zyklus lauf laufnummer messung messreihe versuch versuchsnummer durchgang "
    "durchlauf essai passage sweep trial test repetition wiederholung mounting montage aufspannung einspannung setup",
    "device": "device dut unit sensor serial sensor_sn sn prufling pruefling seriennummer serien geraet gerat capteur "
    "serie",
    "axis": "axis achse axe",
}
NUMBER_WORDS = frozenset(["no", "nr", "n", "number", "num", "nummer", "numero", "id", "de", "du"])
# Texts in the place of a unit that mean that there is no unit.
BLANK_UNITS = frozenset(
    ["", "1", "-", "#", "no", "no.", "nr", "nr.", "n", "№", "id", "text", "label", "index", "none"]
)
MIN_READINGS_PER_LABEL = 3.0  # mean number of consecutive readings with the same label
# Prefixes of channel names in logs, by the unit of the channel.
PREFIXES = {
    "deg/s": ("gyr", "rate", "omega", "gx", "gy", "gz", "wx", "wy", "wz"),
    "ug": ("acc", "ax", "ay", "az"),
    "rad": ("tilt", "angle", "incl", "roll", "pitch"),
}
# Names of a date column that accompanies a column of times of day, in several languages.
DATE_NAMES = (
    *("date", "datum", "day", "tag", "dato", "dag", "data", "giorno", "fecha", "dia", "jour"),
    *("paiva", "paivamaara", "pvm"),
)
RAW_UNITS = ("V", "Hz", "A", "count")  # units of a raw output, which a nominal scale converts
# Units that mark a column along the output's axis as another channel; in another unit it may be a drive voltage, say.
MOTION_UNITS = ("m/s^2", "rad/s", "rad", "uT", "count")
AMBIGUOUS_UNITS = frozenset(  # unit names that may also be ordinary words
    ["min", "day", "days", "bar", "rev", "count", "counts", "second", "minute", "hour", "degree"]
    + ["atm", "psi", "gram", "grams", "lb", "cc", "kp", "mol"]
)
_AXIS_LETTER = re.compile(
    r"(?:^|[\W_\d])[xyzXYZ](?=$|[\W_])|(?<=[a-z])[XYZ](?=$|[\W_])|^[xyz](?=acc|gyr|mag)"
)


def find_units(header: Header, kinds: tuple[str, ...]) -> dict[str, Header]:
    """Return the units, of the dimensions `kinds`, that a header may have: unit → header split into name and unit."""
    pairs = ((unit_in(split.unit or "", kinds), split) for split in list_splits(header))
    return {unit: replace(split, unit=unit) for unit, split in pairs if unit}


def split_trailing_unit(header: Header) -> Header | None:
    """Split a header that ends in a unit of any quantity, in brackets or of two letters or more; None for others."""
    split = None if header.unit else split_off_unit(header)
    unit = (split and split.unit) or ""
    brackets = header.raw[-1:] in tuple(")]}>")
    return split if unit and (brackets or (len(unit) > 1 and unit not in AMBIGUOUS_UNITS)) else None


def split_off_unit(header: Header) -> Header | None:
    """Split a header so that its unit, of any quantity, is as long as possible; None if it may be part of another unit.

    "Rate in deg/hr" has the unit °/h, not the name "Rate in deg" and the unit h; "flow_L_min" remains undecided.
    """
    splits = list_splits(header)
    candidates = [(s, unit) for s in splits if (unit := unit_in(s.unit or "", (ANY,)))]
    if not candidates:
        return None
    split, unit = max(candidates, key=lambda pair: len(pair[0].unit or ""))
    words = re.split(r"[\s_./]+", split.name.strip())[1:]
    is_denominator = parse(unit).powers.keys() in ({"s"}, {"m"}) and header.raw[-1:].isalnum()
    is_half_unit = is_denominator and any(unit_in(t, (ANY,)) for t in words[-1:])
    return None if is_half_unit else replace(split, unit=unit)


def find_unit_ending(header: Header) -> str | None:
    """Return the end of a header that may be an unknown unit: a text in brackets, or after a blank; else None."""
    end = header.raw[-UNIT_SEARCH_CHARACTERS:]
    if match := next((f for p in BRACKETS if (f := p.fullmatch(end))), None):
        return None if match[2].strip().isdigit() else match[2].strip()
    spellings = {text for texts in CONTEXT_SPELLINGS.values() for text in texts if text.isascii()}
    unit_spellings = spellings.difference(("G", "g")) | {"K"}
    return next((r.unit for r in list_splits(header) if r.unit in unit_spellings), None)


@lru_cache(maxsize=4096)  # one header is compared with many columns
def normalise(name: str) -> str:
    """Normalise a name for comparison: lower case, no accents, underscores for blanks, "temp" as temperature."""
    letters = unicodedata.normalize("NFD", name)
    letters = "".join(c for c in letters if not unicodedata.combining(c))  # Prüfling as Prufling
    separated = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", letters)  # boardTemp as board_Temp
    words = re.sub(r"[^a-z0-9]+", "_", separated.lower()).strip("_").split("_")
    return "_".join("temperature" if word in ("temp", "tmp") else word for word in words)


def comparison_key(split: Header) -> str:
    """Return the normalised name of a split header, for comparison; symbols of one letter are unchanged."""
    name = split.name.strip()
    return name if len(name) == 1 else normalise(name)


def find_label_column(header: Header) -> str | None:
    """Return the label column ("run", "device" or "axis") that a header names; None for any other header."""
    splits = (s for s in list_splits(header) if (s.unit or "").lower() in BLANK_UNITS)
    words = (normalise(split.name).split("_") for split in splits)
    nouns = {"_".join(word for word in name if word not in NUMBER_WORDS) for name in words}
    return next((n for n, names in LABEL_NAMES.items() if nouns & {*names.split()}), None)


def are_labels(texts: np.ndarray, in_turn: bool = False) -> bool:
    """Return whether cells are labels: several texts or integers, in blocks or, if `in_turn` (devices), interleaved."""
    levels = set(texts.tolist())
    blocks = len(levels) if in_turn else 1 + int(np.count_nonzero(texts[1:] != texts[:-1]))
    valid = all(re.fullmatch(r"[^.,]*[^\d.,][^.,]*|[+-]?\d+(?:[.,]0*)?", text) for text in levels)
    return valid and len(levels) > 1 and MIN_READINGS_PER_LABEL * blocks <= len(texts)


@dataclass(frozen=True)
class ColumnRule:
    """Rule that matches headers to a column; their units have one of the dimensions `kinds` ("any" for all)."""

    column: Column
    kinds: tuple[str, ...]
    is_output: bool = False

    @property
    def name_tiers(self) -> list[frozenset[str]]:
        """Return the column's names in tiers: its own names, then synonyms, the most probable first."""
        own_names = frozenset(map(normalise, (self.column.name, *self.column.also)))
        synonym_tiers = SYNONYMS.get(self.column.name, "").split("|")
        return [own_names, *(frozenset(tier.split()) for tier in synonym_tiers)]

    def find_matches(
        self, headers: Sequence[Header], unmatched: Collection[int], user_units: Mapping[str, str]
    ) -> dict[int, Header]:
        """Return the unmatched headers, by index, that match the first tier of `name_tiers` that has any match.

        `user_units`: header or name → unit given by the user.
        """
        for names in self.name_tiers:
            splits = {
                i: self._split_header(headers[i], names, user_units) for i in sorted(unmatched)
            }
            if matches := {i: split for i, split in splits.items() if split}:
                return matches
        return {}

    def _split_header(
        self, header: Header, names: Collection[str], user_units: Mapping[str, str]
    ) -> Header | None:
        """Split a header into one of these names and a unit of the column's dimension or none; None if impossible."""
        for split in sorted(list_splits(header), key=lambda r: r.unit is None):
            if comparison_key(split) not in names:
                continue
            if split.unit is None:
                return split
            if unit := unit_in(split.unit, self.kinds):
                return replace(split, unit=unit)
            if header.raw in user_units or split.name in user_units:
                unit = user_units.get(split.name, "")
                return replace(split, unit=unit if unit_in(unit, (ANY,)) else None)
        return None

    def unique_split(self, header: Header, units: Mapping[str, str]) -> Header | None:
        """Return the only split of a header whose unit has the column's dimension; None for no split or several."""
        if ANY in self.kinds:
            return None if header.raw in units else split_off_unit(header)
        splits = find_units(header, self.kinds)
        splits.pop("1", None)
        return splits.popitem()[1] if len(splits) == 1 and header.raw not in units else None

    def propose_headers(self, headers: Sequence[Header]) -> list[Header]:
        """Return the headers with a unit of the column's dimension, else without unit; if possible, similar names."""
        word = normalise(self.column.name)
        preferred_units = MOTION_UNITS if ANY in self.kinds else self.kinds
        tiers = (preferred_units, self.kinds if ANY in self.kinds else RAW_UNITS * self.is_output)
        by_kind = ([h for h in headers if find_units(h, kinds)] for kinds in tiers)
        with_unit = next(filter(None, by_kind), [])
        without_unit = [h for h in headers if not split_off_unit(h)]
        headers = with_unit or without_unit
        similar = [h for h in headers if _has_common_word(normalise(h.name), word)]
        unitless = [h for h in without_unit if self.column.unit and not find_unit_ending(h)]
        return similar or with_unit or unitless

    def contains_name(self, header: Header) -> bool:
        """Return whether a header contains a name of the column; False for labels and for known uncertainties."""
        if self.column.unit is None or self.column.name == UNCERTAINTY:
            return False
        own_names, *synonym_tiers = self.name_tiers
        names = own_names.union(n for tier in synonym_tiers for n in tier if len(n) > 2)
        name_words = set(normalise(self.column.name).split("_"))
        words = (normalise(split.name) for split in list_splits(header))
        return any(name in names or name_words <= set(name.split("_")) for name in words)


def _has_common_word(header_name: str, column_name: str) -> bool:
    """Return whether names share a word, an axis letter, or the first three letters (or more) of a word."""
    words = [(a, b) for a in header_name.split("_") for b in column_name.split("_") if a and b]
    return any(a == b or (min(len(a), len(b)) > 2 and b.startswith(a)) for a, b in words)


def find_channels(output: str, columns: Mapping[str, str | None], unit: str | None) -> list[str]:
    """Return the columns that are other channels of the device of an output, in `unit`.

    They have another axis, contain another motion on the same axis, or the same quantity with another channel number.
    Channels of a device share temperatures and times; hence they correlate without causing each other.
    `columns`: name → unit of the columns that the instrument does not declare.
    """
    numbered, axis = re.sub(r"\d+", "#", output), _find_axis(output)
    channels = []
    for name, column_unit in columns.items():
        same_unit = column_unit and unit and same_dimension(column_unit, unit)
        same_quantity = same_unit and re.sub(r"\d+", "#", name) == numbered
        is_motion = not column_unit or any(same_dimension(column_unit, m) for m in MOTION_UNITS)
        is_on_axis = axis and (letter := _find_axis(name)) and (letter != axis or is_motion)
        if is_on_axis or (same_quantity and "#" in numbered):
            channels.append(name)
    return channels


def _find_axis(name: str) -> str:
    """Return the axis letter (x, y or z) at the end or the beginning of a name; "" if there is none."""
    return next((text[-1].lower() for text in reversed(_AXIS_LETTER.findall(name))), "")


MAX_SHOWN_HEADERS = 4  # headers proposed for a missing column


@dataclass
class MatchedFile:
    """File whose headers are matched to an instrument's columns.

    A header is matched to a column if exactly one split of it is possible; a flag reports the match. A column is not
    searched for if its exact name is in the file, or if `columns=` assigns it.

    Attributes:
        table: the file, its headers split into name and unit.
        instrument: the instrument that declares the expected columns.
        options: the user's options of reading.
        problems: list to which problems are added.
        expected: the expected columns by bayescal's name, in the units in which they are stored.
        columns: the expected columns, then those that the instrument does not declare but that are kept, in base units.
        positions: bayescal's name of each column → its position in the file.
        flags: notes of the file, of matched headers and of ignored columns.
    """

    table: Table
    instrument: InstrumentLike
    options: ReadOptions
    problems: Objections
    expected: dict[str, Column] = field(init=False)
    positions: dict[str, int] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        """Match the headers by the user's options, then by names and units, then by their cells."""
        self.expected = expected_columns(self.instrument)
        self._headers, self.flags = list(self.table.headers), list(self.table.notes)
        self._unmatched = set(range(len(self._headers)))
        self._assign_user_columns()
        user_names = set(self.positions)
        self._assign_instrument_columns()
        self._assign_axes()
        self._assign_label_columns()
        self._register_further_columns(user_names)
        self.table = replace(self.table, headers=tuple(self._headers))
        for name, column in self.expected.items():
            unit = self.header(name).unit if name in self.positions else None
            is_forced = name in self.options.columns and not _find_known_unit(unit)
            if column.unit is None and not is_forced and (unit or "").lower() not in BLANK_UNITS:
                fault, expected = f"has the unit {unit}", f"a label (text) as {name!r}"
                cure = "Remove the unit, or rename the column"
                self.report(self.header(name).raw, fault, expected, cure)
        self._fix_units()
        self.columns = self.expected

    def _assign(self, position: int, split: Header, name: str, reason: str = "") -> None:
        """Assign the header at a position, split as given, to the column `name`."""
        self._unmatched.discard(position)
        self.positions[name] = position
        self._rename(position, split, name + reason)

    def _rename(self, position: int, split: Header, description: str) -> None:
        old_header, self._headers[position] = self._headers[position], split
        if split != old_header:
            unit = f" in {format_unit(split.unit)}" if split.unit else ""
            self.flags.append(f"{self.table.file}: read {old_header.raw!r} as {description}{unit}")

    def _assign_user_columns(self) -> None:
        """Assign the columns that the user names (`columns=`)."""
        for column_name, user_header in self.options.columns.items():
            user_text = to_one_line(user_header)
            position = find_header(self._headers, user_text)
            if position is None:
                fault = f"has no column {user_header!r} ({option('--columns', f'{column_name}={user_header}')})"
                self.report("", fault, cure=f"It has: {format_headers(self.table)}")
            elif position not in self._unmatched:
                other = next(name for name, index in self.positions.items() if index == position)
                fault = f"both {other} and {column_name} by --columns"
                self.report(user_header, fault, cure="Name one for each")
            else:
                header = self._headers[position]
                split = self.rule(column_name).unique_split(header, self.options.units)
                name = header.name if user_text in (header.name, header.raw) else user_text
                self._assign(position, replace(split or header, name=name), column_name)

    def _assign_instrument_columns(self) -> None:
        """Assign the instrument's columns by their exact names, else by synonyms with a unit of the right dimension."""
        headers = self._headers
        index = {headers[i].name: i for i in self._unmatched}
        for name, column in self.expected.items():
            if name in self.options.columns:
                continue
            synonyms = [n for n in column.also if n not in self.expected]
            own_names, rule = [n for n in (name, *synonyms) if n in index], self.rule(name)
            for second in own_names[1:]:
                first, other = headers[index[own_names[0]]].raw, headers[index[second]].raw
                self.report(other, f"a second {name!r} besides {first!r}", cure="Remove one")
            if own_names:
                position = index[own_names[0]]
                unit = unit_in(headers[position].unit or "", rule.kinds) or headers[position].unit
                self._assign(position, replace(headers[position], unit=unit), name)
                continue
            matches = rule.find_matches(headers, self._unmatched, self.options.units)
            if len(matches) == 1:
                position, split = matches.popitem()
                self._assign(position, replace(split, name=name), name)

    def _assign_axes(self) -> None:
        """Assign three axes' outputs to the only triple of headers, in convertible units, that differ in x, y, z."""
        outputs = getattr(self.instrument, "outputs", ())
        if not outputs or not {*self.positions, *self.options.columns}.isdisjoint(outputs):
            return
        triples = dict[str, dict[str, tuple[int, Header]]]()
        for i in sorted(self._unmatched):
            header = self._headers[i]
            if header.raw not in self.options.units:
                header = split_off_unit(header) or header
            unit, name = unit_of(header, "", self.options), header.name.lower()
            if name and unit and is_convertible(unit, str(self.expected[outputs[0]].unit)):
                for key, axis in ((f"{name[:-1]}?", name[-1]), (f"?{name[1:]}", name[0])):
                    triples.setdefault(key, {})[axis] = i, header
        full_triples = [triple for triple in triples.values() if triple.keys() >= {*"xyz"}]
        if len(full_triples) == 1:
            for axis in "xyz":
                position, header = full_triples[0][axis]
                self._assign(position, replace(header, name=f"output_{axis}"), f"output_{axis}")

    def _assign_label_columns(self) -> None:
        """Assign label columns (run, device, axis) by header and cells."""
        for i in sorted(self._unmatched):
            column_name = find_label_column(self._headers[i])
            if column_name is None or column_name in {*self.positions, *self.options.columns}:
                continue
            if self._holds_labels(i, column_name == "device"):
                split = replace(self._headers[i], name=column_name, unit=None)
                self._assign(i, split, column_name, ", as its values are labels")

    def _register_further_columns(self, user_names: set[str]) -> None:
        """Register the remaining columns under the file's names, without units; `user_names`: the user's."""
        for i in sorted(self._unmatched):
            split = split_trailing_unit(self._headers[i])
            if split and split.name not in self.expected:
                self._rename(i, split, split.name)
            name = self._headers[i].name
            if name in self.positions:
                other = f"{name!r} besides {self._headers[self.positions[name]].raw!r}"
                other += ", which --columns assigns" if name in user_names else ""
                cure = f"Rename it, or leave {name!r} out of --columns"
                self.report(self._headers[i].raw, f"a second {other}", cure=cure)
            elif name:
                self.positions[name] = i

    def _fix_units(self) -> None:
        """Replace the unit "any" of expected columns by the fixed unit of the quantity in the file.

        A known uncertainty gets the unit of the output. A nominal scale for an output with unit "any" is a problem; a
        column without a valid unit is reported later, at its conversion.
        """
        for name, column in self.expected.items():
            if column.unit != ANY or name not in self.positions:
                continue
            if self.options.nominal_scale is not None:
                fault = "a nominal scale factor was given, but this instrument has no fixed output unit to convert to"
                cure = (
                    "Omit the nominal scale factor, or choose an instrument whose output has a unit"
                )
                self.report(name, fault, cure=cure)
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
        """Return the rule that matches headers to the column that bayescal calls `name`."""
        column, output = self.expected.get(name), output_name(self.instrument)
        if column is None:
            return ColumnRule(Column(name, ANY), (ANY,))
        scale = self.options.nominal_scale or self.instrument.nominal_scale
        kinds = () if column.unit is None else (column.unit,)
        if scale and name in (output, UNCERTAINTY) and column.unit != ANY:
            kinds = (*kinds, scale.unit)
        return ColumnRule(column, kinds, name == output)

    def header(self, name: str) -> Header:
        """Return the header of the column that bayescal calls `name`."""
        return self.table.headers[self.positions[name]]

    def report(self, column: str, fault: str, *texts: str, **details: Any) -> None:
        """Add a problem of a column, given by its header; the other arguments are those of `Table.objection`."""
        self.problems.append(self.table.objection(column, fault, *texts, **details))

    def note_missing(self) -> bool:
        """Add a problem, with similar headers, for each missing required column; return whether any is missing."""
        positions = {self.positions[name] for name in self.expected if name in self.positions}
        unmatched = [h for i, h in enumerate(self.table.headers) if h.name and i not in positions]
        missing_columns = [
            column
            for name, column in self.expected.items()
            if _is_required(column) and name not in {*self.positions, *self.options.columns}
        ]
        headers = f"It has: {format_headers(self.table)}. "
        for column in missing_columns:
            self._note_lack(column, self.rule(column.name).propose_headers(unmatched), headers)
            headers = ""  # list the headers only once
        return bool(missing_columns)

    def _note_lack(self, column: Column, candidates: Sequence[Header], headers: str) -> None:
        expected = f"{column.name} [{column.example}]" if column.unit else column.name
        expected += f" ({column.meaning})" * bool(column.meaning)
        if not candidates:
            self.report(column.name, "no such column", expected, f"{headers}Add such a column")
            return
        shown_headers = candidates[:MAX_SHOWN_HEADERS]
        choices = [self._format_options(column, header) for header in shown_headers]
        suggestion = choices[0] if len(choices) == 1 else f"({' or '.join(choices)})"
        names = ", ".join(header.raw for header in shown_headers)
        advice = f"{names} {'looks' if len(candidates) == 1 else 'look'} like it. "
        if "--nominal-scale" in suggestion:
            advice += "--nominal-scale is the raw output per unit of output, --nominal-zero the raw output at zero. "
        units = {h.name: (split_off_unit(h) or h).unit or "" for h in candidates}
        channel_names = [
            n for n, u in units.items() if any(is_convertible(u, m) for m in MOTION_UNITS)
        ]
        if len(channel_names) > 1 and column.name == output_name(self.instrument):
            channels_option = option("--channels", ",".join(channel_names))
            advice += f"For a joint analysis of these channels of one device: {channels_option}. "
        cure = f"{headers}{advice}Add such a column, or name it"
        self.report(column.name, "no such column", expected, cure, suggestion)

    def _format_options(self, column: Column, header: Header) -> str:
        """Return the command-line options that assign a header to a column, with placeholders for unknown values."""
        options, rule = option("--columns", f"{column.name}={header.raw}"), self.rule(column.name)
        if column.unit is None or rule.unique_split(header, {}):
            return options
        raw_unit = next(iter(find_units(header, RAW_UNITS)), None)
        if raw_unit and rule.is_output and self.options.nominal_scale is None:
            divisor = f"({column.unit})" if "/" in column.unit else column.unit
            return f"{options} {option('--nominal-scale', f'NUMBER {raw_unit}/{divisor}')}"
        return options if header.unit else f"{options} {option('--unit', f'{header.raw}=UNIT')}"

    def add_further_columns(self) -> None:
        """Add the undeclared columns that have a unit, in base units; flag those that are ignored."""
        if self.options.only_declared:
            return
        further_columns, without_unit, file = dict[str, Column](), list[str](), self.table.file
        for name, position in self.positions.items():
            header = self.table.headers[position]
            if name in self.expected or self.options.is_ignored(header):
                continue
            is_date = normalise(header.name) in DATE_NAMES and not header.unit
            if is_date and "time" in self.positions:
                continue  # read together with the time of day
            if name in RESERVED_NAMES:
                message = f"{file}: column {header.raw!r} ignored: the name {name!r} is reserved"
                self.flags.append(Flag(message, "column.ignored", header.raw))
                continue
            unit = unit_of(header, name, self.options)
            if unit and is_convertible(unit, unit):  # it is a unit
                further_columns[name] = Column(name, base_unit(unit), required=False)
                continue
            unit, matching_column = unit or find_unit_ending(header), self._find_column(header)
            text = (unit or "").lower()
            is_unit = text not in BLANK_UNITS or (matching_column and not text)
            if is_unit and (
                matching_column or _find_known_unit(unit) or not self._holds_labels(position)
            ):
                self._note_unclear(header, unit, matching_column)
            else:
                without_unit.append(header.raw)
        numbered = enumerate(self.table.headers, 1)
        without_unit += [f"column {i}, without a name" for i, h in numbered if not h.name]
        if without_unit:
            needs_none = (n for n, c in self.expected.items() if c.unit is None or n == "time")
            absent = [n for n in needs_none if n not in self.positions]
            advice = " or ".join(option("--columns", f"{n}=NAME") for n in absent)
            advice = f"; to use one as {' or '.join(absent)}: {advice}" * bool(absent)
            message = (
                f"{file}: columns ignored because they have no unit: {', '.join(without_unit)} (to keep one, write its "
                f"unit in the header, 'name [unit]', or {option('--unit', 'NAME=UNIT')}{advice})"
            )
            self.flags.append(Flag(message, "column.ignored", *without_unit))
        self.columns = {**self.expected, **further_columns}

    def _find_column(self, header: Header) -> Column | None:
        """Return the first optional column, absent from the file, whose name a header contains; else None."""
        absent = (c for n, c in self.expected.items() if n not in self.positions)
        optional = (c for c in absent if not _is_required(c))
        return next((c for c in optional if self.rule(c.name).contains_name(header)), None)

    def _note_unclear(self, header: Header, unit: str | None, column: Column | None) -> None:
        """Add a problem for a column of unclear unit, with the options that keep or exclude it."""
        known_unit = _find_known_unit(unit, (column and column.unit) or ANY)
        fault = f"ends in [{unit}], which is not a known unit" if unit else "has no unit"
        ignore_option = option("--ignore", header.raw)
        keep_option = option("--unit", f"{header.raw}={known_unit or 'UNIT'}")
        expected, suggestion = "a known unit", keep_option if known_unit else ignore_option
        if column:
            expected = f"{column.name} [{column.example}]"
            suggestion = f"{option('--columns', f'{column.name}={header.raw}')} {keep_option}"
        cure = f"Give its unit, {keep_option}, or exclude the column, {ignore_option}"
        self.report(header.raw, fault, expected, cure, suggestion)


def _find_known_unit(unit: str | None, kind: str = ANY) -> str | None:
    """Return the known unit of dimension `kind` that a text denotes; None if none or several."""
    matching_names = [name for name, texts in CONTEXT_SPELLINGS.items() if unit in texts]
    return unit_in(unit or "", (kind,)) or (matching_names[0] if len(matching_names) == 1 else None)


def _is_required(column: Column) -> bool:
    return column.required and column.default is None
