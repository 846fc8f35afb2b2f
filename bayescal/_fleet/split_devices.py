"""Files that hold many devices, split into them; what is wrong with one device's rows refuses that device alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from bayescal._core.errors import InputError
from bayescal._fleet.devices import DEVICE, Block, Devices, without
from bayescal._readings.column import Column, NominalScale, Source
from bayescal._readings.column_conversion import ConvertedColumns, convert_columns
from bayescal._readings.column_matching import (
    InstrumentLike,
    ReadOptions,
    expected_columns,
    match,
    output_name,
    refuse_unused_units,
    unit_of,
)
from bayescal._readings.csv_reader import open_csv
from bayescal._readings.dataset_checks import (
    LEAST_TEMPERATURE_SPAN,
    refuse_backward_time,
    refuse_one_temperature,
)
from bayescal._readings.parquet_netcdf_reader import open_netcdf, open_parquet
from bayescal._readings.raw_table import Cells, Table, load_whole, numbers_of
from bayescal._readings.unit_registry import STANDARD_GRAVITY
from bayescal._readings.units import base_unit
from bayescal._readings.write import FORMATS

MAX_BYTES = 2_000_000_000


def split_devices(
    paths: str | Path | Sequence[str | Path],
    instrument: InstrumentLike,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    local_gravity: float = STANDARD_GRAVITY,
    nominal_scale: NominalScale | None = None,
    needs: Sequence[str] = (),
    max_bytes: int = MAX_BYTES,
) -> Devices:
    """Read files that hold many devices, split by the column `device`; a file without one is a device by itself.

    Args:
        paths: CSV, Parquet or NetCDF files. Devices in a file need not stand in order; their readings do.
        instrument: whose readings they are.
        columns, units, local_gravity, nominal_scale: as of `read`; {"device": "serial"} splits by `serial`.
        needs: further columns that a model's effects use: a device that has no number there is refused.
        max_bytes: most that a file may take in memory.

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
    wishes = ReadOptions(columns or {}, units or {}, local_gravity, nominal_scale)
    names: list[str] = []
    blocks: list[Block] = []
    refused: dict[str, str] = {}
    for path in given:
        table = _open(path, max_bytes)
        refuse_unused_units([table], wishes)
        found = _split(table, path, instrument, wishes, needs)
        if twice := set(found.names) & set(names):
            raise InputError(
                f"{path.name!r} holds device {sorted(twice)[0]!r}, which a file before it holds too: put the "
                "readings of a device into one file"
            )
        names += found.names
        blocks += found.blocks
        refused |= found.refused
    return Devices(tuple(names), tuple(blocks), refused)


def _open(path: Path, max_bytes: int) -> Table:
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"{path.name!r} cannot be read: give one of {', '.join(FORMATS)}")
    try:
        if path.stat().st_size > max_bytes:
            raise InputError(
                f"{path.name!r} is larger than {max_bytes} bytes: split it, or raise max_bytes"
            )
        if suffix == ".csv":
            return open_csv(path, path.name)
        return (open_parquet if suffix == ".parquet" else open_netcdf)(path, path.name, max_bytes)
    except OSError as error:
        raise InputError(
            f"{str(path)!r} cannot be read: {error.strerror or error}. Check the name and the folder"
        ) from error


def _split(
    table: Table, path: Path, instrument: InstrumentLike, wishes: ReadOptions, needs: Sequence[str]
) -> Devices:
    expects = _Wider(instrument, _further(table, instrument, wishes, needs))
    places = match(table, expected_columns(expects), wishes)
    named = DEVICE in places
    if named:
        labels = load_whole(table, {places[DEVICE]: False})[places[DEVICE]].values
        # The labels are at hand: as a column they would be read, and checked level by level, once more.
        table, wishes = _less(table, places[DEVICE]), _less_wishes(wishes)
    else:
        labels = np.full(table.rows, path.stem, dtype=object)
    codes, levels = pd.factorize(labels)
    if "" in levels:
        where = table.place(int(np.argmax(labels == "")))
        raise InputError(f"{where} of {table.file!r} names no device: fill it in, or remove it")
    order = np.argsort(codes, kind="stable")
    names = tuple(map(str, levels))
    taken = _Taken(_Rows(table), order)
    admitted, rows, refused = _admit_most(taken, codes[order], names, expects, wishes)
    if not rows.size:
        return Devices(names, (), refused)
    codes = codes[order][rows]
    kept = np.flatnonzero(np.bincount(codes, minlength=len(names)))
    block = Block(
        tuple(names[k] for k in kept),
        np.searchsorted(codes, kept, side="right"),
        admitted.values,
        admitted.units,
        output_name(instrument),
        Source(table.file, table.sha256, table.rows),
    )
    if named:
        block.values[DEVICE], block.units[DEVICE] = labels[order][rows], None
    return _without_useless(names, block, refused, instrument)


def _less(table: Table, position: int) -> Table:
    """A table without one of its columns."""
    rest = [i for i in range(len(table.headers)) if i != position]

    def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
        found = table.load({rest[p]: number for p, number in wanted.items()})
        return {p: found[rest[p]] for p in wanted}

    return replace(table, headers=tuple(table.headers[i] for i in rest), load=load)


