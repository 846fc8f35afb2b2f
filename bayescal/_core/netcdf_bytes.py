"""Data sets as the bytes of a NetCDF-4 file.

Xarray's own writer loads Dask's cluster where that is installed, a third of a second, and asks HDF5 for every dimension
again with each variable.
"""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np
import xarray as xr


def netcdf_bytes(groups: Mapping[str, xr.Dataset], **attributes: str) -> memoryview:
    """Return a NetCDF-4 file of numbers and text, made in memory: HDF5 ends the process where a disk is full.

    Args:
        groups: by name; "" is the root.
        **attributes: of the root.

    Raises:
        TypeError: a variable is neither numbers nor text.
    """
    import h5netcdf  # a tenth of a second that only a saved file needs
    import h5py

    content = io.BytesIO()
    with h5netcdf.File(content, "w") as file:
        for name, data in groups.items():
            group = file.create_group(name) if name else file
            group.dimensions = dict(data.sizes)
            for variable, held in data.variables.items():
                values, kind = np.asarray(held.values), None
                if values.dtype.kind in "UO":
                    values, kind = values.astype(object), h5py.string_dtype()
                elif values.dtype.kind not in "fiu":
                    raise TypeError(
                        f"{variable} is of type {values.dtype}: expected numbers or text"
                    )
                made = group.create_variable(variable, held.dims, data=values, dtype=kind)
                made.attrs.update(held.attrs)
        file.attrs.update(attributes)
    return content.getbuffer()
