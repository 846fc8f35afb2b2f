"""What a batch or a fleet gives: for each device its unknowns, their covariance and a verdict, as arrays and a table.

A fleet is a folder of Parquet files, one for each partition, and `fleet.json` of the whole.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.dataset as pads
import pyarrow.parquet as pq

from bayescal import InputError
from bayescal._annexes.fleet.odd_devices import FAMILY_WISE_ERROR
from bayescal._annexes.fleet.population import Population
from bayescal.workshop import as_json, parsed_json, read_json, replacing_for_user, write_json

FORMAT = "bayescal.batch/1"
AGAIN = "Take a copy, or run the batch again"
SHOWN_DEVICES = 10  # devices, files that are named in print
SHOWN_ALIKE = 3  # of those of which the same is said
SCHEMA = pa.schema(
    [
        ("device", pa.string()),
        ("coefficient", pa.string()),
        ("mean", pa.float64()),
        ("sd", pa.float64()),
        ("unit", pa.string()),
        ("ok", pa.bool_()),
        ("reason", pa.string()),
        ("covariance", pa.list_(pa.float64())),
    ]
)
COLUMNS = tuple(SCHEMA.names[:-1])  # of the table that a user sees


def first_few(items: Mapping[str, str], total: int, head: str = "", more: str = "") -> list[str]:
    """Names and what is said of them, the first ten; then how many more there are. What is the same of several is said
    once, what is said of the most first."""
    alike: dict[str, list[str]] = {}
    for name, why in items.items():
        key = why.replace(repr(name), "").replace(f"device {name}", "")
        alike.setdefault(key, []).append(name)
    shown = sorted(alike.values(), key=len, reverse=True)[:SHOWN_DEVICES]
    lines = []
    for names in shown:
        others = f" and {len(names) - SHOWN_ALIKE} more" * (len(names) > SHOWN_ALIKE)
        lines.append(f"  {head}{', '.join(names[:SHOWN_ALIKE])}{others}: {items[names[0]]}")
    rest = total - sum(map(len, shown))
    return [*lines, f"  … and {rest} more{more}"] if rest > 0 else lines


def printed(table: pd.DataFrame, digits: int) -> str:
    """A table with so many significant digits; a curve in one line, its rms amplitude."""
    if "coefficient" in table:
        of_curve = table["coefficient"].str.extract(_OF_CURVE, expand=True)
        amplitudes = {*of_curve[0][of_curve[1].eq(".amplitude")]}
        shown = ~of_curve[0].isin(amplitudes) | of_curve[1].eq(".amplitude")
        names = table["coefficient"].str.replace(_AMPLITUDE, r"\1, a curve (rms)", regex=True)
        table = table.assign(coefficient=names).loc[shown]
    return table.to_string(index=False, float_format=lambda v: f"{v:.{digits}g}")


# Of a curve: its coefficients, and how long and how large it is.
_OF_CURVE = re.compile(r"^(unknown\(.*\))(\[\d+\]|\.length|\.amplitude)$", re.DOTALL)
_AMPLITUDE = re.compile(r"^(unknown\(.*\))\.amplitude$", re.DOTALL)


def odd_in_words(odd: Mapping[str, list[str]], devices: int) -> list[str]:
    """Devices that are not like the others, a line each; nothing where there are none."""
    told = {name: "; ".join(said) for name, said in odd.items()}
    head = [
        f"{len(odd)} of {devices} devices are not like the others (by chance in {FAMILY_WISE_ERROR:.0%} of fleets):"
    ]
    head = head if odd else []
    return head + first_few(told, len(told), more=f", all in {WHOLE}")


NOT_CHECKED = "fitted is not checked: what the model lacks was looked for in none of them (--find, in Python find=True)"


@dataclass(frozen=True, eq=False)
class BatchPart:
    """Devices that have the same unknowns.

    Attributes:
        devices: their places in the batch.
        names, units: of the unknowns.
        mean: (b, q), in these units.
        covariance: (b, q, q); NaN for what is held at its estimate (standard deviations, by least squares).
    """

    devices: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray

    @property
    def sd(self) -> np.ndarray:
        """Standard uncertainties, (b, q)."""
        variance = np.diagonal(self.covariance, axis1=1, axis2=2)
        return np.sqrt(np.where(variance >= 0, variance, np.nan))


@dataclass(frozen=True, eq=False)
class DeviceResult:
    """One device of a batch.

    Attributes:
        device: its name.
        ok: whether its fit is to be relied on; what the model lacks is another question.
        reason: why not: a refusal, or what the fit did not reach; empty if nothing.
        names, units: of its unknowns; none if it was refused.
        mean: (q,), in these units.
        covariance: (q, q).
    """

    device: str
    ok: bool
    reason: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray

    @property
    def sd(self) -> np.ndarray:
        """Standard uncertainties, (q,)."""
        return np.sqrt(np.diag(self.covariance))

    def __getitem__(self, name: str) -> tuple[float, float]:
        """Mean and standard uncertainty of one unknown.

        Raises:
            InputError: nothing is called so.
        """
        if name not in self.names:
            raise InputError(
                f"device {self.device!r} has no unknown {name!r}; it has: {', '.join(self.names) or 'none'}"
                f"{' (' + self.reason + ')' if self.reason else ''}"
            )
        i = self.names.index(name)
        return float(self.mean[i]), float(self.sd[i])

    def __str__(self) -> str:
        head = f"device {self.device}: {'ok' if self.ok else self.reason}"
        known = [("" if np.isnan(s) else f" ± {s:.2g}") for s in self.sd]
        rows = zip(self.names, self.mean, known, self.units, strict=True)
        return "\n".join([head, *(f"  {n} = {m:.6g}{s} {u}" for n, m, s, u in rows)])


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Fits of many devices. `result["A17"]` or `result[3]` is one device's; `table()` is all of them.

    Attributes:
        devices: names, in the order in which they came.
        ok: whether each fit is to be relied on, (devices,); what the model lacks is another question.
        reasons: why not; empty where nothing stands against it.
        parts: the numbers, devices with the same unknowns together.
        population: what the devices have in common, if it was asked for.
        about: instrument, effects, method, seed and notes.
        facts: by device, how many readings were fitted, and their T0, °C; NaN where that is not known.
        odd: devices that are not like the others, and in what; of a partition of a fleet it is not asked.
    """

    devices: tuple[str, ...]
    ok: np.ndarray
    reasons: tuple[str, ...]
    parts: tuple[BatchPart, ...]
    population: Population | None
    about: dict[str, Any]
    facts: pd.DataFrame
    odd: dict[str, list[str]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.devices)

    def __iter__(self) -> Iterator[DeviceResult]:
        return (self[i] for i in range(len(self)))

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.devices)}

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
        own = self.devices[at], bool(self.ok[at]), self.reasons[at]
        for part in self.parts:
            for i in np.flatnonzero(part.devices == at):
                return DeviceResult(*own, part.names, part.units, part.mean[i], part.covariance[i])
        return DeviceResult(*own, (), (), np.zeros(0), np.zeros((0, 0)))

    def table(self) -> pd.DataFrame:
        """One row for each device and unknown: device, coefficient, mean, sd, unit, ok, reason.

        A device that was refused has one row without a coefficient. Devices in the order in which they came.
        """
        return self.rows().select(COLUMNS).to_pandas()

    def rows(self) -> pa.Table:
        """The table as it is saved, with each unknown's row of the covariance."""
        devices, reasons = (pa.array(own, pa.string()) for own in (self.devices, self.reasons))

        def rows(at: np.ndarray, names: Any, mean: Any, sd: Any, units: Any, rest: Any) -> pa.Table:
            whose = pa.array(at)
            said = (names, mean, sd, units, self.ok[at], reasons.take(whose), rest)
            return pa.table([devices.take(whose), *said], schema=SCHEMA)

        fitted = np.concatenate([np.zeros(0, int), *(part.devices for part in self.parts)])
        refused = np.setdiff1d(np.arange(len(self)), fitted)
        nothing, no_name = np.full(len(refused), np.nan), pa.nulls(len(refused), pa.string())
        no_row = pa.nulls(len(refused), SCHEMA.field("covariance").type)
        places = [refused]
        tables = [rows(refused, no_name, nothing, nothing, no_name, no_row)]
        for part in self.parts:
            b, q = part.mean.shape
            ends = np.arange(0, b * q * q + 1, q, dtype=np.int32)
            covariance = pa.ListArray.from_arrays(ends, part.covariance.ravel())
            names, units = (pa.array(own * b, pa.string()) for own in (part.names, part.units))
            places.append(np.repeat(part.devices, q))
            numbers = names, part.mean.ravel(), part.sd.ravel(), units, covariance
            tables.append(rows(places[-1], *numbers))
        return pa.concat_tables(tables).take(np.argsort(np.concatenate(places), kind="stable"))

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
        table, population = self.rows(), self.population and self.population.data()
        facts = {name: self.facts[name].tolist() for name in self.facts}
        told = {"about": self.about, "population": population, "facts": facts, "odd": self.odd}
        head = json.dumps(as_json({"schema": FORMAT, **told}), allow_nan=False)
        sealed = {"bayescal": head, "bayescal_sha256": _digest(table, head.encode())}
        with replacing_for_user(path) as partial:
            pq.write_table(table.replace_schema_metadata(sealed), partial, write_page_checksum=True)
        return path

    def __str__(self) -> str:
        bad = np.flatnonzero(~self.ok)
        lines = [f"{len(self)} devices, {len(self) - len(bad)} fitted ({self.about['method']})"]
        lines += first_few({self.devices[i]: self.reasons[i] for i in bad}, len(bad))
        lines += [NOT_CHECKED, *odd_in_words(self.odd, len(self))]
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
            lines.append(printed(pd.DataFrame(rows), 4))
        return "\n".join([*lines, *([str(self.population)] if self.population else [])])


