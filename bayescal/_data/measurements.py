"""Measurements: checked columns in fixed units, with the groups of their readings."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from bayescal._core.annex import load_entry
from bayescal._core.errors import InputError
from bayescal._core.formatting import number
from bayescal._core.netcdf import Variable
from bayescal._core.renamed import renamed
from bayescal._core.result_table import Printed, ResultTable, make_table
from bayescal._data import averaging
from bayescal._data import dataset_checks as checks
from bayescal._data.column import (
    ARRAYS,
    SOAK_POINT,
    UNCERTAINTY,
    ConvertedColumns,
    NominalScale,
    Source,
    format_files,
)
from bayescal._data.column_conversion import convert_columns, join_files
from bayescal._data.read_options import InstrumentLike, ReadOptions, check_options, output_name
from bayescal._data.records import PAUSE_STEPS, Records, distinct, label_codes, median_step
from bayescal._data.unit_conversion import ANY, parse, unit_label
from bayescal._tables.cells import broadcast_columns, format_date
from bayescal._tables.csv_file import write
from bayescal._tables.raw_table import ROW, Objections, Table, option

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

SINCE = "since"  # attribute of `time`: seconds since 1970 at time zero, for files with dates
# Alternations between two records per reading, above which they are simultaneous and neither continues the other.
MAX_INTERLEAVED_SHARE = 0.2
MAX_SHOWN_LABELS = 5  # labels of a column that are printed
CAUSE = "cause"  # attribute of a column: 0 if it is excluded as a covariate


@renamed(oddities="anomalies", on_clock="align_clock")
@renamed(followed_by="concatenate", continued_in="find_continuations")
@dataclass(frozen=True, eq=False, repr=False)
class Measurements(Printed):
    """Readings of an instrument, in its fixed units and in the order of the file.

    Created by `read` or `from_arrays`, which check them. The arrays are read-only.

    Attributes:
        values: column name → one entry per reading; float64 numbers, or labels as text.
        units: name → the column's fixed unit; None for labels.
        sources: the files that were read.
        flags: warnings about accepted readings, one sentence each.
        output: name of the output column.
        scale: nominal scale from a raw output to the instrument's, if the user gave one.
        no_causes: columns excluded as covariates: other channels, and those that the user excludes.
        since: seconds since 1970 at time zero; None if the times are not dates.
    """

    values: Mapping[str, np.ndarray]
    units: Mapping[str, str | None]
    sources: tuple[Source, ...] = ()
    flags: tuple[str, ...] = ()
    output: str = "output"
    scale: NominalScale | None = None
    no_causes: frozenset[str] = frozenset()
    since: float | None = None

    def __post_init__(self) -> None:
        """Make the arrays read-only; raise InputError for an unknown unit, or columns of unequal shapes."""
        columns = {n: _freeze_column(values, self.units[n]) for n, values in self.values.items()}
        if {v.ndim for v in columns.values()} != {1} or len({*map(len, columns.values())}) > 1:
            shapes = ", ".join(f"{name} {v.shape}" for name, v in columns.items()) or "none"
            raise InputError(
                f"the columns of measurements must be vectors of equal length, these have the shapes: {shapes}"
            )
        object.__setattr__(self, "values", columns)
        object.__setattr__(self, "units", {name: self.units[name] for name in columns})

    @classmethod
    def from_variables(cls, variables: Mapping[str, Any], **other_fields: Any) -> Measurements:
        """Create measurements from NetCDF variables unchecked; `other_fields`: further ones, such as `sources`."""
        excluded = (name for name, v in variables.items() if not v.attrs.get(CAUSE, 1))
        return cls(
            {name: variable.values for name, variable in variables.items()},
            {name: variable.attrs.get("units") for name, variable in variables.items()},
            no_causes=frozenset(excluded),
            since=variables["time"].attrs.get(SINCE) if "time" in variables else None,
            **other_fields,
        )

    @classmethod
    def from_arrays(
        cls,
        instrument: InstrumentLike,
        arrays: Any = None,
        /,
        *,
        units: Mapping[str, str] | None = None,
        local_gravity: float | None = None,
        allow_one_temperature: bool = False,
        missing: str = "refuse",
        **columns: ArrayLike,
    ) -> Measurements:
        """Create measurements from arrays, checked as `read` checks a file.

        Args:
            instrument: the instrument that declares the columns.
            arrays: columns as a mapping ("humidity [%]"), or a data frame of pandas, polars or xarray, with its
                coordinates and a named index.
            units: column → unit, if it is not the instrument's, and for further columns to keep.
            local_gravity: m/s², as in `read`.
            allow_one_temperature: accept readings at a single temperature, as for a prediction.
            missing: "refuse" readings that are NaN, or "drop" them.
            **columns: one entry per reading, or one for all; in the instrument's units unless `units`, a pint or
                astropy quantity, an xarray attribute `units`, or a name such as `humidity [%]` gives another unit.

        Raises:
            InputError: the columns have unequal lengths, or fail a check of `read`.
        """
        named_units = ((name, c.unit) for c in instrument.columns for name in (c.name, *c.also))
        default_units = {name: None if unit == ANY else unit for name, unit in named_units}
        default_units.setdefault(UNCERTAINTY, default_units.get(output_name(instrument)))
        vectors, array_units = _extract_columns({} if arrays is None else arrays, columns)
        table = Table.from_columns(ARRAYS, broadcast_columns(vectors), default_units | array_units)
        options = ReadOptions(units=units or {}, local_gravity=local_gravity, missing=missing)
        return measure_tables([table], instrument, options, allow_one_temperature)

    @cached_property
    def records(self) -> Records:
        """Return the time records: one per run of each device and axis."""
        return Records.of(self.values)

    @cached_property
    def rates(self) -> dict[str, np.ndarray]:
        """Return the slope of each temperature column over the preceding minute (n,), °C/s; {} without times."""
        thermometers = [n for n, unit in self.units.items() if unit == "degC" and n != SOAK_POINT]
        return {n: self.records.slope(self[n]) for n in thermometers} if self.has("time") else {}

    @cached_property
    def anomalies(self) -> tuple[checks.Anomaly, ...]:
        """Return the anomalies of the temperature columns: error values, repeated values, stuck readings."""
        thermometers = [n for n in self.columns if self.unit(n) == "degC"]
        return tuple(checks.find_anomalies(self.values, self.records, thermometers, self.output))

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a column in its fixed unit, or labels as text; raise InputError for an unknown name."""
        if name not in self.values:
            raise InputError(
                f"{self.file} has no column {name!r}; it has: {', '.join(self.columns)}"
            )
        return self.values[name]

    def __len__(self) -> int:
        return len(next(iter(self.values.values())))

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def __reduce__(self) -> Any:  # calls `__post_init__`, since unpickled arrays are writable
        return Measurements, tuple(getattr(self, f.name) for f in fields(self))

    def _list_parts(self) -> list[str | ResultTable]:
        rows = []
        for name in self.columns:
            values, unit = self[name], self.unit(name)
            if unit is None:
                labels = list(dict.fromkeys(values.tolist()))
                ellipsis = " …" * (len(labels) > MAX_SHOWN_LABELS)
                text = f"{len(labels)} labels: {', '.join(labels[:MAX_SHOWN_LABELS])}{ellipsis}"
            elif np.isnan(values).all():
                text = "empty"
            else:
                text = f"{number(np.nanmin(values), 5)} to {number(np.nanmax(values), 5)}"
            rows.append([name, unit or "", text])
        table = make_table(["column", "unit", "range"], rows, left=3)
        return [f"{len(self)} readings of {self.file}", table]

    def _format_summary(self) -> str:
        columns = (f"{n} [{self.unit(n)}]" if self.unit(n) else n for n in self.columns)
        return f"{len(self)} readings of {self.file}: {', '.join(columns)}"

    def to_pandas(self) -> pd.DataFrame:
        """Return the readings as a `pandas.DataFrame`, columns in their fixed units."""
        return self.to_xarray().to_dataframe()

    def to_xarray(self) -> xr.Dataset:
        """Return the readings as an `xarray.Dataset`; each column of numbers has the attribute `units`."""
        import xarray as xr  # takes half a second, hence not imported by `read`

        return xr.Dataset(
            {n: (v.dims, v.values.copy(), v.attrs) for n, v in self.variables().items()}
        )

    def variables(self) -> dict[str, Variable]:
        """Return the columns and their attributes as variables of a NetCDF file, by name."""
        variables = {}
        for name, values in self.values.items():
            unit = self.units[name]
            attributes = {} if unit is None else {"units": unit}
            attributes |= {CAUSE: 0} if name in self.no_causes else {}
            attributes |= {SINCE: self.since} if name == "time" and self.since is not None else {}
            variables[name] = Variable((ROW,), values, attributes)
        return variables

    def has(self, name: str) -> bool:
        """Return whether a column of this name exists."""
        return name in self

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(self.values)

    @property
    def file(self) -> str:
        """Return the abbreviated names of the source files, for messages."""
        return format_files([source.file for source in self.sources])

    def unit(self, name: str) -> str | None:
        """Return a column's fixed unit, None for labels; raise InputError for an unknown name."""
        self[name]
        return self.units[name]

    @renamed(others="keep_excluded")
    def without_causes(self, names: Collection[str], keep_excluded: bool = True) -> Measurements:
        """Exclude existing columns as covariates; if not `keep_excluded`, allow all other columns again."""
        for name in names:
            self[name]
        no_causes = self.no_causes if keep_excluded else frozenset()
        return replace(self, no_causes=no_causes.union(names))

    def add_to(self, digest: Any) -> None:
        """Update a `hashlib` digest with the names, units and values of all columns."""
        for name in sorted(self.columns):
            column = self[name]
            digest.update(f"{name} [{self.unit(name)}] {len(column)}\n".encode())
            is_text = column.dtype.kind != "f"
            digest.update(json.dumps(column.tolist()).encode() if is_text else column.tobytes())

    def same_as(self, other: Measurements) -> bool:
        """Return whether the columns and all their entries are equal to those of other measurements."""
        return self.values.keys() == other.values.keys() and all(
            np.array_equal(self[name], other[name], equal_nan=unit is not None)
            for name, unit in self.units.items()
        )

    def concatenate(self, later: Measurements) -> Measurements:
        """Append later readings without validation; keep only the columns that both have in the same unit."""
        names = [n for n in self.columns if later.has(n) and self.unit(n) == later.unit(n)]
        values = {n: np.concatenate([self[n], later[n]]) for n in names}
        return replace(self, values=values, no_causes=frozenset())

    def groups(self, name: str) -> tuple[tuple[str, ...], np.ndarray]:
        """Return the members of a grouping, in order of appearance, and each reading's index among them (n,).

        Args:
            name: "run", "device", "axis" (one member "1" if the column is absent), another label column, "reading"
                (each reading a member), or "cell" (run × temperature point; −1 for readings without a temperature
                point). Raises InputError for any other column.
        """
        if name == "reading":
            return tuple(str(i + 1) for i in range(len(self))), np.arange(len(self))
        if name == "cell" and not self.has(SOAK_POINT):
            return (), np.full(len(self), -1, dtype=np.int64)
        if name == "cell":
            runs, run = self.groups("run")
            point, codes = self[SOAK_POINT], np.full(len(self), -1, dtype=np.int64)
            has_point = ~np.isnan(point)
            pairs, codes[has_point] = distinct([run[has_point], point[has_point]])
            return tuple(f"run {runs[r]}, {p:.10g} °C" for r, p in pairs), codes
        if not self.has(name) and name in ("run", "device", "axis"):
            return ("1",), np.zeros(len(self), dtype=np.int64)
        if self.unit(name) is not None:
            raise InputError(
                f"{self.file}: column {name!r} contains numbers and cannot define groups; use labels"
            )
        levels, codes = distinct([self[name]])
        return tuple(label for (label,) in levels), codes

    def select(self, selection: ArrayLike) -> Measurements:
        """Select readings by a mask or indices; raise InputError for a mask of wrong length or an empty selection."""
        index = np.asarray(selection)
        if index.dtype == bool and index.shape != (len(self),):
            raise InputError(
                f"a mask of shape {index.shape} does not fit the {len(self)} readings of "
                f"{self.file}: give one entry per reading"
            )
        index = np.flatnonzero(index) if index.dtype == bool else index
        if not index.size:
            raise InputError(f"no reading of {self.file} was selected: select at least one")
        return replace(self, values={name: values[index] for name, values in self.values.items()})

    def with_column(self, name: str, values: ArrayLike, unit: str | None = None) -> Measurements:
        """Replace a column, or add one in `unit`, by unchecked values (n,); raise InputError for an unknown unit."""
        unit = self.unit(name) if self.has(name) else unit
        return replace(
            self,
            values={**self.values, name: np.array(values)},
            units={**self.units, name: unit},
            no_causes=self.no_causes - {name},
            since=None if name == "time" else self.since,
        )

    def align_clock(self, epoch: float | None, changing: Callable[[], str]) -> Measurements:
        """Return the readings with times relative to a calibration's `epoch`, s since 1970 (None: it has no dates).

        If neither has dates, the times are unchanged: a column `time` has one origin for all runs. `changing` returns
        the names of the effects that depend on the date, for the message, or "".

        Raises:
            InputError: only the readings or only the calibration has dates, and an effect depends on the date.
        """
        if not self.has("time") or self.since == epoch:
            return self
        if self.since is not None and epoch is not None:
            time = np.round(self["time"] + (self.since - epoch), 6)
            return replace(self.with_column("time", time), since=epoch)
        if not (names := changing()):
            return self
        clock_text = "has no dates" if epoch is None else f"counts time from {format_date(epoch)}"
        example = "9 days" if epoch is None else "2026-05-13 10:14:20"
        file = self.sources[0].file if len(self.sources) == 1 else "FILE"
        raise InputError(
            f"{self.file}: its times have {'no ' * (epoch is not None)}dates, the calibration {clock_text}; "
            f"{names} depends on the date. Give the time of its first reading"
            f"{' on the clock of the calibration' * (epoch is None)}: "
            f"{option('--begin', f'{file}={example}')} (in Python, read(…, begin={example!r}))"
        )

    def find_continuations(self, later: Measurements) -> dict[str, np.ndarray]:
        """Return the rows of later readings that continue runs of these readings: run → rows.

        Such rows have the run's name, device and axis, and follow its readings in blocks, the first without a gap. In a
        file of another test, whose clock restarts, times are interleaved with those of the run, or far from them.
        """
        if not (self.has("time") and later.has("time")) or self.since != later.since:
            return {}
        later_times, rows_by_run = later["time"], {}
        for i, (name, times) in later.records.matching_records(self.records).items():
            rows = later.records.rows[i]
            first_time = float(later_times[rows].min())
            earlier_times = times[times < first_time]
            if not earlier_times.size or times.size < 2 or np.isin(later_times[rows], times).any():
                continue
            labels = np.concatenate([np.zeros(times.size, bool), np.ones(rows.size, bool)])
            labels = labels[np.argsort(np.concatenate([times, later_times[rows]]), kind="stable")]
            max_alternations = max(2.0, MAX_INTERLEAVED_SHARE * min(times.size, rows.size))
            is_in_blocks = np.count_nonzero(np.diff(labels)) <= max_alternations
            if is_in_blocks and first_time - earlier_times[-1] <= PAUSE_STEPS * median_step(times):
                rows_by_run[name] = rows
        return rows_by_run

    def average(self, step: str | float) -> Measurements:
        """Average consecutive readings with equal labels and settings over an averaging time.

        `noise.white` of a later fit is the noise of a mean of the largest number of readings; the column
        `output_uncertainty` has the excess noise of means of fewer, and a flag states the noise of a single reading.
        Correlated noise with time constants above `step` is unchanged. Signals faster than `step` (rates, lags,
        vibration, spikes) are averaged out: exclude spikes first (`exclude_faults`).

        Args:
            step: averaging time, such as "1 s", "0.5 s" or "2 min"; a number is in s.

        Raises:
            InputError: invalid `step`, no column `time`, or averaging would combine no two readings, or all of them.
        """
        seconds, time, units = averaging.parse_duration(step), self["time"], self.units
        labels = [n for n, unit in units.items() if unit is None or n == SOAK_POINT]
        codes = label_codes(self.values, labels)
        order = np.lexsort((time, codes))
        is_next = np.diff(codes[order], prepend=-1) == 0  # same group as the preceding reading
        bins = averaging.bin_times(time[order], is_next, seconds)
        is_start = ~is_next | (np.diff(bins, prepend=bins[:1]) != 0)
        varying_columns = ("time", self.output, UNCERTAINTY, *labels)
        for name in (n for n, unit in units.items() if unit != "degC" and n not in varying_columns):
            is_start |= averaging.find_steps(self[name][order], is_next)
        begins = np.flatnonzero(is_start)
        counts = np.diff(begins, append=time.size)
        averaging.check_averaging_time(time[order], is_next, counts, seconds, self.file)
        means = {
            name: v[order][begins] if units[name] is None else averaging.average(v[order], begins)
            for name, v in self.values.items()
        }
        noise = averaging.estimate_reading_noise(self.values, self.output, order, ~is_start)
        uncertainty = averaging.compute_excess_uncertainty(self.values, order, begins, noise)
        means |= {} if uncertainty is None else {UNCERTAINTY: uncertainty}
        rows = np.lexsort((means["time"], self.records.codes[order][begins]))
        low, high, unit = int(counts.min()), int(counts.max()), self.unit(self.output)
        counts_text = str(high) if low == high else f"{low} to {high}"
        flag = f"{self.file}: {time.size} readings averaged over {seconds:g} s, to {counts.size} means of {counts_text}"
        if noise:
            noise_text = f"{noise:.3g} {unit_label(unit or '')}".rstrip()
            flag += f"; noise.white: noise of a mean of {high}; noise of one reading: {noise_text}"
        values, units = {n: v[rows] for n, v in means.items()}, {UNCERTAINTY: unit, **units}
        return replace(self, values=values, units=units, flags=(*self.flags, flag))

    def write(self, path: str | Path) -> Path:
        """Write the readings to a .csv file that `read` can read; times with dates as seconds since 1970.

        Raises:
            InputError: the suffix is not .csv, or the file cannot be written.
        """
        readings = self
        if self.since is not None and self.has("time"):
            readings = self.with_column("time", self["time"] + self.since)
        return write(readings.values, readings.units, path)


