"""Files that were made to stop whoever reads them: small on the disk, without end in memory or time."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

HEADER = "time [s],temperature [degC],output [deg/s]"
MANY = 120_000_000  # bytes that a hostile file unpacks to
BOOK = {
    "[Content_Types].xml": '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Override PartName="/xl/workbook.xml" ContentType="application/vnd.openxmlformats-officedocument.'
    'spreadsheetml.sheet.main+xml"/>'
    '<Override PartName="/xl/worksheets/sheet1.xml" ContentType="application/vnd.openxmlformats-officedocument.'
    'spreadsheetml.worksheet+xml"/></Types>',
    "_rels/.rels": '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Id="rId1" Type="http://schemas.openxmlformats.org/officeDocument/2006/relationships/'
    'officeDocument" Target="xl/workbook.xml"/></Relationships>',
    "xl/workbook.xml": '<workbook xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main" xmlns:r='
    '"http://schemas.openxmlformats.org/officeDocument/2006/relationships"><sheets>'
    '<sheet name="a" sheetId="1" r:id="rId1"/></sheets></workbook>',
    "xl/_rels/workbook.xml.rels": '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Id="rId1" Type="http://schemas.openxmlformats.org/officeDocument/2006/relationships/worksheet" '
    'Target="worksheets/sheet1.xml"/></Relationships>',
}


def sheet(rows: str, before: str = "", dimension: str = "") -> str:
    """XML of a sheet with these rows, and the size that it states."""
    stated = f'<dimension ref="{dimension}"/>' if dimension else ""
    space = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    return f'{before}<worksheet xmlns="{space}">{stated}<sheetData>{rows}</sheetData></worksheet>'


def row(number: int, values: tuple[object, ...], columns: str = "ABCDEFGH") -> str:
    """XML of a row: numbers, and text in place."""
    cells = [
        f'<c r="{c}{number}" t="inlineStr"><is><t>{v}</t></is></c>'
        if isinstance(v, str)
        else f'<c r="{c}{number}"><v>{v}</v></c>'
        for c, v in zip(columns, values, strict=False)
    ]
    return f'<row r="{number}">{"".join(cells)}</row>'


def table_rows(count: int) -> str:
    """A header and so many readings of a gyroscope."""
    head = row(1, tuple(HEADER.split(",")))
    return head + "".join(row(i + 2, (i, 20 + i % 50, 0.1 * i)) for i in range(count))


def write_book(path: Path, text: str, **more: bytes) -> None:
    """An Excel file of one sheet, and further parts."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, part in {**BOOK, "xl/worksheets/sheet1.xml": text, **more}.items():
            archive.writestr(name, part)


