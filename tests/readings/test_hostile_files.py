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
    BEGAN,
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
    "units behind underscores": Good(
        text(("t_s", "Temp_C", "gyro_z_dps")), {"columns": {"output": "gyro_z_dps"}}
    ),
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
    "points in times beside a day": Good(
        text(
            ("Dato", "Time", *HEAD[1:]),
            (when(lambda m: f"{m:%d-%m-%Y}"), when(lambda m: f"{m:%H.%M.%S}"), TEMPERATURE, RATE),
        )
    ),
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
    "the month as a word": Good(dated(lambda m: f"{m:%d-%b-%Y %H:%M:%S}")),
    "milliseconds behind a colon": Good(dated(lambda m: f"{m:%m/%d/%Y %H:%M:%S}:{m.microsecond // 1000:03}")),
    "a title, a remark, then the header": Good("Lab 3, unit 7\n\nremark\n" + text(HEAD)),
    "a row of units": Good(text(("time", "temperature", "output")).replace("output\n", "output\ns,(°C),deg/s\n")),
    "degrees for a temperature": Good(text(("time [s]", "temperature [deg]", HEAD[2]))),
    "degrees behind a line": Good(text(("time (s)", "temp_deg", HEAD[2]))),
    "the sign of degrees": Good(text(("time (s)", "Temperature (°)", HEAD[2]))),
    "a missing reading, dropped": Good(with_cell(4, 2, ""), {"missing": "drop"}, (2,)),
    "marks of missing readings, dropped": Good(
        with_cell(4, 1, "N/A", with_cell(7, 2, "1.#QNAN")), {"missing": "drop"}, (2, 5)
    ),
    "-999, dropped": Good(with_cell(5, 2, "-999"), {"missing": "drop"}, (3,)),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_it_is_read_right(put, name):
    content, options, left_out = READ[name]
    is_right(bc.read(put(content), GYRO, **options), left_out)


class Bad(NamedTuple):
    """A file that is refused: how many problems it has, and words that must be said."""

    content: str | bytes
    count: int
    said: tuple[str, ...]
    options: Mapping[str, Any] = MappingProxyType({})


UNNAMED = text(("time", "Temp (C)", "gyro_z"))
REFUSED = {
    "no units": Bad(
        text(("time", "temperature", "output")),
        3,
        ("--unit time=UNIT", "--unit temperature=UNIT", "such as deg/s"),
    ),
    "no output": Bad(text(("t_s", "Temp_C", "gyro_z_dps")), 1, ("--columns output=gyro_z_dps",)),
    "three gyroscopes": Bad(
        text((*HEAD[:2], "gx (dps)", "gy (dps)"), (TIME, TEMPERATURE, RATE, RATE)),
        1,
        ("gx (dps), gy (dps) look like it", "--columns 'output=gx (dps)'"),
    ),
    "two temperatures": Bad(
        text(("time [s]", "Temp (C)", "Temp [K]", "output [dps]"), (TIME, TEMPERATURE, TEMPERATURE, RATE)),
        1,
        ("lacks the column 'temperature'", "Temp"),
    ),
    "text and gaps": Bad(
        with_cell(3, 1, "", with_cell(4, 2, "OVLD", with_cell(9, 2, "x"))),
        2,
        ("'OVLD', 'x'", "4, 9", "--missing drop"),
    ),
    "everything": Bad(
        with_cell(3, 1, "", with_cell(4, 2, "1,5", with_cell(6, 0, "5", UNNAMED))),
        6,
        ("no such column", "4 fields", "has no unit", "holds no number", "--missing drop"),
    ),
    "months and days that may be exchanged": Bad(
        dated(lambda m: f"{m - timedelta(days=20):%m/%d/%Y %H:%M:%S}", "time"), 1,
        ("which number is the day", "--date-order mdy", "mdy if it begins 2026-11-02, dmy if it begins 2026-02-11"),
    ),
    "days above 12 in both places": Bad(
        with_cell(5, 0, "23/11/2026 00:00:30", dated(lambda m: f"{m:%m/%d/%Y %H:%M:%S}", "time")), 1,
        ("not all dates in one order",),
    ),
    "zones in some rows": Bad(
        with_cell(5, 0, iso(BEGAN) + "+01:00", dated(iso, "time")), 1, ("with a zone everywhere",)
    ),
    "times or dates": Bad(
        dated(lambda m: f"{m + timedelta(seconds=3967):%H.%M.%S}", "time"), 1, ("--date-order dmy",)
    ),
    "dates and numbers": Bad(with_cell(5, 0, "40.0", dated(iso, "time")), 1, ("reads '40.0'", "a date such as")),
    "no header": Bad("0,20,1\n1,20,2\n", 1, ("has no header",)),
    "milliseconds called seconds": Bad(
        counted(1_000, "time [s]"), 1, ("Are the numbers in ms?", "--unit 'time [s]=ms'")
    ),
    "a missing reading in every row": Bad(
        text(HEAD, (TIME, TEMPERATURE, ["NaN"] * 12)), 1, ("no row without",), {"missing": "drop"}
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_once_with_all_that_is_wrong(put, name):
    content, count, _said, options = REFUSED[name]
    path = put(content)
    with pytest.raises(bc.InputError) as refused:
        bc.read(path, GYRO, **options)
    assert (len(refused.value.problems) or 1) == count, str(refused.value)
    assert list(path.parent.iterdir()) == [path]
