"""Results of a batch: for each device its unknowns, their covariance and a verdict, as arrays and a table."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.fleet.find_devices import EFFECTS, DeviceStructure
from bayescal._annexes.fleet.population import estimate_population

FORMAT = "bayescal.batch/1"
# Probability that a fleet of like devices has one that is named; shared by all devices and quantities (C. Bonferroni).
FAMILY_WISE_ERROR = 0.01
SHOWN_DEVICES = 10  # devices, files that are named in print
SHOWN_ALIKE = 3  # of those of which the same is said
SCHEMA = pa.schema(
    {
        **{"device": pa.string(), "coefficient": pa.string()},
        **{"mean": pa.float64(), "sd": pa.float64(), "unit": pa.string()},
        **{"ok": pa.bool_(), "reason": pa.string()},
        **{"covariance": pa.list_(pa.float64()), "readings": pa.float64(), "T0": pa.float64()},
    }
)
COEFFICIENTS = ["coefficient", "median", "between devices", "population sd", "typical sd"]
COEFFICIENTS += ["unit", "devices"]
COLUMNS = SCHEMA.names[:7]  # of the table that a user sees


def first_few(items: Mapping[str, str], head: str = "", ending: str = "") -> list[str]:
    """Return names and what is said of them, once where it is the same: the first ten, and how many more there are."""
    by_reason: dict[str, list[str]] = {}
    for name, why in items.items():
        key = why.replace(repr(name), "").replace(f"device {name}", "")
        by_reason.setdefault(key, []).append(name)
    groups = sorted(by_reason.values(), key=len, reverse=True)[:SHOWN_DEVICES]
    lines = []
    for names in groups:
        others = f" and {len(names) - SHOWN_ALIKE} more" * (len(names) > SHOWN_ALIKE)
        lines.append(f"  {head}{', '.join(names[:SHOWN_ALIKE])}{others}: {items[names[0]]}")
    hidden = len(items) - sum(map(len, groups))
    return [*lines, f"  … and {hidden} more{ending}"] if hidden > 0 else lines


# Heads of printed tables.
HEADS = {"between devices": "sd of estimates", "population sd": "sd in the population"}
HEADS |= {"typical sd": "standard uncertainty (median)"}
EFFECT_HEADS = {"devices": "devices with it", "possible": "devices with it or a rival"}
EFFECT_HEADS |= {"in fleet": "P(any has it)", "expected": "expected devices"}
EFFECT_HEADS |= {"share": "expected share", "low": "share, if any: 2.5 %", "high": "97.5 %"}


def printed(table: pd.DataFrame, digits: int, heads: Mapping[str, str]) -> str:
    """Format a table with so many significant digits."""

    def cell(v: Any) -> str:
        number = "–" if v != v else ws.number(v, digits) if isinstance(v, float) else str(v)
        return ws.unit_label(v) if isinstance(v, str) and v in units else number

    units = {*table.get("unit", ())}
    rows = [[*map(cell, row)] for row in table.to_numpy()]
    return str(ws.plain_table([heads.get(n, n) for n in table.columns], rows))


NOT_CHECKED = "missing effects were looked for in none of them (--find, in Python find=True)"


@dataclass(frozen=True, eq=False)
class DeviceResult:
    """One device of a batch.

    Attributes:
        device: its name.
        reason: why its fit is not to be relied on: a refusal, or what the fit did not reach; empty if nothing.
        names, units: of its unknowns; none if it was refused.
        mean: (q,), in these units.
        covariance: (q, q); NaN for what is held at its estimate (standard deviations, by least squares).
        readings: how many were fitted; NaN if that is not known.
        t0: reference temperature, °C; NaN where there is none.
        structure: what is missing from its model, if that was looked for; not saved.
    """

    device: str = ""
    reason: str = ""
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    mean: np.ndarray = field(default_factory=partial(np.zeros, 0))
    covariance: np.ndarray = field(default_factory=partial(np.zeros, (0, 0)))
    readings: float = np.nan
    t0: float = np.nan
    structure: DeviceStructure | None = None

    @property
    def ok(self) -> bool:
        """Return whether its fit is to be relied on; what the model lacks is another question."""
        return not self.reason

    @property
    def sd(self) -> np.ndarray:
        """Return standard uncertainties, (q,); NaN for what is held."""
        variance = np.diag(self.covariance)
        return np.sqrt(np.where(variance >= 0, variance, np.nan))

    def __getitem__(self, name: str) -> tuple[float, float]:
        """Return mean and standard uncertainty of one unknown; raise InputError if nothing is called so."""
        if name not in self.names:
            others = ", ".join(self.names) or "none"
            raise bc.InputError(f"device {self.device!r} has no unknown {name!r}; it has: {others}")
        i = self.names.index(name)
        return float(self.mean[i]), float(self.sd[i])

    def __str__(self) -> str:
        head = f"device {self.device}: {'ok' if self.ok else self.reason}"
        errors = [("" if np.isnan(s) else f" ± {s:.2g}") for s in self.sd]
        rows = zip(self.names, self.mean, errors, self.units, strict=True)
        return "\n".join([head, *(f"  {n} = {m:.6g}{s} {u}" for n, m, s, u in rows)])


def _rows_of(results: Iterable[DeviceResult]) -> pa.Table:
    """Return one row for each device and unknown, and one of a device that has none."""
    rows = [
        (fit.device, name, mean, sd, unit, fit.ok, fit.reason, covariance, fit.readings, fit.t0)
        for fit in results
        for name, mean, sd, unit, covariance in (
            zip(fit.names, fit.mean, fit.sd, fit.units, fit.covariance, strict=True)
            if fit.names
            else [(None,) * 5]
        )
    ]
    return pa.table([*zip(*rows, strict=True)] or [[]] * len(SCHEMA), schema=SCHEMA)


def _split_by_device(rows: pa.Table) -> tuple[DeviceResult, ...]:
    """Return the devices of a results table; raise ValueError if rows of one are missing or not contiguous."""
    fits = list[DeviceResult]()
    for name, group in groupby(rows.to_pylist(), lambda row: row["device"]):
        first, *_ = group_rows = [*group]
        of_unknowns = [row for row in group_rows if row["coefficient"] is not None]
        keys = ("coefficient", "unit", "mean", "covariance")
        names, units, mean, covariance = ([row[key] for row in of_unknowns] for key in keys)
        moments = np.array(mean), np.reshape(covariance, (len(mean), len(mean)))
        fields = (*names,), (*units,), *moments, first["readings"], first["T0"]
        fits.append(DeviceResult(name, first["reason"], *fields))
    if len({fit.device for fit in fits}) < len(fits):
        raise ValueError("rows of a device are not contiguous")
    return tuple(fits)


def refuse_suffix(path: Path) -> Path:
    """Return a path to save a batch to; raise InputError for another suffix than .parquet."""
    if path.suffix != ".parquet":
        raise bc.InputError(f"a batch is saved as Parquet: name it ….parquet, not {path.name!r}")
    return path


@ws.renamed(doubted="unreliable")
@dataclass(frozen=True, eq=False)
class BatchResult:
    """Fits of many devices. `result["A17"]` or `result[3]` is one device's; `table()` is all of them.

    Attributes:
        results: one a device, in the order in which they came.
        about: instrument, effects, method, seed and notes.
        odd: devices that are not like the others, and in what.
        checked: devices in which it was looked for what the model lacks (`find`).
        missing: file → why its devices are not among the results.
        left_out: what stands in folders of readings and was not read → why.
        effects: where effects were looked for, one row an effect, as `effects_table` says; else no rows.
    """

    results: tuple[DeviceResult, ...]
    about: dict[str, Any]
    odd: dict[str, list[str]] = field(default_factory=dict)
    checked: int = 0
    missing: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    effects: pd.DataFrame = field(default_factory=partial(pd.DataFrame, columns=EFFECTS))

    @cached_property
    def _by_name(self) -> dict[str, DeviceResult]:
        return {fit.device: fit for fit in self.results}

    @property
    def devices(self) -> tuple[str, ...]:
        """Return the names, in the order in which they came."""
        return tuple(self._by_name)

    @property
    def ok(self) -> np.ndarray:
        """Return whether each fit is to be relied on, (devices,); what the model lacks is another question."""
        return np.array([fit.ok for fit in self.results], dtype=bool)

    def __len__(self) -> int:
        return len(self.results)

    def __iter__(self) -> Iterator[DeviceResult]:
        return iter(self.results)

    def __getitem__(self, device: str | int) -> DeviceResult:
        """Return one device's result, by its name or its place; raise InputError if there is none."""
        if isinstance(device, int) and -len(self) <= device < len(self):
            return self.results[device]
        if device in self._by_name:
            return self._by_name[device]
        names = ", ".join(self.devices[:5])
        raise bc.InputError(f"there is no device {device!r} among the {len(self)}: {names} …")

    def table(self) -> pd.DataFrame:
        """Return one row for each device and unknown: device, coefficient, mean, sd, unit, ok, reason.

        A device that was refused has one row without a coefficient. Devices in the order in which they came.
        """
        return _rows_of(self.results).select(COLUMNS).to_pandas()

    @property
    def fitted(self) -> int:
        """Count the devices whose fit is to be relied on."""
        return sum(fit.ok for fit in self)

    @property
    def unreliable(self) -> dict[str, str]:
        """Return the devices whose fit is not to be relied on, and why."""
        return {fit.device: fit.reason for fit in self if not fit.ok}

    def coefficients(self) -> pd.DataFrame:
        """Return one row a coefficient, over the devices that are fitted.

        Columns: median, experimental standard deviation between devices; that of the population, without what
        readings leave open (restricted likelihood); median standard uncertainty, unit, devices.
        """

        def row(name: str, unit: str, g: pd.DataFrame) -> list[Any]:
            mean, sd, population = g["mean"].to_numpy(), g["sd"].to_numpy(), np.nan
            if len(g) > 1 and np.isfinite(sd).all():
                population = np.sqrt(estimate_population(mean, sd**2)[1])
            between = g["mean"].std(ddof=1)
            return [name, np.median(mean), between, population, np.median(sd), unit, len(g)]

        by_unknown = self.table().query("ok").groupby(["coefficient", "unit"], sort=False)
        rows = [row(name, unit, g) for (name, unit), g in by_unknown]  # pyright: ignore
        return pd.DataFrame(rows, columns=COEFFICIENTS)

    def data(self) -> dict[str, Any]:
        """Return the whole without its devices, as plain data."""
        fields = ("checked", "odd", "missing", "left_out", "about")
        return ws.as_json(
            {
                "schema": FORMAT,
                "devices": len(self),
                "fitted": self.fitted,
                "not_fitted": list(self.unreliable),
                **{name: getattr(self, name) for name in fields},
                "coefficients": self.coefficients().to_dict("records"),
                "effects": self.effects.to_dict("records"),
            }
        )

    def save(self, path: str | Path) -> Path:
        """Write the table to Parquet, with each unknown's row of the covariance. `load_batch` reads it back.

        Args:
            path: a name ….parquet; the whole without its devices, as of `data`, stands in its metadata.

        Raises:
            InputError: another suffix, or a place that cannot be written to.
        """
        path = refuse_suffix(Path(path))
        head = {"bayescal": json.dumps(self.data(), allow_nan=False)}
        with ws.replacing_for_user(path) as place:
            table = _rows_of(self.results).replace_schema_metadata(head)
            pq.write_table(table, place, write_page_checksum=True)
        return path

    def _repr_html_(self) -> str:
        return f"<pre>{ws.html_text(self)}</pre>"

    def __str__(self) -> str:
        bad, odd = self.unreliable, {n: "; ".join(why) for n, why in self.odd.items()}
        lines = [f"{len(self)} devices, {self.fitted} fitted ({self.about['method']})"]
        lines += first_few(bad)
        searched = f"{self.checked} searched for missing effects"
        lines.append(searched if self.checked else NOT_CHECKED)
        if odd:
            chance = f"by chance in {FAMILY_WISE_ERROR:.0%} of fleets"
            lines.append(f"{len(odd)} of {len(self)} devices are not like the others ({chance}):")
        lines += first_few(odd, ending=", all in `odd`")
        lines += first_few(self.missing, "no results of ", " files")
        lines += first_few(self.left_out, "not read: ", ", not read either")
        lines += [printed(self.coefficients(), 4, HEADS)] * bool(self.fitted)
        if len(self.effects):
            table = printed(self.effects.head(SHOWN_DEVICES), 3, EFFECT_HEADS)
            lines.append(f"effects in addition to the model given:\n{table}")
        return "\n".join(lines)


def load_batch(path: str | Path) -> BatchResult:
    """Read a saved batch back.

    Raises:
        InputError: there is no such file, it is no batch of this version, or it is damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise bc.InputError(f"There is no file {path}: give a batch saved by bayescal")
    try:
        table = pq.read_table(path, page_checksum_verification=True)
        head = ws.parsed_json((table.schema.metadata or {})[b"bayescal"])
        if head["schema"] != FORMAT:
            raise KeyError(head["schema"])
        content = ("about", "odd", "checked", "missing", "left_out")
        return BatchResult(
            _split_by_device(table.select(SCHEMA.names).cast(SCHEMA)),
            effects=pd.DataFrame(head["effects"], columns=EFFECTS),
            **{name: head[name] for name in content},
        )
    except Exception as error:  # whatever a damaged file makes Arrow raise
        raise bc.InputError(
            f"{path.name} is no batch of this version, or a damaged one ({type(error).__name__}). Take a copy, "
            "or run the batch again"
        ) from None
