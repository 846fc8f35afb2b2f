"""Files of one gyroscope test under headers as laboratories write them, made up at random: what a property is tried on.

Units in the ways that are customary, labels of runs, preambles, encodings, two languages, decimal commas, other columns
beside. What stands in a file is known, so that what is read silently wrong can be counted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.random import Generator

ROWS = 36
TIME = np.arange(ROWS) * 10.0
TEMPERATURE = 20 + 0.0625 * TIME
RATE = 0.5 + 0.015625 * (TEMPERATURE - 25)  # °/s
RUN = np.repeat([1, 2, 3], ROWS // 3)

_BRACKETS = ("{} [{}]", "{} ({})", "{}[{}]", "{}/{}", "{}_{}", "{}, {}", "{} / {}", "{} in {}")
_TIME = (
    "time",
    "Time",
    "Zeit",
    "t",
    "Timestamp",
    "elapsed",
    "Elapsed Time",
    "Messzeit",
    "Sekunden",
    "Time stamp",
)
_TEMPERATURE = (
    "temperature",
    "Temp",
    "Temperatur",
    "T",
    "T_chamber",
    "Temp.",
    "Temperatur Gehäuse",
    "die temp",
    "TEMP",
)
_OUTPUT = (
    "output",
    "Rate",
    "Drehrate",
    "gyro_z",
    "Gyro Z",
    "omega_z",
    "Ausgang",
    "Rate Z",
    "Winkelgeschwindigkeit",
)
_RUN = (
    *(
        "run",
        "Run",
        "Run No.",
        "Lauf",
        "Lauf-Nr.",
        "Cycle [#]",
        "Zyklus",
        "Cycle",
        "Messung Nr",
        "Test ID",
        "Cycle #",
    ),
    *("Versuch", "Durchgang (#)", "Run [-]", "Charge [#]", "Cycle no"),
)
_SIZES = {  # unit as it is written → what one is in s, °C (with its zero) or °/s
    "time": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "min": 60.0, "seconds": 1.0, "h": 3600.0},
    "output": {
        "deg/s": 1.0,
        "°/s": 1.0,
        "dps": 1.0,
        "deg/h": 1 / 3600,
        "mdps": 1e-3,
        "rad/s": 180 / np.pi,
        "°/sec": 1.0,
    },
}
_DEGREES = ("degC", "°C", "C", "deg C", "K", "Celsius", "degF", "oC")
_BESIDE = (
    "humidity [%]", "Feuchte (%rF)", "supply [V]", "comment", "Bemerkung", "status", "Sample [#]", "index", "p [hPa]",
    "Pressure (psi)", "flow [L/min]", "Kraft [N]", "load (kg)", "setpoint", "Soll (°C)", "current [mA]",
    "gyro_x [deg/s]", "quality [arb]", "Fan [%]", "operator",
)  # fmt: skip
_PREAMBLE = (
    "# test of a gyroscope\n# operator: Müller\n", "Gyro test\nOperator;Müller\n\n",
    "Datum: 22.11.2026\nPrüfer: Jäger\n", "Serial,4711\nDate,2026-11-22\n",
)  # fmt: skip


class LabFile(NamedTuple):
    """A file, and what a person knows who wrote it.

    Attributes:
        content: of the file.
        headers: of each of our columns, the file's; of runs too, if it has any.
        units: of the file's columns.
    """

    content: bytes
    headers: dict[str, str]
    units: dict[str, str]


def lab_file(random: Generator) -> LabFile:
    """One of them."""

    def one(choices):
        return choices[int(random.integers(len(choices)))]

    headers, units = dict[str, str](), dict[str, str]()
    columns = list[tuple[str, list[str]]]()

    def put(
        ours: str, name: str, unit: str, values: np.ndarray, decimals: int, meant: str = ""
    ) -> None:
        head = one(_BRACKETS).format(name, unit) if random.random() < 0.9 else name
        headers[ours], units[head] = head, meant or unit
        columns.append((head, [f"{v:.{decimals}f}" for v in values]))

    in_s = one([*_SIZES["time"]])
    put("time", one(_TIME), in_s, TIME / _SIZES["time"][in_s], 9)
    degrees = one(_DEGREES)
    shown = {"K": TEMPERATURE + 273.15, "degF": TEMPERATURE * 1.8 + 32}.get(degrees, TEMPERATURE)
    put(
        "temperature",
        one(_TEMPERATURE),
        degrees,
        shown,
        6,
        degrees if degrees in ("K", "degF") else "degC",
    )
    in_rate = one([*_SIZES["output"]])
    put(
        "output",
        one(_OUTPUT),
        in_rate,
        RATE / _SIZES["output"][in_rate],
        9,
        {"°/sec": "deg/s"}.get(in_rate, in_rate),
    )
    if random.random() < 0.6:
        headers["run"] = one(_RUN)
        columns.append((headers["run"], [str(r) for r in RUN]))
    for head in {one(_BESIDE) for _ in range(int(random.integers(3)))}:
        words = head in ("comment", "Bemerkung", "status", "operator")
        values = ["ok"] * ROWS if words else [f"{v:.3f}" for v in 1 + random.random(ROWS)]
        columns.append(
            (head, [str(i) for i in range(ROWS)] if head in ("Sample [#]", "index") else values)
        )
    order = random.permutation(len(columns))
    comma = random.random() < 0.3
    separator = one([";", "\t"]) if comma or random.random() < 0.2 else ","
    if separator == "," and any("," in head for head, _ in columns):
        separator = ";"
    rows = [[columns[i][0] for i in order]]
    rows += [
        [columns[i][1][k].replace(".", "," if comma else ".") for i in order] for k in range(ROWS)
    ]
    text = "\n".join(separator.join(row) for row in rows) + "\n"
    text = (one(_PREAMBLE) if random.random() < 0.3 else "") + text
    encoding = one(["utf-8", "utf-8", "utf-8-sig", "windows-1252", "utf-16"])
    return LabFile(text.encode(encoding), headers, units)
