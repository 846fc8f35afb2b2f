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

from bayescal._core.annex import first_offered
from bayescal._core.errors import InputError
from bayescal._core.formatting import number
from bayescal._core.netcdf import Variable
from bayescal._core.result_table import Printed, ResultTable, plain_table
from bayescal._data import averaging
from bayescal._data import dataset_checks as checks
from bayescal._data.column import (
    ARRAYS,
    MAY_BE_EMPTY,
    UNCERTAINTY,
    ConvertedColumns,
    NominalScale,
    Source,
    file_names,
)
from bayescal._data.column_conversion import convert_columns, join_files
from bayescal._data.read_options import InstrumentLike, ReadOptions, output_name, unused_options
from bayescal._data.records import PAUSE_STEPS, Records, distinct, label_codes, median_step
from bayescal._data.unit_conversion import ANY, parse, unit_label
from bayescal._tables.cells import broadcast_columns, format_date
from bayescal._tables.raw_table import ROW, Objections, Table, option
from bayescal._tables.write import write

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

SINCE = "since"  # attribute of the time: seconds since 1970 at its zero, where the file has dates
# Changes from one record to the other, per reading: beyond, two are simultaneous and neither continues the other.
MAX_INTERLEAVED_SHARE = 0.2
MAX_SHOWN_LABELS = 5  # of a column
CAUSE = "cause"  # attribute of a column: 0 where it is no possible cause


