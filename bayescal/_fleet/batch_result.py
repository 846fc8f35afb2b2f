"""What a batch gives: for each device its unknowns, their covariance and a verdict, as a few arrays and as a table."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from bayescal._core.atomic_file import replacing_for_user
from bayescal._core.errors import InputError
from bayescal._fleet.device_result import BatchPart, DeviceResult
from bayescal._fleet.population import Population

SCHEMA = "bayescal.batch/1"
AGAIN = "Take a copy, or run the batch again"
SHOWN = 10  # devices that are named in print when they cannot be trusted
COLUMNS = ("device", "coefficient", "mean", "sd", "unit", "ok", "reason")
POPULATION = ("coefficient", "mean", "mean_sd", "spread", "spread_sd", "unit")


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Fits of many devices. `result["A17"]` or `result[3]` is one device's; `table()` is all of them.

    Attributes:
        devices: names, in the order in which they came.
        ok: whether each result is reliable, (devices,).
        reasons: why not; empty where nothing stands against it.
        parts: the numbers, devices with the same unknowns together.
        population: what the devices have in common, if it was asked for.
        about: instrument, effects, method, seed and notes.
    """

    devices: tuple[str, ...]
    ok: np.ndarray
    reasons: tuple[str, ...]
    parts: tuple[BatchPart, ...]
    population: Population | None
    about: dict[str, Any]

    def __len__(self) -> int:
        return len(self.devices)

    def __iter__(self) -> Iterator[DeviceResult]:
        return (self[i] for i in range(len(self)))

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.devices)}

    @cached_property
    def _where(self) -> dict[int, tuple[int, int]]:
        """Place in the batch → part, and place in it."""
        return {
            int(d): (p, i) for p, part in enumerate(self.parts) for i, d in enumerate(part.devices)
        }

    def __getitem__(self, device: str | int) -> DeviceResult:
        """One device's result, by its name or by its place.

        Raises:
            InputError: there is no such device.
        """
        at = self._places.get(device) if isinstance(device, str) else device
        if at is None or not -len(self) <= at < len(self):
            shown = ", ".join(self.devices[:5])
            raise InputError(f"there is no device {device!r} among the {len(self)}: {shown} …")
        at %= len(self)
        found = partial(DeviceResult, self.devices[at], bool(self.ok[at]), self.reasons[at])
        if at not in self._where:
            return found(names=(), units=(), mean=np.zeros(0), covariance=np.zeros((0, 0)))
        p, i = self._where[at]
        part = self.parts[p]
        return found(
            names=part.names,
            units=part.units,
            mean=part.mean[i],
            covariance=part.covariance[i],
        )

    def table(self) -> pd.DataFrame:
        """One row for each device and unknown: device, coefficient, mean, sd, unit, ok, reason.

        A device that was refused has one row without a coefficient. Devices in the order in which they came.
        """
        return self._long(covariance=False)

    def _long(self, covariance: bool) -> pd.DataFrame:
        names = np.array(self.devices, dtype=object)
        reasons = np.array(self.reasons, dtype=object)
        refused = np.array([i for i in range(len(self)) if i not in self._where], dtype=int)
        pieces, places = [], []
        for part in self.parts:
            q = len(part.names)
            at = np.repeat(part.devices, q)
            piece = {
                "device": names[at],
                "coefficient": np.tile(np.array(part.names, dtype=object), len(part.devices)),
                "mean": part.mean.ravel(),
                "sd": part.sd.ravel(),
                "unit": np.tile(np.array(part.units, dtype=object), len(part.devices)),
                "ok": self.ok[at],
                "reason": reasons[at],
            }
            if covariance:
                piece["covariance"] = list(part.covariance.reshape(-1, q))
            pieces.append(pd.DataFrame(piece))
            places.append(at)
        none = {"coefficient": None, "mean": np.nan, "sd": np.nan, "unit": None, "ok": False}
        empty = pd.DataFrame(
            {"device": names[refused], **none, "reason": reasons[refused]}, columns=list(COLUMNS)
        )
        if covariance:
            empty["covariance"] = None
        if len(refused) or not pieces:
            pieces.append(empty)
            places.append(refused)
        order = np.argsort(np.concatenate(places), kind="stable")
        return pd.concat(pieces, ignore_index=True).iloc[order].reset_index(drop=True)

    def save(self, path: str | Path) -> Path:
        """Write the table to Parquet, with each unknown's row of the covariance. `load_batch` reads it back.

        Raises:
            InputError: another suffix, or a place that cannot be written to.
        """
        path = Path(path)
        if path.suffix != ".parquet":
            raise InputError(
                f"a batch is saved as Parquet: name the file ….parquet, not {path.name!r}"
            )
        long = self._long(covariance=True)
        kinds = [pa.string(), pa.string(), pa.float64(), pa.float64(), pa.string(), pa.bool_()]
        kinds += [pa.string(), pa.list_(pa.float64())]
        head = json.dumps(
            {"schema": SCHEMA, "about": self.about, "population": _told(self.population)}
        )
        fields = [pa.field(n, k) for n, k in zip((*COLUMNS, "covariance"), kinds, strict=True)]
        schema = pa.schema(fields)
        columns = [
            pa.array(long[f.name].tolist() if f.name == "covariance" else long[f.name], type=f.type)
            if f.name not in ("mean", "sd")
            else pa.array(long[f.name].to_numpy(np.float64), type=f.type)  # NaN stays NaN
            for f in fields
        ]
        table = pa.Table.from_arrays(columns, schema=schema)
        sealed = {"bayescal": head, "bayescal_sha256": _digest(table, head.encode())}
        with replacing_for_user(path) as partial:
            pq.write_table(table.replace_schema_metadata(sealed), partial, write_page_checksum=True)
        return path

    def __str__(self) -> str:
        bad = np.flatnonzero(~self.ok)
        lines = [f"{len(self)} devices, {len(self) - len(bad)} reliable ({self.about['method']})"]
        lines += [f"  {self.devices[i]}: {self.reasons[i]}" for i in bad[:SHOWN]]
        lines += [f"  … and {len(bad) - SHOWN} more"] if len(bad) > SHOWN else []
        for part in self.parts:
            good = self.ok[part.devices]
            if not good.any():
                continue
            rows = {
                "coefficient": part.names,
                "median": np.median(part.mean[good], axis=0),
                "between devices": part.mean[good].std(axis=0),
                "typical sd": np.median(part.sd[good], axis=0),
                "unit": part.units,
            }
            lines.append(
                pd.DataFrame(rows).to_string(index=False, float_format=lambda v: f"{v:.4g}")
            )
        return "\n".join([*lines, *([str(self.population)] if self.population else [])])


