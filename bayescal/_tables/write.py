"""Writing of readings, with the units where `read` finds them; files are replaced atomically."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bayescal._core.atomic_file import encode_name, replacing_for_user
from bayescal._core.errors import InputError
from bayescal._core.netcdf import Variable, netcdf_bytes
from bayescal._core.quoting import csv_cell
from bayescal._tables.raw_table import FORMATS

Columns = Mapping[str, np.ndarray]
Units = Mapping[str, str | None]


def write(
    columns: Columns, units: Units, path: str | Path, variables: Mapping[str, Variable]
) -> Path:
    """Write readings in the format that the suffix names (.csv, .parquet or .nc), and return the path.

    `units` are of numbers, None for labels; `variables` hold the same columns for NetCDF.

    Raises:
        InputError: another suffix, no such folder, or a place that cannot be written to.
    """
    path = Path(path)
    if (suffix := path.suffix.lower()) not in FORMATS:
        raise InputError(
            f"{path.name!r}: readings cannot be written as "
            f"{path.suffix or 'a file without a suffix'!r}; choose {', '.join(FORMATS)}"
        )
    named = {name if units[name] is None else f"{name} [{units[name]}]": name for name in columns}
    with replacing_for_user(path) as partial:
        if suffix == ".csv":
            _write_csv({header: columns[name] for header, name in named.items()}, partial)
        elif suffix == ".parquet":
            _write_parquet(columns, units, named, partial)
        else:
            group = {encode_name(name): variable for name, variable in variables.items()}
            partial.write_bytes(netcdf_bytes({"": group}))
    return path


def _write_csv(columns: Columns, path: Path) -> None:
    """Write numbers with all their digits; NaN as empty cells."""
    cells = (
        map(csv_cell, values.tolist())
        if values.dtype.kind in "OU"
        else ("" if value != value else value for value in values.tolist())
        for values in columns.values()
    )
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(map(csv_cell, columns))
        writer.writerows(zip(*cells, strict=True))


def _write_parquet(columns: Columns, units: Units, named: Mapping[str, str], path: Path) -> None:
    import pyarrow as pa  # a tenth of a second that text does without
    import pyarrow.parquet as pq

    arrays, fields = [], []
    for header, name in named.items():
        unit, values = units[name], columns[name]
        kind = pa.string() if unit is None else pa.float64()
        arrays.append(pa.array(values.tolist() if unit is None else values, type=kind))
        fields.append(pa.field(header, kind, metadata=None if unit is None else {"units": unit}))
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), path)
