"""Devices that stand in several partitions: each is refused once, and counted once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from bayescal._core.json_shape import parsed_json
from bayescal._fleet.fit_partition import PARTITION
from bayescal._fleet.partitions import Partition


@dataclass(frozen=True)
class Doubled:
    """What a partition has to know of devices that other partitions hold too.

    Attributes:
        refused: device → why; in the first of its partitions.
        dropped: devices that are refused in an earlier partition.
    """

    refused: Mapping[str, str] = field(default_factory=dict)
    dropped: tuple[str, ...] = ()


def doubled_devices(folder: Path, partitions: Sequence[Partition]) -> dict[int, Doubled]:
    """Partition → its devices that stand in others too, after all were fitted by themselves.

    Their readings belong into one file: which of them count, and from where their time runs, cannot be told.
    """
    names = [_names(folder / partition.file) for partition in partitions]
    numbers = [pa.array([i] * len(n), pa.int32()) for i, n in enumerate(names)]
    table = pa.table(
        {
            "device": pa.chunked_array(names, pa.string()),
            "at": pa.chunked_array(numbers, pa.int32()),
        }
    )
    counts = table.group_by("device").aggregate([("at", "count")])
    twice = counts.filter(pc.greater(counts["at_count"], 1))["device"]  # pyright: ignore
    rows = table.filter(pc.is_in(table["device"], value_set=twice)).to_pydict()  # pyright: ignore
    where: dict[str, list[int]] = {}
    for device, at in zip(rows["device"], rows["at"], strict=True):
        where.setdefault(device, []).append(at)
    refused: dict[int, dict[str, str]] = {}
    dropped: dict[int, list[str]] = {}
    for device, places in where.items():
        shown = " and ".join(repr(partitions[i].name) for i in places[:2])
        refused.setdefault(places[0], {})[device] = (
            f"device {device!r} stands in {len(places)} partitions, {shown}: put its readings into one file"
        )
        for i in places[1:]:
            dropped.setdefault(i, []).append(device)
    return {
        i: Doubled(refused.get(i, {}), tuple(sorted(dropped.get(i, []))))
        for i in sorted({*refused, *dropped})
    }


def _names(path: Path) -> pa.Array:
    """The devices of a partition, those left out of its results too."""
    if not path.is_file():
        return pa.array([], pa.string())

    column = pq.read_table(path, columns=["device"])["device"].unique()
    column = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    head = parsed_json((pq.read_schema(path).metadata or {})[b"bayescal"])
    left_out = head["about"][PARTITION]["dropped"]
    return pa.concat_arrays([column, pa.array(left_out, pa.string())])
