"""What computing costs, and how the cost grows with the readings: beside peers, and beside what the machine can do.

Rows, each in a process of its own on one core: gradients of the log density under white and Ornstein–Uhlenbeck noise
(`gradient_white.py`, `gradient_correlated.py`); the memory of a fit to ten million readings (`memory_cost.py`); a whole
search (`stepwise.py`); one least-squares fit (`fit_cost.py`, `cold_fit.py`). A row that is in
`results/scaling.jsonl` is not run again. Every row compares values before it states a speed; ratios are of times from
one run, the least of several taken in turn.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from benchmarks.markdown import table
from benchmarks.record import RESULTS, add_line, read_lines, write
from benchmarks.speed.own_process import measured
from benchmarks.speed.scaling.cold_fit import cold
from benchmarks.speed.scaling.fit_cost import warm
from benchmarks.speed.scaling.gradient_correlated import wander
from benchmarks.speed.scaling.gradient_white import white
from benchmarks.speed.scaling.memory_cost import memory

LINES = RESULTS / "scaling.jsonl"


def _stepwise() -> dict[str, Any]:
    # Late, for it imports JAX: the kernel counts the memory of a process that starts another to the latter's peak.
    from benchmarks.speed.scaling.stepwise import stepwise

    return stepwise()


ROWS: dict[str, Callable[[], dict[str, Any]]] = {
    "gradient, white noise": white,
    "gradient, Ornstein–Uhlenbeck noise": wander,
    "memory, least squares, 10⁵ readings": partial(memory, 100_000),
    "memory, least squares, 10⁷ readings": partial(memory, 10_000_000),
    "a whole search beside stepwise BIC": _stepwise,
    "least squares, gyroscope's line": partial(warm, "line"),
    "least squares, gyroscope's warm-up": partial(warm, "warm-up"),
    "least squares, ng accelerometer": partial(warm, "ng accelerometer"),
    "least squares, cold start": cold,
}


@contextmanager
def one_core() -> Iterator[None]:
    """This process and those that it starts on one core, where the system can."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def main() -> None:
    """Run the rows that are missing, write and print the table.

    Raises:
        RuntimeError: a row failed.
    """
    done = {line["row"]: line for line in read_lines(LINES)}
    only = os.environ.get("BAYESCAL_ONLY", "")
    for name in ROWS:
        if name in done or only not in name:
            continue
        with one_core():
            found = measured(__name__, name)
        if found is None:
            continue
        done[name] = {"row": name, **found}
        add_line(LINES, done[name])
        print(f"{name}: {done[name]['told']}", flush=True)
    rows = [done[name] for name in ROWS if name in done]
    write("scaling", {"cores_used": 1, "rows": rows})
    print(table(["row", "found"], ([row["row"], row["told"]] for row in rows)))


def measure(name: str) -> dict[str, Any]:
    """One row, in this process."""
    return ROWS[name]()
