"""Readings of many devices as a few long columns, one device's rows after the other's.

Ten thousand devices are a few arrays here, not ten thousand objects; one device's `Measurements` are made when they
are asked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr

from bayescal._core.errors import InputError
from bayescal._data.column import Source
from bayescal._data.measurements import Measurements
from bayescal._tables.raw_table import ROW

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

    def measurements(self, index: int) -> Measurements:
        """One device's readings."""
        rows = slice(int(self.starts[index]), int(self.ends[index]))
        variables = {}
        for name, column in self.values.items():
            unit, own = self.units[name], column[rows]
            variables[name] = (
                xr.Variable(ROW, own.astype(str))
                if unit is None
                else xr.Variable(ROW, own.astype(np.float64), {"units": unit})
            )
        file = f"device {self.names[index]}"
        if self.source is not None:
            file = f"{self.source.file}, {file}"
        source = Source(file, self.source.sha256 if self.source else "", rows.stop - rows.start)
        return Measurements(xr.Dataset(variables), (source,), (), self.output)


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
        rows = sum(int(block.ends[-1]) for block in self.blocks)
        return f"<{rows} readings of {len(self)} devices, {len(self.refused)} of them refused>"


def without(block: DeviceBlock, bad: Mapping[int, str]) -> DeviceBlock:
    """A block without some of its devices."""
    if not bad:
        return block
    keep = np.array([i not in bad for i in range(len(block.names))])
    rows = np.repeat(keep, block.counts)
    return replace(
        block,
        names=tuple(n for n, k in zip(block.names, keep, strict=True) if k),
        ends=np.cumsum(block.counts[keep]),
        values={name: values[rows] for name, values in block.values.items()},
    )


def gathered(
    readings: Sequence[Measurements] | Mapping[str, Measurements],
) -> Devices:
    """Devices from measurements, named by their key, by their label of column `device`, or by their place."""
    if isinstance(readings, Mapping):
        names, given = [str(n) for n in readings], list(readings.values())
    else:
        given = list(readings)
        names = [_label(one, i) for i, one in enumerate(given)]
        if len(set(names)) < len(names):
            names = [str(i + 1) for i in range(len(given))]
    alike: dict[tuple, list[int]] = {}
    for i, one in enumerate(given):
        kind = tuple((n, one.unit(n)) for n in one.columns), one.output
        alike.setdefault(kind, []).append(i)
    blocks, refused = [], {}
    for (columns, output), members in alike.items():
        values = {n: np.concatenate([given[i][n] for i in members]) for n, _ in columns}
        ends = np.cumsum([len(given[i]) for i in members])
        block = DeviceBlock(
            names=tuple(names[i] for i in members),
            ends=ends,
            values=values,
            units=dict(columns),
            output=output,
        )
        bad = _not_finite(block)
        refused |= {block.names[i]: why for i, why in bad.items()}
        if len(bad) < len(members):
            blocks.append(without(block, bad))
    return Devices(tuple(names), tuple(blocks), refused)


def _label(one: Measurements, index: int) -> str:
    levels = one.groups(DEVICE)[0] if one.has(DEVICE) else ()
    return levels[0] if len(levels) == 1 else str(index + 1)


def _not_finite(block: DeviceBlock) -> dict[int, str]:
    """Devices with a number that is none (arrays made by hand are not checked at any door)."""
    bad: dict[int, str] = {}
    for name, values in block.values.items():
        if block.units[name] is None or name == "temperature_point":
            continue
        wrong = np.flatnonzero(~np.isfinite(values))
        for row in wrong[::-1]:
            i = int(np.searchsorted(block.ends, row, side="right"))
            bad[i] = (
                f"reading {row - block.starts[i] + 1} of device {block.names[i]}, column {name!r}: reads "
                f"{values[row]:g}, a number was expected. Fill it in, or remove the reading"
            )
    return bad