@dataclass(frozen=True, eq=False, repr=False)
class Measurements(Printed):
    """Readings of an instrument, in its fixed units and in the order in which they came.

    Made by `read` or `from_arrays`, which check them. The arrays are read-only.

    Attributes:
        values: name → one entry a reading; numbers are float64, labels are text.
        units: name → the column's fixed unit; None for labels.
        sources: the files they came from.
        flags: warnings of readings that were accepted, a sentence each.
        output: name of the output column.
        scale: nominal scale from a raw output to the instrument's, where the user gave one.
        no_causes: columns that are no possible causes: other channels, and those that the user excludes.
        since: seconds since 1970 at time zero; None where the time counts from no date.
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
        columns = {name: _column(values, self.units[name]) for name, values in self.values.items()}
        if {v.ndim for v in columns.values()} != {1} or len({*map(len, columns.values())}) > 1:
            shapes = ", ".join(f"{name} {v.shape}" for name, v in columns.items()) or "none"
            raise InputError(
                f"measurements have the one dimension {ROW!r}, these have columns of unequal shapes: {shapes}"
            )
        object.__setattr__(self, "values", columns)
        object.__setattr__(self, "units", {name: self.units[name] for name in columns})

    @classmethod
    def of_variables(cls, held: Mapping[str, Any], **other_fields: Any) -> Measurements:
        """Make readings of `variables`, unchecked; `other_fields` are those beyond these, such as `sources`."""
        gone = (name for name, variable in held.items() if not variable.attrs.get(CAUSE, 1))
        return cls(
            {name: variable.values for name, variable in held.items()},
            {name: variable.attrs.get("units") for name, variable in held.items()},
            no_causes=frozenset(gone),
            since=held["time"].attrs.get(SINCE) if "time" in held else None,
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
        """Make measurements of arrays, checked as `read` checks a file; options as of `read`.

        Args:
            instrument: whose columns these are.
            arrays: columns as a mapping ("humidity [%]"), or a data frame of pandas, polars or xarray, with its
                coordinates and a named index.
            units: unit of a column that is not in the instrument's own (or has none: "any"), and of further columns
                to keep.
            local_gravity: as of `read`.
            allow_one_temperature: accept one temperature, as for a prediction.
            missing: "refuse" readings that are NaN, or "drop" them.
            **columns: one entry per reading, or one for all; in the instrument's units unless `units` says otherwise, a
                unit of pint or astropy that they carry, an attribute `units` of xarray's,
                or a name like a file's header, `humidity [%]`.

        Raises:
            InputError: what `read` refuses, or columns of unequal length.
        """
        named_units = ((name, c.unit) for c in instrument.columns for name in (c.name, *c.also))
        default_units = {name: None if unit == ANY else unit for name, unit in named_units}
        default_units.setdefault(UNCERTAINTY, default_units.get(output_name(instrument)))
        held, own_units = _held_columns({} if arrays is None else arrays, columns)
        table = Table.of_columns(ARRAYS, broadcast_columns(held), default_units | own_units)
        options = ReadOptions(units=units or {}, local_gravity=local_gravity, missing=missing)
        return measure_tables([table], instrument, options, allow_one_temperature)

    @cached_property
    def records(self) -> Records:
        """Return the records: each run of each device and axis."""
        return Records.of(self.values)

    @cached_property
    def rates(self) -> dict[str, np.ndarray]:
        """Return the slope of each column of temperatures over the last minute of its record, °C/s; {} without time."""
        warm = [n for n, unit in self.units.items() if unit == "degC" and n != MAY_BE_EMPTY]
        return {n: self.records.slope(self[n]) for n in warm} if self.has("time") else {}

    @cached_property
    def oddities(self) -> tuple[checks.Anomaly, ...]:
        """Return the anomalies of the columns of thermometers."""
        warm = [n for n in self.columns if self.unit(n) == "degC"]
        return tuple(checks.find_anomalies(self.values, self.records, warm, self.output))

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a column, in its fixed unit; labels as text; InputError where there is none of that name."""
        if name not in self.values:
            raise InputError(
                f"{self.file} has no column {name!r}; it has: {', '.join(self.columns)}"
            )
        return self.values[name]

    def __len__(self) -> int:
        return len(next(iter(self.values.values())))

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def __reduce__(self) -> Any:  # through `__post_init__`: pickled arrays can be written to
        return Measurements, tuple(getattr(self, f.name) for f in fields(self))

    def _parts(self) -> list[str | ResultTable]:
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
        table = plain_table(["column", "unit", "range"], rows, left=3)
        return [f"{len(self)} readings of {self.file}", table]

    def _brief(self) -> str:
        named = (f"{n} [{self.unit(n)}]" if self.unit(n) else n for n in self.columns)
        return f"{len(self)} readings of {self.file}: {', '.join(named)}"

    def to_pandas(self) -> pd.DataFrame:
        """Return the readings as a `pandas.DataFrame`, columns in their fixed units."""
        return self.to_xarray().to_dataframe()

    def to_xarray(self) -> xr.Dataset:
        """Return the readings as an `xarray.Dataset`; each column of numbers has the attribute `units`."""
        import xarray as xr  # half a second that reading does without

        return xr.Dataset(
            {n: (v.dims, v.values.copy(), v.attrs) for n, v in self.variables().items()}
        )

    def variables(self) -> dict[str, Variable]:
        """Return the columns with their attributes, as a NetCDF file holds them."""
        variables = {}
        for name, values in self.values.items():
            unit = self.units[name]
            attributes = {} if unit is None else {"units": unit}
            attributes |= {CAUSE: 0} if name in self.no_causes else {}
            attributes |= {SINCE: self.since} if name == "time" and self.since is not None else {}
            variables[name] = Variable((ROW,), values, attributes)
        return variables

    def has(self, name: str) -> bool:
        """Return whether there is a column of that name."""
        return name in self

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(self.values)

    @property
    def file(self) -> str:
        """Return the names of the source files, short, for messages."""
        return file_names([source.file for source in self.sources])

    def unit(self, name: str) -> str | None:
        """Return a column's fixed unit; None for labels; InputError where there is no column of that name."""
        self[name]
        return self.units[name]

    def without_causes(self, names: Collection[str], others: bool = True) -> Measurements:
        """Exclude columns, which are there, as causes; the others as before, or (without `others`) all allowed."""
        for name in names:
            self[name]
        no_causes = self.no_causes if others else frozenset()
        return replace(self, no_causes=no_causes.union(names))

    def add_to(self, digest: Any) -> None:
        """Add names, units and values of all columns to a digest of `hashlib`."""
        for name in sorted(self.columns):
            column = self[name]
            digest.update(f"{name} [{self.unit(name)}] {len(column)}\n".encode())
            text = column.dtype.kind != "f"
            digest.update(json.dumps(column.tolist()).encode() if text else column.tobytes())

    def same_as(self, other: Measurements) -> bool:
        """Return whether both have the same columns, and equal entries in each."""
        return self.values.keys() == other.values.keys() and all(
            np.array_equal(self[name], other[name], equal_nan=unit is not None)
            for name, unit in self.units.items()
        )

    def followed_by(self, later: Measurements) -> Measurements:
        """Concatenate these readings and later ones, in the columns that both have; unchecked."""
        names = [n for n in self.columns if later.has(n) and self.unit(n) == later.unit(n)]
        values = {n: np.concatenate([self[n], later[n]]) for n in names}
        return replace(self, values=values, no_causes=frozenset())

    def groups(self, name: str) -> tuple[tuple[str, ...], np.ndarray]:
        """Return the members of a grouping, in order of appearance, and each reading's index among them.

        Args:
            name: "run", "device", "axis" (a single "1" where there is no such column), another column of labels,
                "reading" (each its own member), or "cell": run × temperature point, −1 for readings without one. Any
                other raises InputError.
        """
        if name == "reading":
            return tuple(str(i + 1) for i in range(len(self))), np.arange(len(self))
        if name == "cell" and not self.has(MAY_BE_EMPTY):
            return (), np.full(len(self), -1, dtype=np.int64)
        if name == "cell":
            runs, run = self.groups("run")
            point, codes = self[MAY_BE_EMPTY], np.full(len(self), -1, dtype=np.int64)
            has_point = ~np.isnan(point)
            pairs, codes[has_point] = distinct([run[has_point], point[has_point]])
            return tuple(f"run {runs[r]}, {p:.10g} °C" for r, p in pairs), codes
        if not self.has(name) and name in ("run", "device", "axis"):
            return ("1",), np.zeros(len(self), dtype=np.int64)
        if self.unit(name) is not None:
            raise InputError(
                f"{self.file}: column {name!r} holds numbers and makes no groups; use labels"
            )
        levels, codes = distinct([self[name]])
        return tuple(label for (label,) in levels), codes

    def select(self, chosen: ArrayLike) -> Measurements:
        """Select readings by a mask or by indices; InputError for a mask of another length, or for none chosen."""
        index = np.asarray(chosen)
        if index.dtype == bool and index.shape != (len(self),):
            raise InputError(
                f"a mask of shape {index.shape} cannot choose among the {len(self)} readings of "
                f"{self.file}: give one entry per reading"
            )
        index = np.flatnonzero(index) if index.dtype == bool else index
        if not index.size:
            raise InputError(f"no reading of {self.file} was chosen: choose at least one")
        return replace(self, values={name: values[index] for name, values in self.values.items()})

    def with_column(self, name: str, values: ArrayLike, unit: str | None = None) -> Measurements:
        """Replace or add one column, one value per reading; unchecked.

        Args:
            unit: of a new column of numbers; a column that is there keeps its own.

        Raises:
            InputError: an unknown unit.
        """
        unit = self.unit(name) if self.has(name) else unit
        return replace(
            self,
            values={**self.values, name: np.array(values)},
            units={**self.units, name: unit},
            no_causes=self.no_causes - {name},
            since=None if name == "time" else self.since,
        )

    def on_clock(self, epoch: float | None, changing: Callable[[], str]) -> Measurements:
        """Count times from a calibration's `epoch`, s since 1970; None where it has no dates.

        Times without dates count from the calibration's zero where that has no date either: a column `time` has one
        origin over all runs. `changing` gives what changes with the date, for the message; empty for nothing.

        Raises:
            InputError: one has dates and the other has none, and something changes with the date.
        """
        if not self.has("time") or self.since == epoch:
            return self
        if self.since is not None and epoch is not None:
            time = np.round(self["time"] + (self.since - epoch), 6)
            return replace(self.with_column("time", time), since=epoch)
        if not (names := changing()):
            return self
        dated = "has no dates" if epoch is None else f"counts time from {format_date(epoch)}"
        has, example = ("dates", "9 days") if epoch is None else ("no dates", "2026-05-13 10:14:20")
        of = self.sources[0].file if len(self.sources) == 1 else "FILE"
        raise InputError(
            f"{self.file}: its times have {has}, the calibration {dated}; with the date changes {names}. Say "
            f"when its first reading was taken{' on the clock of the calibration' * (epoch is None)}: "
            f"{option('--begin', f'{of}={example}')} (in Python, begin={example!r} where it is read)"
        )

    def continued_in(self, later: Measurements) -> dict[str, np.ndarray]:
        """Return the rows, by run, of later readings that continue runs of these.

        They have the run's name (and device and axis), and follow its readings in blocks, the first without a pause. A
        file of another test, whose clock restarts, has times that fall among all of the record's, or far from them.
        """
        if not (self.has("time") and later.has("time")) or self.since != later.since:
            return {}
        at, continued = later["time"], {}
        for i, (name, times) in later.records.matching_records(self.records).items():
            rows = later.records.rows[i]
            first = float(at[rows].min())
            before = times[times < first]
            if not before.size or times.size < 2 or np.isin(at[rows], times).any():
                continue
            merged = np.concatenate([np.zeros(times.size, bool), np.ones(rows.size, bool)])
            merged = merged[np.argsort(np.concatenate([times, at[rows]]), kind="stable")]
            most = max(2.0, MAX_INTERLEAVED_SHARE * min(times.size, rows.size))
            in_blocks = np.count_nonzero(np.diff(merged)) <= most
            if in_blocks and first - before[-1] <= PAUSE_STEPS * median_step(times):
                continued[name] = rows
        return continued

    def average(self, step: str | float) -> Measurements:
        """Average over consecutive times readings whose labels and settings agree.

        Each mean keeps its noise: `noise.white` of a fit is that of the mean of most readings, the column
        `output_uncertainty` holds the excess of a mean of fewer, and a flag gives the noise of a single reading.
        Correlated noise slower than `step` stays as it is. Changes within `step` are lost: rates, lags and vibration
        that fast, and spikes, which a mean hides: set them aside first.

        Args:
            step: such as "1 s", "0.5 s" or "2 min"; a number is in s.

        Raises:
            InputError: no such time, no column `time`, or each reading its own mean, or one mean of all.
        """
        seconds, time, units = averaging.duration(step), self["time"], self.units
        labels = [n for n, unit in units.items() if unit is None or n == MAY_BE_EMPTY]
        codes = label_codes(self.values, labels)
        order = np.lexsort((time, codes))
        same = np.diff(codes[order], prepend=-1) == 0  # as the reading before, in this order
        bins = averaging.bin_times(time[order], same, seconds)
        starts = ~same | (np.diff(bins, prepend=bins[:1]) != 0)
        varying = ("time", self.output, UNCERTAINTY, *labels)
        for name in (n for n, unit in units.items() if unit != "degC" and n not in varying):
            starts |= averaging.find_steps(self[name][order], same)
        begins = np.flatnonzero(starts)
        counts = np.diff(begins, append=time.size)
        averaging.refuse_useless(time[order], same, counts, seconds, self.file)
        means = {
            name: v[order][begins] if units[name] is None else averaging.mean_rows(v[order], begins)
            for name, v in self.values.items()
        }
        noise = averaging.noise_of_reading(self.values, self.output, order, ~starts)
        uncertainty = averaging.uncertainty_of_means(self.values, order, begins, noise)
        means |= {} if uncertainty is None else {UNCERTAINTY: uncertainty}
        row = np.lexsort((means["time"], self.records.codes[order][begins]))
        low, high, unit = int(counts.min()), int(counts.max()), self.unit(self.output)
        sizes = str(high) if low == high else f"{low} to {high}"
        flag = f"{self.file}: {time.size} readings averaged over {seconds:g} s, to {counts.size} means of {sizes}"
        if noise:
            noise_text = f"{noise:.3g} {unit_label(unit or '')}".rstrip()
            flag += f"; noise.white is that of a mean of {high}, {noise_text} that of one"
        values, units = {name: v[row] for name, v in means.items()}, {UNCERTAINTY: unit, **units}
        return replace(self, values=values, units=units, flags=(*self.flags, flag))

    def write(self, path: str | Path) -> Path:
        """Write the readings to a .csv file, as `read` reads it; dated times count from 1970.

        Raises:
            InputError: another suffix, or a place that cannot be written to.
        """
        dated = self
        if self.since is not None and self.has("time"):
            dated = self.with_column("time", self["time"] + self.since)
        return write(dated.values, dated.units, path)


