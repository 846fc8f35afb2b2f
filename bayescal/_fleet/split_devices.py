"""Files that hold many devices, split into them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bayescal._core.errors import InputError
from bayescal._data.column import Column, NominalScale, Source
from bayescal._data.header_matching import matched, unused_options
from bayescal._data.read_options import (
    InstrumentLike,
    ReadOptions,
    expected_columns,
    output_name,
    unit_of,
)
from bayescal._data.unit_conversion import base_unit
from bayescal._data.unit_parsing import STANDARD_GRAVITY
from bayescal._fleet.device_refusals import TableRows, TakenRows, convert_most, without_useless
from bayescal._fleet.devices import DEVICE, DeviceBlock, Devices
from bayescal._tables.cells import Cells
from bayescal._tables.open_table import MAX_BYTES, open_table
from bayescal._tables.problems import Problems
from bayescal._tables.raw_table import Table, load_whole


def split_devices(
    paths: str | Path | Sequence[str | Path],
    instrument: InstrumentLike,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    local_gravity: float = STANDARD_GRAVITY,
    missing: str = "refuse",
    decimal: str = "",
    needs: Sequence[str] = (),
    max_bytes: int = MAX_BYTES,
    **more: Any,
) -> Devices:
    """Read files that hold many devices, split by the column `device`; a file without one is a device by itself.

    Args:
        paths: CSV, Parquet or NetCDF files. Devices in a file need not stand in order; their readings do.
        instrument: whose readings they are.
        columns, units, local_gravity, missing, decimal: as of `read`; {"device": "serial"} splits by `serial`.
        needs: further columns that a model's effects use: a device that has no number there is refused.
        max_bytes: most that a file may take in memory.
        more: nominal_scale, nominal_zero, date_order, ignore, as of `read`.

    Returns:
        The devices. Those with a cell that cannot be used, one temperature only or time that runs backwards are in
        `refused`, each with its message; the others are not affected.

    Raises:
        InputError: a file cannot be read, lacks a column, has a wrong unit, rows without a device, or a device of
            another file: nothing in it can be told apart from what is right.
    """
    given = [Path(p) for p in ([paths] if isinstance(paths, str | Path) else paths)]
    if not given:
        raise InputError("no file was given to split into devices: give at least one")
    options = ReadOptions.of(
        instrument,
        columns=columns or {},
        units=units or {},
        local_gravity=local_gravity,
        missing=missing,
        decimal=decimal,
        **more,
    )
    names: list[str] = []
    blocks: list[DeviceBlock] = []
    refused: dict[str, str] = {}
    for path in given:
        table = open_readings(path, options, max_bytes)
        found = split_table(table, path.stem, instrument, options, needs)
        if twice := set(found.names) & set(names):
            raise InputError(
                f"{path.name!r} holds device {sorted(twice)[0]!r}, which a file before it holds too: put the "
                "readings of a device into one file"
            )
        names += found.names
        blocks += found.blocks
        refused |= found.refused
    return Devices(tuple(names), tuple(blocks), refused)


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
    expects = _Wider(instrument, _further(table, instrument, options, needs))
    table, places = matched(table, expects, options, problems := Problems())
    problems.refuse()
    named = DEVICE in places
    if named:
        labels = load_whole(table, {places[DEVICE]: False})[places[DEVICE]].values
        # The labels are at hand: as a column they would be read, and checked level by level, once more.
        table, options = _less(table, places[DEVICE]), _without_device_column(options)
    else:
        labels = np.full(table.rows, stem, dtype=object)
    codes, levels = pd.factorize(labels)
    if "" in levels:
        where = table.place(int(np.argmax(labels == "")))
        raise InputError(f"{where} of {table.file!r} names no device: fill it in, or remove it")
    order = np.argsort(codes, kind="stable")
    names = tuple(map(str, levels))
    taken = TakenRows(TableRows(table), order)
    converted, rows, refused = convert_most(taken, codes[order], names, expects, options)
    if not rows.size:
        return Devices(names, (), refused)
    codes = codes[order][rows]
    kept = np.flatnonzero(np.bincount(codes, minlength=len(names)))
    block = DeviceBlock(
        names=tuple(names[k] for k in kept),
        ends=np.searchsorted(codes, kept, side="right"),
        values=converted.values,
        units=converted.units,
        output=output_name(instrument),
        source=Source(table.file, table.sha256, table.rows),
    )
    if named:
        block.values[DEVICE], block.units[DEVICE] = labels[order][rows], None
    return without_useless(names, block, refused, instrument)


def _less(table: Table, position: int) -> Table:
    """A table without one of its columns."""
    rest = [i for i in range(len(table.headers)) if i != position]

    def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
        found = table.load({rest[p]: number for p, number in wanted.items()})
        return {p: found[rest[p]] for p in wanted}

    return replace(table, headers=tuple(table.headers[i] for i in rest), load=load)


def _without_device_column(options: ReadOptions) -> ReadOptions:
    columns = {ours: theirs for ours, theirs in options.columns.items() if ours != DEVICE}
    return replace(options, columns=columns)


@dataclass(frozen=True)
class _Wider:
    """An instrument with further columns."""

    instrument: InstrumentLike
    further: tuple[Column, ...]

    @property
    def name(self) -> str:
        return self.instrument.name

    @property
    def columns(self) -> tuple[Column, ...]:
        return (*self.instrument.columns, *self.further)

    @property
    def nominal_scale(self) -> NominalScale | None:
        return self.instrument.nominal_scale

    @property
    def output(self) -> str:
        return output_name(self.instrument)


def _further(
    table: Table, instrument: InstrumentLike, options: ReadOptions, needs: Sequence[str]
) -> tuple[Column, ...]:
    """Columns that effects need and the instrument does not know, in their base units."""
    known = expected_columns(instrument)
    headers = {h.name: h for h in table.headers}
    found = []
    for name in needs:
        header = headers.get(options.columns.get(name, name))
        if name in known or header is None or (unit := unit_of(header, name, options)) is None:
            continue
        found.append(Column(name, base_unit(unit), required=False))
    return tuple(found)
