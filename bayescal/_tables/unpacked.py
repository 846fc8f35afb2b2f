"""Checks of the decompressed size of a file before it is decompressed, against decompression bombs.

A few megabytes of zeros decompress to gigabytes, arrays may be declared but never written, nested lists may exhaust the
stack of the library that reads them, and a file may link to others. Files of readings have none of these.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from pathlib import Path
from typing import Any

from bayescal._tables.raw_table import format_bytes, unusable

SHEET_LIMIT, ARRAYS = (25, 2e7), (100, 1e8)
"""Limits of a format: ratio of decompressed to compressed size, and decompressed size in bytes that is always allowed.

Measured ratios: sheet of constants 10, MATLAB's compressed doubles 4 to 7, a single constant 700.
"""
_MAX_OBJECTS = 100_000  # number of groups and arrays of an HDF5 file
_CSV_ADVICE = "Save the readings as CSV"


def refuse_unpacked(file_name: str, packed: int, unpacked: int, limit: tuple[float, float]) -> None:
    """Raise InputError if the decompressed size of a file, bytes, exceeds the `limit` of its format."""
    max_ratio, min_bytes = limit
    if unpacked > max(min_bytes, max_ratio * packed):
        fault = (
            f"decompresses from {format_bytes(packed)} to {format_bytes(unpacked)} or more, a ratio of "
            f"{unpacked / packed:,.0f}, above the limit of {max_ratio:g}"
        )
        raise unusable(file_name, fault, _CSV_ADVICE)


def refuse_hdf5(hdf5: Any, file_name: str, size: int) -> None:
    """Raise InputError if an open HDF5 file is too large, has circular groups, or links to other files."""
    import h5py  # takes a tenth of a second
    from h5py import h5o  # pyright: ignore[reportAttributeAccessIssue]

    total_size, pending, visited = 0, [hdf5], {h5o.get_info(hdf5.id).addr}
    while pending:
        group = pending.pop()
        for name in group:
            path, link = f"{group.name.rstrip('/')}/{name}", group.get(name, getlink=True)
            node = group[name] if isinstance(link, h5py.HardLink) else None
            is_array = isinstance(node, h5py.Dataset)
            if node is None or (is_array and (node.is_virtual or node.external)):
                fault = f"is incomplete: {path} is a link, or its numbers are in another file"
                raise unusable(file_name, fault, "Save the readings in the file itself")
            address = h5o.get_info(node.id).addr
            is_repeated = address in visited and not is_array
            if is_repeated or len(visited) > _MAX_OBJECTS:
                fault = f"contains more than {_MAX_OBJECTS:,} arrays and groups"
                fault = f"contains the group {path} twice (by a link)" if is_repeated else fault
                raise unusable(file_name, fault, _CSV_ADVICE)
            visited.add(address)
            total_size += int(node.size or 0) * node.dtype.itemsize if is_array else 0
            pending += [node] * isinstance(node, h5py.Group)
    refuse_unpacked(file_name, size, total_size, ARRAYS)


# Elements of a MAT-file up to version 7.2; classes of arrays that contain others: cells, structures, objects,
# functions, opaque objects ("MAT-File Format", The MathWorks, 1999 to 2024, chapter 1).
_COMPRESSED, _CONTAINER_CLASSES, _FUNCTION = 15, b"[\x01\x02\x03\x10\x11]", 16
_MAX_CONTAINERS = 2000  # in a file, since some thousands exhaust the stack of the recursive reader


def refuse_matlab(path: Path, file_name: str) -> None:
    """Raise InputError if a MAT-file (up to 7.2) is too large decompressed, or has too many cells and structures."""
    size, total_size, container_count = path.stat().st_size, 0, 0
    with path.open("rb") as handle:
        header = handle.read(128)
        if 0 in header[:4]:  # version 4: uncompressed matrices
            return
        order = ">" if header[126:] == b"MI" else "<"
        # Pattern of the array flags with the class, which precede the dimensions.
        kinds = b"..." * (order == ">") + _CONTAINER_CLASSES
        flags = re.compile(re.escape(struct.pack(f"{order}II", 6, 8)) + kinds, re.DOTALL)
        while len(tag := handle.read(8)) == 8:
            kind, length = struct.unpack(f"{order}II", tag)
            if length > size - handle.tell():
                raise ValueError("a variable is longer than the file")
            data = handle.read(length)
            if kind == _COMPRESSED:
                limit = int(max(ARRAYS[1], ARRAYS[0] * size)) + 1
                data = zlib.decompressobj().decompress(data, limit)
                total_size += len(data)
                refuse_unpacked(file_name, size, total_size, ARRAYS)
            for match in flags.finditer(data):
                container_count += 1
                count = 1
                if data[match.end() - 1] < _FUNCTION:  # others have no dimensions
                    (size_bytes,) = struct.unpack_from(f"{order}I", data, match.start() + 20)
                    layout = f"{order}{size_bytes // 4}i"
                    count = math.prod(struct.unpack_from(layout, data, match.start() + 24))
                if container_count > _MAX_CONTAINERS or 8 * count > len(data):
                    fault = f"has over {_MAX_CONTAINERS:,} cells and structures, or declares more data than it holds"
                    raise unusable(file_name, fault, _CSV_ADVICE)
