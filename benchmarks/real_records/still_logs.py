"""Public logs of others at rest: the noise of the first half, and whether the second half lies where it says.

Each channel is told by `bayescal noise` alone. The Allan deviations of the second half are counted that lie between
which 95 % of those of such a record lie under the noise of the first half. Results go to
`benchmarks/results/still_logs.json`, a channel each, and from there to `docs/still_logs.md`; a channel that is there is
not measured again.

The logs are not part of this repository. They are looked for in the folder that `BAYESCAL_STILL_LOGS` names: the page
says what to put there.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal_models import still_sensor
from benchmarks.real_records import still_logs_page
from benchmarks.record import read, write

INERTIAL = ("deg/s", "ug")  # units that a filter's file has a place for


@dataclass(frozen=True)
class StillLog:
    """A log, and where it is from.

    Attributes:
        title, file: of the page, and the file in the folder.
        source, commit, path, licence: the repository, its commit, the path there, and what it allows.
        made: how the file is made of what stands there.
        channels: its columns.
    """

    title: str
    file: str
    source: str
    commit: str
    path: str
    licence: str
    made: str
    channels: tuple[str, ...]


def _ocxo(title: str, file: str, which: str) -> StillLog:
    return StillLog(
        title=title,
        file=file,
        source="https://github.com/aewallin/allantools",
        commit="599dc9ea133ea4852f97e5ed88e51dc11bbdae1f",
        path="tests/ocxo/ocxo_frequency.txt",
        licence="LGPL 3",
        made=f"{which}: times of 1 Hz before the departures of the frequency from 10 MHz, in parts of 10¹², and the "
        "header `time [s],frequency [1]`",
        channels=("frequency",),
    )


LOGS = (
    StillLog(
        title="ADIS16405, three gyroscopes and three accelerometers",
        file="adis_16405_imu1.csv",
        source="https://github.com/SMAC-Group/imudata",
        commit="eec6e5b627a31a4a1c286e0d1475c6556705b2a6",
        path="data/adis_16405_imu1.rda",
        licence="CC BY-NC-SA 4.0; recorded at the University of Calgary, Department of Geomatics Engineering",
        made="Times of 100 Hz before its six columns, and the header "
        "`time [s],gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s],acc_x [g],acc_y [g],acc_z [g]`",
        channels=("gyro_x", "gyro_y", "gyro_z", "acc_x", "acc_y", "acc_z"),
    ),
    _ocxo(
        "Oven-controlled crystal oscillator against a hydrogen maser",
        "ocxo_whole.csv",
        "All readings",
    ),
    _ocxo(
        "The same oscillator after its events",
        "ocxo_calm.csv",
        "From 7700 s on: of what is before, `bayescal noise` says that there are events",
    ),
)


def main() -> None:
    """Measure the channels whose log is there and that are not measured yet, and render the page."""
    named = os.environ.get("BAYESCAL_STILL_LOGS")
    results: dict[str, Any] = {"channels": {}, **read("still_logs")}
    if not named:
        print("still_logs: nothing measured, BAYESCAL_STILL_LOGS may name the folder of logs")
    for log in LOGS if named else ():
        path = Path(named or "") / log.file
        if not path.is_file():
            print(f"still_logs: skipped, no {path}")
            continue
        for channel in log.channels:
            name = f"{log.file}: {channel}"
            if name not in results["channels"]:
                print(f"still_logs: {name}", flush=True)
                results["channels"][name] = measure(path, channel)
                write("still_logs", results)
    still_logs_page.write(LOGS, results["channels"])


def measure(path: Path, channel: str) -> dict[str, Any]:
    """The noise of the whole log as printed, and how the first half's foretells the second."""
    began = time.process_time()
    readings = bc.read(path, still_sensor.INSTRUMENT, columns={"output": channel})
    whole = bc.noise(readings)
    seconds = time.process_time() - began
    half = len(readings) // 2
    told = bc.noise(readings.select(np.arange(half)))
    later = bc.allan_deviation(readings.select(np.arange(half, 2 * half)))
    inside = (told.estimate_low <= later.deviation) & (later.deviation <= told.estimate_high)
    return {
        "readings": len(readings),
        "seconds": seconds,
        "printed": str(whole),
        "yaml": bc.kalibr_yaml({channel: whole}) if whole.unit in INERTIAL else None,
        "first_half": told.law,
        "tau": told.measured.tau.tolist(),
        "low": told.estimate_low.tolist(),
        "high": told.estimate_high.tolist(),
        "second_half": later.deviation.tolist(),
        "inside": inside.tolist(),
    }