def _less_wishes(wishes: ReadOptions) -> ReadOptions:
    columns = {ours: theirs for ours, theirs in wishes.columns.items() if ours != DEVICE}
    return replace(wishes, columns=columns)


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
    table: Table, instrument: InstrumentLike, wishes: ReadOptions, needs: Sequence[str]
) -> tuple[Column, ...]:
    """Columns that effects need and the instrument does not know, in their base units."""
    known = expected_columns(instrument)
    headers = {h.name: h for h in table.headers}
    found = []
    for name in needs:
        header = headers.get(wishes.columns.get(name, name))
        if name in known or header is None or (unit := unit_of(header, name, wishes)) is None:
            continue
        found.append(Column(name, base_unit(unit), required=False))
    return tuple(found)


class _Rows:
    """A table's cells, loaded once, from which tables of some of its rows are made."""

    def __init__(self, table: Table) -> None:
        self.table = table
        self.loaded: dict[tuple[int, bool], Cells] = {}

    def _cells(self, position: int, number: bool) -> Cells:
        if (position, number) not in self.loaded:
            self.loaded[position, number] = load_whole(self.table, {position: number})[position]
        return self.loaded[position, number]

    def some(self, position: int, number: bool, rows: np.ndarray) -> Cells:
        cells = self._cells(position, number)
        if cells.bad is None:
            return Cells(cells.values[rows])
        return numbers_of(pd.Series(self._cells(position, False).values[rows], dtype=object))


@dataclass
class _Taken:
    """Some rows of a table, and which of them a refusal spoke of last."""

    of: _Rows
    rows: np.ndarray
    spoken_of: int = -1

    def table(self) -> Table:
        whole = self.of.table

        def place(index: int) -> str:
            self.spoken_of = index
            return whole.place(int(self.rows[index]))

        def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
            return {p: self.of.some(p, number, self.rows) for p, number in wanted.items()}

        return Table(whole.file, whole.headers, len(self.rows), whole.sha256, load, place)


def _admit_most(
    taken: _Taken,
    codes: np.ndarray,
    names: Sequence[str],
    expects: InstrumentLike,
    wishes: ReadOptions,
) -> tuple[ConvertedColumns, np.ndarray, dict[str, str]]:
    """The columns of all devices whose cells can be used, their rows (of those taken), and why the others not.

    Raises:
        InputError: something is wrong that is not in one row.
    """

    def attempt(rows: np.ndarray) -> ConvertedColumns | str:
        part = replace(taken, rows=taken.rows[rows], spoken_of=-1)
        table = part.table()
        try:
            return convert_columns(table, expects, wishes)
        except InputError as error:
            index = part.spoken_of
            if index < 0 or not str(error).startswith(table.place(index)):
                raise  # of the header, not of a row
            return str(error)

    def search(rows: np.ndarray) -> Iterator[tuple[int, str]]:
        """Devices that are refused by themselves; by halves, for they are few."""
        found = attempt(rows)
        if not isinstance(found, str):
            return
        members = np.unique(codes[rows])
        if len(members) == 1:
            yield int(members[0]), found
            return
        left = codes[rows] < members[len(members) // 2]
        yield from search(rows[left])
        yield from search(rows[~left])

    rows = np.arange(len(taken.rows))
    found, bad = attempt(rows), {}
    if isinstance(found, str):
        bad = dict(search(rows))
        rows = rows[~np.isin(codes, list(bad))]
        found = attempt(rows) if rows.size else ConvertedColumns()
    if isinstance(found, str):
        raise InputError(found)
    return found, rows, {names[code]: why for code, why in bad.items()}


def _without_useless(
    names: tuple[str, ...], block: Block, refused: dict[str, str], instrument: InstrumentLike
) -> Devices:
    """Refuse devices with one temperature only, or with time running backwards."""
    bad: dict[int, str] = {}
    needs_temperature = any(c.name == "temperature" and c.required for c in instrument.columns)
    if needs_temperature and "temperature" in block.values:
        values = block.values["temperature"]
        span = np.maximum.reduceat(values, block.starts) - np.minimum.reduceat(values, block.starts)
        for i in np.flatnonzero(span < LEAST_TEMPERATURE_SPAN):
            bad[int(i)] = _message(refuse_one_temperature, block, int(i))
    for i in _backward(block):
        bad.setdefault(i, _message(refuse_backward_time, block, i))
    refused = {**refused, **{block.names[i]: why for i, why in bad.items()}}
    return Devices(names, (without(block, bad),) if len(bad) < len(block.names) else (), refused)


def _message(refuse, block: Block, index: int) -> str:
    rows = slice(int(block.starts[index]), int(block.ends[index]))
    file = f"device {block.names[index]}"
    own = {name: values[rows] for name, values in block.values.items()}
    try:
        if refuse is refuse_one_temperature:
            refuse(own, file)
        else:
            refuse(own, lambda i: f"reading {i + 1} of {file}")
    except InputError as error:
        return str(error)
    return "cannot be used"


def _backward(block: Block) -> list[int]:
    """Devices in which time runs backwards within a run of an axis."""
    if "time" not in block.values:
        return []
    device = np.repeat(np.arange(len(block.names)), block.counts)
    record = device.copy()
    for name in ("run", "axis"):
        if name in block.values:
            codes, levels = pd.factorize(block.values[name])
            record = record * len(levels) + codes
    order = np.argsort(record, kind="stable")
    back = (np.diff(block.values["time"][order]) < 0) & (np.diff(record[order]) == 0)
    return sorted(set(device[order[1:][back]].tolist()))
