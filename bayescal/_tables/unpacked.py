"""What a file unpacks to, looked at before it is unpacked: so that a small file takes neither memory nor time.

A few megabytes of zeros unpack to gigabytes, arrays may be stated that were never written, lists may stand in each
other until the library that reads them ends the process, and a file may name others. Readings do none of that.
"""

from __future__ import annotations

import math
import re
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple

from bayescal._tables.raw_table import bytes_text, unusable

_CHUNK = 1 << 20  # bytes unpacked at a time


class Limit(NamedTuple):
    """How much a format may unpack to: so many times its size, and whatever that is, so many bytes.

    Measured: a sheet of constants 10 times, MATLAB's compressed doubles 4 to 7 times, and 700 times a constant alone.
    """

    times: float
    free: float


SHEET, ARRAYS = Limit(25, 2e7), Limit(100, 1e8)
_OBJECTS = 100_000  # groups and arrays of an HDF5 file


def refuse_unpacked(file: str, packed: float, unpacked: float, limit: Limit) -> None:
    """Refuse a file that unpacks to far more than readings do.

    Raises:
        InputError: it does.
    """
    if unpacked > max(limit.free, limit.times * packed):
        raise unusable(
            file,
            f"holds {bytes_text(packed)} that unpack to {bytes_text(unpacked)} or more, at least "
            f"{unpacked / packed:,.0f} times as much; at most {limit.times:g} times are read",
            "Save the readings as CSV",
        )


def refuse_zip(path: Path, file: str) -> None:
    """Look at the sizes that a ZIP archive, such as an Excel file, states; no more than these are ever unpacked.

    Raises:
        InputError: it unpacks to too much.
        zipfile.BadZipFile: it is none.
    """
    with zipfile.ZipFile(path) as archive:
        total = sum(one.file_size for one in archive.infolist())
    refuse_unpacked(file, path.stat().st_size, total, SHEET)


def refuse_hdf5(opened: Any, file: str, size: int) -> None:
    """Look at an open HDF5 file: what its arrays state, whether its groups end, whether it names other files.

    Raises:
        InputError: it states too much, a group stands in itself, or it leads elsewhere.
    """
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
                raise unusable(
                    file, f"is not all there: {came}", "Save the readings in the file itself"
                )
            address = h5o.get_info(node.id).addr
            if len(seen) > _OBJECTS or (address in seen and not array):
                came = f"has the group {inner} twice, or over {_OBJECTS:,} arrays and groups"
                raise unusable(file, came, "Save the readings as CSV")
            seen.add(address)
            if array:
                total += int(node.size or 0) * node.dtype.itemsize
            else:
                waiting += [node] * isinstance(node, h5py.Group)
    refuse_unpacked(file, size, total, ARRAYS)


# Elements of a MATLAB file up to 7.2, and classes of arrays that hold others: cells, structures, objects, functions,
# opaque ones ("MAT-File Format", The MathWorks, 1999 to 2024, chapter 1).
_MATRIX, _COMPRESSED, _HOLDS_OTHERS = 14, 15, b"\x01\x02\x03\x10\x11"
_MOST_HOLDING = 2000  # of these in a file: their reader calls itself, and some thousands in each other end the process


def refuse_matlab(path: Path, file: str) -> None:
    """Look through a MATLAB file up to 7.2: what its variables unpack to, how many cells and structures it has.

    Raises:
        InputError: it unpacks to too much, has more of them than any, or states more entries than it holds.
    """
    size, total, holding = path.stat().st_size, 0, 0
    with path.open("rb") as handle:
        head = handle.read(128)
        if 0 in head[:4]:  # version 4: plain matrices, each as long as the file has bytes for
            return
        order = ">" if head[126:] == b"MI" else "<"
        classes = (b"..." * (order == ">")) + b"[" + re.escape(_HOLDS_OTHERS) + b"]"
        flags = re.compile(re.escape(struct.pack(f"{order}II", 6, 8)) + classes, re.DOTALL)
        while len(tag := handle.read(8)) == 8:
            kind, length = struct.unpack(f"{order}II", tag)
            if length > size - handle.tell():
                raise ValueError("a variable is longer than the file")
            data = handle.read(length)
            if kind == _COMPRESSED:
                data = _inflated(data, file, size, total)
                total += len(data)
            for found in flags.finditer(data):
                holding += 1
                count = _entries(data, found.start() + 16, order)
                if holding > _MOST_HOLDING or 8 * count > len(data):
                    came = f"has over {_MOST_HOLDING:,} cells and structures, or states {count:,} that it does not hold"
                    raise unusable(file, came, "save the readings as CSV")


def _inflated(packed: bytes, file: str, size: int, before: int) -> bytes:
    """A compressed variable, unpacked as long as the whole stays within what a file may unpack to."""
    inflater, parts, total = zlib.decompressobj(), list[bytes](), before
    while part := inflater.decompress(packed, _CHUNK):
        parts.append(part)
        total += len(part)
        refuse_unpacked(file, size, total, ARRAYS)
        packed = inflater.unconsumed_tail
    return b"".join(parts)


def _entries(data: bytes, at: int, order: str) -> int:
    """How many entries an array states whose dimensions stand at a place; none where none do."""
    if len(data) < at + 8:
        return 0
    kind, length = struct.unpack_from(f"{order}II", data, at)
    begin, length = (
        (at + 4, kind >> 16) if kind >> 16 else (at + 8, min(length, len(data) - at - 8))
    )
    return math.prod(struct.unpack_from(f"{order}{length // 4}i", data, begin))
