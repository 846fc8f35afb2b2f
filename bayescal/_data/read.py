"""`read`: files in, measurements out, or a refusal that says where and what to do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from bayescal._core.errors import InputError
from bayescal._core.quoting import one_line
from bayescal._data.column import MAY_BE_EMPTY, ConvertedColumns, NominalScale, Source
from bayescal._data.column_conversion import convert_columns
from bayescal._data.dataset_checks import problems_of_whole
from bayescal._data.header_matching import (
    InstrumentLike,
    ReadOptions,
    expected_columns,
    output_name,
    unused_options,
)
from bayescal._data.unit_conversion import STANDARD_GRAVITY
from bayescal._tables.open_table import MAX_BYTES, check_files, open_table
from bayescal._tables.raw_table import Problems, Table

if TYPE_CHECKING:
    from bayescal._data.measurements import Measurements


@overload
def read(
    path_or_paths: str | Path | Sequence[str | Path],
    instrument: InstrumentLike,
    *,
    outputs: None = None,
    **options: Any,
) -> Measurements: ...
@overload
def read(
    path_or_paths: str | Path | Sequence[str | Path],
    instrument: InstrumentLike,
    *,
    outputs: Sequence[str],
    **options: Any,
) -> dict[str, Measurements]: ...
def read(  # pyright: ignore[reportInconsistentOverload]
    path_or_paths: str | Path | Sequence[str | Path],
    instrument: InstrumentLike,
    *,
    outputs: Sequence[str] | None = None,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    local_gravity: float = STANDARD_GRAVITY,
    local_field: str | None = None,
    nominal_scale: NominalScale | str | None = None,
    nominal_zero: str | None = None,
    allow_one_temperature: bool = False,
    missing: str = "refuse",
    decimal: str = "",
    date_order: str = "",
    ignore: Sequence[str] = (),
    max_bytes: int = MAX_BYTES,
) -> Measurements | dict[str, Measurements]:
    """Read readings of an instrument from one file or several: CSV, Parquet, NetCDF, Excel, MATLAB, or logs.

    Headers read `name [unit]`, or as people write them ("Temp (°C)", "gyro_z_dps"), where that can be read in one
    way only, which a flag says; lines that begin with # may stand above a CSV's header. Columns are
    converted to the instrument's units, and rows keep their order. Dates, and counts since 1970, become seconds since
    the first reading of all files. Where several files have no column `run`, each is a run named after its file. A
    column that the instrument does not know is kept in base units if it has a unit, and otherwise left out with a
    flag. Of a log (PX4 .ulg, ArduPilot .bin, ROS .bag, .mcap, .db3) only the channels that `columns` names are read.

    Args:
        path_or_paths: the files.
        instrument: whose readings they are.
        outputs: the file's names of several channels of one unit: each is read as the output, the others left out.
        columns: our name → the file's, where they differ: {"output": "gyro_x"}.
        units: the file's name (or ours) → unit, where the header has none or a wrong one.
        local_gravity: m/s², for columns in m/s²; internal accelerations are in local g.
        local_field: magnitude of the magnetic field that magnetometers are turned in, such as "48.2 uT".
        nominal_scale: how a raw output (V, Hz) becomes the instrument's, in place of its own: "250 V/g".
        nominal_zero: the raw output at zero, such as "1.21 V".
        allow_one_temperature: accept one temperature, as for a prediction.
        missing: "refuse" files with missing readings, or "drop" the rows in which one is missing; they are gaps.
        decimal: "." or "," in the numbers of text files; empty where the file shows it.
        date_order: of month, day and year in dates such as 05/06/2026: "mdy", "dmy" or "ymd"; empty where a day above
            12 shows it.
        ignore: columns of the file that are left out.
        max_bytes: most that all files together may hold.

    Returns:
        The readings; of several outputs, by their names.

    Raises:
        InputError: a file, a column, a unit or a cell cannot be used. One problem is a sentence that names file, row
            and column, what was read, what was expected, and what to do; several are a list of these, and the
            error's `problems`.
    """
    paths = [path_or_paths] if isinstance(path_or_paths, str | Path) else list(path_or_paths)
    paths = [Path(path) for path in paths]
    names = check_files(paths, max_bytes)
    options = ReadOptions.of(
        instrument,
        columns=columns or {},
        units=units or {},
        local_gravity=local_gravity,
        local_field=local_field,
        nominal_scale=nominal_scale,
        nominal_zero=nominal_zero,
        missing=missing,
        decimal=decimal,
        date_order=date_order,
        ignore=ignore,
    )

    def one(options: ReadOptions) -> Measurements:
        tables, parts = _opened(paths, names, instrument, options, max_bytes)
        output = options.columns.get(output_name(instrument), "")
        sources = tuple(Source(table.file, table.sha256, table.rows, output) for table in tables)
        joined = parts[0]
        if len(parts) > 1:
            _label_runs(parts, _runs(paths))
            joined = _join(parts)
        joined = replace(joined, flags=[*joined.flags, *_equal_contents(tables)])
        problems_of_whole(joined, instrument, allow_one_temperature).refuse()

        from bayescal._data.measurements import assemble  # after what is refused: it needs a second

        return assemble(joined, instrument, sources, options.nominal_scale)

    return one(options) if outputs is None else _each(outputs, options, instrument, one)


def _each(
    outputs: Sequence[str],
    options: ReadOptions,
    instrument: InstrumentLike,
    one: Callable[[ReadOptions], Measurements],
) -> dict[str, Measurements]:
    """Readings of several outputs, each as `one` reads it; what is wrong with any is said at once."""
    if not outputs or len(set(outputs)) < len(outputs):
        raise InputError(f"outputs={list(outputs)}: name each channel once, and one at least")
    problems, found = Problems(), dict[str, "Measurements"]()
    if (output := output_name(instrument)) in options.columns:
        raise InputError(f"{output}={options.columns[output]}, and channels: say only the channels")
    for name in (expected_columns(instrument).keys() - {output}).intersection(outputs):
        raise InputError(
            f"{name!r} is no channel: {instrument.name!r} reads it as what channels depend on"
        )
    for name in outputs:
        columns = {**options.columns, output: name}
        others = frozenset(outputs) - {name}
        with problems.collecting():
            found[name] = one(replace(options, columns=columns, others=others))
    Problems(dict.fromkeys(problems)).refuse()
    return found


def _opened(
    paths: Sequence[Path],
    names: Sequence[str],
    instrument: InstrumentLike,
    options: ReadOptions,
    max_bytes: int,
) -> tuple[list[Table], list[ConvertedColumns]]:
    """The files as tables and as columns; all that is wrong with any of them is refused at once."""
    problems, tables, parts = Problems(), list[Table](), list[ConvertedColumns]()
    for path, name in zip(paths, names, strict=True):
        with problems.collecting(name):
            asked = tuple(options.columns.values())
            tables.append(open_table(path, name, max_bytes, options.decimal, asked))
    if len(tables) == len(paths):
        unused_options(tables, options, problems)
    for table in tables:
        with problems.collecting(table.file):
            part = convert_columns(table, instrument, options, problems)
            parts.append(part)
            records_known = part.unread.isdisjoint(("run", "device", "axis"))
            if problems and records_known:  # said with the rest
                problems += problems_of_whole(part, instrument, True)
    problems.refuse()
    return tables, parts


def _runs(paths: Sequence[Path]) -> list[str]:
    """A run's label for each file: its stem, with folder or number where that is not enough."""
    stems = [one_line(path.stem) for path in paths]
    if len(set(stems)) < len(stems):
        with_folder = [one_line(f"{path.resolve().parent.name}/{path.stem}") for path in paths]
        repeated = Counter(stems)
        stems = [w if repeated[s] > 1 else s for s, w in zip(stems, with_folder, strict=True)]
    labels: list[str] = []
    for stem in stems:
        label, number = stem, 2
        while label in labels:
            label, number = f"{stem} ({number})", number + 1
        labels.append(label)
    return labels


