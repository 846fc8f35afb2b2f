"""Readings of many devices as a few long columns, one device's rows after the other's; files split into them.

Ten thousand devices are a few arrays here, not ten thousand objects; one device's `Measurements` are made when they
are asked for. What is wrong with one device's rows in a file refuses that device alone.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bayescal import Column, InputError, Measurements
from bayescal._data.column import ConvertedColumns, Place, Source
from bayescal._data.column_conversion import convert_columns
from bayescal._data.dataset_checks import backward_time, same_temperature
from bayescal._data.header_matching import MatchedFile
from bayescal._data.read_options import (
    ExpectedColumns,
    InstrumentLike,
    output_name,
    unit_of,
    unused_options,
)
from bayescal._tables.cells import Cells
from bayescal._tables.open_table import MAX_BYTES
from bayescal._tables.raw_table import Table, load_whole
from bayescal.workshop import Objections, ReadOptions, base_unit, expected_columns, open_table

DEVICE = "device"


@dataclass(frozen=True, eq=False)
class DeviceBlock:
    """Devices whose readings have the same columns, one after the other.

    Attributes:
        names: of the devices.
        ends: index past each device's last row.
        values: columns of all rows.
        units: of the columns; None for labels.
        output: name of the output column.
        source: the file that they came from, if any.
    """

    names: tuple[str, ...]
    ends: np.ndarray
    values: dict[str, np.ndarray]
    units: dict[str, str | None]
    output: str = "output"
    source: Source | None = None

    @property
    def starts(self) -> np.ndarray:
        return np.concatenate([[0], self.ends[:-1]])

    @property
    def counts(self) -> np.ndarray:
        """Readings of each device."""
        return self.ends - self.starts

    @property
    def temperatures(self) -> list[str]:
        """Columns of measured temperatures, whose mean is a reference of the bases."""
        return [n for n, unit in self.units.items() if unit == "degC" and n != "temperature_point"]

    def columns(self, index: int) -> dict[str, np.ndarray]:
        """The columns of one device."""
        rows = slice(int(self.starts[index]), int(self.ends[index]))
        return {name: values[rows] for name, values in self.values.items()}

    def measurements(self, index: int) -> Measurements:
        """One device's readings."""
        file, sha256 = f"device {self.names[index]}", ""
        if self.source is not None:
            file, sha256 = f"{self.source.file}, {file}", self.source.sha256
        source = Source(file, sha256, int(self.counts[index]))
        return Measurements(self.columns(index), self.units, (source,), output=self.output)

    def some(self, keep: np.ndarray) -> DeviceBlock:
        """The devices where `keep` is true."""
        if keep.all():
            return self
        rows = np.repeat(keep, self.counts)
        return replace(
            self,
            names=tuple(n for n, k in zip(self.names, keep, strict=True) if k),
            ends=np.cumsum(self.counts[keep]),
            values={name: values[rows] for name, values in self.values.items()},
        )


@dataclass(frozen=True, eq=False)
class Devices:
    """Readings of many devices of one type.

    `devices["A17"]` is one device's `Measurements`; iterating gives them one at a time.

    Attributes:
        names: of all devices, in order of appearance, refused ones too.
        blocks: the readings of those that were let in.
        refused: name → why its rows cannot be used.
    """

    names: tuple[str, ...]
    blocks: tuple[DeviceBlock, ...]
    refused: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, name: str) -> Measurements:
        """One device's readings.

        Raises:
            InputError: no device is called so, or it was refused.
        """
        if name in self.refused:
            raise InputError(f"device {name!r} was refused: {self.refused[name]}")
        for block in self.blocks:
            if name in block.names:
                return block.measurements(block.names.index(name))
        shown = ", ".join(self.names[:5])
        raise InputError(f"no device is called {name!r}; there are {len(self)}: {shown} …")

    def __iter__(self) -> Iterator[Measurements]:
        for block in self.blocks:
            for i in range(len(block.names)):
                yield block.measurements(i)

    def __repr__(self) -> str:
        return f"<{self.readings} readings of {len(self)} devices, {len(self.refused)} of them refused>"

    @classmethod
    def together(cls, some: Sequence[Devices]) -> Devices:
        """Devices of several files."""
        names = dict.fromkeys(name for devices in some for name in devices.names)
        blocks = tuple(block for devices in some for block in devices.blocks)
        return cls(tuple(names), blocks, {n: why for d in some for n, why in d.refused.items()})

    @property
    def readings(self) -> int:
        """Readings of the devices that were let in."""
        return sum(int(block.ends[-1]) for block in self.blocks)

    def without(self, names: Collection[str]) -> Devices:
        """All devices but these."""
        if not names:
            return self
        kept = [(b, np.array([n not in names for n in b.names])) for b in self.blocks]
        return Devices(
            tuple(n for n in self.names if n not in names),
            tuple(block.some(keep) for block, keep in kept if keep.any()),
            {n: why for n, why in self.refused.items() if n not in names},
        )

    def refusing(self, why: Mapping[str, str]) -> Devices:
        """The same devices, some of them refused for these reasons."""
        why = {name: why[name] for name in self.names if name in why}
        return replace(self, blocks=self.without(why).blocks, refused=self.refused | why)


