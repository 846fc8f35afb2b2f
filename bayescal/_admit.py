"""From a file's columns to an instrument's numbers: conversion, and what cannot be let in.

Columns of the instrument are refused with the row and the reason. A column that no instrument asked
for is never a reason to refuse a file: it is kept if it is sound, because a user's own effect may
need it, and otherwise left out with a flag that says why.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from bayescal import _units
from bayescal._column import TAKEN, Column
from bayescal._errors import InputError
from bayescal._match import (
    Expects,
    Wishes,
    expected_columns,
    match,
    output_name,
    refuse_missing,
    unit_of,
)
from bayescal._table import Cells, Header, Table

MAY_BE_EMPTY = "temperature_point"  # empty on a ramp
_LIKELY_UNITS = (
    *("deg", "arcsec", "rad", "deg/s", "rad/s", "g", "mg", "ug", "degC", "degF", "K"),
    *("s", "min", "h", "V", "mV", "Hz", "kHz", "1", "%", "ppm"),
)


@dataclass
class Admitted:
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


def admit(table: Table, instrument: Expects, wishes: Wishes) -> Admitted:
    """Let a file's columns in.

    Args:
        table: the file.
        instrument: whose columns are expected.
        wishes: renamings, units, gravity and scale.

    Returns:
        Columns in the instrument's units, in its order, then what else was kept.

    Raises:
        InputError: a column, a unit or a cell cannot be used; the message names file, row and
            column.
    """
    expected = expected_columns(instrument)
    places = match(table, expected, wishes)
    refuse_missing(table, expected, places, instrument.name)
    result = Admitted()
    kept = _extras(table, expected, places, wishes, result)
    wanted = {places[name]: expected[name].unit is not None for name in expected if name in places}
    cells = table.load({**wanted, **{places[name]: True for name in kept}})
    for name, column in expected.items():
        if name in places:
            header = table.headers[places[name]]
            _Door(table, header, column, wishes, instrument, result).take(cells[places[name]])
        if name not in result.values and column.default is not None:
            kind = object if column.unit is None else np.float64
            result.values[name] = np.full(table.rows, column.default, dtype=kind)
            result.units[name] = column.unit
            result.filled.add(name)
    for name in kept:
        _keep(
            table,
            table.headers[places[name]],
            name,
            kept[name],
            wishes,
            cells[places[name]],
            result,
        )
    return result


def _extras(
    table: Table,
    expected: Mapping[str, Column],
    places: Mapping[str, int],
    wishes: Wishes,
    result: Admitted,
) -> dict[str, str]:
    """Name → unit of columns beyond the instrument's; those without one are flagged."""
    kept: dict[str, str] = {}
    without: list[str] = []
    for name in (n for n in places if n not in expected):
        header = table.headers[places[name]]
        unit = unit_of(header, name, wishes)
        if unit is None:
            without.append(header.raw)
        elif name in TAKEN:
            result.flags.append(
                f"{table.file}: column {header.raw!r} ignored: the name {name!r} is taken"
            )
        else:
            try:
                _units.check_unit(unit)
            except InputError:
                result.flags.append(
                    f"{table.file}: column {header.raw!r} ignored: [{unit}] is no unit known here"
                )
            else:
                kept[name] = unit
    without += [
        f"column {i + 1}, without a name" for i, h in enumerate(table.headers) if not h.name
    ]
    if without:
        result.flags.append(
            f"{table.file}: ignored, because they have no unit: {', '.join(without)} (to keep one, "
            "write 'name [unit]' or give units=)"
        )
    return kept


def _keep(
    table: Table,
    header: Header,
    name: str,
    unit: str,
    wishes: Wishes,
    cells: Cells,
    result: Admitted,
) -> None:
    """An extra column in its base unit, if every cell is a number."""
    base = _units.base_unit(unit)
    values = _units.convert(cells.values, unit, base, local_gravity=wishes.local_gravity)
    wrong = np.flatnonzero(~np.isfinite(values))
    if name == MAY_BE_EMPTY:
        wrong = np.flatnonzero(np.isinf(values))
    if cells.bad or wrong.size:
        index, seen = cells.bad or (int(wrong[0]), _shown(cells.values[wrong[0]]))
        result.flags.append(
            f"{table.file}: column {header.raw!r} ignored: {table.place(index)} {seen}"
            if not cells.bad
            else f"{table.file}: column {header.raw!r} ignored: {table.place(index)} reads {seen!r}"
        )
        return
    result.values[name], result.units[name] = values, base


def _shown(value: float) -> str:
    return "is empty or NaN" if np.isnan(value) else f"reads {value:g}"