def measure_tables(
    tables: Sequence[Table],
    instrument: InstrumentLike,
    options: ReadOptions,
    allow_one_temperature: bool,
    labels: Sequence[str] = ("",),
    problems: Objections | None = None,
) -> Measurements:
    """Convert tables of files or arrays to measurements; raise InputError with all their problems.

    `labels` name the runs of files without a column `run`; `problems` are those of files that could not be opened.
    """
    problems, converted = Objections(problems or ()), list[ConvertedColumns]()
    if not problems:
        check_options(tables, options, problems)
    file_options = [options.restrict_to(table, tables) for table in tables]
    for table, table_options in zip(tables, file_options, strict=True):
        with problems.collecting():
            converted.append(convert_columns(table, instrument, table_options))
    problems.refuse()
    joined, output = join_files(converted, labels), output_name(instrument)
    checks.find_problems(joined, instrument, allow_one_temperature).refuse()
    sources = tuple(
        Source(t.file, t.sha256, t.rows, o.columns.get(output, ""), dict(o.columns), dict(o.units))
        for t, o in zip(tables, file_options, strict=True)
        if t.sha256
    )
    names = format_files([source.file for source in sources])
    values, units = joined.values, joined.units
    repeated = checks.find_repeated_rows(values)
    flags = checks.flags_of(joined, output, names, repeated)
    # with equal times, a repeated row cannot be a separate reading
    if "time" in values and len(repeated):
        values = {n: np.delete(v, repeated) for n, v in values.items()}
    if outputs := getattr(instrument, "outputs", ()):
        as_scalar = load_entry("scalar_readings", f"reading {', '.join(outputs)}")
        values, units, scalar_flags = as_scalar(instrument, values, units, names)
        flags += tuple(scalar_flags)
    channels, scale = frozenset(joined.other_channels & values.keys()), options.nominal_scale
    return Measurements(values, units, sources, flags, output, scale, channels, joined.origin)


