"""`docs/fleet.md`, from what was measured of fleets."""

from __future__ import annotations

from typing import Any

from benchmarks.intervals import proportion
from benchmarks.markdown import table
from benchmarks.record import DOCS, read

PAGE = DOCS / "fleet.md"
HEAD = """# Fleets: what was measured

`make bench-fleet` measures what is missing in `benchmarks/results/fleet.json` and writes this page. Workers are
processes of their own (`LocalCluster`), no mocks. How a fleet is run: [with a fleet](how_to/fleet.md).
"""


def render() -> None:
    """Write the page from the parts that have been measured."""
    found, parts = read("fleet"), [HEAD]
    for name, one in SECTIONS.items():
        if name in found:
            parts.append(one(found[name]))
    PAGE.write_text("\n".join(parts), encoding="utf-8")


def _throughput(r: dict[str, Any]) -> str:
    rows = [["bayescal, from files to files", f"{r['devices_per_core_second']:,.0f}", "1"]]
    rows += [
        [n, f"{p['devices_per_core_second']:,.0f}", f"{p['ratio']:.0f}"]
        for n, p in r["peers"].items()
    ]
    pair = r["one_to_two_workers"]
    return f"""## {r["devices"]:,} devices by least squares

A line in temperature for each of {r["devices"]:,} simulated gyroscopes, {r["readings"]:,} readings in
{r["partitions"]} files, with two workers: {r["processor_s"]:.0f} CPU seconds
in the workers, reading, fitting, writing and
checksums together, {r["clock_s"]:.0f} s wall-clock on a machine that had other work.
At most {r["peak_memory_mb"]:.0f} MB in a process
(goal 1 GiB). The peers fit arrays that are in memory already, one call a device, in the same run.

{table(["", "devices per core-second", "bayescal over it"], rows)}
From one worker to two, on {pair["devices"]:,} devices: {pair["ratio"]:.2f} × wall-clock (goal 1.7).
"""


def _kills(r: dict[str, Any]) -> str:
    moments = ", ".join(f"{k['moment_s']:.1f}" for k in r["kills"])
    return f"""## kill -9 of a worker

One of two workers killed at a random moment of a run of {r["devices"]:,} devices in {r["partitions"]} partitions
({r["run_s"]:.1f} s): the same results, bit for bit, {proportion(r["same"], len(r["kills"]))} times.
Moments, s: {moments}.
A scheduler that is killed, and the same command run again, is a test: `tests/fleet/test_cluster_faults.py`.
"""


def _one_process(r: dict[str, Any]) -> str:
    return f"""## A population over partitions

{r["devices"]:,} devices in {r["partitions"]} partitions against one process: means and standard deviations with
their uncertainties differ by {r["largest_relative_difference"]:.1g} at most, relative (goal 1e-10).
"""


def _coverage(r: dict[str, Any]) -> str:
    count = r["fleets"]
    rows = [
        [name, proportion(round(m * count), count), proportion(round(s * count), count)]
        for name, m, s in zip(r["coefficients"], r["mean"], r["spread"], strict=True)
    ]
    return f"""Intervals of 95 % over {count} simulated fleets of {r["devices"]} devices:

{table(["coefficient", "mean held", "spread held"], rows)}"""


def _finding(r: dict[str, Any]) -> str:
    head = ["hidden", "size", "share drawn", "in devices", "named in", "possible in", "expected"]
    head += ["share of the fleet, 95 %"]
    rows = [
        [e["effect"], f"{e['size']:g}", f"{e['hidden_share']:.0%}", e["hidden"], e["found"]]
        + [int(e["possible"]), f"{e['expected']:.1f}", f"{e['low']:.1%} to {e['high']:.1%}"]
        for e in r["effects"]
    ]
    others = [
        f"`{t['effect']}` ({t['expected']:.1f} devices expected, named in {t['devices']})"
        for t in r["table"]
        if t["effect"] not in {e["effect"] for e in r["effects"]}
    ]
    return f"""## Each device's structure searched

{r["devices"]:,} simulated gyroscopes of {r["readings"]} readings, `--find`:
{r["devices_per_core_second"]:.2f} devices per core-second ({r["processor_s"]:.0f} CPU seconds).
Devices with an effect where nothing is hidden: {proportion(r["false"], r["empty"])}.
Devices whose model has a substitute of what is hidden: {proportion(r["wrongly_named"], r["devices"] - r["empty"])}.

{table(head, rows)}
*Named in*: devices whose model has it. *Possible in*: devices in which it is one of the effects of which one is missing
with a probability of 0.95; one device of so few readings cannot always tell which. *Expected*, and the share: from all
devices together; every device that has an effect here has it at the one size, which the reckoning of shares does not
know ([limits](limits.md#how-often-it-errs)). Next in that table: {", ".join(others[:3]) or "nothing"}.

Where the time of a search goes: half to refits of structures (20 to 40 for a device, of 50 ms), a fifth to the
scores of candidates, a tenth to their columns. Devices share compiled programs of a worker, not columns: every device
has temperatures of its own.
"""


def _wafer(r: dict[str, Any]) -> str:
    c = r["checked"]
    told = "the same pairs in the same order" if c["same"] else "NOT the same pairs"
    return f"""## Pairs of a wafer

The twelve best of {r["pairs"]:,} pairs of {r["devices"]:,} made-up resonators:
{r["processor_s"]:.0f} CPU seconds, {r["peak_memory_mb"]:.0f} MB.
{r["bounded"]:,} pairs were excluded by their bound, {r["evaluated"]:,} were computed.
The best leaves {r["best"][2]:.2f} µg, the twelfth {r["last"][2]:.2f} µg, and no excluded pair less than
{r["least_excluded"]:.2f} µg. On {c["devices"]:,} devices the full table ({c["full_table_s"]:.0f} s; by bounds
{c["by_bounds_s"]:.1f} s) has {told}.
"""


SECTIONS = {
    "throughput": _throughput,
    "kills": _kills,
    "one_process": _one_process,
    "coverage": _coverage,
    "finding": _finding,
    "wafer": _wafer,
}
