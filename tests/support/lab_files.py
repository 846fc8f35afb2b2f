"""One gyroscope test, and ways to write it down: what the tests of a laboratory's files share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

TIME = np.arange(12) * 10.0
TEMPERATURE = 20 + 0.125 * TIME
RATE = 0.5 + 0.015625 * (TEMPERATURE - 25)  # °/s, in binary fractions
BEGAN = datetime(2026, 11, 22, 23, 59, 0, 123000, tzinfo=UTC)
HEAD = ("time [s]", "temperature [degC]", "output [deg/s]")


def text(
    head: Sequence[str] = HEAD,
    columns: Sequence[Any] = (TIME, TEMPERATURE, RATE),
    separator: str = ",",
    decimal: str = ".",
) -> str:
    """A text file of these columns."""

    def cell(value: Any) -> str:
        return value if isinstance(value, str) else repr(float(value)).replace(".", decimal)

    rows = [separator.join(map(cell, row)) for row in zip(*columns, strict=True)]
    return "\n".join([separator.join(head), *rows, ""])


def when(form: Callable[[datetime], str], zone: str = "") -> list[str]:
    return [form(BEGAN + timedelta(seconds=t)) + zone for t in TIME]


def dated(form: Callable[[datetime], str], head: str = "Timestamp", zone: str = "") -> str:
    return text((head, *HEAD[1:]), (when(form, zone), TEMPERATURE, RATE))


def counted(per_second: int, head: str) -> str:
    began = round(BEGAN.timestamp() * 1e3) * per_second // 1000
    counts = [str(began + int(t) * per_second) for t in TIME]
    return text((head, *HEAD[1:]), (counts, TEMPERATURE, RATE))


def with_cell(row: int, column: int, cell: str, source: str = "") -> str:
    lines = [line.split(",") for line in (source or text()).splitlines()]
    lines[row - 1][column] = cell
    return "\n".join([",".join(line) for line in lines] + [""])


def iso(moment: datetime) -> str:
    return moment.replace(tzinfo=None).isoformat(timespec="milliseconds")


def spaced(moment: datetime) -> str:
    return iso(moment).replace("T", " ")


def is_right(readings, left_out=()):
    kept = np.setdiff1d(np.arange(len(TIME)), left_out)
    np.testing.assert_array_equal(readings["time"], TIME[kept])
    np.testing.assert_allclose(readings["temperature"], TEMPERATURE[kept], rtol=1e-14)
    np.testing.assert_allclose(readings["output"], RATE[kept], rtol=1e-14)
