"""Bounds on what a file may unpack to, checked before it is unpacked.

A few megabytes of zeros unpack to gigabytes, arrays may be stated that were never written, lists may be nested until
the library that reads them ends the process, and a file may name others. Readings do none of that.
"""

from __future__ import annotations

import math
import re
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

from bayescal._tables.raw_table import bytes_text, unusable

# How many times its size a format may unpack to, and how many bytes whatever its size. Measured: a sheet of constants
# 10 times, MATLAB's compressed doubles 4 to 7 times, and 700 times a constant alone.
SHEET, ARRAYS = (25, 2e7), (100, 1e8)
MAX_HDF5_OBJECTS = 100_000
# Cells and structures of a MATLAB file: their reader is recursive, and some thousands in each other end the process.
MAX_MATLAB_CONTAINERS = 2000
# "MAT-File Format", The MathWorks, chapter 1: a compressed element; classes of arrays that contain others.
_COMPRESSED, _CONTAINERS = 15, b"\x01\x02\x03\x10\x11"
_CHUNK = 1 << 20  # bytes unpacked at a time


def refuse_unpacked(file: str, packed: float, unpacked: float, limit: tuple[float, float]) -> None:
    """Raise InputError where a file unpacks to far more than readings do."""
    if unpacked > max(limit[1], limit[0] * packed):
        came = f"holds {bytes_text(packed)} that unpack to {bytes_text(unpacked)} or more"
        more = f"at least {unpacked / packed:,.0f} times as much; at most {limit[0]} times are read"
        raise unusable(file, f"{came}, {more}", "Save the readings as CSV")


def refuse_zip(path: Path, file: str) -> None:
    """Raise InputError where the sizes that a ZIP archive states, beyond which nothing is unpacked, are too large."""
    with zipfile.ZipFile(path) as archive:
        total = sum(member.file_size for member in archive.infolist())
    refuse_unpacked(file, path.stat().st_size, total, SHEET)


def refuse_hdf5(opened: Any, file: str, size: int) -> None:
    """Raise InputError where an open HDF5 file states too much, has a group in itself, or links to other files."""
    import h5py  # a tenth of a second that other formats do without
    from h5py import h5o  # pyright: ignore[reportAttributeAccessIssue]

    total, waiting, seen = 0, [opened], {h5o.get_info(opened.id).addr}
    while waiting:
        group = waiting.pop()
        for name in group:
            hard = isinstance(group.get(name, getlink=True), h5py.HardLink)
            node, inner = group[name] if hard else None, f"{group.name.rstrip('/')}/{name}"
            array = isinstance(node, h5py.Dataset)
            if not hard or (array and (node.is_virtual or node.external)):
                came = f"{inner} is a link to somewhere else, or its numbers stand in another file"
                cure = "Save the readings in the file itself"
                raise unusable(file, f"is not all there: {came}", cure)
            address = h5o.get_info(node.id).addr
            if len(seen) > MAX_HDF5_OBJECTS or (address in seen and not array):
                came = (
                    f"has the group {inner} twice, or over {MAX_HDF5_OBJECTS:,} arrays and groups"
                )
                raise unusable(file, came, "Save the readings as CSV")
            seen.add(address)
            total += int(node.size or 0) * node.dtype.itemsize if array else 0
            waiting += [node] * isinstance(node, h5py.Group)
    refuse_unpacked(file, size, total, ARRAYS)


def refuse_matlab(path: Path, file: str) -> None:
    """Raise InputError where a MATLAB file up to 7.2 unpacks to too much, or states or nests too many containers."""
    size, total, containers = path.stat().st_size, 0, 0
    with path.open("rb") as handle:
        head = handle.read(128)
        if 0 in head[:4]:  # version 4: plain matrices, each as long as the file has bytes for
            return
        order = ">" if head[126:] == b"MI" else "<"
        classes = (b"..." * (order == ">")) + b"[" + re.escape(_CONTAINERS) + b"]"
        flags = re.compile(re.escape(struct.pack(f"{order}II", 6, 8)) + classes, re.DOTALL)
        while len(tag := handle.read(8)) == 8:
            kind, length = struct.unpack(f"{order}II", tag)
            if length > size - handle.tell():
                raise ValueError("a variable is longer than the file")
            data, packed = bytearray(), handle.read(length)
            if kind == _COMPRESSED:
                inflater = zlib.decompressobj()
                while part := inflater.decompress(packed, _CHUNK):
                    data += part
                    packed = inflater.unconsumed_tail
                    refuse_unpacked(file, size, total + len(data), ARRAYS)
                total += len(data)
            for found in flags.finditer(data or packed):
                containers += 1
                count = _entries(data or packed, found.start() + 16, order)
                if containers > MAX_MATLAB_CONTAINERS or 8 * count > len(data or packed):
                    came = f"has over {MAX_MATLAB_CONTAINERS:,} cells and structures, or states {count:,}"
                    raise unusable(
                        file, f"{came} that it does not hold", "save the readings as CSV"
                    )


def _entries(data: bytes | bytearray, at: int, order: str) -> int:
    """Number of entries that the dimensions at a place in a MATLAB file state; 0 where there are none."""
    if len(data) < at + 8:
        return 0
    kind, length = struct.unpack_from(f"{order}II", data, at)
    small = kind >> 16  # bytes of an element packed into its own tag
    begin, length = (at + 4, small) if small else (at + 8, min(length, len(data) - at - 8))
    return math.prod(struct.unpack_from(f"{order}{length // 4}i", data, begin))
