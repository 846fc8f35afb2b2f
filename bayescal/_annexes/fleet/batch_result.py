"""Results of a batch of devices: unknowns, covariance and failed checks of each device, and statistics of all."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import groupby
from pathlib import Path
from statistics import mode
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.fleet.find_devices import EFFECT_COLUMNS, DeviceStructure
from bayescal._annexes.fleet.population import estimate_population

FORMAT = "bayescal.batch/1"
# Probability that a fleet without outliers has a device flagged; divided among devices and quantities (C. Bonferroni).
FAMILY_WISE_ERROR = 0.01
MAX_PRINTED_ROWS = 10  # devices, files or effects listed in printed results
MAX_NAMES_PER_REASON = 3  # names printed of devices or files with the same reason
SCHEMA = pa.schema(
    {
        **{"device": pa.string(), "coefficient": pa.string(), "mean": pa.float64()},
        **{"sd": pa.float64(), "unit": pa.string(), "ok": pa.bool_(), "reason": pa.string()},
        **{"covariance": pa.list_(pa.float64()), "readings": pa.float64(), "T0": pa.float64()},
    }
)
COEFFICIENT_COLUMNS = ["coefficient", "median", "between devices", "population sd", "typical sd"]
COEFFICIENT_COLUMNS += ["unit", "devices"]
ATTRIBUTE_BY_KEY = {"checked": "searched_count", "odd": "outliers", "missing": "file_errors"}
ATTRIBUTE_BY_KEY |= {"left_out": "skip_reasons", "about": "configuration", "revised": "revisions"}
TABLE_COLUMNS = SCHEMA.names[:7]  # of `BatchResult.table`


def format_reasons(reasons: Mapping[str, str], prefix: str = "", suffix: str = "") -> list[str]:
    """Format name → reason as a line for each of the ten most frequent reasons, and one that counts the other names.

    `prefix` precedes the names in a line, `suffix` follows the count.
    """
    names_by_reason: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        key = reason.replace(repr(name), "").replace(f"device {name}", "")
        names_by_reason.setdefault(key, []).append(name)
    groups = sorted(names_by_reason.values(), key=len, reverse=True)[:MAX_PRINTED_ROWS]
    lines = []
    for names in groups:
        first_names, n_more = names[:MAX_NAMES_PER_REASON], len(names) - MAX_NAMES_PER_REASON
        name_list = ", ".join(first_names) + f" and {n_more} more" * (n_more > 0)
        lines.append(f"  {prefix}{name_list}: {reasons[names[0]]}")
    n_more = len(reasons) - sum(map(len, groups))
    return [*lines, f"  … and {n_more} more{suffix}"] if n_more > 0 else lines


STATISTIC_HEADERS = {"between devices": "sd of estimates", "population sd": "sd in the population"}
STATISTIC_HEADERS |= {"typical sd": "standard uncertainty (median)"}
EFFECT_HEADERS = {"devices": "found by own search", "possible": "one of several by own search"}
EFFECT_HEADERS |= {"in fleet": "P(any has it)", "expected": "devices expected"}
EFFECT_HEADERS |= {"share": "expected share", "low": "share if any: 2.5 %", "high": "97.5 %"}


def format_table(table: pd.DataFrame, digits: int, headers: Mapping[str, str]) -> str:
    """Format a table: numbers with `digits` significant digits, NaN as "–"; `headers`: column → printed header."""

    def format_cell(v: Any) -> str:
        text = ws.number(v, digits) if isinstance(v, float) else str(v)
        return {"nan": "–", "0": "not resolved"}.get(text, text) if isinstance(v, float) else text

    formats = {n: ws.unit_label if n == "unit" else format_cell for n in table.columns}
    columns = (ws.TableColumn(headers.get(n, n), n, formatter) for n, formatter in formats.items())
    return str(ws.ResultTable(tuple(columns), table.to_dict("records")))


OTHER_EFFECTS = "not in the rows of coefficients that all devices have, which are of the most frequent set of effects"
IMPROBABLE = "  {}: do not use before another test: {} was found, but is improbable in the fleet"
NO_SEARCH = "no device was searched for missing effects (option --find, or find=True)"


@ws.renamed(readings="reading_count")
@dataclass(frozen=True, eq=False)
class DeviceResult:
    """Result of the fit of one device of a batch.

    Attributes:
        device: name of the device.
        reason: error message or failed checks because of which the fit is unreliable; empty for a reliable fit.
        names, units: names and units of the q unknowns; empty if the device was rejected.
        mean: posterior mean of each unknown (q,), in `units`.
        covariance: posterior covariance (q, q); NaN where it is not estimated (σ of the noise, by least squares).
        reading_count: number of readings fitted; NaN if not known.
        t0: reference temperature T0, °C; NaN if the model has none.
        structure: result of the search for missing effects; None without a search. Not saved.
    """

    device: str = ""
    reason: str = ""
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    mean: np.ndarray = field(default_factory=partial(np.zeros, 0))
    covariance: np.ndarray = field(default_factory=partial(np.zeros, (0, 0)))
    reading_count: float = np.nan
    t0: float = np.nan
    structure: DeviceStructure | None = None

    @property
    def ok(self) -> bool:
        """Return whether the fit is reliable; the model may nevertheless lack effects."""
        return not self.reason

    @property
    def sd(self) -> np.ndarray:
        """Return the standard uncertainty of each unknown (q,); NaN where it is not estimated."""
        variance = np.diag(self.covariance)
        return np.sqrt(np.where(variance >= 0, variance, np.nan))

    def __getitem__(self, name: str) -> tuple[float, float]:
        """Return mean and standard uncertainty of the unknown `name`; raise InputError if it does not exist."""
        if name not in self.names:
            names = ", ".join(self.names) or "none"
            raise bc.InputError(f"device {self.device!r} has no unknown {name!r}; it has: {names}")
        i = self.names.index(name)
        return float(self.mean[i]), float(self.sd[i])

    def __str__(self) -> str:
        title = f"device {self.device}: {'ok' if self.ok else self.reason}"
        sd_texts = [("" if np.isnan(s) else f" ± {s:.2g}") for s in self.sd]
        rows = zip(self.names, self.mean, sd_texts, self.units, strict=True)
        return "\n".join([title, *(f"  {n} = {m:.6g}{s} {u}" for n, m, s, u in rows)])


def _tabulate(results: Iterable[DeviceResult]) -> pa.Table:
    """Tabulate results: one row per device and unknown, and one row for a device without unknowns."""
    rows = [
        (f.device, name, mean, sd, unit, f.ok, f.reason, covariance, f.reading_count, f.t0)
        for f in results
        for name, mean, sd, unit, covariance in (
            zip(f.names, f.mean, f.sd, f.units, f.covariance, strict=True)
            if f.names
            else [(None,) * 5]
        )
    ]
    return pa.table([*zip(*rows, strict=True)] or [[]] * len(SCHEMA), schema=SCHEMA)


def _split_by_device(rows: pa.Table) -> tuple[DeviceResult, ...]:
    """Split a results table by device; raise ValueError if rows of a device are missing or not contiguous."""
    fits = list[DeviceResult]()
    for name, device_rows in groupby(rows.to_pylist(), lambda row: row["device"]):
        first_row, *_ = group_rows = [*device_rows]
        unknown_rows = [row for row in group_rows if row["coefficient"] is not None]
        keys = ("coefficient", "unit", "mean", "covariance")
        names, units, mean, covariance = ([row[key] for row in unknown_rows] for key in keys)
        moments = np.array(mean), np.reshape(covariance, (len(mean), len(mean)))
        fields = (*names,), (*units,), *moments, first_row["readings"], first_row["T0"]
        fits.append(DeviceResult(name, first_row["reason"], *fields))
    if len({fit.device for fit in fits}) < len(fits):
        raise ValueError("rows of a device are not contiguous")
    return tuple(fits)


def require_parquet(path: Path) -> Path:
    """Return the path of a file in which to save a batch; raise InputError if its suffix is not .parquet."""
    if path.suffix != ".parquet":
        raise bc.InputError(f"{path.name!r} must end in .parquet: a batch is saved as Parquet")
    return path


@ws.renamed(doubted="unreliable", data="to_json_data", fitted="fitted_count", **ATTRIBUTE_BY_KEY)
@dataclass(frozen=True, eq=False)
class BatchResult:
    """Results of the fits of many devices; `result["A17"]` or `result[3]` is the result of one device.

    Attributes:
        results: result of each device, in input order.
        configuration: instrument, effects, noise law, method, seed, reference constants, non-default settings.
        outliers: name of an outlying device → messages, one per outlying quantity.
        searched_count: number of devices searched for missing effects (`find`).
        file_errors: name of an unreadable file → error message.
        skip_reasons: path of a folder's entry that was not read → reason.
        effects: table of the effects found by `find`, one row per effect; columns: `tabulate_effects`.
        revisions: device whose own search found effects improbable in the fleet → these, and those fitted instead.
    """

    results: tuple[DeviceResult, ...]
    configuration: dict[str, Any]
    outliers: dict[str, list[str]] = field(default_factory=dict)
    searched_count: int = 0
    file_errors: dict[str, str] = field(default_factory=dict)
    skip_reasons: dict[str, str] = field(default_factory=dict)
    effects: pd.DataFrame = field(default_factory=partial(pd.DataFrame, columns=EFFECT_COLUMNS))
    revisions: dict[str, str] = field(default_factory=dict)

    @cached_property
    def _results_by_name(self) -> dict[str, DeviceResult]:
        return {fit.device: fit for fit in self.results}

    @cached_property
    def _unknowns_by_device(self) -> dict[str, str]:
        """Return the names of the unknowns of each reliable fit as one text, without noise and members of groups."""
        names = {fit.device: [n for n in fit.names if n[:6] != "noise."] for fit in self if fit.ok}
        return {d: ", ".join(dict.fromkeys(n.partition("(")[0] for n in names[d])) for d in names}

    @property
    def devices(self) -> tuple[str, ...]:
        """Return the devices' names, in input order."""
        return tuple(self._results_by_name)

    @property
    def ok(self) -> np.ndarray:
        """Return whether the fit of each device is reliable, (devices,); its model may nevertheless lack effects."""
        return np.array([fit.ok for fit in self.results], dtype=bool)

    def __len__(self) -> int:
        return len(self.results)

    def __iter__(self) -> Iterator[DeviceResult]:
        return iter(self.results)

    def __getitem__(self, device: str | int) -> DeviceResult:
        """Return the result of one device, by name or index; raise InputError if there is none."""
        if isinstance(device, int) and -len(self) <= device < len(self):
            return self.results[device]
        if device in self._results_by_name:
            return self._results_by_name[device]
        names = ", ".join(self.devices[:5]) + " …" * (len(self) > 5)
        raise bc.InputError(f"there is no device {device!r}; the {len(self)} devices are: {names}")

    def table(self) -> pd.DataFrame:
        """Return one row per device and unknown: device, coefficient, mean, sd, unit, ok, reason.

        A rejected device has one row without a coefficient. Devices are in input order.
        """
        return _tabulate(self.results).select(TABLE_COLUMNS).to_pandas()

    @property
    def fitted_count(self) -> int:
        """Return the number of devices with a reliable fit."""
        return sum(fit.ok for fit in self)

    @property
    def unreliable(self) -> dict[str, str]:
        """Return the reasons why fits are unreliable, by device name."""
        return {fit.device: fit.reason for fit in self if not fit.ok}

    def coefficients(self) -> pd.DataFrame:
        """Return statistics of each coefficient over the devices with a reliable fit, one row per coefficient.

        Columns: coefficient; median, and experimental standard deviation `between devices`, of the estimates; standard
        deviation in the population, without the estimates' uncertainties (restricted likelihood); median standard
        uncertainty (`typical sd`); unit; number of devices. As the meaning of a coefficient depends on the other
        effects, only those devices with it are included that have the most frequent set of effects.
        """

        def summarise(name: str, unit: str, fits: pd.DataFrame) -> list[Any]:
            effect_sets = np.array([self._unknowns_by_device[device] for device in fits["device"]])
            fits = fits.loc[effect_sets == mode(effect_sets)]
            mean, sd, population_sd = fits["mean"].to_numpy(), fits["sd"].to_numpy(), np.nan
            if len(fits) > 1 and np.isfinite(sd).all():
                population_sd = np.sqrt(estimate_population(mean, sd**2)[1])
            moments = np.median(mean), fits["mean"].std(), population_sd, np.median(sd)
            return [name, *moments, unit, len(fits)]

        by_unknown = self.table().query("ok").groupby(["coefficient", "unit"], sort=False)
        rows = [summarise(*key, fits) for key, fits in by_unknown]  # pyright: ignore
        return pd.DataFrame(rows, columns=COEFFICIENT_COLUMNS)

    def to_json_data(self) -> dict[str, Any]:
        """Return the counts, saved attributes and tables of the batch as JSON data, without results of devices."""
        data = {"schema": FORMAT, "devices": len(self), "fitted": self.fitted_count}
        data |= {"not_fitted": list(self.unreliable)}
        data |= {key: getattr(self, name) for key, name in ATTRIBUTE_BY_KEY.items()}
        tables = {"coefficients": self.coefficients(), "effects": self.effects}
        return ws.as_json(data | {key: t.to_dict("records") for key, t in tables.items()})

    def save(self, path: str | Path) -> Path:
        """Write the results to a Parquet file, which `load_batch` reads; return its path.

        Args:
            path: file name ending in .parquet. Rows: those of `table()`, with covariances; metadata: `to_json_data()`.

        Raises:
            InputError: the suffix is not .parquet, or the file cannot be written.
        """
        path = require_parquet(Path(path))
        metadata = {"bayescal": json.dumps(self.to_json_data(), allow_nan=False)}
        with ws.replace_user_file(path) as temporary_path:
            table = _tabulate(self.results).replace_schema_metadata(metadata)
            pq.write_table(table, temporary_path, write_page_checksum=True)
        return path

    def _repr_html_(self) -> str:
        return f"<pre>{ws.escape_html(self)}</pre>"

    def __str__(self) -> str:
        outlier_texts = {name: "; ".join(texts) for name, texts in self.outliers.items()}
        head = f"{len(self)} devices, {self.fitted_count} fitted ({self.configuration['method']})"
        lines = [head, *format_reasons(self.unreliable)]
        lines.append(
            f"{n} searched for missing effects" if (n := self.searched_count) else NO_SEARCH
        )
        if count := len(outlier_texts):
            rate = f"family-wise error rate {FAMILY_WISE_ERROR:.0%}"
            lines.append(f"{count} of {len(self)} devices are outliers ({rate}):")
        lines += format_reasons(outlier_texts, suffix=", all in `outliers`")
        lines += format_reasons(self.file_errors, "no results of ", " files")
        lines += format_reasons(self.skip_reasons, "not read: ", ", not read either")
        if unknowns := self._unknowns_by_device:
            lines.append(format_table(self.coefficients(), 4, STATISTIC_HEADERS))
            most = mode(unknowns.values())
            lines += format_reasons({d: OTHER_EFFECTS for d, u in unknowns.items() if u != most})
        if len(effects := self.effects.head(MAX_PRINTED_ROWS)):
            table = effects.assign(**{"in fleet": effects["in fleet"].map(ws.probability)})
            lines += ["effects missing from the model:", format_table(table, 3, EFFECT_HEADERS)]
            for name in effects.query("devices > 0 and `in fleet` < 0.5")["effect"]:
                is_of_effect = self.table()["coefficient"].str.match(rf"{name}(?!\w)", na=False)
                devices = ", ".join(dict.fromkeys(self.table()["device"][is_of_effect]))
                lines += [IMPROBABLE.format(devices, name)] * bool(devices)
            lines += format_reasons(self.revisions)
        return "\n".join(lines)


def load_batch(path: str | Path) -> BatchResult:
    """Read a batch saved by `BatchResult.save`.

    Raises:
        InputError: the file does not exist, is damaged, or is not a batch of this version.
    """
    path, advice = Path(path), "Use a backup copy, or run the batch again"
    if not path.is_file():
        raise bc.InputError(f"{path} does not exist: give the file of a batch saved by bayescal")
    try:
        table = pq.read_table(path, page_checksum_verification=True)
        metadata = {"revised": {}} | ws.parse_json((table.schema.metadata or {})[b"bayescal"])
        if metadata["schema"] != FORMAT:
            raise KeyError(metadata["schema"])
        return BatchResult(
            _split_by_device(table.select(SCHEMA.names).cast(SCHEMA)),
            effects=pd.DataFrame(metadata["effects"], columns=EFFECT_COLUMNS),
            **{name: metadata[key] for key, name in ATTRIBUTE_BY_KEY.items()},
        )
    except Exception as error:  # whatever a damaged file makes Arrow raise
        fault = f"is damaged, or is not a batch of this version ({type(error).__name__})"
        raise bc.InputError(f"{path.name} {fault}. {advice}") from None