def _label_runs(parts: Sequence[ConvertedColumns], labels: Sequence[str]) -> None:
    """Give the files without a column `run` a run of their own, and say which runs span files."""
    own = [set(part.values["run"]) if "run" in part.values else set() for part in parts]
    named = set().union(*own)
    seen: dict[str, str] = {}
    for part, label, runs in zip(parts, labels, own, strict=True):
        (table,) = part.tables
        if "run" not in part.values:
            label = f"file {label}" if label in named else label
            part.values["run"] = np.full(table.rows, label, dtype=object)
            part.units["run"] = None
        part.flags += [
            f"run {run!r} of {table.file} is taken as the one of {seen[run]}, continued"
            for run in sorted(runs & seen.keys())
        ]
        seen = dict.fromkeys(runs, table.file) | seen


def _join(parts: Sequence[ConvertedColumns]) -> ConvertedColumns:
    """Files one after the other; labels in some files only, or one column in two dimensions, are refused."""
    tables = [table for part in parts for table in part.tables]
    joined = ConvertedColumns(tuple(tables), flags=[flag for part in parts for flag in part.flags])
    joined.filled = set.intersection(*(part.filled for part in parts))
    joined.beside = set().union(*(part.beside for part in parts))
    joined.origin = _on_one_clock(parts)
    units = {name: unit for part in parts for name, unit in part.units.items()}
    for name, unit in units.items():
        for table, part in zip(tables, parts, strict=True):
            if part.units.get(name, unit) != unit:
                raise InputError(
                    f"column {name!r} is in {part.units[name]} in {table.file!r} and in {unit} in "
                    "another file: give it one kind of unit, or rename one"
                )
        with_it, without = _first_files(parts, [name in part.values for part in parts])
        if without and unit is None:
            raise InputError(
                f"{without!r} lacks the column {name!r} that {with_it!r} has: label every file, or "
                "none"
            )
        if without and name == MAY_BE_EMPTY:
            joined.flags.append(f"{without}: no {name!r}: its readings belong to no cell (a ramp)")
        elif without:
            joined.flags.append(f"column {name!r} left out: {with_it} has it, {without} has not")
            continue
        empty = [np.full(table.rows, np.nan) for table in tables]
        joined.values[name] = np.concatenate(
            [p.values.get(name, e) for p, e in zip(parts, empty, strict=True)]
        )
        joined.units[name] = unit
    return joined


