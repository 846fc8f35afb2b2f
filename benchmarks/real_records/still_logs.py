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
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal_models import still_sensor
from benchmarks.real_records import still_logs_page
from benchmarks.real_records.still_log_sources import LOGS
from benchmarks.record import read, write

INERTIAL = ("deg/s", "ug")  # units that a filter's file has a place for


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
    render()


def render() -> None:
    """Render the page from the results that stand."""
    still_logs_page.write(LOGS, read("still_logs")["channels"])


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
