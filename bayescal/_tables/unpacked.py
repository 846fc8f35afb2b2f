"""Checks of the unpacked size of a file before it is unpacked, against decompression bombs.

A few megabytes of zeros unpack to gigabytes, arrays may be stated that were never written, nested lists may exhaust
the stack of the library that reads them, and a file may link to others. Readings do none of that.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from pathlib import Path
from typing import Any

from bayescal._tables.raw_table import format_bytes, unusable

SHEET, ARRAYS = (25, 2e7), (100, 1e8)
"""Largest ratio of unpacked to packed size of a format, and unpacked bytes that are always allowed.

Measured: a sheet of constants 10 times, MATLAB's compressed doubles 4 to 7 times, and 700 times a constant alone.
"""
_OBJECTS = 100_000  # groups and arrays of an HDF5 file
_AS_CSV = "Save the readings as CSV"


def refuse_unpacked(file: str, packed: float, unpacked: float, limit: tuple[float, float]) -> None:
    """Raise InputError where a file unpacks to far more than readings do."""
    times, free = limit
    if unpacked > max(free, times * packed):
        fault = (
            f"holds {format_bytes(packed)} that unpack to {format_bytes(unpacked)} or more, at least "
            f"{unpacked / packed:,.0f} times as much; at most {times:g} times are read"
        )
        raise unusable(file, fault, _AS_CSV)


def refuse_hdf5(opened: Any, file: str, size: int) -> None:
    """Raise InputError where an open HDF5 file states too much, has a group in itself, or links to other files."""
    import h5py  # a tenth of a second that other formats do without
    from h5py import h5o  # pyright: ignore[reportAttributeAccessIssue]

    total, waiting, visited = 0, [opened], {h5o.get_info(opened.id).addr}
    while waiting:
        group = waiting.pop()
        for name in group:
            inner, hard = f"{group.name.rstrip('/')}/{name}", group.get(name, getlink=True)
            node = group[name] if isinstance(hard, h5py.HardLink) else None
            array = isinstance(node, h5py.Dataset)
            if node is None or (array and (node.is_virtual or node.external)):
                fault = f"is not all there: {inner} is a link to somewhere else, or its numbers stand in another file"
                raise unusable(file, fault, "Save the readings in the file itself")
            address = h5o.get_info(node.id).addr
            if len(visited) > _OBJECTS or (address in visited and not array):
                fault = f"has the group {inner} twice, or over {_OBJECTS:,} arrays and groups"
                raise unusable(file, fault, _AS_CSV)
            visited.add(address)
            total += int(node.size or 0) * node.dtype.itemsize if array else 0
            waiting += [node] * isinstance(node, h5py.Group)
    refuse_unpacked(file, size, total, ARRAYS)


# Elements of a MATLAB file up to 7.2, and classes of arrays that hold others: cells, structures, objects, functions,
# opaque ones ("MAT-File Format", The MathWorks, 1999 to 2024, chapter 1).
_COMPRESSED, _HOLDS_OTHERS, _FUNCTION = 15, b"[\x01\x02\x03\x10\x11]", 16
_MAX_CONTAINERS = 2000  # in a file: their reader is recursive, and some thousands exhaust the stack


def refuse_matlab(path: Path, file: str) -> None:
    """Raise InputError where a MATLAB file up to 7.2 unpacks to too much, or states or nests too many containers."""
    size, total, holding = path.stat().st_size, 0, 0
    with path.open("rb") as handle:
        head = handle.read(128)
        if 0 in head[:4]:  # version 4: plain matrices, each as long as the file has bytes for
            return
        order = ">" if head[126:] == b"MI" else "<"
        # The array's flags with its class, before its dimensions.
        kinds = b"..." * (order == ">") + _HOLDS_OTHERS
        flags = re.compile(re.escape(struct.pack(f"{order}II", 6, 8)) + kinds, re.DOTALL)
        while len(tag := handle.read(8)) == 8:
            kind, length = struct.unpack(f"{order}II", tag)
            if length > size - handle.tell():
                raise ValueError("a variable is longer than the file")
            data = handle.read(length)
            if kind == _COMPRESSED:
                limit = int(max(ARRAYS[1], ARRAYS[0] * size)) + 1
                data = zlib.decompressobj().decompress(data, limit)
                total += len(data)
                refuse_unpacked(file, size, total, ARRAYS)
            for match in flags.finditer(data):
                holding += 1
                count = 1
                if data[match.end() - 1] < _FUNCTION:  # others state no dimensions
                    (size_bytes,) = struct.unpack_from(f"{order}I", data, match.start() + 20)
                    form = f"{order}{size_bytes // 4}i"
                    count = math.prod(struct.unpack_from(form, data, match.start() + 24))
                if holding > _MAX_CONTAINERS or 8 * count > len(data):
                    fault = f"has over {_MAX_CONTAINERS:,} cells and structures, or declares more data than it holds"
                    raise unusable(file, fault, _AS_CSV)