def _first_files(
    parts: Sequence[ConvertedColumns], have: Sequence[bool]
) -> tuple[str | None, str | None]:
    """The first file that has something, and the first that has not."""
    files = [part.tables[0].file for part in parts]
    with_it = next((file for file, has in zip(files, have, strict=True) if has), None)
    return with_it, next((file for file, has in zip(files, have, strict=True) if not has), None)


def _on_one_clock(parts: Sequence[ConvertedColumns]) -> float | None:
    """Shift the times of files that count from dates to the earliest, which is returned; None without dates."""
    timed = [part for part in parts if "time" in part.values]
    origins = [part.origin for part in timed if part.origin is not None]
    if not origins:
        return None
    with_it, without = _first_files(timed, [part.origin is not None for part in timed])
    if without:
        raise InputError(
            f"{with_it!r} has dates in its column 'time', {without!r} has none: give all files the same clock, or "
            "read them one by one"
        )
    for part in timed:
        assert part.origin is not None
        part.values["time"] = np.round(part.values["time"] + (part.origin - min(origins)), 6)
    return min(origins)


def _equal_contents(tables: Sequence[Table]) -> list[str]:
    first: dict[str, str] = {}
    for table in tables:
        first.setdefault(table.sha256, table.file)
    return [
        f"{table.file} has the same content as {first[table.sha256]}: the same readings twice?"
        for table in tables
        if table.file != first[table.sha256]
    ]