def measure_tables(
    tables: Sequence[Table],
    instrument: InstrumentLike,
    options: ReadOptions,
    one_temperature: bool,
    labels: Sequence[str] = ("",),
    problems: Objections | None = None,
) -> Measurements:
    """Convert tables of files, or of arrays, to measurements; raise InputError with all problems of all of them.

    `labels` are of the files' runs, where they have no column `run`; `problems` of files that could not be opened.
    """
    problems, parts = Objections(problems or ()), list[ConvertedColumns]()
    if not problems:
        unused_options(tables, options, problems)
    file_options = [options.of_file(table, tables) for table in tables]
    for table, table_options in zip(tables, file_options, strict=True):
        with problems.collecting():
            parts.append(convert_columns(table, instrument, table_options))
    problems.refuse()
    whole, output = join_files(parts, labels), output_name(instrument)
    checks.problems_of_whole(whole, instrument, one_temperature).refuse()
    sources = tuple(
        Source(t.file, t.sha256, t.rows, o.columns.get(output, ""), dict(o.columns), dict(o.units))
        for t, o in zip(tables, file_options, strict=True)
        if t.sha256
    )
    names = file_names([source.file for source in sources])
    values, units = whole.values, whole.units
    repeated = checks.repeated_rows(values)
    flags = checks.flags_of(whole, output, names, repeated)
    # with the time among the columns, none can be a reading of its own
    if "time" in values and len(repeated):
        values = {n: np.delete(v, repeated) for n, v in values.items()}
    if outputs := getattr(instrument, "outputs", ()):
        as_scalar = first_offered("scalar_readings", f"reading {', '.join(outputs)}")
        values, units, scalar_flags = as_scalar(instrument, values, units, names)
        flags += tuple(scalar_flags)
    channels, scale = frozenset(whole.other_channels & values.keys()), options.nominal_scale
    return Measurements(values, units, sources, flags, output, scale, channels, whole.origin)


