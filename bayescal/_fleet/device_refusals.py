"""What is wrong with one device's rows refuses that device alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from bayescal._core.errors import InputError
from bayescal._data.column import ConvertedColumns
from bayescal._data.column_conversion import convert_columns
from bayescal._data.dataset_checks import refuse_backward_time, refuse_one_temperature
from bayescal._data.read_options import InstrumentLike, ReadOptions
from bayescal._data.record_settings import recording
from bayescal._fleet.devices import DeviceBlock, Devices, without
from bayescal._tables.cells import Cells
from bayescal._tables.problems import Problem, Problems
from bayescal._tables.raw_table import Table, load_whole


class TableRows:
    """A table's cells, loaded once, from which tables of some of its rows are made."""

    def __init__(self, table: Table) -> None:
        self.table = table
        self.loaded: dict[tuple[int, bool], Cells] = {}

    def _cells(self, position: int, number: bool) -> Cells:
        if (position, number) not in self.loaded:
            self.loaded[position, number] = load_whole(self.table, {position: number})[position]
        return self.loaded[position, number]

    def some(self, position: int, number: bool, rows: np.ndarray) -> Cells:
        return self._cells(position, number).take(rows)


@dataclass(frozen=True)
class TakenRows:
    """Some rows of a table."""

    of: TableRows
    rows: np.ndarray

    def table(self) -> Table:
        def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
            return {p: self.of.some(p, number, self.rows) for p, number in wanted.items()}

        return replace(self.of.table.take(self.rows), load=load)


def convert_most(
    taken: TakenRows,
    codes: np.ndarray,
    names: Sequence[str],
    instrument: InstrumentLike,
    options: ReadOptions,
) -> tuple[ConvertedColumns, np.ndarray, dict[str, str]]:
    """The columns of all devices whose cells can be used, their rows (of those taken), and why the others not.

    Raises:
        InputError: something is wrong that is not in one row.
    """
    rows, refused = np.arange(len(taken.rows)), dict[str, str]()
    while rows.size:
        problems = Problems()
        table = replace(taken, rows=taken.rows[rows]).table()
        found = convert_columns(table, instrument, options, problems)
        if not problems:
            return found, rows if found.kept is None else rows[found.kept], refused
        Problems(p for p in problems if not p.rows).refuse()
        told: dict[int, Problem] = {}
        for problem in problems:
            for index in problem.rows:
                place = (table.place(index),)
                told.setdefault(
                    int(codes[rows[index]]), replace(problem, rows=(index,), places=place)
                )
        refused |= {names[code]: str(problem) for code, problem in told.items()}
        rows = rows[~np.isin(codes[rows], list(told))]
    return ConvertedColumns(), rows, refused


def without_useless(
    names: tuple[str, ...], block: DeviceBlock, refused: dict[str, str], instrument: InstrumentLike
) -> Devices:
    """Refuse devices with one temperature only, or with time running backwards."""
    bad: dict[int, str] = {}
    needs_temperature = any(c.name == "temperature" and c.required for c in instrument.columns)
    if needs_temperature and "temperature" in block.values:
        values = block.values["temperature"]
        span = np.maximum.reduceat(values, block.starts) - np.minimum.reduceat(values, block.starts)
        for i in np.flatnonzero(span < recording().temperature_span):
            bad[int(i)] = _message(refuse_one_temperature, block, int(i))
    for i in _backward(block):
        bad.setdefault(i, _message(_refuse_time, block, i))
    refused = {**refused, **{block.names[i]: why for i, why in bad.items()}}
    return Devices(names, (without(block, bad),) if len(bad) < len(block.names) else (), refused)


def _message(
    refuse: Callable[[dict[str, np.ndarray], str], None], block: DeviceBlock, index: int
) -> str:
    """What is said of a device that is refused."""
    rows = slice(int(block.starts[index]), int(block.ends[index]))
    own = {name: values[rows] for name, values in block.values.items()}
    try:
        refuse(own, f"device {block.names[index]}")
    except InputError as error:
        return str(error)
    return "cannot be used"


def _refuse_time(own: dict[str, np.ndarray], file: str) -> None:
    refuse_backward_time(own, lambda i: f"reading {i + 1} of {file}")


def _backward(block: DeviceBlock) -> list[int]:
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
