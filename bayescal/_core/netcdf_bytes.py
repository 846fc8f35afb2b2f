"""A DataTree or Dataset as the bytes of a NetCDF-4 file, which is HDF5 with dimensions written as dimension scales.

Xarray's own writer asks HDF5 for every dimension again with each variable, 5 ms each: half the time of saving a
calibration, and a tenth of a step of the workbench. What it reads is the same.

Layout: Unidata, "NetCDF-4 format specification" (NetCDF C library, appendix C).
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import xarray as xr
from xarray.conventions import encode_dataset_coordinates

from bayescal._core.version import __version__

# Of a dimension that has no values of its own; with its size in ten places behind.
WITHOUT_VALUES = "This is a netCDF dimension but not a netCDF variable."


def netcdf_bytes(data: xr.DataTree | xr.Dataset) -> memoryview:
    """The bytes of a NetCDF-4 file of numbers, text and truth values.

    In memory, because HDF5 ends the process where it writes to a full disk itself.

    Raises:
        TypeError: a variable is neither numbers, text nor truth values.
    """
    import h5py  # a tenth of a second that only a saved file needs

    tree = data if isinstance(data, xr.DataTree) else xr.DataTree(data)
    content, count = io.BytesIO(), 0
    with h5py.File(content, "w", track_order=True) as file:
        file.attrs["_NCProperties"] = np.bytes_(f"version=2,bayescal={__version__}")
        for node in tree.subtree:
            own = node.to_dataset(inherit=False)
            parent, _, name = node.path.rpartition("/")
            above: Any = file[parent or "/"]
            group = above.create_group(name, track_order=True) if name else above
            _write_group(group, own, count)
            count += len(own.sizes)
    return content.getbuffer()


def _write_group(group: Any, own: xr.Dataset, first: int) -> None:
    """A group's dimensions, numbered from `first` on, then its other variables."""
    variables, attributes = encode_dataset_coordinates(own)
    group.attrs.update(attributes)
    scales, numbers = {}, {}
    for number, (dim, size) in enumerate(own.sizes.items(), start=first):
        if dim in variables:
            scale, title = _write_variable(group, dim, variables[dim]), str(dim)
        else:
            scale = group.create_dataset(dim, (size,), ">f4", maxshape=(size or None,))
            title = f"{WITHOUT_VALUES}{size:10}"
        scale.make_scale(title)
        scale.attrs["_Netcdf4Dimid"] = np.int32(number)
        scales[dim], numbers[dim] = scale, number
    for name, variable in variables.items():
        if name in scales:
            continue
        made = _write_variable(group, name, variable)
        for axis, dim in enumerate(variable.dims):
            made.dims[axis].attach_scale(scales[dim])
        if variable.dims:
            made.attrs["_Netcdf4Coordinates"] = np.array(
                [numbers[d] for d in variable.dims], np.int32
            )


def _write_variable(group: Any, name: Any, variable: xr.Variable) -> Any:
    import h5py

    values, attributes = np.asarray(variable.values), dict(variable.attrs)
    kind: Any = values.dtype
    if kind.kind == "b":  # of which NetCDF has none: as xarray writes it
        kind, attributes["dtype"] = np.int8, "bool"
    elif kind.kind in "UO":
        kind, values = h5py.string_dtype(), values.astype(object)
    elif kind.kind not in "fiu":
        raise TypeError(f"{name} is of type {kind}: expected numbers, text or truth values")
    # HDF5 has a dimension scale without values only where the dimension may grow.
    limits = tuple(size or None for size in values.shape)
    grows = {"maxshape": limits} if None in limits else {}
    made = group.create_dataset(name, data=values, dtype=kind, track_order=True, **grows)
    made.attrs.update(attributes)
    return made