def _held_columns(frame: Any, columns: dict[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the columns of a mapping or a data frame as bare arrays, and the units that they carry."""
    names = [*getattr(frame, "coords", ()), *getattr(frame, "columns", frame)]
    table = {str(name): frame[name] for name in names} | columns
    if (name := getattr(getattr(frame, "index", None), "name", None)) is not None:
        table.setdefault(str(name), frame.index)
    units = {name: unit for name, values in table.items() if (unit := _unit_of(values))}
    return {n: getattr(v, "magnitude", getattr(v, "value", v)) for n, v in table.items()}, units


def _unit_of(values: Any) -> str | None:
    """Return the unit that a column carries in pint, astropy or xarray, as text; None where it carries none."""
    unit = getattr(values, "units", getattr(values, "unit", None))
    unit = getattr(values, "attrs", {}).get("units", None if isinstance(unit, str) else unit)
    kind = getattr(unit, "dimensionality", getattr(unit, "physical_type", None))
    if str(kind).strip("[]") == "mass":  # g is gravity here, and a gram there
        return getattr(unit, "long_names", [str(unit)])[0]
    if kind is None and not isinstance(unit, str):  # such as the resolution of dates
        return None
    text = f"{unit:~C}" if hasattr(unit, "dimensionality") else str(unit)
    return text.replace("g_0", "g").replace("Δ°", "delta_deg") or "1"


def _column(values: ArrayLike, unit: str | None) -> np.ndarray:
    """Return a read-only column: text without a unit, numbers with one."""
    if unit is not None:
        parse(unit)
    view = np.asarray(values).astype(str) if unit is None else np.asarray(values, np.float64).view()
    view.flags.writeable = False
    return view
