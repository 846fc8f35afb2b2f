"""A sealed file whose pieces are changed and whose checksum is then made right again: what only its reader can see."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import xarray as xr

from bayescal._core.atomic_file import TRAILER_BYTES as TRAILER_BYTES
from bayescal._core.atomic_file import read_sealed, write_sealed


def resealed(path: Path, out: Path, change: Callable[[xr.DataTree], xr.DataTree | None]) -> Path:
    """The calibration in `path`, its tree changed, as `out`."""
    content = io.BytesIO(read_sealed(path, "a saved calibration", ""))
    tree = xr.open_datatree(content, engine="h5netcdf").load()
    tree = change(tree) or tree
    write_sealed(tree.to_netcdf(engine="h5netcdf"), out)
    return out


def described(**changes: Any) -> Callable[[xr.DataTree], None]:
    """A change of a calibration's description; None takes an entry out."""

    def change(tree: xr.DataTree) -> None:
        told = {**json.loads(tree.attrs["bayescal"]), **changes}
        tree.attrs["bayescal"] = json.dumps({k: v for k, v in told.items() if v is not None})

    return change
