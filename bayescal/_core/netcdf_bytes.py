"""A DataTree or Dataset as the bytes of a NetCDF-4 file, which is HDF5 with dimensions written as dimension scales.

Xarray's own writer asks HDF5 for every dimension again with each variable, 5 ms each: half the time of saving a
calibration, and a tenth of a step of the workbench; its reader asks for the variable again with each attribute, nearly
four thousand times for a calibration: three quarters of the time of loading one. What they write and read is the same.

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
_WITHOUT_VALUES = WITHOUT_VALUES.encode("ascii")


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


# Of a variable, for HDF5 and NetCDF themselves.
_NOT_OF_PEOPLE = {
    *("CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST", "_FillValue"),
    *("_Netcdf4Dimid", "_Netcdf4Coordinates", "_NCProperties"),
}


def netcdf_tree(file: Any) -> xr.DataTree:
    """The tree in an open NetCDF-4 file of numbers, text and truth values, all of it in memory.

    Args:
        file: an `h5py.File`, of `netcdf_bytes` or of xarray, whose links lead nowhere else (`refuse_hdf5`).

    Raises:
        LookupError, ValueError, RuntimeError: it is no such file.
    """
    import h5py

    found, waiting = {}, [file]
    while waiting:
        group = waiting.pop()
        found[group.name] = _read_group(group)
        waiting += [inner for inner in group.values() if isinstance(inner, h5py.Group)][::-1]
    return xr.DataTree.from_dict(found)


def _read_group(group: Any) -> xr.Dataset:
    import h5py

    variables, attributes = {}, _attributes_of(group)
    beside = attributes.pop("coordinates", "").split()
    for name, node in group.items():
        if isinstance(node, h5py.Group):
            continue
        title = node.attrs.get("NAME", b"")
        if (title if isinstance(title, bytes) else title.encode()).startswith(_WITHOUT_VALUES):
            continue
        dims = (name,) if node.is_scale else tuple(d[0].name.rpartition("/")[2] for d in node.dims)
        values, own = node[()], _attributes_of(node)
        if h5py.check_string_dtype(node.dtype):
            values = np.asarray(node.asstr()[()], str)
        elif own.pop("dtype", "") == "bool":
            values = np.asarray(values, bool)
        beside += own.pop("coordinates", "").split()
        variables[name] = xr.Variable(dims, values, own)
    return xr.Dataset(variables, attrs=attributes).set_coords(beside)


def _attributes_of(node: Any) -> dict[str, Any]:
    found = {name: value for name, value in node.attrs.items() if name not in _NOT_OF_PEOPLE}
    # A number is an array of one to NetCDF.
    return {n: v if isinstance(v, str) or np.size(v) != 1 else v.item() for n, v in found.items()}
