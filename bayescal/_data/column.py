"""Columns and nominal scale of an instrument; sources of readings; overload codes and placeholders."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bayescal._core.errors import InputError
from bayescal._data.unit_conversion import ANY
from bayescal._tables.raw_table import ROW, Table

MIN_PLACEHOLDER_RANGES = 3.0  # from a placeholder such as −999 to the other values, in their ranges

UNCERTAINTY = "output_uncertainty"  # known standard uncertainty of each reading
SOAK_POINT = "temperature_point"  # soak temperature; empty on ramps
# 1 for readings converted with an assumed local gravity, 0 for others.
ASSUMED_GRAVITY = "assumed_gravity"
ARRAYS = "the given arrays"  # source of readings that are not from files
RESERVED_NAMES = (ROW, "cell")  # names of groupings: each reading, and run × temperature point


@dataclass(frozen=True)
class Column:
    """Column that an instrument declares for its files.

    Attributes:
        name: bayescal's name; a file may use another one (`columns=`).
        unit: fixed unit in bayescal; None for a text label (run, device, axis, group, direction); "any" for a channel
            of any quantity, stored in its fixed unit (µg, °/s, rad, °C; ppm, ppb, % unchanged; else base units).
        meaning: description in one line.
        required: whether a file without the column is refused.
        default: value, in `unit`, of every reading if the file lacks the column; None omits the column.
        low, high: smallest and largest plausible value, in `unit`; a file with other values is refused.
        allowed: the valid labels; if empty, all labels are valid.
        also: further names that files may use for the column.
    """

    name: str
    unit: str | None
    meaning: str = ""
    required: bool = True
    default: float | str | None = None
    low: float | None = None
    high: float | None = None
    allowed: tuple[str, ...] = ()
    also: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise InputError for contradictory attributes."""
        if not self.name.strip() or self.name in RESERVED_NAMES:
            raise InputError(f"a column cannot be called {self.name!r}: choose another name")
        low, high = self.low, self.high
        if low is not None and high is not None and not low < high:
            raise InputError(f"column {self.name!r}: low {low} is not below high {high}")
        if self.unit == ANY and self.default is not None:
            default = f"its default {self.default!r} has no unit: omit it"
            raise InputError(f"column {self.name!r} may be in any unit, but {default}")

    @property
    def example(self) -> str | None:
        """Return an example of a unit of the column, for messages."""
        return "m/s^2" if self.unit == ANY else self.unit


@dataclass(frozen=True)
class NominalScale:
    """Conversion of a raw output (V, Hz) to the instrument's output: (raw − offset)/gain.

    Attributes:
        unit: unit of the raw output and of `offset`.
        gain: raw units per output unit, such as V per °/s.
        offset: raw output at zero input.
        by_gravity: whether the gain was stated per m/s² and converted by the local gravity.
    """

    unit: str
    gain: float
    offset: float = 0.0
    by_gravity: bool = False

    def __post_init__(self) -> None:
        """Raise InputError for a gain of zero, or numbers that are not finite."""
        if not (math.isfinite(self.gain) and self.gain != 0 and math.isfinite(self.offset)):
            raise InputError(
                f"nominal scale {self.gain:g} {self.unit} with offset {self.offset:g}: the gain "
                "must be finite and not zero, the offset finite"
            )

    def apply(self, raw: ArrayLike, *, difference: bool = False) -> np.ndarray:
        """Convert raw outputs in `unit` to outputs; `difference`: values are uncertainties, without offset and sign."""
        raw = np.asarray(raw, dtype=np.float64)
        return raw / abs(self.gain) if difference else (raw - self.offset) / self.gain


@dataclass(frozen=True)
class Source:
    """Source file of readings: its name, SHA-256, number of rows, and the user's options for its columns.

    Attributes:
        output: header of the column that was read as the output, if the user chose it; else empty.
        columns: bayescal's name → the file's header, of columns assigned by the user.
        units: header → unit, of columns whose unit the user gave.
    """

    file: str
    sha256: str
    rows: int
    output: str = ""
    columns: dict[str, str] = field(default_factory=dict, hash=False)
    units: dict[str, str] = field(default_factory=dict, hash=False)


