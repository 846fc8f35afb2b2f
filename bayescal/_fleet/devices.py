"""Readings of many devices as a few long columns, one device's rows after the other's.

Ten thousand devices are a few arrays here, not ten thousand objects; one device's `Measurements` are made when they
are asked for.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
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
        variables = {
            name: xr.Variable(ROW, own.astype(str))
            if self.units[name] is None
            else xr.Variable(ROW, own.astype(np.float64), {"units": self.units[name]})
            for name, own in self.columns(index).items()
        }
        file, sha256 = f"device {self.names[index]}", ""
        if self.source is not None:
            file, sha256 = f"{self.source.file}, {file}", self.source.sha256
        source = Source(file, sha256, int(self.counts[index]))
        return Measurements(xr.Dataset(variables), (source,), (), self.output)

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
