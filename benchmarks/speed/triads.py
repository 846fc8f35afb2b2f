"""Three axes: how long a fit, a search and a calibration take, warm, and where the time of a calibration goes.

    python -m benchmarks triad_speed

Seconds are the least of some runs in turn, after two that are not counted: by the clock and of the processor, which a
busy machine stretches less. Beside them stands the ratio to the first fit of the same run.
"""

from __future__ import annotations

import cProfile
import pstats
import time
from collections.abc import Callable
from typing import Any

import bayescal as bc
from bayescal_models import accelerometer_triad as triad
from benchmarks.record import write
from benchmarks.speed.timing import interleaved

TEMPERATURES = (-20.0, 0.0, 25.0, 50.0, 70.0)  # °C
RUNS = 5
# Parts of a calibration, by the function that does them; what is called in it is counted with it.
PARTS = {
    "search": ("walk.py", "walk"),
    "average over structures": ("structure_average.py", "averaged"),
    "fits of the steps": ("fit.py", "fit"),
    "what is missing": ("discover.py", "discovery_at"),
    "response and slopes, in all of these": ("record.py", "_response"),
}


def main() -> None:
    """Measure, write and print."""
    plan = triad.Campaign(poses=14, temperatures=TEMPERATURES)
    model = triad.INSTRUMENT.baseline()
    few, many = (
        triad.simulate(seed=1, campaign=triad.Campaign(poses=poses)) for poses in (20, 400)
    )
    warm = triad.simulate({"bias.temperature": 0.3}, seed=2, campaign=plan)
    over_temperature = model + ["bias.temperature", "scale.temperature"]
    first = bc.fit(model, warm)
    tasks: dict[str, Callable[[], Any]] = {
        "fit of 20 poses": lambda: bc.fit(model, few),
        "fit of 5 x 14 poses over temperature": lambda: bc.fit(over_temperature, warm),
        "fit of 400 poses": lambda: bc.fit(model, many),
        "search of 5 x 14 poses": lambda: bc.discover(first),
        "calibration of 5 x 14 poses": lambda: bc.calibrate(model, warm),
    }
    interleaved(tasks, 2)  # compiles
    rows = {name: one._asdict() for name, one in interleaved(tasks, RUNS).items()}
    unit = next(iter(rows.values()))["processor"]
    for name, row in rows.items():
        del row["made"]
        row["ratio"] = row["processor"] / unit
        print(
            f"{name:40s} {row['clock']:.3f} s, processor {row['processor']:.3f} s, {row['ratio']:.1f}"
        )
    parts = _parts(tasks["calibration of 5 x 14 poses"])
    for name, share in parts.items():
        print(f"{name:40s} {100 * share:.0f} %")
    write("triad_speed", {"seconds": rows, "parts": parts})


def _parts(task: Callable[[], Any]) -> dict[str, float]:
    """Shares of a task's time by the profiler."""
    profile = cProfile.Profile(time.process_time)
    profile.runcall(task)
    known: Any = pstats.Stats(profile)  # its table is no part of the stub
    times = {
        (path.rpartition("/")[2], name): row[3] for (path, _, name), row in known.stats.items()
    }
    return {part: times.get(at, 0.0) / known.total_tt for part, at in PARTS.items()}


if __name__ == "__main__":
    main()
