"""Readings written, with the units where `read` finds them.

Everything is written beside its place and then renamed, so a file is there whole or not at all.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import xarray as xr

from bayescal._core.atomic_file import renamed, replacing_for_user, storable
from bayescal._core.errors import InputError
from bayescal._core.netcdf_bytes import netcdf_bytes
from bayescal._core.quoting import csv_cell
from bayescal._tables.raw_table import FORMATS


def write(dataset: xr.Dataset, path: str | Path) -> Path:
    """Write a data set of readings in the format that the suffix names.

    Args:
        dataset: one dimension, numbers with the attribute `units`, and text.
        path: ending in .csv, .parquet or .nc.

    Returns:
        The path.

    Raises:
        InputError: another suffix, no such folder, or a place that cannot be written to.
    """
    path = Path(path)
    writers: dict[str, Callable[[xr.Dataset, Path], None]] = {
        ".csv": _write_csv,
        ".parquet": _write_parquet,
        ".nc": _write_netcdf,
    }
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise InputError(
            f"{path.name!r}: readings cannot be written as "
            f"{path.suffix or 'a file without a suffix'!r}; choose {', '.join(FORMATS)}"
        )
    with replacing_for_user(path) as partial:
        writer(dataset, partial)
    return path


def _columns(dataset: xr.Dataset) -> dict[str, np.ndarray]:
    """Values under `name [unit]`, labels under their name."""
    found = {}
    for name, variable in dataset.data_vars.items():
        unit = variable.attrs.get("units")
        found[str(name) if unit is None else f"{name} [{unit}]"] = variable.values
    return found


def _write_csv(dataset: xr.Dataset, path: Path) -> None:
    made = {
        csv_cell(name): list(map(csv_cell, values)) if values.dtype.kind in "OU" else values
        for name, values in _columns(dataset).items()
    }
    frame = pd.DataFrame(made)
    frame.to_csv(path, index=False, lineterminator="\n", encoding="utf-8")


def _write_parquet(dataset: xr.Dataset, path: Path) -> None:
    arrays, fields = [], []
    units = [variable.attrs.get("units") for variable in dataset.data_vars.values()]
    for (name, values), unit in zip(_columns(dataset).items(), units, strict=True):
        kind = pa.string() if unit is None else pa.float64()
        metadata = None if unit is None else {"units": unit}
        arrays.append(pa.array(values.tolist() if unit is None else values, type=kind))
        fields.append(pa.field(name, kind, metadata=metadata))
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), path)


def _write_netcdf(dataset: xr.Dataset, path: Path) -> None:
    path.write_bytes(netcdf_bytes(renamed(dataset, storable)))
