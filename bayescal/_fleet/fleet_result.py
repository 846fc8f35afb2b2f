"""What a fleet gives: a folder of Parquet files, one for each partition, and `fleet.json` of the whole."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.dataset as pads

from bayescal._core.atomic_file import write_text
from bayescal._core.errors import InputError
from bayescal._core.json_shape import read_json
from bayescal._fleet.batch_result import (
    COLUMNS,
    SHOWN,
    DeviceResult,
    first_few,
    load_batch,
    printed,
)
from bayescal._fleet.find_devices import COLUMNS as EFFECTS
from bayescal._fleet.population import Population

FORMAT = "bayescal.fleet/1"
WHOLE = "fleet.json"
ALONE = "devices"  # folder of each device's own results
POOLED = "pooled"  # and of those under the population


@dataclass(frozen=True, eq=False)
class FleetResult:
    """Fits of more devices than one process holds. `result["A17"]` is one device's; the rest stays on disk.

    Attributes:
        folder: of the results.
        devices, trusted, readings: how many.
        doubted: some devices whose result is not reliable, and why.
        missing: file → why its devices are not among the results; the same call goes on from there.
        table: one row a coefficient: mean over the devices that are trusted, standard deviation between them, typical
            (root mean square) standard uncertainty, unit.
        population: what the devices have in common, if it was asked for.
        apart: devices that stand out from the population, and their posterior predictive p, the least first.
        effects: where effects were looked for, one row an effect, as `shares.effects_table` says; else no rows.
        about: instrument, effects, method, seed, versions, partitions and what they took.
        left_out: what stands in folders of readings and was not read → why.
    """

    folder: Path
    devices: int
    trusted: int
    readings: int
    doubted: dict[str, str]
    missing: dict[str, str]
    table: pd.DataFrame
    population: Population | None
    apart: dict[str, float]
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
        """Plain JSON."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        del plain["folder"], plain["table"]
        return {
            "schema": FORMAT,
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
        text = json.dumps(self.data(), indent=1, ensure_ascii=False)
        return write_text(text + "\n", self.folder / WHOLE)

    def __str__(self) -> str:
        lines = [f"{self.devices} devices, {self.trusted} reliable ({self.about['method']})"]
        lines += first_few(self.doubted, self.devices - self.trusted)
        lines += first_few(self.missing, len(self.missing), "no results of ", " files")
        lines += first_few(self.left_out, len(self.left_out), "not read: ", ", not read either")
        lines.append(printed(self.table, 4))
        if len(self.effects):
            shown = printed(self.effects.head(SHOWN), 3)
            lines.append(f"missing from the devices' models:\n{shown}")
        lines += [str(self.population)] if self.population else []
        if self.apart:
            least = ", ".join(f"{n} (p = {p:.2g})" for n, p in list(self.apart.items())[:SHOWN])
            lines.append(f"standing out from the population: {least}")
        return "\n".join(lines)


def load_fleet(folder: str | Path) -> FleetResult:
    """Read the results of a fleet; the devices' own stay on disk until they are asked for.

    Raises:
        InputError: there are none of this version in the folder.
    """
    folder = Path(folder)
    try:
        held = read_json(folder / WHOLE)
        if held.pop("schema") != FORMAT:
            raise KeyError("schema")
        table, population = pd.DataFrame(held.pop("coefficients")), held.pop("population")
        population = population and Population.of_data(population)
        effects = pd.DataFrame(held.pop("effects"), columns=EFFECTS)
        return FleetResult(folder, table=table, population=population, effects=effects, **held)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{folder} holds no results of a fleet, or not of this version ({type(error).__name__}: {error}): give "
            "the folder that a batch of partitions was written to"
        ) from None
