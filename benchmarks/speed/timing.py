"""Times that can be compared: what is compared runs in turn, and the least of several counts."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np


class Timed(NamedTuple):
    """The shortest of several times, s: by the clock, and of the processor; and what came out last.

    Other work on the machine lengthens the clock's time, hardly the processor's.
    """

    clock: float
    processor: float
    made: Any


def interleaved(runs: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, Timed]:
    """Each of several calls, one after the other in every round."""
    best = dict.fromkeys(runs, Timed(np.inf, np.inf, None))
    for _ in range(repeats):
        for name, run in runs.items():
            begun = time.perf_counter(), time.process_time()
            made = run()
            clock, processor = time.perf_counter() - begun[0], time.process_time() - begun[1]
            least = best[name]
            best[name] = Timed(min(least.clock, clock), min(least.processor, processor), made)
    return best


def least_of(run: Callable[[], Any], repeats: int) -> Timed:
    """One call, several times."""
    return interleaved({"": run}, repeats)[""]


def clocks(timed: Mapping[str, Timed]) -> dict[str, float]:
    """Seconds of each by the clock."""
    return {name: one.clock for name, one in timed.items()}