def _digest(table: pa.Table, head: bytes) -> str:
    """SHA-256 over what a batch says of itself and every value of its table, however Parquet lays them out."""
    digest = hashlib.sha256(head)
    for name in SCHEMA.names:
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
        head = parsed_json(text)
        if head["schema"] != FORMAT:
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
    columns = {name: table.column(name).to_numpy() for name in SCHEMA.names}
    codes, names = pd.factorize(columns["device"])
    starts = np.searchsorted(codes, np.arange(len(names)))
    try:
        population, devices = head["population"], tuple(map(str, names))
        return BatchResult(
            devices=devices,
            ok=columns["ok"][starts].astype(bool),
            reasons=tuple(columns["reason"][starts]),
            parts=_parts(columns, [*starts, len(codes)]),
            population=population and Population.of_data(population),
            about=head["about"],
            facts=facts_of(devices, head.get("facts", {})),
            odd=head.get("odd", {}),
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path.name} was changed after it was saved: {error}. {AGAIN}") from None


def facts_of(devices: Sequence[str], known: Mapping[str, Sequence[float | None]]) -> pd.DataFrame:
    """Of each device, how many readings and about which temperature; NaN where that is not known."""
    return pd.DataFrame(known, list(devices), ["readings", "T0"], dtype=float)