def gathered(readings: Sequence[Measurements] | Mapping[str, Measurements]) -> Devices:
    """Devices from measurements, named by their key, by their label of column `device`, or by their place."""
    if isinstance(readings, Mapping):
        names, given = [str(n) for n in readings], list(readings.values())
    else:
        given = list(readings)
        names = [_label(one, i) for i, one in enumerate(given)]
        if len(set(names)) < len(names):
            names = [str(i + 1) for i in range(len(given))]
    blocks = joined(
        DeviceBlock(
            names=(name,),
            ends=np.array([len(one)]),
            values={n: one[n] for n in one.columns},
            units={n: one.unit(n) for n in one.columns},
            output=one.output,
        )
        for name, one in zip(names, given, strict=True)
    )
    bad = {name: why for block in blocks for name, why in _not_finite(block).items()}
    return Devices(tuple(names), blocks).refusing(bad)


def joined(blocks: Iterable[DeviceBlock]) -> tuple[DeviceBlock, ...]:
    """Blocks of the same columns as one: thousands of files with a device each are fitted at once."""
    alike: dict[tuple, list[DeviceBlock]] = {}
    for block in blocks:
        alike.setdefault((*block.units.items(), block.output), []).append(block)
    return tuple(
        some[0]
        if len(some) == 1
        else replace(
            some[0],
            names=tuple(n for block in some for n in block.names),
            ends=np.cumsum(np.concatenate([block.counts for block in some])),
            values={n: np.concatenate([b.values[n] for b in some]) for n in some[0].values},
            source=None,
        )
        for some in alike.values()
    )


def _label(one: Measurements, index: int) -> str:
    levels = one.groups(DEVICE)[0] if one.has(DEVICE) else ()
    return levels[0] if len(levels) == 1 else str(index + 1)


def _not_finite(block: DeviceBlock) -> dict[str, str]:
    """Devices with a number that is none, and where (arrays made by hand were checked by no file reader)."""
    bad: dict[str, str] = {}
    for column, values in block.values.items():
        if block.units[column] is None or column == "temperature_point":
            continue
        for row in np.flatnonzero(~np.isfinite(values))[::-1]:
            i = int(np.searchsorted(block.ends, row, side="right"))
            bad[block.names[i]] = (
                f"reading {row - block.starts[i] + 1} of device {block.names[i]}, column {column!r}: reads "
                f"{values[row]:g}, a number was expected. Fill it in, or remove the reading"
            )
    return bad


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
    return open_table(path, path.name, max_bytes, options.decimal, options.headers)


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
    problems, options = Objections(table.problems), options.of_file(table)
    unused_options([table], options, problems)
    problems.refuse()
    further = _further(table, instrument, options, needs)
    output = output_name(instrument)
    expects = ExpectedColumns(
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
        problems, some = Objections(), table.take(rows)
        converted = convert_columns(some, instrument, options, problems)
        if not problems:
            return converted, rows if converted.kept is None else rows[converted.kept], refused
        Objections(p for p in problems if not p.rows).refuse()
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
    need = any(c.name == "temperature" and c.required for c in instrument.columns)
    need, refused = need and "temperature" in block.values, dict[str, str]()
    for i, name in enumerate(block.names):
        columns, file = block.columns(i), f"device {name}"
        problems = [*same_temperature(columns, file)] if need else []
        problems += backward_time(columns, lambda row, file=file: Place(f"reading {row + 1}", file))
        if problems:
            refused[name] = str(problems[0])
    return refused
