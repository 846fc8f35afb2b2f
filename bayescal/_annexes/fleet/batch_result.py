"""What a batch gives: for each device its unknowns, their covariance and a verdict, as arrays and a table."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from bayescal import InputError
from bayescal._annexes.fleet.odd_devices import FAMILY_WISE_ERROR
from bayescal._annexes.fleet.population import Population
from bayescal.workshop import as_json, parsed_json, replacing_for_user, write_json

FORMAT = "bayescal.batch/1"
AGAIN = "Take a copy, or run the batch again"
TABLE, SUMMARY = "devices.parquet", "fleet.json"  # of a result that is a folder
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
EFFECTS = ["effect", "devices", "possible", "in fleet", "expected", "share", "low", "high"]


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
    """A table with so many significant digits."""
    return table.to_string(index=False, float_format=lambda v: f"{v:.{digits}g}")


def odd_in_words(odd: Mapping[str, list[str]], devices: int) -> list[str]:
    """Devices that are not like the others, a line each; nothing where there are none."""
    told = {name: "; ".join(said) for name, said in odd.items()}
    head = [
        f"{len(odd)} of {devices} devices are not like the others (by chance in {FAMILY_WISE_ERROR:.0%} of fleets):"
    ]
    head = head if odd else []
    return head + first_few(told, len(told), more=", all in `odd`")


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
        odd: devices that are not like the others, and in what.
        checked: devices in which it was looked for what the model lacks (`find`).
        missing: file → why its devices are not among the results.
        left_out: what stands in folders of readings and was not read → why.
        effects: where effects were looked for, one row an effect, as `effects_table` says; else no rows.
    """

    devices: tuple[str, ...]
    ok: np.ndarray
    reasons: tuple[str, ...]
    parts: tuple[BatchPart, ...]
    population: Population | None
    about: dict[str, Any]
    facts: pd.DataFrame
    odd: dict[str, list[str]] = field(default_factory=dict)
    checked: int = 0
    missing: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    effects: pd.DataFrame = field(default_factory=partial(pd.DataFrame, columns=EFFECTS))

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

    @property
    def fitted(self) -> int:
        """Devices whose fit is to be relied on."""
        return int(self.ok.sum())

    @property
    def doubted(self) -> dict[str, str]:
        """Devices whose fit is not to be relied on, and why."""
        each = zip(self.devices, self.reasons, self.ok, strict=True)
        return {name: why for name, why, ok in each if not ok}

    def coefficients(self) -> pd.DataFrame:
        """Return one row a coefficient, over the devices that are fitted.

        Columns: its median, the standard deviation between devices, the median standard uncertainty, unit, devices.
        """
        moments: dict[tuple[str, str], list[tuple[np.ndarray, np.ndarray]]] = {}
        for part in self.parts:
            good = self.ok[part.devices]
            columns = zip(part.names, part.units, part.mean[good].T, part.sd[good].T, strict=True)
            for name, unit, mean, sd in columns:
                if good.any():
                    moments.setdefault((name, unit), []).append((mean, sd))
        rows = []
        for (name, unit), own in moments.items():
            mean, sd = (np.concatenate(a) for a in zip(*own, strict=True))
            rows.append([name, np.median(mean), mean.std(), np.median(sd), unit, len(mean)])
        columns = ["coefficient", "median", "between devices", "typical sd", "unit", "devices"]
        return pd.DataFrame(rows, columns=columns)

    def data(self) -> dict[str, Any]:
        """The whole without its devices, as plain data."""
        told = ("checked", "odd", "missing", "left_out", "about")
        return as_json(
            {
                "schema": FORMAT,
                "devices": len(self),
                "fitted": self.fitted,
                "not_fitted": list(self.doubted),
                **{name: getattr(self, name) for name in told},
                "coefficients": self.coefficients().to_dict("records"),
                "population": self.population and self.population.data(),
                "effects": self.effects.to_dict("records"),
            }
        )

    def save(self, path: str | Path) -> Path:
        """Write the table to Parquet, with each unknown's row of the covariance. `load_batch` reads it back.

        Args:
            path: a name ….parquet; without a suffix a folder, for `devices.parquet` and the whole as `fleet.json`.

        Raises:
            InputError: another suffix, or a place that cannot be written to.
        """
        path = Path(path)
        if not path.suffix:
            self.save(path / TABLE)
            write_json(self.data(), path / SUMMARY)
            return path
        if path.suffix != ".parquet":
            raise InputError(
                f"a batch is saved as Parquet: name the file ….parquet, not {path.name!r}"
            )
        table = self.rows()
        facts = {name: self.facts[name].tolist() for name in self.facts}
        head = json.dumps(as_json(self.data() | {"facts": facts}), allow_nan=False)
        table = table.replace_schema_metadata({"bayescal": head})
        with replacing_for_user(path) as place:
            pq.write_table(table, place, write_page_checksum=True)
        return path

    def __str__(self) -> str:
        bad = self.doubted
        lines = [f"{len(self)} devices, {self.fitted} fitted ({self.about['method']})"]
        lines += first_few(bad, len(bad))
        checked = f"{self.checked} checked for what their model lacks"
        lines += [checked if self.checked else NOT_CHECKED, *odd_in_words(self.odd, len(self))]
        lines += first_few(self.missing, len(self.missing), "no results of ", " files")
        lines += first_few(self.left_out, len(self.left_out), "not read: ", ", not read either")
        lines.append(printed(self.coefficients(), 4))
        if len(self.effects):
            shown = printed(self.effects.head(SHOWN_DEVICES), 3)
            lines.append(f"missing from the devices' models:\n{shown}")
        return "\n".join([*lines, *([str(self.population)] if self.population else [])])


def load_batch(path: str | Path) -> BatchResult:
    """Read a saved batch back: its Parquet file, or the folder that holds it.

    Raises:
        InputError: there is no such file, it is no batch of this version, or it is damaged.
    """
    path = Path(path) / TABLE if Path(path).is_dir() else Path(path)
    if not path.is_file():
        raise InputError(f"There is no file {path}: give a batch saved by bayescal")
    try:
        table = pq.read_table(path, page_checksum_verification=True)
        head = parsed_json((table.schema.metadata or {})[b"bayescal"])
        if head["schema"] != FORMAT:
            raise KeyError(head["schema"])
    except Exception as error:  # whatever a damaged file makes Arrow raise
        raise InputError(
            f"{path.name} is no batch of this version, or a damaged one ({type(error).__name__}). {AGAIN}"
        ) from None
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
            facts=pd.DataFrame(
                head.get("facts", {}), list(devices), ["readings", "T0"], dtype=float
            ),
            odd=head.get("odd", {}),
            checked=head.get("checked", 0),
            missing=head.get("missing", {}),
            left_out=head.get("left_out", {}),
            effects=pd.DataFrame(head.get("effects", []), columns=EFFECTS),
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path.name} was changed after it was saved: {error}. {AGAIN}") from None


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
