"""What a batch gives: for each device its unknowns, their covariance and a verdict, as arrays and a table."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as pads
import pyarrow.parquet as pq
from jaxtyping import Float

from bayescal import InputError
from bayescal._annexes.fleet.odd_devices import FAMILY_WISE_ERROR
from bayescal._annexes.fleet.population import Named, Population, follow, learn
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
        ("readings", pa.float64()),
        ("T0", pa.float64()),
    ]
)
COLUMNS = SCHEMA.names[:7]  # of the table that a user sees
FILE = "file"  # beside these, until it is known that no device stands in several
EFFECTS = ["effect", "devices", "possible", "in fleet", "expected", "share", "low", "high"]


def first_few(items: Mapping[str, str], total: int, head: str = "", more: str = "") -> list[str]:
    """Return names and what is said of them, once where it is the same: the first ten, and how many more there are."""
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
    told, chance = {n: "; ".join(said) for n, said in odd.items()}, f"{FAMILY_WISE_ERROR:.0%}"
    head = f"{len(odd)} of {devices} devices are not like the others (by chance in {chance} of fleets):"
    return [head] * bool(odd) + first_few(told, len(told), more=", all in `odd`")


NOT_CHECKED = "fitted is not checked: what the model lacks was looked for in none of them (--find, in Python find=True)"


class Moments(NamedTuple):
    """Posterior means and covariances of devices with the same unknowns.

    Attributes:
        at: their places among all devices, (b,).
        names, units: of the unknowns.
        mean: (b, q), in these units.
        covariance: (b, q, q); NaN for what is held at its estimate (standard deviations, by least squares).
        readings: how many were fitted, (b,).
        t0: their reference temperature, °C; NaN where there is none, (b,).
    """

    at: np.ndarray
    names: tuple[str | None, ...]
    units: tuple[str | None, ...]
    mean: np.ndarray
    covariance: np.ndarray
    readings: np.ndarray
    t0: np.ndarray


def rows_of(
    devices: Sequence[str], files: Sequence[str], reasons: Sequence[str], fitted: Sequence[Moments]
) -> pa.Table:
    """Return one row for each device and unknown, in the order of the devices; one of a device that has none.

    Args:
        devices: names.
        files: that each stands in.
        reasons: what stands against each; "" where nothing does.
        fitted: moments of those that have any.
    """
    refused = np.setdiff1d(np.arange(len(devices)), np.concatenate([[], *(m.at for m in fitted)]))
    nothing = np.full((len(refused), 1, 1), np.nan)
    none = Moments(refused, (None,), (None,), nothing[:, 0], nothing, *2 * (nothing[:, 0, 0],))
    told = [pa.array(own, pa.string()) for own in (devices, reasons, files)]
    ok = np.array([not why for why in reasons], dtype=bool)
    tables, places = [], []
    for m in (*fitted, none):
        b, q = m.mean.shape
        at = np.repeat(m.at, q).astype(int)
        names, units = (pa.array(own * b, pa.string()) for own in (m.names, m.units))
        ends = np.arange(0, b * q * q + 1, q, dtype=np.int32)
        covariance = pa.ListArray.from_arrays(ends, m.covariance.ravel())
        device, reason, file = (own.take(pa.array(at)) for own in told)
        facts = np.repeat(m.readings, q).astype(float), np.repeat(m.t0, q).astype(float)
        sd = _standard_deviations(m.covariance).ravel()
        own = [device, names, m.mean.ravel(), sd, units, ok[at], reason, covariance, *facts, file]
        tables.append(pa.table(own, schema=SCHEMA.append(pa.field(FILE, pa.string()))))
        places.append(at)
    return pa.concat_tables(tables).take(np.argsort(np.concatenate(places), kind="stable"))


def _standard_deviations(covariance: Float[np.ndarray, "b q q"]) -> Float[np.ndarray, "b q"]:
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    return np.sqrt(np.where(variance >= 0, variance, np.nan))


def without_repeated(rows: pa.Table) -> pa.Table:
    """Return the rows of one run, in which devices of several files are refused: which readings count is not known."""
    files = rows.group_by("device").aggregate([(FILE, "distinct")]).to_pylist()
    twice = {one["device"]: sorted(own) for one in files if len(own := one[f"{FILE}_distinct"]) > 1}
    kept = rows.filter(pc.invert(pc.is_in(rows["device"], pa.array([*twice], pa.string()))))
    why = [
        f"device {name!r} stands in {len(own)} files, {own[0]!r} and {own[1]!r}: put its readings into one"
        for name, own in twice.items()
    ]
    found = pa.concat_tables([kept, rows_of([*twice], [""] * len(twice), why, ())])
    return found.drop_columns([FILE])


def pooled(rows: pa.Table, named: Named, seed: int) -> tuple[pa.Table, Population]:
    """Return rows under the population that is learned from the devices that are to be relied on: each moves toward it.

    Raises:
        ModelError: fewer than three of them.
    """
    mean, covariances = rows["mean"].to_numpy().copy(), rows["covariance"].combine_chunks()
    squares, offsets = covariances.values.to_numpy().copy(), covariances.offsets.to_numpy()
    names, good = rows["coefficient"].to_numpy(), rows["ok"].to_numpy()
    alike: dict[tuple[str, ...], list[int]] = {}
    for begin, end in spans(rows).values():
        if good[begin]:
            alike.setdefault((*names[begin:end],), []).append(begin)
    groups, parts = list[Any](), list[Any]()
    for own, begins in alike.items():
        q, of = len(own), np.array([own.index(name) for name in named])
        at = np.array(begins)[:, None] + np.arange(q)
        places = (offsets[at[:, 0]][:, None] + np.arange(q * q)).reshape(-1, q, q)
        groups.append((of, at, places))
        parts.append((mean[at][:, of], squares[places][:, of[:, None], of]))
    if not groups:
        parts = [(np.zeros((0, len(named))), np.zeros((0, len(named), len(named))))]
    population, *moments = learn(*map(np.concatenate, zip(*parts, strict=True)), named, seed)
    sd, begin = rows["sd"].to_numpy().copy(), 0
    for of, at, places in groups:
        some = slice(begin, begin + len(at))
        begin = some.stop
        new = follow(mean[at], squares[places], of, *(m[some] for m in moments))
        mean[at], squares[places] = new
        sd[at] = _standard_deviations(new[1])
    lists = pa.ListArray.from_arrays(covariances.offsets, squares)
    for name, column in (("mean", mean), ("sd", sd), ("covariance", lists)):
        rows = rows.set_column(SCHEMA.names.index(name), SCHEMA.field(name), pa.array(column))
    return rows, population


def spans(rows: pa.Table) -> dict[str, tuple[int, int]]:
    """Return the rows of each device, from and to."""
    devices = rows["device"].combine_chunks().dictionary_encode()
    begins = np.flatnonzero(np.diff(devices.indices.to_numpy(), prepend=-1)).tolist()
    return dict(zip(devices.dictionary.to_pylist(), pairwise([*begins, len(rows)]), strict=True))


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
        rows: the numbers, a row for each device and unknown, with that of the covariance.
        about: instrument, effects, method, seed and notes.
        population: what the devices have in common, if it was asked for.
        odd: devices that are not like the others, and in what.
        checked: devices in which it was looked for what the model lacks (`find`).
        missing: file → why its devices are not among the results.
        left_out: what stands in folders of readings and was not read → why.
        effects: where effects were looked for, one row an effect, as `effects_table` says; else no rows.
    """

    rows: pa.Table
    about: dict[str, Any]
    population: Population | None = None
    odd: dict[str, list[str]] = field(default_factory=dict)
    checked: int = 0
    missing: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    effects: pd.DataFrame = field(default_factory=partial(pd.DataFrame, columns=EFFECTS))

    @cached_property
    def _spans(self) -> dict[str, tuple[int, int]]:
        return spans(self.rows)

    @cached_property
    def _firsts(self) -> pa.Table:
        return self.rows.take(pa.array([begin for begin, _ in self._spans.values()], pa.int64()))

    @cached_property
    def devices(self) -> tuple[str, ...]:
        """Names, in the order in which they came."""
        return tuple(self._spans)

    @property
    def ok(self) -> np.ndarray:
        """Whether each fit is to be relied on, (devices,); what the model lacks is another question."""
        return self._firsts["ok"].to_numpy()

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why not; empty where nothing stands against it."""
        return tuple(self._firsts["reason"].to_pylist())

    @property
    def facts(self) -> pd.DataFrame:
        """By device, how many readings were fitted, and their T0, °C; NaN where that is not known."""
        return self._firsts.select(["readings", "T0"]).to_pandas().set_axis(self.devices)

    def __len__(self) -> int:
        return len(self._spans)

    def __iter__(self) -> Iterator[DeviceResult]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, device: str | int) -> DeviceResult:
        """One device's result, by its name or by its place.

        Raises:
            InputError: there is no such device.
        """
        if isinstance(device, int) and -len(self) <= device < len(self):
            device = self.devices[device]
        if device not in self._spans:
            shown = ", ".join(self.devices[:5])
            raise InputError(f"there is no device {device!r} among the {len(self)}: {shown} …")
        begin, end = self._spans[device]
        own = self.rows.slice(begin, end - begin).to_pydict()
        q = 0 if own["coefficient"][0] is None else end - begin
        return DeviceResult(
            device,
            own["ok"][0],
            own["reason"][0],
            tuple(own["coefficient"][:q]),
            tuple(own["unit"][:q]),
            np.array(own["mean"][:q]),
            np.array(own["covariance"][:q]).reshape(q, q),
        )

    def table(self) -> pd.DataFrame:
        """One row for each device and unknown: device, coefficient, mean, sd, unit, ok, reason.

        A device that was refused has one row without a coefficient. Devices in the order in which they came.
        """
        return self.rows.select(COLUMNS).to_pandas()

    @property
    def fitted(self) -> int:
        """Devices whose fit is to be relied on."""
        return int(self.ok.sum())

    @property
    def doubted(self) -> dict[str, str]:
        """Devices whose fit is not to be relied on, and why."""
        return {n: why for n, why in zip(self.devices, self.reasons, strict=True) if why}

    def coefficients(self) -> pd.DataFrame:
        """Return one row a coefficient, over the devices that are fitted.

        Columns: its median, the standard deviation between devices, the median standard uncertainty, unit, devices.
        """
        good = self.rows.select(COLUMNS).filter(pads.field("ok")).to_pandas()
        rows = [
            [name, np.median(own["mean"]), own["mean"].std(ddof=0), np.median(own["sd"]), unit]
            + [len(own)]
            for (name, unit), own in good.groupby(["coefficient", "unit"], sort=False)
        ]
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
        head = {"bayescal": json.dumps(self.data(), allow_nan=False)}
        with replacing_for_user(path) as place:
            table = self.rows.replace_schema_metadata(head)
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
        lines += [printed(self.coefficients(), 4)] * bool(self.fitted)
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
        for name in {*SCHEMA.names} - {*table.column_names}:  # facts, of earlier files
            table = table.append_column(name, pa.nulls(len(table), pa.float64()))
        told = ("about", "odd", "checked", "missing", "left_out")
        found = BatchResult(
            table.select(SCHEMA.names).cast(SCHEMA),
            population=head["population"] and Population.of_data(head["population"]),
            effects=pd.DataFrame(head.get("effects", []), columns=EFFECTS),
            **{name: head[name] for name in told if name in head},
        )
        counts = np.array([end - begin for begin, end in found._spans.values()], dtype=int)
        lengths = pc.list_value_length(found.rows["covariance"]).fill_null(1).to_numpy()
        if not np.array_equal(lengths, np.repeat(counts, counts)):
            raise ValueError("rows of a device are missing")
        return found
    except Exception as error:  # whatever a damaged file makes Arrow raise
        raise InputError(
            f"{path.name} is no batch of this version, or a damaged one ({type(error).__name__}). {AGAIN}"
        ) from None
