"""Atomic writing of readings as CSV, in the format that `read` reads."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bayescal._core.atomic_file import replacing_for_user
from bayescal._core.errors import InputError
from bayescal._core.quoting import csv_cell


def write(
    columns: Mapping[str, np.ndarray], units: Mapping[str, str | None], path: str | Path
) -> Path:
    """Write readings to a .csv file, numbers with all digits and NaN as empty cells; return the path.

    `units`: column → unit of numbers, None for labels.

    Raises:
        InputError: the suffix is not .csv, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".csv":
        raise InputError(
            f"{path.name!r}: readings are written as CSV: give a name that ends in .csv"
        )
    names = [name if units[name] is None else f"{name} [{units[name]}]" for name in columns]
    cells = (
        map(csv_cell, values.tolist())
        if values.dtype.kind in "OU"
        else ("" if value != value else value for value in values.tolist())
        for values in columns.values()
    )
    with (
        replacing_for_user(path) as partial,
        partial.open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(map(csv_cell, names))
        writer.writerows(zip(*cells, strict=True))
    return path
