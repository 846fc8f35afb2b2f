"""Some row groups of a Parquet file as a table of whole devices.

A device whose readings run over the end of a stretch belongs to the stretch in which they begin: its rows at the start
of the next are left out there. So devices stand together in such a file, as they do where it was written by device.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from bayescal._core.errors import InputError
from bayescal._fleet.partitions import Piece
from bayescal._tables.cells import Cells
from bayescal._tables.parquet_netcdf import arrow_cells, field_unit
from bayescal._tables.raw_table import Header, Table, as_format, refuse_large, row_place


def open_row_groups(piece: Piece, device: str, max_bytes: int) -> Table | None:
    """The devices that begin in these row groups; None where none does.

    Args:
        piece: the file and its row groups.
        device: the file's name of the column of devices.
        max_bytes: most that the numbers may take in memory.

    Raises:
        InputError: it is no Parquet, is too large once unpacked, or has no column of devices.
    """
    file, path = piece.path.name, piece.path
    with as_format(file, "Parquet"), pq.ParquetFile(path) as opened:
        schema = opened.schema_arrow
        fields = [schema.field(i) for i in range(len(schema))]
        headers = tuple(Header.parse(f.name, field_unit(f)) for f in fields)
        named = [f.name for f, h in zip(fields, headers, strict=True) if h.name == device]
        if not named:
            raise InputError(
                f"{file!r} has no column {device!r}, and more readings than a partition holds: write it in "
                "several files, or name the column of devices"
            )
        stop, begin, end, ahead = _stretch(opened, piece, named[0])
        digest = _digest(opened, piece, range(piece.groups[0] if piece.groups else 0, stop))
    if begin >= end:
        return None
    refuse_large(file, end - begin, len(fields), max_bytes)
    first = piece.groups[0] if piece.groups else 0

    def load(wanted: Mapping[int, bool]) -> dict[int, Cells]:
        found = {}
        with as_format(file, "Parquet"), pq.ParquetFile(path) as opened:
            for position, number in wanted.items():
                name = fields[position].name
                column = opened.read_row_groups(range(first, stop), columns=[name]).column(name)
                found[position] = arrow_cells(column.slice(begin, end - begin), number)
        pa.default_memory_pool().release_unused()
        return found

    return Table(
        file=file,
        headers=headers,
        rows=end - begin,
        sha256=digest,
        load=load,
        place=lambda index: row_place(ahead + begin + index),
    )


def _stretch(opened: pq.ParquetFile, piece: Piece, column: str) -> tuple[int, int, int, int]:
    """The row group past the last that is read; first row and that past the last; rows before the first group."""
    footer = opened.metadata
    first, stop = piece.groups or (0, footer.num_row_groups)

    def labels(group: int) -> pa.ChunkedArray:
        return opened.read_row_group(group, columns=[column]).column(column).cast(pa.string())

    counts = [footer.row_group(g).num_rows for g in range(footer.num_row_groups)]
    own = pa.chunked_array([c for g in range(first, stop) for c in labels(g).chunks], pa.string())
    begin, end = 0, len(own)
    if first:
        begin = _leading(own, labels(first - 1)[-1])
    if begin == end:
        return stop, begin, end, sum(counts[:first])
    last = own[-1]
    while stop < footer.num_row_groups:
        more = labels(stop)
        own_rows = _leading(more, last)
        end += own_rows
        stop += bool(own_rows)
        if own_rows < len(more):
            break
    return stop, begin, end, sum(counts[:first])


def _leading(labels: pa.ChunkedArray, label: pa.Scalar) -> int:
    """How many labels at the start are this one."""
    other = pc.index(pc.not_equal(labels, label), True).as_py()  # pyright: ignore
    return len(labels) if other < 0 else other


def _digest(opened: pq.ParquetFile, piece: Piece, groups: range) -> str:
    """SHA-256 of the bytes of these row groups, and of where they stand in the file."""
    digest = hashlib.sha256(repr((piece.groups, groups)).encode())
    with piece.path.open("rb") as file:
        for group in groups:
            row_group = opened.metadata.row_group(group)
            for i in range(row_group.num_columns):
                column = row_group.column(i)
                at = column.data_page_offset
                if column.has_dictionary_page and column.dictionary_page_offset:
                    at = min(at, column.dictionary_page_offset)
                file.seek(at)
                digest.update(file.read(column.total_compressed_size))
    return digest.hexdigest()
