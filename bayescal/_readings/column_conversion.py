"""From a file's columns to an instrument's numbers: conversion, and what is refused.

A refusal names the file, the row, the column, what was read, what was expected, and what to do.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass, field

import numpy as np

from bayescal._core.errors import InputError
from bayescal._readings import unit_conversion
from bayescal._readings.column import MAY_BE_EMPTY, Column, placeholder
from bayescal._readings.column_matching import (
    InstrumentLike,
    ReadOptions,
    expected_columns,
    extra_columns,
    match,
    output_name,
    refuse_missing,
    unit_of,
    with_fixed_units,
)
from bayescal._readings.raw_table import Cells, Header, Table, load_whole

_LIKELY_UNITS = (
    *("deg", "arcsec", "rad", "deg/s", "rad/s", "g", "mg", "ug", "degC", "degF", "K"),
    *("s", "min", "h", "V", "mV", "Hz", "kHz", "1", "%", "ppm"),
)


@dataclass
class ConvertedColumns:
    """One file's columns as ours.

    Attributes:
        values: name → one entry per reading.
        units: name → unit; None for labels.
        flags: what was odd.
        filled: names of columns that hold a default.
    """

    values: dict[str, np.ndarray] = field(default_factory=dict)
    units: dict[str, str | None] = field(default_factory=dict)
    flags: list[str] = field(default_factory=list)
    filled: set[str] = field(default_factory=set)


def convert_columns(
    table: Table, instrument: InstrumentLike, options: ReadOptions
) -> ConvertedColumns:
    """Check a file's columns and convert them.

    Args:
        table: the file.
        instrument: whose columns are expected.
        options: renamings, units, gravity and scale.

    Returns:
        Columns in the instrument's units, in its order, then what else was kept.

    Raises:
        InputError: a column, a unit or a cell cannot be used; the message names file, row and
            column.
    """
    expected = expected_columns(instrument)
    positions = match(table, expected, options)
    refuse_missing(table, expected, positions, instrument.name)
    expected = with_fixed_units(expected, table, positions, options)
    extra, flags = extra_columns(table, expected, positions, options)
    converted = ConvertedColumns(flags=[*table.notes, *flags])
    found = {n: c for n, c in (expected | extra).items() if n in positions}
    cells = load_whole(table, {positions[n]: c.unit is not None for n, c in found.items()})
    readers = {
        name: _ColumnReader(
            table=table,
            header=table.headers[positions[name]],
            column=column,
            options=options,
            instrument=instrument,
            converted=converted,
        )
        for name, column in found.items()
    }
    for name, column in expected.items():
        if name in readers:
            readers[name].read(cells[positions[name]])
        if name not in converted.values and column.default is not None:
            kind = object if column.unit is None else np.float64
            converted.values[name] = np.full(table.rows, column.default, dtype=kind)
            converted.units[name] = column.unit
            converted.filled.add(name)
    for name in extra:
        readers[name].read_if_sound(cells[positions[name]])
    return converted


@dataclass(frozen=True)
class _ColumnReader:
    """Checks one column of a file and converts it into `converted`."""

    table: Table
    header: Header
    column: Column
    options: ReadOptions
    instrument: InstrumentLike
    converted: ConvertedColumns

    def read(self, cells: Cells) -> None:
        """A column of the instrument; one that is empty and not required is left out.

        Raises:
            InputError: a cell or the unit cannot be used.
        """
        name = self.column.name
        if self.column.unit is None:
            if not self.column.required and (cells.values == "").all():
                self._flag("is empty and was left out")
                return
            self._refuse_labels(cells.values)
            self.converted.values[name], self.converted.units[name] = cells.values, None
            return
        unit = self._unit()
        if not self.column.required and cells.bad is None and np.isnan(cells.values).all():
            self._flag("is empty and was left out")
            return
        if cells.bad:
            self._refuse_text(*cells.bad, unit)
        with np.errstate(over="ignore"):
            values = self._convert(cells.values, unit)
        self._refuse_not_finite(cells.values, values, unit)
        if (index := placeholder(cells.values)) is not None:
            raise InputError(
                f"{self._at(index)} reads {cells.values[index]:g}, far from all other numbers: it stands for a missing "
                "reading. Remove such rows"
            )
        self._refuse_implausible(cells.values, values, unit)
        self.converted.values[name], self.converted.units[name] = values, self.column.unit

    def read_if_sound(self, cells: Cells) -> None:
        """A column that no instrument asked for: left out, with a flag, unless every cell is a number."""
        name, fixed, gravity = self.column.name, self.column.unit, self.options.local_gravity
        unit = unit_of(self.header, name, self.options)
        assert unit is not None and fixed is not None  # `extra_columns` keeps no other
        values = unit_conversion.convert(cells.values, unit, fixed, local_gravity=gravity)
        unusable = np.flatnonzero(self._not_finite(values))
        if cells.bad or unusable.size:
            index = cells.bad[0] if cells.bad else int(unusable[0])
            seen = f"reads {cells.bad[1]!r}" if cells.bad else _reading(cells.values[index])
            self._flag(f"ignored: {self.table.place(index)} {seen}")
            return
        if unit_conversion.needs_gravity(unit, fixed):
            self._flag(f"turned into local g by {gravity:g} m/s²")
        self.converted.values[name], self.converted.units[name] = values, fixed

    def _flag(self, said: str) -> None:
        self.converted.flags.append(f"{self.table.file}: column {self.header.raw!r} {said}")

    def _at(self, index: int) -> str:
        return f"{self.table.place(index)} of {self.table.file!r}, column {self.header.raw!r}:"

    def _unit(self) -> str:
        unit = unit_of(self.header, self.column.name, self.options)
        where = f"{self.table.file!r}, column {self.header.raw!r}:"
        if unit is None:
            raise InputError(
                f"{where} the header has no unit. Write '{self.header.name} [{self.column.example}]' "
                f"(or the unit that the numbers are in), or give units={{{self.header.name!r}: …}} "
                f"(--unit {self.header.name}=…)"
            )
        try:
            unit_conversion.check_unit(unit)
        except InputError as error:
            raise InputError(f"{where} {error}. Correct the header, or give units=") from error
        if self.header.unit and unit != self.header.unit:
            self._flag(f"taken as [{unit}], as units= says")
        return unit

    def _refuse_labels(self, values: np.ndarray) -> None:
        first: dict[str, int] = {}
        for index, label in enumerate(values.tolist()):
            first.setdefault(label, index)
        for label, index in first.items():
            if not label:
                raise InputError(
                    f"{self._at(index)} is empty, a label was expected. Fill it in, or remove the "
                    "row"
                )
            if any(unicodedata.category(character) in ("Cc", "Cs") for character in label):
                raise InputError(
                    f"{self._at(index)} reads {label!r}, which holds a control character. Remove it"
                )
            if self.column.allowed and label not in self.column.allowed:
                raise InputError(
                    f"{self._at(index)} reads {label!r}, an unknown label; expected is one of "
                    f"{', '.join(self.column.allowed)}. Correct it"
                )

    def _refuse_text(self, index: int, text: str, unit: str) -> None:
        hint = "Correct the cell, or remove the row"
        if re.fullmatch(r"[+-]?\d*,\d+([eE][+-]?\d+)?", text):
            hint = "If that is a decimal comma, export the file with decimal points"
        raise InputError(
            f"{self._at(index)} reads {text[:60]!r}, a number in {unit_conversion.pretty(unit)} was "
            f"expected. {hint}"
        )

    def _convert(self, values: np.ndarray, unit: str) -> np.ndarray:
        """Numbers in `unit` in the column's, by the nominal scale if it is a raw output."""
        target, gravity = self.column.unit or "1", self.options.local_gravity
        output = output_name(self.instrument)
        difference = self.column.name == "output_uncertainty"
        scale = self.options.nominal_scale or self.instrument.nominal_scale
        if unit_conversion.same_dimension(unit, target):
            if unit_conversion.needs_gravity(unit, target):
                self._flag(f"turned into local g by {gravity:g} m/s²")
            return unit_conversion.convert(
                values, unit, target, local_gravity=gravity, difference=difference
            )
        raw_output = self.column.name == output or difference
        if raw_output and scale is not None and unit_conversion.same_dimension(unit, scale.unit):
            shifted = scale.offset and not difference
            reading = f"(reading − {scale.offset:g})" if shifted else "reading"
            self._flag(
                f"turned into {unit_conversion.pretty(target)} by the nominal scale: "
                f"{reading}/{scale.gain:g}, reading in {unit_conversion.pretty(scale.unit)}"
            )
            raw = unit_conversion.convert(
                values, unit, scale.unit, local_gravity=gravity, difference=difference
            )
            return scale.apply(raw, difference=difference)
        also = (
            f", or {scale.unit}, which the nominal scale converts" if raw_output and scale else ""
        )
        hint = " Or give a nominal_scale." if raw_output and scale is None else ""
        raise InputError(
            f"{self.table.file!r}, column {self.header.raw!r}: its unit is [{unit}], expected is "
            f"one that converts to {target}{also}. Correct the header, or give "
            f"units={{{self.header.name!r}: …}}.{hint}"
        )

    def _not_finite(self, values: np.ndarray) -> np.ndarray:
        """Mask of the readings that are no number; a temperature point may be empty."""
        return np.isinf(values) if self.column.name == MAY_BE_EMPTY else ~np.isfinite(values)

    def _refuse_not_finite(self, raw: np.ndarray, values: np.ndarray, unit: str) -> None:
        wrong = self._not_finite(values)
        if wrong.any():
            index = int(np.argmax(wrong))
            seen = _reading(raw[index]) + (", too large" if np.isfinite(raw[index]) else "")
            raise InputError(
                f"{self._at(index)} {seen}, a number in {unit_conversion.pretty(unit)} was expected. "
                "Fill it in, or remove the row"
            )

    def _refuse_implausible(self, raw: np.ndarray, values: np.ndarray, unit: str) -> None:
        low = -np.inf if self.column.low is None else self.column.low
        high = np.inf if self.column.high is None else self.column.high
        wrong = (values < low) | (values > high)
        if not wrong.any():
            return
        index, shown = int(np.argmax(wrong)), unit_conversion.pretty(self.column.unit or "1")
        limits = f"at least {low:g}" if high == np.inf else f"at most {high:g}"
        limits = f"{low:g} … {high:g}" if low > -np.inf and high < np.inf else limits
        same = unit_conversion.pretty(unit) == shown
        internal = "" if same else f", that is {values[index]:.6g} {shown}"
        likely = _LIKELY_UNITS if wrong.mean() >= 0.5 else ()  # a single slip says nothing of units
        better = [u for u in likely if u != unit and self._plausible_in(u, raw, low, high)]
        hint = (
            f"Are the numbers in {better[0]}? Then write '{self.header.name} [{better[0]}]'"
            if better
            else "Check the unit and the number"
        )
        raise InputError(
            f"{self._at(index)} reads {raw[index]:.6g} {unit_conversion.pretty(unit)}{internal}; "
            f"plausible is {limits} {shown}. {hint}"
        )

    def _plausible_in(self, unit: str, raw: np.ndarray, low: float, high: float) -> bool:
        target = self.column.unit or "1"
        if not unit_conversion.same_dimension(unit, target):
            return False
        values = unit_conversion.convert(
            raw, unit, target, local_gravity=self.options.local_gravity
        )
        return bool(np.all(np.isnan(values) | ((values >= low) & (values <= high))))


def _reading(value: float) -> str:
    """What a cell that holds no finite number reads."""
    return "is empty or NaN" if np.isnan(value) else f"reads {value:g}"
