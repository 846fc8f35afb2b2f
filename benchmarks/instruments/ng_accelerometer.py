"""A ng accelerometer on a tilted table: what customary estimates make of it, what ours do, and source 0's figures.

    python -m benchmarks ng_accelerometer

1. Instrument A with a fixture tilted by 2′, 1′ and none: bias of the twelve-position estimator, and our interval.
2. Fixed-point heating: the tempcos that three ways of subtracting give at both ends, and one posterior of all readings.
3. The tide in a month of cells: what it does to the scale factor.
4. Widths of the tempcos' intervals for instruments A and B beside the published ones.
5. In orbit: temperature sensitivity of the output before and after compensation with instrument B's calibration.

Each part checks its answer; a failed check ends the benchmark after the results are written.
"""

from __future__ import annotations

from typing import Any

from benchmarks.instruments.ng_customary import fixed_point_heating, fixture_tilt, tide
from benchmarks.instruments.ng_tempcos import in_orbit, interval_widths
from benchmarks.record import write


def main() -> None:
    """Run the five parts, print their tables and write the results.

    Raises:
        SystemExit: a check failed.
    """
    parts = {
        "fixture_tilt": fixture_tilt,
        "fixed_point_heating": fixed_point_heating,
        "tide": tide,
        "interval_widths": interval_widths,
        "in_orbit": in_orbit,
    }
    results: dict[str, Any] = {}
    for name, part in parts.items():
        print(f"\n{(part.__doc__ or name).splitlines()[0]}", flush=True)
        results[name] = part()
        write("ng_accelerometer", results)
    failed = [f"{n}: {c}" for n, r in results.items() for c, ok in r["checks"].items() if not ok]
    if failed:
        raise SystemExit("ng_accelerometer: failed checks: " + "; ".join(failed))