def _told(population: Population | None) -> dict[str, Any] | None:
    if population is None:
        return None
    return {
        "table": population.table.to_dict("list"),
        "ok": population.ok,
        "reason": population.reason,
        "devices": population.devices,
        "pareto_k": population.pareto_k,
    }


def _digest(table: pa.Table, head: bytes) -> str:
    """SHA-256 over what a batch says of itself and every value of its table, however Parquet lays them out."""
    digest = hashlib.sha256(head)
    for name in (*COLUMNS, "covariance"):
        column = table.column(name).combine_chunks()
        digest.update(f"\n{name} {len(column)}\n".encode())
        if name == "covariance":
            digest.update(json.dumps(column.value_lengths().to_pylist()).encode())
            column = column.flatten()
        numbers = pa.types.is_floating(column.type) and not column.null_count
        digest.update(
            column.to_numpy().tobytes() if numbers else json.dumps(column.to_pylist()).encode()
        )
    return digest.hexdigest()


def load_batch(path: str | Path) -> BatchResult:
    """Read a saved batch back.

    Raises:
        InputError: there is no such file, it is no batch of this version, or it is damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"There is no file {path}: give a batch saved by bayescal")
    try:
        table = pq.read_table(path, page_checksum_verification=True)
        about = table.schema.metadata or {}
        text, seal = about[b"bayescal"], about[b"bayescal_sha256"]
        head = json.loads(text)
        if head["schema"] != SCHEMA:
            raise KeyError(head["schema"])
        whole = _digest(table, text).encode() == seal
    except Exception as error:  # whatever a damaged file makes Arrow raise
        raise InputError(
            f"{path.name} is no batch of this version, or a damaged one ({type(error).__name__}). {AGAIN}"
        ) from None
    if not whole:
        raise InputError(
            f"{path.name} is damaged: its values do not have the checksum that it states. {AGAIN}"
        )
    columns = {name: table.column(name).to_numpy() for name in (*COLUMNS, "covariance")}
    codes, names = pd.factorize(columns["device"])
    starts = np.searchsorted(codes, np.arange(len(names)))
    try:
        parts = _parts(columns, [*starts, len(codes)])
        told = head["population"]
        if told is not None:
            told = Population(pd.DataFrame(told.pop("table"), columns=list(POPULATION)), **told)
        return BatchResult(
            devices=tuple(map(str, names)),
            ok=columns["ok"][starts].astype(bool),
            reasons=tuple(columns["reason"][starts]),
            parts=parts,
            population=told,
            about=head["about"],
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path.name} was changed after it was saved: {error}. {AGAIN}") from None


def _parts(columns: dict[str, np.ndarray], starts: list[int]) -> tuple[BatchPart, ...]:
    """Devices with the same unknowns together; each device's rows begin at its start.

    Raises:
        ValueError: a device's covariance is not of the size of its unknowns.
    """
    alike: dict[tuple, list[int]] = {}
    for d, (begin, end) in enumerate(pairwise(starts)):
        if columns["coefficient"][begin] is not None:
            kind = (tuple(columns["coefficient"][begin:end]), tuple(columns["unit"][begin:end]))
            alike.setdefault(kind, []).append(d)
    parts = []
    for (own, units), devices in alike.items():
        rows = np.array(starts)[devices][:, None] + np.arange(len(own))
        covariance = np.stack([np.stack(list(columns["covariance"][r])) for r in rows])
        if covariance.shape[1:] != (len(own), len(own)):
            raise ValueError(
                f"the covariance of device {columns['device'][rows[0, 0]]!r} is {covariance.shape[1:]}, it has "
                f"{len(own)} unknowns"
            )
        parts.append(
            BatchPart(
                devices=np.array(devices),
                names=own,
                units=units,
                mean=columns["mean"][rows],
                covariance=covariance,
            )
        )
    return tuple(parts)
