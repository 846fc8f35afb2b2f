"""NetCDF-4 files of numbers and text, written and read in memory without xarray, whose import takes half a second."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np


class Variable(NamedTuple):
    """Array with named dimensions and attributes, like xarray's `Variable`."""

    dims: tuple[str, ...]
    values: np.ndarray
    attrs: Mapping[str, Any] = {}


Group = Mapping[str, Variable]


def encode_netcdf(groups: Mapping[str, Group], **attributes: str) -> memoryview:
    """Encode groups of variables and root attributes as a NetCDF-4 file in memory, since HDF5 aborts on a full disk."""
    import h5netcdf  # takes a tenth of a second, needed for saved files only
    import h5py

    content = io.BytesIO()
    with h5netcdf.File(content, "w") as file:
        for name, variables in groups.items():
            group = file.create_group(name)
            arrays = variables.values()
            group.dimensions = {d: n for v in arrays for d, n in zip(v.dims, v.values.shape)}  # noqa: B905
            for variable_name, (dims, values, attrs) in variables.items():
                dtype = None
                if values.dtype.kind in "UO":
                    values, dtype = values.astype(object), h5py.string_dtype()
                stored = group.create_variable(variable_name, dims, data=values, dtype=dtype)
                stored.attrs.update(attrs)
        file.attrs.update(attributes)
    return content.getbuffer()


def decode_netcdf(
    content: io.BytesIO, names: Iterable[str]
) -> tuple[dict[str, Group], dict[str, Any]]:
    """Return the groups `names` and the root attributes of a NetCDF-4 file; raise ValueError for a missing group."""
    import h5netcdf

    with h5netcdf.File(content, "r") as file:
        if missing := [name for name in names if name not in file.groups]:
            raise ValueError(f"it has no group {', '.join(missing)}")
        groups = dict[str, Group]()
        for name in names:
            pairs = file[name].variables.items()
            arrays = {n: (v.dimensions, np.asarray(v[...]), dict(v.attrs)) for n, v in pairs}
            groups[name] = {n: Variable(*array) for n, array in arrays.items()}
        return groups, dict(file.attrs)
