"""Files that hold many devices, split into them; what is wrong with one device's rows refuses that device alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from bayescal._core.errors import InputError
from bayescal._data.column import Column, ConvertedColumns, NominalScale, Source
from bayescal._data.column_conversion import convert_columns
from bayescal._data.dataset_checks import refuse_backward_time, refuse_one_temperature
from bayescal._data.header_matching import MatchedFile, unused_options
from bayescal._data.read_options import (
    InstrumentLike,
    ReadOptions,
    expected_columns,
    output_name,
    unit_of,
)
from bayescal._data.record_settings import recording
from bayescal._data.unit_conversion import base_unit
from bayescal._fleet.devices import DEVICE, DeviceBlock, Devices
from bayescal._tables.cells import Cells
from bayescal._tables.open_table import MAX_BYTES, open_table
from bayescal._tables.problems import Problems
from bayescal._tables.raw_table import Table, load_whole


def split_devices(
    paths: str | Path | Sequence[str | Path],
    instrument: InstrumentLike,
    *,
    needs: Sequence[str] = (),
    max_bytes: int = MAX_BYTES,
    **how: Any,
) -> Devices:
    """Read files that hold many devices, split by the column `device`; a file without one is a device by itself.

    Args:
        paths: CSV, Parquet or NetCDF files. Devices in a file need not stand in order; their readings do.
        instrument: whose readings they are.
        needs: further columns that a model's effects use: a device that has no number there is refused.
        max_bytes: most that a file may take in memory.
        how: columns, units, local_gravity, missing, decimal, nominal_scale, nominal_zero, date_order, ignore, as of
            `read`; columns={"device": "serial"} splits by `serial`.

    Returns:
        The devices. Those with a cell that cannot be used, one temperature only or time that runs backwards are in
        `refused`, each with its message; the others are not affected.

    Raises:
        InputError: a file cannot be read, lacks a column, has a wrong unit, rows without a device, or a device of
            another file: nothing shows then what of it is right.
    """
    given = [Path(p) for p in ([paths] if isinstance(paths, str | Path) else paths)]
    if not given:
        raise InputError("no file was given to split into devices: give at least one")
    options = ReadOptions.of(instrument, **{k: v for k, v in how.items() if v is not None})
    names: dict[str, None] = {}
    files: list[Devices] = []
    for path in given:
        table = open_readings(path, options, max_bytes)
        files.append(split_table(table, path.stem, instrument, options, needs))
        if twice := names.keys() & files[-1].names:
            raise InputError(
                f"{path.name!r} holds device {min(twice)!r}, which a file before it holds too: put the "
                "readings of a device into one file"
            )
        names |= dict.fromkeys(files[-1].names)
    return Devices.together(files)


def open_readings(path: Path, options: ReadOptions, max_bytes: int = MAX_BYTES) -> Table:
    """A file of readings as a table; of a log, the channels that the options name.

    Raises:
        InputError: it cannot be read, or is larger than it may be.
    """
    if path.is_file() and path.stat().st_size > max_bytes:
        raise InputError(
            f"{path.name!r} is larger than {max_bytes} bytes: split it, or raise max_bytes"
        )
    asked = tuple(options.columns.values())
    return open_table(path, path.name, max_bytes, options.decimal, asked)


class _WithFurtherColumns(NamedTuple):
    """What reading asks of an instrument, with further columns that must be read."""

    name: str
    columns: tuple[Column, ...]
    nominal_scale: NominalScale | None
    output: str


def split_table(
    table: Table,
    stem: str,
    instrument: InstrumentLike,
    options: ReadOptions,
    needs: Sequence[str] = (),
) -> Devices:
    """The devices of one table; without a column `device` it is a device called `stem`.

    Raises:
        InputError: as `split_devices`.
    """
    problems = Problems(table.problems)
    unused_options([table], options, problems)
    problems.refuse()
    further = _further(table, instrument, options, needs)
    output = output_name(instrument)
    expects = _WithFurtherColumns(
        instrument.name, (*instrument.columns, *further), instrument.nominal_scale, output
    )
    file = MatchedFile(table, expects, options, problems)
    table, places = file.table, file.positions
    table = _read_once(table)
    problems.refuse()
    labels = np.full(table.rows, stem, dtype=object)
    if DEVICE in places:
        labels = table.load({places[DEVICE]: False})[places[DEVICE]].values
        # The labels are at hand: as a column they would be checked, level by level, once more.
        table = _less(table, places[DEVICE])
        columns = {ours: theirs for ours, theirs in options.columns.items() if ours != DEVICE}
        options = replace(options, columns=columns)
    codes, levels = pd.factorize(labels)
    if "" in levels:
        where = table.place(int(np.argmax(labels == "")))
        raise InputError(f"{where} of {table.file!r} names no device: fill it in, or remove it")
    names = tuple(map(str, levels))
    converted, rows, refused = _convert_usable(table, codes, names, expects, options)
    if not rows.size:
        return Devices(names, (), refused)
    counts = np.bincount(codes[rows])
    block = DeviceBlock(
        names=tuple(names[k] for k in np.flatnonzero(counts)),
        ends=np.cumsum(counts[counts > 0]),
        values=converted.values,
        units=converted.units,
        output=output,
        source=Source(table.file, table.sha256, table.rows),
    )
    if DEVICE in places:
        block.values[DEVICE], block.units[DEVICE] = labels[rows], None
    return Devices(names, (block,), refused).refusing(_useless(block, instrument))


def _read_once(table: Table) -> Table:
    """The table, whose columns are kept once they were read: rows of it are taken again and again."""

    @cache
    def cells(position: int, number: bool) -> Cells:
        return load_whole(table, {position: number})[position]

    return replace(table, load=lambda wanted: {p: cells(p, n) for p, n in wanted.items()})


def _less(table: Table, position: int) -> Table:
    """A table without one of its columns."""
    rest = [i for i in range(len(table.headers)) if i != position]

    def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
        cells = table.load({rest[p]: number for p, number in wanted.items()})
        return {p: cells[rest[p]] for p in wanted}

    return replace(table, headers=tuple(table.headers[i] for i in rest), load=load)


def _further(
    table: Table, instrument: InstrumentLike, options: ReadOptions, needs: Sequence[str]
) -> tuple[Column, ...]:
    """Columns that effects need and the instrument does not know, in their base units."""
    headers = {h.name: h for h in table.headers}
    further = []
    for name in [n for n in needs if n not in expected_columns(instrument)]:
        header = headers.get(options.columns.get(name, name))
        if header is not None and (unit := unit_of(header, name, options)) is not None:
            further.append(Column(name, base_unit(unit), required=False))
    return tuple(further)


def _convert_usable(
    table: Table,
    codes: np.ndarray,
    names: Sequence[str],
    instrument: InstrumentLike,
    options: ReadOptions,
) -> tuple[ConvertedColumns, np.ndarray, dict[str, str]]:
    """The columns of all devices whose cells can be used, their rows of the table, and why the others cannot."""
    rows, refused = np.argsort(codes, kind="stable"), dict[str, str]()
    while rows.size:
        problems, some = Problems(), table.take(rows)
        converted = convert_columns(some, instrument, options, problems)
        if not problems:
            return converted, rows if converted.kept is None else rows[converted.kept], refused
        Problems(p for p in problems if not p.rows).refuse()
        bad: dict[int, str] = {}
        for problem in problems:
            for index in problem.rows:
                one = replace(problem, rows=(index,), places=(some.place(index),))
                bad[int(codes[rows[index]])] = str(one)
        refused |= {names[code]: why for code, why in bad.items()}
        rows = rows[~np.isin(codes[rows], list(bad))]
    return ConvertedColumns(), rows, refused


def _useless(block: DeviceBlock, instrument: InstrumentLike) -> dict[str, str]:
    """Devices with one temperature only, or with time running backwards, and what is said of them."""
    bad = _backward(block)
    need = any(c.name == "temperature" and c.required for c in instrument.columns)
    if need := need and "temperature" in block.values:
        values = block.values["temperature"]
        span = np.maximum.reduceat(values, block.starts) - np.minimum.reduceat(values, block.starts)
        bad |= set(np.flatnonzero(span < recording().temperature_span).tolist())
    refused = {}
    for i in sorted(bad):
        columns, file, problems = block.columns(i), f"device {block.names[i]}", Problems()
        with problems.collecting(file):
            if need:
                refuse_one_temperature(columns, file)
            refuse_backward_time(columns, lambda row, file=file: f"reading {row + 1} of {file}")
        refused[block.names[i]] = str(problems[0])
    return refused


def _backward(block: DeviceBlock) -> set[int]:
    """Devices in which time runs backwards within a run of an axis."""
    if "time" not in block.values:
        return set()
    device = np.repeat(np.arange(len(block.names)), block.counts)
    record = device
    for name in {"run", "axis"} & block.values.keys():
        codes, levels = pd.factorize(block.values[name])
        record = record * len(levels) + codes
    order = np.argsort(record, kind="stable")
    back = (np.diff(block.values["time"][order]) < 0) & (np.diff(record[order]) == 0)
    return set(device[order[1:][back]].tolist())