@dataclass(frozen=True)
class _Door:
    """One column of the instrument on its way in."""

    table: Table
    header: Header
    column: Column
    wishes: Wishes
    instrument: Expects
    result: Admitted

    def take(self, cells: Cells) -> None:
        """Check and convert the cells, and put them into the result.

        Raises:
            InputError: a cell or the unit cannot be used.
        """
        name = self.column.name
        if self.column.unit is None:
            if not self.column.required and (cells.values == "").all():
                self._absent()
                return
            self.result.values[name] = self._labels(cells.values)
            self.result.units[name] = None
            return
        unit = self._unit()
        if not self.column.required and cells.bad is None and np.isnan(cells.values).all():
            self._absent()
            return
        if cells.bad:
            self._refuse_text(*cells.bad, unit)
        with np.errstate(over="ignore"):
            values = self._convert(cells.values, unit)
        self._refuse_not_finite(cells.values, values, unit)
        self._refuse_implausible(cells.values, values, unit)
        self.result.values[name], self.result.units[name] = values, self.column.unit

    def _absent(self) -> None:
        self.result.flags.append(
            f"{self.table.file}: column {self.header.raw!r} is empty and was left out"
        )

    def _at(self, index: int) -> str:
        return f"{self.table.place(index)} of {self.table.file!r}, column {self.header.raw!r}:"

    def _unit(self) -> str:
        unit = unit_of(self.header, self.column.name, self.wishes)
        where = f"{self.table.file!r}, column {self.header.raw!r}:"
        if unit is None:
            raise InputError(
                f"{where} the header has no unit. Write '{self.header.name} [{self.column.unit}]' "
                f"(or the unit that the numbers are in), or give units={{{self.header.name!r}: …}} "
                f"(--unit {self.header.name}=…)"
            )
        try:
            _units.check_unit(unit)
        except InputError as error:
            raise InputError(f"{where} {error}. Correct the header, or give units=") from error
        if self.header.unit and unit != self.header.unit:
            self.result.flags.append(
                f"{self.table.file}: column {self.header.raw!r} taken as [{unit}], as units= says"
            )
        return unit

    def _labels(self, values: np.ndarray) -> np.ndarray:
        codes, levels = pd.factorize(values)
        for code, label in enumerate(levels):
            index = int(np.argmax(codes == code))
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
        return values

    def _refuse_text(self, index: int, text: str, unit: str) -> None:
        hint = "Correct the cell, or remove the row"
        if re.fullmatch(r"[+-]?\d*,\d+([eE][+-]?\d+)?", text):
            hint = "If that is a decimal comma, export the file with decimal points"
        raise InputError(
            f"{self._at(index)} reads {text[:60]!r}, a number in {_units.pretty(unit)} was "
            f"expected. {hint}"
        )

    def _convert(self, values: np.ndarray, unit: str) -> np.ndarray:
        """Numbers in `unit` in the column's, by the nominal scale if it is a raw output."""
        target, gravity = self.column.unit or "1", self.wishes.local_gravity
        output = output_name(self.instrument)
        difference = self.column.name == "output_uncertainty"
        scale = self.wishes.nominal_scale or self.instrument.nominal_scale
        flag = f"{self.table.file}: column {self.header.raw!r}"
        if _units.same_dimension(unit, target):
            if _units.needs_gravity(unit, target):
                self.result.flags.append(f"{flag} turned into local g by {gravity:g} m/s²")
            return _units.convert(
                values, unit, target, local_gravity=gravity, difference=difference
            )
        raw_output = self.column.name == output or difference
        if raw_output and scale is not None and _units.same_dimension(unit, scale.unit):
            shifted = scale.offset and not difference
            reading = f"(reading − {scale.offset:g})" if shifted else "reading"
            self.result.flags.append(
                f"{flag} turned into {_units.pretty(target)} by the nominal scale: "
                f"{reading}/{scale.gain:g}, reading in {_units.pretty(scale.unit)}"
            )
            raw = _units.convert(
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

    def _refuse_not_finite(self, raw: np.ndarray, values: np.ndarray, unit: str) -> None:
        wrong = np.isinf(values) if self.column.name == MAY_BE_EMPTY else ~np.isfinite(values)
        if wrong.any():
            index = int(np.argmax(wrong))
            seen = _shown(raw[index]) + (", too large" if np.isfinite(raw[index]) else "")
            raise InputError(
                f"{self._at(index)} {seen}, a number in {_units.pretty(unit)} was expected. "
                "Fill it in, or remove the row"
            )

    def _refuse_implausible(self, raw: np.ndarray, values: np.ndarray, unit: str) -> None:
        low = -np.inf if self.column.low is None else self.column.low
        high = np.inf if self.column.high is None else self.column.high
        wrong = (values < low) | (values > high)
        if not wrong.any():
            return
        index, shown = int(np.argmax(wrong)), _units.pretty(self.column.unit or "1")
        limits = f"at least {low:g}" if high == np.inf else f"at most {high:g}"
        limits = f"{low:g} … {high:g}" if low > -np.inf and high < np.inf else limits
        same = _units.pretty(unit) == shown
        internal = "" if same else f", that is {values[index]:.6g} {shown}"
        better = [u for u in _LIKELY_UNITS if u != unit and self._plausible_in(u, raw, low, high)]
        hint = (
            f"Are the numbers in {better[0]}? Then write '{self.header.name} [{better[0]}]'"
            if better
            else "Check the unit and the number"
        )
        raise InputError(
            f"{self._at(index)} reads {raw[index]:.6g} {_units.pretty(unit)}{internal}; "
            f"plausible is {limits} {shown}. {hint}"
        )

    def _plausible_in(self, unit: str, raw: np.ndarray, low: float, high: float) -> bool:
        target = self.column.unit or "1"
        if not _units.same_dimension(unit, target):
            return False
        values = _units.convert(raw, unit, target, local_gravity=self.wishes.local_gravity)
        return bool(np.all(np.isnan(values) | ((values >= low) & (values <= high))))
