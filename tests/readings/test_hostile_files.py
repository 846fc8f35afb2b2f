"""Forty files as laboratories have them: each is read right, or refused once with all that is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import timedelta
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pytest

import bayescal as bc
from tests.support.gyro_files import GYRO
from tests.support.lab_files import (
    HEAD,
    RATE,
    TEMPERATURE,
    TIME,
    counted,
    dated,
    is_right,
    iso,
    spaced,
    text,
    when,
    with_cell,
)


class Good(NamedTuple):
    """A file that is read right: its content, options, and how near the numbers are."""

    content: str | bytes
    options: Mapping[str, Any] = MappingProxyType({})
    left_out: tuple[int, ...] = ()


def beside(day: str, clock: str) -> str:
    columns = when(lambda m: f"{m:{day}}"), when(lambda m: f"{m:{clock}}"), TEMPERATURE, RATE
    return text(("Dato", "Time", *HEAD[1:]), columns)


OUTPUT = {"columns": {"output": "gyro_z"}}
GYRO_Z_UNITS = {"time": "s", "temp": "degC", "gyro_z": "dps"}
READ = {
    "as it should be": Good(text()),
    "units in round brackets": Good(text(("Time (s)", "Temp (°C)", "Output (°/s)"))),
    "C for °C": Good(text(("time [s]", "temperature [C]", "output [deg/s]"))),
    "units behind a slash": Good(text(("t/s", "T/°C", "output/(deg/s)"))),
    "quantities over units": Good(
        text(("t/ms", "T/°C", "ω/(°/s)"), (1e3 * TIME, TEMPERATURE, RATE)), {"columns": {"output": "ω/(°/s)"}}
    ),
    "Windows, decimal commas": Good(
        text(("Time [s]", "Temperature [°C]", "Rate [°/s]"), separator=";", decimal=",").encode("cp1252"),
        {"columns": {"output": "Rate"}},
    ),
    "units behind underscores": Good(text(("t_s", "Temp_C", "gyro_z_dps")), {"columns": {"output": "gyro_z_dps"}}),
    "units given": Good(text(("time", "temp", "gyro_z")), {**OUTPUT, "units": GYRO_Z_UNITS}),
    "kelvin and radians": Good(
        text(("time [ms]", "temperature [K]", "output [rad/s]"), (TIME * 1e3, TEMPERATURE + 273.15, np.radians(RATE)))
    ),
    "degrees an hour": Good(text((*HEAD[:2], "output_dph"), (TIME, TEMPERATURE, RATE * 3600))),
    "other letters": Good(text(("TIME [S]", "TEMPERATURE [DEGC]", "Output [Deg/s]"))),
    "byte order mark": Good("\ufeff" + text()),
    "UTF-16": Good(text().encode("utf-16")),
    "Latin-1": Good(text(("t [s]", "Temp [°C]", "output [°/s]")).encode("latin-1")),
    "carriage returns": Good(text().replace("\n", "\r\n")),
    "semicolons": Good(text(separator=";")),
    "tabs": Good(text(separator="\t")),
    "decimal commas": Good(text(separator=";", decimal=",")),
    "decimal commas between tabs": Good(text(separator="\t", decimal=",")),
    "comments and blank lines": Good("# test 7\n\n" + text() + "\n\n"),
    "ISO": Good(dated(iso)),
    "ISO with Z": Good(dated(iso, "time", "Z")),
    "ISO with an offset": Good(dated(iso, "time", "+03:00")),
    "date and time": Good(dated(spaced)),
    "day first, with points": Good(dated(lambda m: f"{m:%d.%m.%Y %H:%M:%S}.{m.microsecond // 1000:03}", "Date")),
    "points in times": Good(dated(lambda m: f"{m:%d/%m/%Y %H.%M.%S}.{m.microsecond // 1000:03}")),
    "points in dates and times": Good(
        dated(lambda m: f"{m.day}.{m.month}.{m.year} klo {m:%H.%M.%S}.{m.microsecond // 1000:03}", "Aika")
    ),
    "points in times beside a day": Good(beside("%d-%m-%Y", "%H.%M.%S")),
    "a midnight, a day missing": Good(with_cell(4, 0, "-", beside("%Y-%m-%d 00:00", "%T")), {"missing": "drop"}, (2,)),
    "blanks": Good(text(separator="   ")),
    "blanks and tabs": Good(text(separator=" \t ").replace("\n", "  \r\n")),
    "blanks, units that touch": Good(text(("time[s]", "temperature[°C]", "output[deg / s]"), separator=" ")),
    "blanks, no units": Good(
        text(("time", "temperature", "output"), separator="  "),
        {"units": {"time": "s", "temperature": "degC", "output": "deg/s"}},
    ),
    "blanks, a row of units": Good(
        "Unit 7, lab 3, on a table\n"
        + text(("time", "temperature", "output"), separator="  ").replace("output\n", "output\n [s]  [degC]  [deg/s]\n")
    ),
    "blanks, decimal commas": Good(text(separator="  ", decimal=",")),
    "blanks, dates with one": Good(dated(spaced).replace(",", "   ")),
    "names in a comment": Good("# made by a script\n# " + text(separator=" ")),
    "Unix seconds": Good(counted(1, "timestamp")),
    "Unix milliseconds": Good(counted(1_000, "timestamp")),
    "Unix microseconds": Good(counted(1_000_000, "timestamp")),
    "Unix microseconds, said": Good(counted(1_000_000, "time [us]")),
    "month first": Good(dated(lambda m: f"{m:%m/%d/%Y %H:%M:%S}.{m.microsecond // 1000:03}")),
    "day first, as the day says": Good(dated(lambda m: f"{m:%d/%m/%Y-%H:%M:%S}")),
    "day first, as the user says": Good(
        dated(lambda m: f"{m - timedelta(days=20):%d/%m/%y %I:%M:%S %p}"), {"date_order": "dmy"}
    ),
    "the month as a word": Good(dated(lambda m: f"{m:%d}-{('Aug', 'août', 'ago')[m.second % 3]}-{m:%Y %H:%M:%S}")),
    "milliseconds behind a colon": Good(dated(lambda m: f"{m:%m/%d/%Y %H:%M:%S}:{m.microsecond // 1000:03}")),
    "a title, a remark, then the header": Good("Lab 3, unit 7\n\nremark\n" + text(HEAD)),
    "a row of units": Good(text(("time", "temperature", "output")).replace("output\n", "output\ns,(°C),deg/s\n")),
    "degrees for a temperature": Good(text(("time [s]", "temperature [deg]", HEAD[2]))),
    "degrees behind a line": Good(text(("time (s)", "temp_deg", HEAD[2]))),
    "the sign of degrees": Good(text(("time (s)", "Temperature (°)", HEAD[2]))),
    "a missing reading, dropped": Good(with_cell(4, 2, ""), {"missing": "drop"}, (2,)),
    "marks of missing ones": Good(with_cell(4, 1, "N/A", with_cell(7, 2, "1.#QNAN")), {"missing": "drop"}, (2, 5)),
    "-999, dropped": Good(with_cell(5, 2, "-999"), {"missing": "drop"}, (3,)),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_hostile_file_is_read_correctly(put, name):
    content, options, left_out = READ[name]
    is_right(bc.read(put(content), GYRO, **options), left_out)


def test_text_in_a_later_stretch_of_dates_is_refused(put, monkeypatch):
    monkeypatch.setattr("bayescal._tables.csv_file._CHUNK_ROWS", 3)
    with pytest.raises(bc.InputError, match="reads 'error'"):
        bc.read(put(with_cell(5, 0, "error", dated(spaced))), GYRO, missing="drop")
