"""The devices of a partition: its files opened one by one, a file that cannot be read kept from the others."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayescal._core.atomic_file import sha256_of
from bayescal._core.errors import InputError
from bayescal._fleet.devices import DEVICE, DeviceBlock, Devices, without
from bayescal._fleet.fleet_request import Request
from bayescal._fleet.partitions import Partition, Piece
from bayescal._fleet.row_groups import open_row_groups
from bayescal._fleet.split_devices import open_readings, split_table


@dataclass(frozen=True)
class PartitionReadings:
    """What a partition holds.

    Attributes:
        devices: of all its files.
        unreadable: file → why it cannot be used.
        readings: rows that the devices have.
    """

    devices: Devices
    unreadable: dict[str, str]
    readings: int


def content_digest(partition: Partition, request: Request) -> str:
    """SHA-256 over a partition's bytes and what is done with them; empty where it cannot be read."""
    digest = hashlib.sha256(request.digest.encode())
    for piece in partition.pieces:
        try:
            if piece.groups is None:
                own = sha256_of(piece.path)
            else:
                table = open_row_groups(piece, _device_column(request), request.max_bytes)
                own = "" if table is None else table.sha256
        except (OSError, InputError):
            return ""
        digest.update(f"\n{piece.name} {own}".encode())
    return digest.hexdigest()


def read_partition(
    partition: Partition, request: Request, doubled: Mapping[str, str], dropped: Sequence[str] = ()
) -> PartitionReadings:
    """The devices of a partition.

    Args:
        partition: where they stand.
        request: how they are read.
        doubled: devices that stand in several places, refused with these reasons.
        dropped: devices that are refused elsewhere and do not count here.
    """
    found: list[Devices] = []
    unreadable: dict[str, str] = {}
    for piece in partition.pieces:
        try:
            devices = _devices(piece, request)
        except (InputError, OSError) as error:
            unreadable[piece.name] = str(error)
            continue
        found += [devices] if devices is not None else []
    names = Counter(name for devices in found for name in devices.names)
    twice = {
        name: f"device {name!r} stands in several files of {partition.name!r}: put its readings into one"
        for name, count in names.items()
        if count > 1
    }
    refused = {**{n: why for d in found for n, why in d.refused.items()}, **twice}
    refused |= {name: why for name, why in doubled.items() if name in names}
    out = set(refused) | set(dropped)
    blocks = _joined([block for devices in found for block in _kept(devices.blocks, out)])
    return PartitionReadings(
        Devices(
            tuple(n for n in names if n not in set(dropped)),
            blocks,
            {n: why for n, why in refused.items() if n not in set(dropped)},
        ),
        unreadable,
        sum(int(b.ends[-1]) for b in blocks),
    )


def _device_column(request: Request) -> str:
    return request.options.columns.get(DEVICE, DEVICE)


def _devices(piece: Piece, request: Request) -> Devices | None:
    if piece.groups is None:
        table = open_readings(piece.path, request.options, request.max_bytes)
    else:
        table = open_row_groups(piece, _device_column(request), request.max_bytes)
        if table is None:  # it lies within a device that begins before it
            return None
    instrument = request.model.instrument
    return split_table(table, piece.path.stem, instrument, request.options, request.needs)


def _kept(blocks: Sequence[DeviceBlock], out: set[str]) -> list[DeviceBlock]:
    kept = []
    for block in blocks:
        bad = {i: "" for i, name in enumerate(block.names) if name in out}
        if len(bad) < len(block.names):
            kept.append(without(block, bad))
    return kept


def _joined(blocks: Sequence[DeviceBlock]) -> tuple[DeviceBlock, ...]:
    """Blocks of the same columns as one: thousands of files with a device each are fitted at once."""
    alike: dict[tuple, list[DeviceBlock]] = {}
    for block in blocks:
        alike.setdefault((tuple(block.units.items()), block.output), []).append(block)
    made = []
    for some in alike.values():
        if len(some) == 1:
            made.append(some[0])
            continue
        rows = np.cumsum([0, *(int(b.ends[-1]) for b in some[:-1])])
        made.append(
            replace(
                some[0],
                names=tuple(n for b in some for n in b.names),
                ends=np.concatenate([b.ends + r for b, r in zip(some, rows, strict=True)]),
                values={n: np.concatenate([b.values[n] for b in some]) for n in some[0].values},
                source=None,
            )
        )
    return tuple(made)