def book_of_blanks(path: Path) -> None:
    write_book(path, sheet(table_rows(3) + " " * (MANY // 4)))


def book_of_strings(path: Path) -> None:
    more = "<si><t/></si>" * (MANY // 40)
    space = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    part = f'<sst xmlns="{space}">{more}</sst>'.encode()
    write_book(path, sheet(table_rows(3)), **{"xl/sharedStrings.xml": part})


def book_of_laughs(path: Path) -> None:
    lines = ['<!ENTITY a0 "lol">'] + [
        f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12)
    ]
    before = f"<!DOCTYPE worksheet [{''.join(lines)}]>"
    write_book(path, sheet(row(1, ("&a11;",)), before))


def matlab(*variables: bytes) -> bytes:
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H2s", 0x0100, b"IM")
    return head + b"".join(variables)


def matrix(kind: int, inner: bytes, size: tuple[int, int] = (1, 1), name: bytes = b"") -> bytes:
    """A matrix of a MATLAB file: cells (1), numbers (6), …"""
    body = struct.pack("<4I", 6, 8, kind, 0) + struct.pack("<2I2i", 5, 8, *size)
    body += struct.pack("<HH4s", 1, len(name), name) if name else struct.pack("<2I", 1, 0)
    return struct.pack("<2I", 14, len(body + inner)) + body + inner


def matlab_of_zeros(path: Path) -> None:
    count = MANY // 8
    packer, parts = zlib.compressobj(1), []
    head = matrix(6, b"", (count, 1), b"a")[8:] + struct.pack("<2I", 9, 8 * count)
    parts.append(packer.compress(struct.pack("<2I", 14, len(head) + 8 * count) + head))
    parts += [packer.compress(bytes(1 << 20)) for _ in range(1 + MANY // (1 << 20))]
    packed = b"".join([*parts, packer.flush()])
    path.write_bytes(matlab(struct.pack("<2I", 15, len(packed)) + packed))


def matlab_of_cells(path: Path, depth: int = 100_000, torn: bool = False) -> None:
    """Cells in cells; torn: each says that it ends before what it holds, which a reader of cells does not look at."""
    core = matrix(6, struct.pack("<2Id", 9, 8, 1.0))
    plain = matrix(1, b"")[8:]
    sizes = [
        len(plain) if torn else len(core) + len(plain) + i * (8 + len(plain)) for i in range(depth)
    ]
    heads = [struct.pack("<2I", 14, size) + plain for size in sizes]
    inner = b"".join(reversed(heads)) + core
    path.write_bytes(matlab(matrix(1, inner, name=b"a")))


def hdf5(make: Callable[[h5py.File], object]) -> Callable[[Path], None]:
    """A file of NetCDF-4's and MATLAB 7.3's kind."""

    def write(path: Path) -> None:
        with h5py.File(path, "w", userblock_size=512 if path.suffix == ".mat" else 0) as opened:
            make(opened)
        if path.suffix == ".mat":
            with path.open("r+b") as handle:
                handle.write(b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<H2s", 0x0200, b"IM"))

    return write


def never_written(opened: h5py.File) -> None:
    for name in ("time", "output"):
        opened.create_dataset(name, (MANY,), "f8", chunks=(1000,))


def full_of_itself(opened: h5py.File) -> None:
    for level in range(40):
        group = opened.require_group("a" * (level + 1))
        opened[f"b{level}"] = group
        for name in "xyz":
            group[name] = opened["/"]


def leads_to_a_file(opened: h5py.File) -> None:
    opened["output"] = h5py.ExternalLink("/etc/hostname", "/output")


def stands_in_a_file(opened: h5py.File) -> None:
    opened.create_dataset("output", (5,), "u1", external=[("/etc/hostname", 0, 5)])


def parquet_of_ones(path: Path) -> None:
    ones = pa.array(np.ones(1_000_000))
    table = pa.table({"time [s]": ones, "output [deg/s]": ones})
    with pq.ParquetWriter(path, table.schema) as writer:
        for _ in range(MANY // 8_000_000):
            writer.write_table(table)


def text_of(line: str, rows: int = 3) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        count = line.count(",") + 1
        body = "".join(",".join([str(i)] * count) + "\n" for i in range(rows))
        path.write_text(f"{line}\n{body}")

    return write


def endless_line(path: Path) -> None:
    path.write_text(HEADER + "\n" + "1" * (1 << 25))


# File → how it is made. Each is refused, in words; or, where that is said, read.
REFUSED: dict[str, Callable[[Path], None]] = {
    "blanks.xlsx": book_of_blanks,
    "strings.xlsx": book_of_strings,
    "laughs.xlsx": book_of_laughs,
    "zeros.mat": matlab_of_zeros,
    "cells.mat": matlab_of_cells,
    "torn.mat": lambda path: matlab_of_cells(path, torn=True),
    "promised.mat": lambda path: path.write_bytes(matlab(matrix(1, b"", (1 << 28, 1), b"a"))),
    "never_written.mat": hdf5(never_written),
    "full_of_itself.mat": hdf5(full_of_itself),
    "external_link.mat": hdf5(leads_to_a_file),
    "external_file.mat": hdf5(stands_in_a_file),
    "never_written.nc": hdf5(never_written),
    "full_of_itself.nc": hdf5(full_of_itself),
    "external_link.nc": hdf5(leads_to_a_file),
    "external_file.nc": hdf5(stands_in_a_file),
    "ones.parquet": parquet_of_ones,
    "columns.csv": text_of(",".join(f"x{i}" for i in range(200_000))),
    "one_name.csv": text_of(",".join(["x"] * 50_000)),
    "rates.csv": text_of(",".join(f"gyr_{i} [deg/s]" for i in range(20_000))),
    "long_names.csv": text_of(",".join("a_" * 2000 + str(i) for i in range(200))),
    "brackets.csv": text_of(",".join("( " * 5000 + str(i) + ")" for i in range(50))),
    "squares.csv": text_of(",".join("[" * 5000 + str(i) + "]" for i in range(50))),
    "blanks.csv": text_of("time [s]," + ",".join("a" + " " * 20_000 + f"{i}]" for i in range(20))),
    "endless_line.csv": endless_line,
}