def _extract_columns(frame: Any, columns: dict[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the columns of a mapping or a data frame as plain arrays, and the units attached to them."""
    names = [*getattr(frame, "coords", ()), *getattr(frame, "columns", frame)]
    table = {str(name): frame[name] for name in names} | columns
    if (name := getattr(getattr(frame, "index", None), "name", None)) is not None:
        table.setdefault(str(name), frame.index)
    units = {name: unit for name, values in table.items() if (unit := _find_unit(values))}
    return {n: getattr(v, "magnitude", getattr(v, "value", v)) for n, v in table.items()}, units


def _find_unit(values: Any) -> str | None:
    """Return the unit attached to a column by pint, astropy or xarray, as text; None if there is none."""
    unit = getattr(values, "units", getattr(values, "unit", None))
    unit = getattr(values, "attrs", {}).get("units", None if isinstance(unit, str) else unit)
    kind = getattr(unit, "dimensionality", getattr(unit, "physical_type", None))
    if str(kind).strip("[]") == "mass":  # g is gravity in bayescal, a gram in pint and astropy
        return getattr(unit, "long_names", [str(unit)])[0]
    if kind is None and not isinstance(unit, str):  # such as the resolution of dates
        return None
    text = f"{unit:~C}" if hasattr(unit, "dimensionality") else str(unit)
    return text.replace("g_0", "g").replace("Δ°", "delta_deg") or "1"


def _freeze_column(values: ArrayLike, unit: str | None) -> np.ndarray:
    """Return a read-only column: float64 numbers with a unit, text without."""
    if unit is not None:
        parse(unit)
    view = np.asarray(values).astype(str) if unit is None else np.asarray(values, np.float64).view()
    view.flags.writeable = False
    return view
