"""Files that unpack without end, nest without end, or name other files: refused in words, before they are unpacked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.io

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import run
from tests.support.hostile_files import HEADER, REFUSED, row, sheet, table_rows, write_book

GYRO = mems_gyro.INSTRUMENT


@pytest.mark.slow
@pytest.mark.parametrize("name", REFUSED)
def test_a_hostile_file_is_refused_and_the_refusal_says_why(name, tmp_path) -> None:
    if name.endswith(".xlsx"):
        pytest.importorskip("openpyxl")
    path = tmp_path / name
    REFUSED[name](path)
    assert path.stat().st_size < 40_000_000
    with pytest.raises(bc.InputError):
        bc.read(path, GYRO)


def test_a_sheet_is_read_whole_whatever_size_it_states(tmp_path) -> None:
    """Of 330 rows 110 were read where the sheet stated A1:C111, without a word."""
    pytest.importorskip("openpyxl")
    read = {}
    for stated in ("A1:C331", "A1:C111", "A1:B331", "A1", "A5:C9", "A1:XFD1048576", ""):
        path = tmp_path / "sheet.xlsx"
        write_book(path, sheet(table_rows(330), dimension=stated))
        read[stated] = bc.read(path, GYRO)
        assert len(read[stated]) == 330, stated
        np.testing.assert_array_equal(read[stated]["output"], read["A1:C331"]["output"])


def test_a_row_of_a_sheet_counts_wherever_it_stands(tmp_path) -> None:
    pytest.importorskip("openpyxl")
    path = tmp_path / "sheet.xlsx"
    rows = [row(i + 2, (i, 20 + i, 0.1 * i)) for i in range(5)]
    far = row(1_048_576, (7, 27, 0.7))
    write_book(path, sheet(row(1, tuple(HEADER.split(","))) + "".join(rows) + far))
    assert len(bc.read(path, GYRO)) == 6


@pytest.mark.parametrize("packed", [False, True])
def test_a_structure_of_a_log_is_read_beside_others(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / "log.mat"
    some = {"time": np.arange(9.0), "temperature": 20 + np.arange(9.0), "output": np.arange(9.0)}
    cells = np.empty((2, 3), dtype=object)
    cells[:] = "a cell"
    beside = {"text": "kk", "whole": np.int16(3), "inner": {"cells": cells, "more": {"a": 1.0}}}
    scipy.io.savemat(path, {"log": {**some, **beside}, "cells": cells}, do_compression=packed)
    found = bc.read(path, GYRO, units={"time": "s", "temperature": "degC", "output": "deg/s"})
    np.testing.assert_array_equal(found["output"], some["output"])


HEAD = b"time [s],temperature [degC],output [deg/s]\n"


NO_TABLES = {
    "a quotation mark behind a return": b'\r"', "the same in UTF-16": '\r"'.encode("utf-16"),
    "the same in a header": b'a,b\r"\n1,2\n', "a quotation mark": b'"',
    "quotation marks": b'"' * 200_001, "quoted nothing": b'"",""\n"",""\n',
    "separators": b";;;\n;;;\n", "tabs": b"\t\t\t", "zeros": b"\0" * 50, "a mark": b"\xef\xbb\xbf",
    "a mark of UTF-16": b"\xff\xfe", "a mark and a quotation mark": b'\xef\xbb\xbf"',
    "half a character of UTF-16": b"\xff\xfe\x00\xd8", "returns": b"\r\r\r", "a form feed": b"\x0c",
    "an end of file": b"\x1a", "no characters": b"\xff\xff\xff", "comments": b"# one\n# two",
    "a quotation mark that never ends": HEAD + b'0,"20,1\n1,21,2\n',
    "one in the header": b'time [s],temperature [degC],"output [deg/s]\n0,20,1\n1,21,2\n',
    "quoted text without end": HEAD + b'0,"' + b"x" * 200_000 + b'",1\n1,20,2\n',
    "a name without end": b'"' + b"x" * 200_000 + b'",b\n1,2\n',
    "numbers between blanks": b"0 20 1\n1 21 2\n",
}  # fmt: skip


@pytest.mark.parametrize("content", NO_TABLES.values(), ids=NO_TABLES)
def test_a_file_that_is_no_table_ends_with_status_2(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "content.csv"
    path.write_bytes(content)
    ran = run("fit", path, "--instrument", "mems_gyro")
    assert ran.status == 2
    assert "content.csv" in ran.err and "Traceback" not in ran.err
