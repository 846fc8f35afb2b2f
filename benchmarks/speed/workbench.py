"""The workbench in a real browser: from the command to the first paint, a preview, *Add*, a redraw of many readings.

    python -m benchmarks workbench

Times are the user's: from the press to what it brings being on the page, with everything between (the browser, the
connection, the fit). The processor's time of the server stands beside them, since other work on the machine lengthens
the clock's. Chromium is headless, without a network and without a graphics processor.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.record import write
from tests.workbench.real_page import Bench, Seen, browser

ARGUMENTS = ("--instrument", "mems_gyro")
GOALS = {"first paint": 1.5, "whole page": None, "preview": 0.2, "add": 1.0, "redraw": 0.5}  # s
MANY = 100_000
CANDIDATES = (
    "bias.thermal_lag",
    "bias.drift",
    "bias.temperature_quadratic",
    "bias.temperature_cubic",
)


def write_readings(path: Path, count: int) -> Path:
    """A gyroscope's record of three runs: a line, a lag behind the board, a drift, white noise; seed 1."""
    rng, time_s = np.random.default_rng(1), 10.0 * np.arange(count)
    share = time_s / time_s[-1]
    temperature = 55 + 25 * np.sin(6 * np.pi * share)
    lag = 25 * 0.05 * np.cos(6 * np.pi * share)
    output = 21 + 0.05 * (temperature - 55) + lag + share + 0.05 * rng.standard_normal(count)
    pd.DataFrame(
        {
            "run": 1 + (3 * share * 0.999).astype(int),
            "time [s]": time_s,
            "temperature [degC]": temperature,
            "board_temperature [degC]": temperature - 20 * lag,
            "output [deg/s]": output,
        }
    ).to_csv(path, index=False)
    return path


def processor_seconds(bench: Bench) -> float:
    """Of the server, user and system."""
    fields = Path(f"/proc/{bench.process.pid}/stat").read_text("utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100


def timed(bench: Bench, act: Callable[[], Any]) -> dict[str, float]:
    """Seconds by the clock and by the server's processor."""
    clock, processor = time.perf_counter(), processor_seconds(bench)
    act()
    return {"clock": time.perf_counter() - clock, "processor": processor_seconds(bench) - processor}  # fmt: skip


def interaction(bench: Bench, seen: Seen) -> dict[str, Any]:
    """Previews and an *Add* at 2,000 readings."""
    seen.looked()
    previews = [timed(bench, lambda name=name: seen.point(name)) for name in CANDIDATES]
    middle = {key: statistics.median(p[key] for p in previews) for key in previews[0]}
    return {"preview": middle, "add": timed(bench, lambda: seen.add("bias.thermal_lag"))}


def redraw(bench: Bench, seen: Seen) -> dict[str, float]:
    """A further panel of 10⁵ readings: ticked, decimated, drawn; the search for what is missing goes on beside it."""
    seen.page.wait_for_timeout(2000)
    count = seen.page.locator(".bk-Figure").count()

    def act() -> None:
        seen.page.get_by_text("temperature", exact=True).click()
        seen.page.wait_for_function(FIGURES, arg=count + 1)

    return timed(bench, act)


FIGURES = """n => { let found = 0; const walk = (node) => {
  if (node.classList && node.classList.contains("bk-Figure")) found += 1;
  for (const one of [...(node.shadowRoot ? node.shadowRoot.children : []), ...node.children]) walk(one); };
  walk(document.body); return found >= n; }"""


def opening(bench: Bench, seen: Seen, begun: float) -> dict[str, Any]:
    """From the command to the first words in the browser, and to the whole page."""

    def taken() -> dict[str, float]:
        return {"clock": time.perf_counter() - begun, "processor": processor_seconds(bench)}

    seen.page.goto(bench.url, wait_until="commit")
    seen.page.get_by_text("bayescal workbench").first.wait_for()
    first = taken()
    seen.page.get_by_text("Where it fails").wait_for()
    return {"first paint": first, "whole page": taken()}


def main() -> None:
    """Measure, and write `benchmarks/results/workbench.json`."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for count in (2000, MANY):
            readings = write_readings(Path(folder) / f"{count}.csv", count)
            with browser() as seen:
                begun = time.perf_counter()
                bench = Bench(readings, *ARGUMENTS, "--out", Path(folder) / f"kept_{count}")
                try:
                    first = opening(bench, seen, begun)
                    if count == MANY:
                        found["redraw"] = redraw(bench, seen)
                    else:
                        found |= {**first, **interaction(bench, seen)}
                finally:
                    bench.close()
    rows = {name: {**r, "goal": GOALS[name]} for name, r in found.items()}
    write("workbench", {"load": os.getloadavg()[2], "rows": rows})


if __name__ == "__main__":
    main()