def _parts(columns: dict[str, np.ndarray], starts: list[int]) -> tuple[BatchPart, ...]:
    """Devices with the same unknowns together; each device's rows begin at its start. ValueError: of unequal sizes."""
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
        parts.append(BatchPart(np.array(devices), own, units, columns["mean"][rows], covariance))
    return tuple(parts)


FLEET_FORMAT = "bayescal.fleet/1"
WHOLE = "fleet.json"
ALONE = "devices"  # folder of each device's own results
POOLED = "pooled"  # and of those under the population
EFFECTS = ["effect", "devices", "possible", "in fleet", "expected", "share", "low", "high"]


@dataclass(frozen=True, eq=False)
class FleetResult:
    """Fits of more devices than one process holds. `result["A17"]` is one device's; the rest stays on disk.

    Attributes:
        folder: of the results.
        devices, fitted, checked, readings: how many; fitted are devices whose fit is to be relied on, checked those in
            which it was looked for what the model lacks (`find`).
        doubted: some devices whose fit is not to be relied on, and why.
        missing: file → why its devices are not among the results; the same call goes on from there.
        odd: devices that are not like the others, and in what.
        table: one row a coefficient: mean over the devices that are fitted, standard deviation between them, typical
            (root mean square) standard uncertainty, unit.
        population: what the devices have in common, if it was asked for.
        effects: where effects were looked for, one row an effect, as `shares.effects_table` says; else no rows.
        about: instrument, effects, method, seed, versions, partitions and what they took.
        left_out: what stands in folders of readings and was not read → why.
    """

    folder: Path
    devices: int
    fitted: int
    checked: int
    readings: int
    doubted: dict[str, str]
    missing: dict[str, str]
    odd: dict[str, list[str]]
    table: pd.DataFrame
    population: Population | None
    effects: pd.DataFrame
    about: dict[str, Any]
    left_out: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return self.devices

    @property
    def files(self) -> Path:
        """The folder of the Parquet dataset: device, coefficient, mean, sd, unit, ok, reason, covariance."""
        return self.folder / (POOLED if self.population is not None else ALONE)

    def dataset(self) -> pads.FileSystemDataset:
        """All rows as a dataset of pyarrow, which reads them in pieces."""
        return pads.dataset(self.files, format="parquet")

    def rows(self) -> pd.DataFrame:
        """All rows, as `BatchResult.table` has them: a million devices take a gigabyte."""
        return self.dataset().to_table(columns=list(COLUMNS)).to_pandas()

    def __getitem__(self, device: str) -> DeviceResult:
        """One device's result.

        Raises:
            InputError: there is no such device.
        """
        wanted = pads.field("device") == device
        for piece in self.dataset().get_fragments():
            if piece.count_rows(filter=wanted):
                return load_batch(piece.path)[device]
        raise InputError(f"there is no device {device!r} among the {self.devices} of {self.folder}")

    def data(self) -> dict[str, Any]:
        """Plain data."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        del plain["folder"], plain["table"]
        return {
            "schema": FLEET_FORMAT,
            **plain,
            "coefficients": self.table.to_dict("records"),
            "population": self.population and self.population.data(),
            "effects": self.effects.to_dict("records"),
        }

    def save(self) -> Path:
        """Write `fleet.json` beside the partitions.

        Raises:
            InputError: it cannot be written.
        """
        return write_json(as_json(self.data()), self.folder / WHOLE, indent=1)

    def __str__(self) -> str:
        lines = [f"{self.devices} devices, {self.fitted} fitted ({self.about['method']})"]
        lines += first_few(self.doubted, self.devices - self.fitted)
        lines += [
            f"{self.checked} checked for what their model lacks" if self.checked else NOT_CHECKED
        ]
        lines += odd_in_words(self.odd, self.devices)
        lines += first_few(self.missing, len(self.missing), "no results of ", " files")
        lines += first_few(self.left_out, len(self.left_out), "not read: ", ", not read either")
        lines.append(printed(self.table, 4))
        if len(self.effects):
            shown = printed(self.effects.head(SHOWN_DEVICES), 3)
            lines.append(f"missing from the devices' models:\n{shown}")
        lines += [str(self.population)] if self.population else []
        return "\n".join(lines)


def load_fleet(folder: str | Path) -> FleetResult:
    """Read the results of a fleet; the devices' own stay on disk until they are asked for.

    Raises:
        InputError: there are none of this version in the folder.
    """
    folder = Path(folder)
    try:
        held = read_json(folder / WHOLE)
        if held.pop("schema") != FLEET_FORMAT:
            raise KeyError("schema")
        rows, population = held.pop("coefficients"), held.pop("population")
        table = pd.DataFrame(rows).astype(
            dict.fromkeys(("mean", "between devices", "typical sd"), float)
        )
        population = population and Population.of_data(population)
        effects = pd.DataFrame(held.pop("effects"), columns=EFFECTS)
        held.pop("apart", None)  # of fleets of 0.2.0
        held = {"fitted": held.pop("trusted", None), "checked": len(effects) > 0, "odd": {}} | held
        return FleetResult(folder, table=table, population=population, effects=effects, **held)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{folder} holds no results of a fleet, or not of this version ({type(error).__name__}: {error}): give "
            "the folder that a batch of partitions was written to"
        ) from None