class Place(NamedTuple):
    """Row label of a reading, such as "row 12", and its file."""

    row: str
    file: str

    def __str__(self) -> str:
        return f"{self.row} of {self.file!r}"


@dataclass
class ConvertedColumns:
    """Columns of one file, or of several files concatenated, under bayescal's names and in fixed units.

    Attributes:
        tables: the files, restricted to the kept rows.
        values, units: name → one entry per reading; name → unit, None for labels.
        flags: warnings about the readings, in words.
        missing: name → indices of its missing readings.
        origin: seconds since 1970 at time zero; None if the times are not dates.
        kept_rows: indices of the kept rows of the file; None for all.
        other_channels: names of columns that are other output channels of the same device.
        by_gravity: names of columns converted by the local gravity.
    """

    tables: tuple[Table, ...] = ()
    values: dict[str, np.ndarray] = field(default_factory=dict)
    units: dict[str, str | None] = field(default_factory=dict)
    flags: list[str] = field(default_factory=list)
    missing: dict[str, np.ndarray] = field(default_factory=dict)
    origin: float | None = None
    kept_rows: np.ndarray | None = None
    other_channels: set[str] = field(default_factory=set)
    by_gravity: set[str] = field(default_factory=set)

    def fill(self, name: str, value: float | str, unit: str | None) -> None:
        """Add a column with the same value for every reading."""
        kind, rows = object if unit is None else np.float64, sum(t.rows for t in self.tables)
        self.values[name] = np.full(rows, value, dtype=kind)
        self.units[name] = unit

    def locate(self, index: int) -> Place:
        """Return the file and row of a reading, given its index in the concatenated files."""
        for table in self.tables:
            if index < table.rows:
                break
            index -= table.rows
        return Place(table.place(index), table.file)

    @property
    def thermometers(self) -> list[str]:
        """Return the names of the measured temperature columns, °C."""
        return [n for n, unit in self.units.items() if unit == "degC" and n != SOAK_POINT]


def format_files(files: Sequence[str]) -> str:
    """Format file names for messages: the first, and the number of others."""
    if not files:
        return ARRAYS
    return files[0] if len(files) == 1 else f"{files[0]} and {len(files) - 1} more"


_PLACEHOLDER_SIZES = (999.0, 9999.0, 99999.0, 999.25, 9999.25, 999.9, 9999.9)  # of loggers
PLACEHOLDERS = (*(-size for size in _PLACEHOLDER_SIZES), *_PLACEHOLDER_SIZES)
# Codes of SCPI instruments (SCPI-1999, volume 1, 7.2.1.4 and 7.2.1.5).
OVERLOAD_CODE, NO_NUMBER_CODE = 9.9e37, 9.91e37


def find_overloads(values: np.ndarray) -> np.ndarray:
    """Return the indices of values that are an SCPI code for an overload (±9.9E37) or no reading (9.91E37)."""
    is_overload = np.isclose(abs(values), OVERLOAD_CODE, rtol=1e-6)
    return np.flatnonzero(is_overload | np.isclose(values, NO_NUMBER_CODE, rtol=1e-6))


def find_placeholders(values: np.ndarray) -> np.ndarray:
    """Return the indices of values that are a placeholder for a missing reading, such as −999, far from all others."""
    is_placeholder = np.zeros(len(values), dtype=bool)
    for value in np.intersect1d(values[np.isin(values, PLACEHOLDERS)], PLACEHOLDERS):
        is_equal = values == value
        numbers = values[~is_equal & np.isfinite(values)]
        if len(numbers) < max(3, len(values) / 2):  # too few to tell a placeholder from readings
            continue
        low, high = float(numbers.min()), float(numbers.max())
        if max(low - value, value - high) > MIN_PLACEHOLDER_RANGES * (high - low):
            is_placeholder |= is_equal
    return np.flatnonzero(is_placeholder)
