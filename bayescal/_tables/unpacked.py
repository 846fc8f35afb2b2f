"""What a file unpacks to, looked at before it is unpacked: so that a small file takes neither memory nor time.

A few megabytes of zeros unpack to gigabytes, arrays may be stated that were never written, lists may stand in each
other until the library that reads them ends the process, and a file may name others. Readings do none of that.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from bayescal._core.errors import InputError
from bayescal._core.json_shape import DEEPEST
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
    """Look at an open HDF5 file: what its arrays state, how deep its groups go, whether it names other files.

    Raises:
        InputError: it states too much, is nested deeper than any, or leads elsewhere.
    """
    import h5py  # a tenth of a second that other formats do without
    from h5py import h5o  # pyright: ignore[reportAttributeAccessIssue]

    total, waiting = 0, [(opened, 0)]
    seen = {h5o.get_info(opened.id).addr}
    while waiting:
        group, depth = waiting.pop()
        for name in group:
            link, inner = group.get(name, getlink=True), f"{group.name.rstrip('/')}/{name}"
            if not isinstance(link, h5py.HardLink):
                raise InputError(
                    f"{file!r}: {inner} is a link to somewhere else, which is not followed. Save the readings in the "
                    "file itself"
                )
            node = group[name]
            address = h5o.get_info(node.id).addr
            if address in seen and isinstance(node, h5py.Group):
                raise InputError(f"{file!r}: the group {inner} stands there twice, or in itself")
            seen.add(address)
            if len(seen) > _OBJECTS or depth >= DEEPEST:
                raise unusable(
                    file,
                    f"has more than {_OBJECTS:,} arrays and groups, or groups in each other deeper than {DEEPEST}",
                    "save the readings as CSV",
                )
            if isinstance(node, h5py.Group):
                waiting.append((node, depth + 1))
            elif isinstance(node, h5py.Dataset):
                if node.is_virtual or node.external:
                    raise InputError(
                        f"{file!r}: the numbers of {inner} stand in another file, which is not read. Save them in the "
                        "file itself"
                    )
                total += int(node.size or 0) * node.dtype.itemsize
    refuse_unpacked(file, size, total, ARRAYS)


# Matrices in a MATLAB file up to 7.2 ("MAT-File Format", The MathWorks, 1999 to 2024, chapter 1).
_MATRIX, _COMPRESSED = 14, 15  # kinds of elements
_CELL, _STRUCT, _OBJECT, _FUNCTION, _OPAQUE = 1, 2, 3, 16, 17  # classes of arrays
_SPARSE, _COMPLEX = 5, 0x800  # one of them, and a flag
_HOLDS_OTHERS = (_CELL, _STRUCT, _OBJECT, _FUNCTION, _OPAQUE)


def refuse_matlab(path: Path, file: str) -> None:
    """Look through a MATLAB file up to 7.2: what its compressed variables unpack to, how deep cells and structures go.

    Raises:
        InputError: it unpacks to too much, is nested deeper than any, or contradicts itself where it is nested.
    """
    size, total = path.stat().st_size, 0
    with path.open("rb") as handle:
        head = handle.read(128)
        if 0 in head[:4]:  # version 4: plain matrices, each as long as the file has bytes for
            return
        order = ">" if head[126:] == b"MI" else "<"
        while len(tag := handle.read(8)) == 8:
            kind, length = struct.unpack(f"{order}II", tag)
            if length > size - handle.tell():
                raise ValueError("a variable is longer than the file")
            if kind == _COMPRESSED:
                packed = handle.read(length)
                total += sum(map(len, _inflated(packed, file, size, total)))
                begin = zlib.decompressobj().decompress(packed, 32)
                nested = _class_of(begin, order) in _HOLDS_OTHERS
                data = b"".join(_inflated(packed, file, size, 0)) if nested else b""
            elif kind == _MATRIX:
                data = tag + handle.read(length)
                data = data if _class_of(data, order) in _HOLDS_OTHERS else b""
            else:
                handle.seek(length, 1)
                continue
            if data:
                _end_of_matrix(data, 0, len(data), order, file)


def _inflated(packed: bytes, file: str, size: int, before: int) -> Iterator[bytes]:
    """A compressed variable, a piece at a time, as long as the whole stays within what a file may unpack to."""
    inflater, total = zlib.decompressobj(), before
    piece = inflater.decompress(packed, _CHUNK)
    while piece:
        total += len(piece)
        refuse_unpacked(file, size, total, ARRAYS)
        yield piece
        piece = inflater.decompress(inflater.unconsumed_tail, _CHUNK)


def _class_of(data: bytes, order: str) -> int:
    """Of a matrix: cells, a structure, numbers, …"""
    return struct.unpack_from(f"{order}I", data, 16)[0] & 0xFF if len(data) >= 20 else 0


def _element(data: bytes, at: int, order: str) -> tuple[int, int, int, int]:
    """Kind of an element, where its bytes begin, how many there are, and where the next element begins."""
    kind, length = struct.unpack_from(f"{order}II", data, at)
    if kind >> 16:  # a small one: both numbers and the bytes in eight
        return kind & 0xFFFF, at + 4, kind >> 16, at + 8
    return kind, at + 8, length, at + 8 + (length if kind == _MATRIX else -(-length // 8) * 8)


def _end_of_matrix(data: bytes, at: int, limit: int, order: str, file: str, depth: int = 0) -> int:
    """Walk through a matrix and those in it; each must hold what it states, and end where it says.

    Raises:
        InputError: they are nested deeper than any.
        ValueError, struct.error: they contradict themselves: their reader would go on behind them.
    """
    kind, begin, length, end = _element(data, at, order)
    if kind != _MATRIX or end > limit:
        raise ValueError("a cell or structure holds something else than it says")
    if not length:
        return end
    flags = struct.unpack_from(f"{order}I", data, begin + 8)[0]
    if flags & 0xFF in _HOLDS_OTHERS:
        if depth >= DEEPEST:
            came = f"has cells or structures in each other deeper than {DEEPEST}"
            raise unusable(file, came, "save the readings as CSV")
        count, at = _held(data, begin, end, order)
        for _ in range(count):
            at = _end_of_matrix(data, at, end, order, file, depth + 1)
    else:  # numbers or text: the parts of its kind
        at = begin
        for _ in range(3 + {_SPARSE: 3}.get(flags & 0xFF, 1) + bool(flags & _COMPLEX)):
            *_, at = _element(data, at, order)
    if at != end:
        raise ValueError("a cell or structure, or what it holds, does not end where it says")
    return end


def _held(data: bytes, at: int, end: int, order: str) -> tuple[int, int]:
    """How many matrices one holds, and where the first begins."""
    kind, elements = data[at + 8] if order == "<" else data[at + 11], list[tuple[int, int]]()
    while at < end:
        told, begin, length, after = _element(data, at, order)
        if told == _MATRIX:
            break
        elements.append((begin, length))
        at = after
    if kind in (_FUNCTION, _OPAQUE):
        return 1, at
    begin, length = elements[1]
    count = 1
    for size in struct.unpack_from(f"{order}{length // 4}i", data, begin):
        count *= size
    if kind in (_STRUCT, _OBJECT):
        width, names = (elements[-2], elements[-1])
        longest = struct.unpack_from(f"{order}i", data, width[0])[0]
        count *= names[1] // max(longest, 1)
    return count, at
