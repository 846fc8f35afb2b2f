"""Readings: checked columns in fixed units, with the groups that they fall into."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from bayescal._core.errors import InputError
from bayescal._core.formatting import Printed, number, table
from bayescal._data.averaging import average
from bayescal._data.column import (
    ARRAYS,
    MAY_BE_EMPTY,
    ConvertedColumns,
    NominalScale,
    Source,
    file_names,
)
from bayescal._data.column_conversion import convert_columns
from bayescal._data.dataset_checks import (
    flags_of,
    problems_of_whole,
    repeated_rows,
)
from bayescal._data.header_matching import InstrumentLike, ReadOptions, output_name, unused_options
from bayescal._data.pose_rows import MAGNITUDE, MAGNITUDE_READ, scalar_readings
from bayescal._data.unit_conversion import ANY, STANDARD_GRAVITY, parse
from bayescal._tables.cells import date_text, equally_long
from bayescal._tables.raw_table import ROW, Problems, Table
from bayescal._tables.write import write

SINCE = "since"  # attribute of the time: seconds since 1970 at its zero, where the file has dates
SHOWN = 5  # labels of a column that are named
CAUSE = "cause"  # attribute of a column: 0 where nothing is taken to depend on it


@dataclass(frozen=True, eq=False, repr=False)
class Measurements(Printed):
    """Readings of an instrument, in its fixed units and in the order in which they came.

    Made by `read` or `from_arrays`, which check them. The arrays are read-only.

    Attributes:
        data: one dimension, `reading`; numbers are float64 with the attribute `units`, labels are
            text.
        sources: the files they came from.
        flags: what was odd but no reason to refuse them, a sentence each.
        output: name of the output column.
        scale: how a raw output is turned into the instrument's, where the user said so.
    """

    data: xr.Dataset
    sources: tuple[Source, ...] = ()
    flags: tuple[str, ...] = ()
    output: str = "output"
    scale: NominalScale | None = None

    def __post_init__(self) -> None:
        """Make the arrays read-only.

        Raises:
            InputError: the data set has another dimension than `reading`.
        """
        if set(self.data.sizes) != {ROW}:
            raise InputError(
                f"measurements have the one dimension {ROW!r}, these have "
                f"{', '.join(map(str, self.data.sizes))}"
            )
        # the arrays of `Dataset.items`, made one by one, take a time that grows by the square
        for name in self.data.data_vars:
            self.data.variables[name].values.flags.writeable = False

    @classmethod
    def from_arrays(
        cls,
        instrument: InstrumentLike,
        /,
        *,
        units: Mapping[str, str] | None = None,
        local_gravity: float = STANDARD_GRAVITY,
        nominal_scale: NominalScale | str | None = None,
        nominal_zero: str | None = None,
        allow_one_temperature: bool = False,
        missing: str = "refuse",
        **columns: ArrayLike,
    ) -> Measurements:
        """Readings from arrays, checked as `read` checks a file.

        Args:
            instrument: whose columns these are.
            units: unit of a column that is not in the instrument's own (or has none: "any"), and of
                further columns to keep.
            local_gravity: m/s², for columns in m/s².
            nominal_scale, nominal_zero: in place of the instrument's, as of `read`.
            allow_one_temperature: accept one temperature, as for a prediction.
            missing: "refuse" readings that are NaN, or "drop" them.
            **columns: one entry per reading, or one for all; in the instrument's units unless
                `units` says otherwise, or a name like a file's header, `humidity [%]`.

        Raises:
            InputError: what `read` refuses, and columns of unequal length.
        """
        own = {
            name: None if c.unit == ANY else c.unit
            for c in instrument.columns
            for name in (c.name, *c.also)
        }
        own.setdefault("output_uncertainty", own.get(output_name(instrument)))
        table = Table.of_columns(ARRAYS, equally_long(columns), own)
        options = ReadOptions.of(
            instrument,
            units=units or {},
            local_gravity=local_gravity,
            nominal_scale=nominal_scale,
            nominal_zero=nominal_zero,
            missing=missing,
        )
        problems = Problems()
        unused_options([table], options, problems)
        converted = convert_columns(table, instrument, options, problems)
        problems += problems_of_whole(converted, instrument, allow_one_temperature)
        problems.refuse()
        return assemble(converted, instrument, scale=options.nominal_scale)

    def __getitem__(self, name: str) -> np.ndarray:
        """A column, in its fixed unit; labels as text.

        Raises:
            InputError: there is none of that name.
        """
        if name not in self.data.data_vars:
            raise InputError(
                f"{self.file} has no column {name!r}; it has: {', '.join(self.columns)}"
            )
        return self.data[name].values

    def __len__(self) -> int:
        return self.data.sizes[ROW]

    def __contains__(self, name: object) -> bool:
        return name in self.data.data_vars

    def __reduce__(self) -> Any:
        return Measurements, (self.data, self.sources, self.flags, self.output, self.scale)

    def __str__(self) -> str:
        rows = []
        for name in self.columns:
            values, unit = self[name], self.unit(name)
            if unit is None:
                labels = list(dict.fromkeys(values.tolist()))
                more = " …" * (len(labels) > SHOWN)
                said = f"{len(labels)} labels: {', '.join(labels[:SHOWN])}{more}"
            elif np.isnan(values).all():
                said = "empty"
            else:
                said = f"{number(np.nanmin(values), 5)} to {number(np.nanmax(values), 5)}"
            rows.append([name, unit or "", said])
        shown = table(["column", "unit", "range"], rows, left=3)
        return f"{len(self)} readings of {self.file}\n{shown}"

    def _brief(self) -> str:
        named = (f"{n} [{self.unit(n)}]" if self.unit(n) else n for n in self.columns)
        return f"{len(self)} readings of {self.file}: {', '.join(named)}"

    def to_pandas(self) -> pd.DataFrame:
        """The readings as a `pandas.DataFrame`, columns in their fixed units."""
        return self.data.to_dataframe()

    def to_xarray(self) -> xr.Dataset:
        """The readings as an `xarray.Dataset`; each column of numbers says its `units`."""
        return self.data.copy(deep=True)

    def has(self, name: str) -> bool:
        """Whether there is a column of that name."""
        return name in self

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(map(str, self.data.data_vars))

    @property
    def file(self) -> str:
        """Where the readings came from, short, for messages."""
        return file_names([source.file for source in self.sources])

    def unit(self, name: str) -> str | None:
        """A column's fixed unit; None for labels.

        Raises:
            InputError: there is no column of that name.
        """
        self[name]
        return self.data[name].attrs.get("units")

    @property
    def no_causes(self) -> frozenset[str]:
        """Names of columns that nothing is taken to depend on: other channels, and what the user leaves out."""
        held = self.data.variables  # as in `__post_init__`
        return frozenset(n for n in self.columns if not held[n].attrs.get(CAUSE, 1))

    def without_causes(self, names: Collection[str], others: bool = True) -> Measurements:
        """The same readings, in which nothing is taken to depend on these columns; others as before, or all may be.

        Raises:
            InputError: there is no such column.
        """
        for name in names:
            self[name]
        gone = {*names, *(self.no_causes if others else ())}
        if gone == self.no_causes:
            return self
        data = self.data.copy()
        for name in data.data_vars:
            plain = {k: v for k, v in data[name].attrs.items() if k != CAUSE}
            data[name].attrs = {**plain, **({CAUSE: 0} if name in gone else {})}
        return replace(self, data=data)

    @property
    def since(self) -> float | None:
        """Seconds since 1970 at time zero; None where the time counts from no date."""
        return self.data["time"].attrs.get(SINCE) if self.has("time") else None

    def add_to(self, digest: Any) -> None:
        """Add names, units and values of all columns to a digest of `hashlib`."""
        for name in sorted(self.columns):
            column = self[name]
            digest.update(f"{name} [{self.unit(name)}] {len(column)}\n".encode())
            digest.update(
                np.ascontiguousarray(column).tobytes()
                if column.dtype.kind == "f"
                else json.dumps(column.tolist()).encode()
            )

    def followed_by(self, later: Measurements) -> Measurements:
        """These readings and then later ones, of the columns that both have; unchecked."""
        names = [n for n in self.columns if later.has(n) and self.unit(n) == later.unit(n)]
        joined = {n: _variable(np.concatenate([self[n], later[n]]), self.unit(n)) for n in names}
        return replace(self, data=xr.Dataset(joined))

    def groups(self, name: str) -> tuple[tuple[str, ...], np.ndarray]:
        """The members of a grouping, in order of appearance, and each reading's index among them.

        Args:
            name: "run", "device", "axis" (a single "1" where there is no such column), another
                column of labels, "reading" (each its own member), or "cell": run × temperature
                point, −1 for readings without one.

        Raises:
            InputError: there is no such grouping.
        """
        if name == "reading":
            return tuple(str(i + 1) for i in range(len(self))), np.arange(len(self))
        if name == "cell":
            return self._cells()
        if not self.has(name) and name in ("run", "device", "axis"):
            return ("1",), np.zeros(len(self), dtype=np.int64)
        if self.unit(name) is not None:
            raise InputError(
                f"{self.file}: column {name!r} holds numbers and makes no groups; use labels"
            )
        codes, levels = pd.factorize(self[name].astype(object))
        return tuple(map(str, levels)), codes

    def _cells(self) -> tuple[tuple[str, ...], np.ndarray]:
        if not self.has(MAY_BE_EMPTY):
            return (), np.full(len(self), -1, dtype=np.int64)
        runs, run = self.groups("run")
        frame = pd.DataFrame({"run": run, "point": self[MAY_BE_EMPTY]})
        codes = frame.groupby(["run", "point"], sort=False).ngroup().fillna(-1).astype(np.int64)
        pairs = frame.dropna().drop_duplicates().itertuples(index=False)
        return tuple(f"run {runs[r]}, {p:.10g} °C" for r, p in pairs), codes.to_numpy()

    def select(self, chosen: ArrayLike) -> Measurements:
        """Some of the readings, by a mask or by indices.

        Raises:
            InputError: a mask of another length, or nothing chosen.
        """
        index = np.asarray(chosen)
        if index.dtype == bool and index.shape != (len(self),):
            raise InputError(
                f"a mask of shape {index.shape} cannot choose among the {len(self)} readings of "
                f"{self.file}: give one entry per reading"
            )
        index = np.flatnonzero(index) if index.dtype == bool else index
        if not index.size:
            raise InputError(f"no reading of {self.file} was chosen: choose at least one")
        return replace(self, data=self.data.isel({ROW: index}))

    def with_column(self, name: str, values: ArrayLike, unit: str | None = None) -> Measurements:
        """The same readings with one column replaced or added, one value a reading; unchecked.

        Args:
            unit: of a new column of numbers; a column that is there keeps its own.

        Raises:
            InputError: an unknown unit.
        """
        unit = self.unit(name) if self.has(name) else unit
        return replace(self, data=self.data.assign({name: _variable(np.array(values), unit)}))

    def average(self, step: str | float) -> Measurements:
        """Means over times that follow each other, of readings whose labels and settings agree.

        Each mean keeps the noise it has: `noise.white` of a fit is that of the mean of most readings, the column
        `output_uncertainty` holds what a mean of fewer has beside it, and a flag says what a single reading scatters
        by. Correlated noise slower than `step` stays as it is. Lost is what happens within `step`: rates, lags and
        vibration that fast, and spikes, which a mean hides: set them aside first.

        Args:
            step: such as "1 s", "0.5 s" or "2 min"; a number is in s.

        Raises:
            InputError: no such time, no column `time`, or no two readings in any of these times.
        """
        columns, units = {n: self[n] for n in self.columns}, {n: self.unit(n) for n in self.columns}
        made = average(columns, units, self.output, step, self.file)
        means = {name: _variable(values, made.units[name]) for name, values in made.columns.items()}
        means["time"].attrs.update({SINCE: s} if (s := self.since) is not None else {})
        found = replace(self, data=xr.Dataset(means), flags=(*self.flags, made.flag))
        return found.without_causes(self.no_causes)

    def write(self, path: str | Path) -> Path:
        """Write the readings to .csv, .parquet or .nc, as `read` reads them.

        Raises:
            InputError: another suffix, or a place that cannot be written to.
        """
        return write(self.data, path)


def assemble(
    converted: ConvertedColumns,
    instrument: InstrumentLike,
    sources: tuple[Source, ...] = (),
    scale: NominalScale | None = None,
) -> Measurements:
    """Measurements of checked columns, of one file or of several one after the other."""
    names, output = file_names([source.file for source in sources]), output_name(instrument)
    since, units = converted.origin, converted.units
    if since is not None:
        began = f"{names}: time is in s since {date_text(since)}, the first reading"
        converted.flags.append(began)
    repeated = repeated_rows(converted.values)
    flags = [*converted.flags, *flags_of(converted, output, names, repeated)]
    values = converted.values
    # with the time among the columns, none can be a reading of its own
    if "time" in values and len(repeated):
        values = {n: np.delete(v, repeated) for n, v in values.items()}
    if outputs := getattr(instrument, "outputs", ()):
        sized = [c.meaning for c in instrument.columns if c.name == MAGNITUDE]
        values, units = scalar_readings(outputs, values, units, names, bool(sized))
        if MAGNITUDE_READ in values.keys() - converted.values.keys():
            read = f"{values[MAGNITUDE_READ][0]:.4g} {units[MAGNITUDE_READ]}"
            flags.append(
                f"{names}: the magnitude {sized[0]} is not given (--local-field, or a column {MAGNITUDE!r}): it is "
                f"taken as the outputs read it, {read}, and ratios of scale factors are measured"
            )
    variables = {n: _variable(v, units[n]) for n, v in values.items()}
    if since is not None:
        variables["time"].attrs[SINCE] = since
    made = Measurements(xr.Dataset(variables), sources, tuple(flags), output, scale)
    return made.without_causes(converted.beside & variables.keys())


def of_columns(values: Mapping[str, np.ndarray], units: Mapping[str, str | None]) -> Measurements:
    """Measurements of columns by name, in their fixed units, as they are; unchecked."""
    return Measurements(xr.Dataset({n: _variable(v, units[n]) for n, v in values.items()}))


def _variable(values: np.ndarray, unit: str | None) -> xr.Variable:
    if unit is None:
        return xr.Variable(ROW, values.astype(str))
    parse(unit)
    return xr.Variable(ROW, values.astype(np.float64, copy=False), {"units": unit})
