"""All figures of fleets, part by part: what stands in the results is not measured again (delete it to do so)."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.fleet import finding, kills, page, populations, throughput, wafer
from benchmarks.record import read, write

PARTITIONS, DEVICES = 100, 10_000  # a million devices of 60 readings
KILLS = 20


def parts(work: Path) -> dict[str, Callable[[], Any]]:
    """What is measured, by name."""
    return {
        "throughput": lambda: throughput.measured(work, PARTITIONS, DEVICES),
        "kills": lambda: kills.measured(work, KILLS),
        "one_process": lambda: populations.against_one_process(work),
        "coverage": populations.coverage,
        "finding": lambda: finding.measured(work),
        "wafer": wafer.measured,
    }


def main() -> None:
    """Measure what is missing, write `results/fleet.json` and `docs/fleet.md`."""
    with tempfile.TemporaryDirectory() as folder:
        for name, measure in parts(Path(folder)).items():
            found = read("fleet")
            if name not in found:
                print(f"  {name} …", flush=True)
                write("fleet", {**found, name: measure()})
    page.render()
