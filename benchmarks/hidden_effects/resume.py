"""Banks that take hours: campaigns are measured one after another, a line each, for as long as is allowed."""

from __future__ import annotations

import os
import random
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.record import add_line, cases_of, core, measured

SECONDS = 3300.0  # of one instrument's part, unless BAYESCAL_SECONDS says otherwise
T = TypeVar("T")


def chosen(names: Iterable[str]) -> list[str]:
    """The instruments that BAYESCAL_ONLY names, or all."""
    return os.environ.get("BAYESCAL_ONLY", "").split() or list(names)


def go_on(
    path: Path,
    fields: Sequence[str],
    cases: Iterable[tuple[tuple[Any, ...], T]],
    measure: Callable[[T], tuple[dict[str, Any], str]],
    workers: int = 1,
) -> None:
    """Measure the cases that have no row yet, a line each; after `SECONDS`, or at BAYESCAL_UNTIL, say so and stop.

    Of a release only until BAYESCAL_SAMPLE rows stand, of cases drawn at random, others for every code; those that have
    a row of an older code first.

    Args:
        path: of the file.
        fields: of a row, that tell cases apart.
        cases: each beside the values of these.
        measure: from a case to its row, and what is told of it.
        workers: processes that measure at once; rows of two or more come in the order in which they end.
    """
    begun, done = time.time(), measured(path, fields)
    end = begun + float(os.environ.get("BAYESCAL_SECONDS", SECONDS))
    end = min(end, float(os.environ.get("BAYESCAL_UNTIL", "inf")))  # of the epoch, as `begun` is
    if sample := int(os.environ.get("BAYESCAL_SAMPLE", 0)):
        drawn = list(cases)
        random.Random(core()).shuffle(drawn)
        known = cases_of(path, fields)
        drawn.sort(key=lambda case: case[0] not in known)
        cases = islice((c for c in drawn if c[0] not in done), max(0, sample - len(done)))
    missing = (case for key, case in cases if key not in done and time.time() < end)
    for row, told in _measured(missing, measure, workers):
        add_line(path, row, fields)
        print(f"{path.stem} {told}", file=sys.stderr)
        if time.time() > end:
            print(f"{path.stem}: stopped after {time.time() - begun:.0f} s; run again to go on")
            return


def go_on_by_seed(
    path: Path, seeds: Iterable[int], measure: Callable[[int], tuple[dict[str, Any], str]]
) -> None:
    """The same of campaigns that a seed tells apart."""
    go_on(path, ("seed",), (((seed,), seed) for seed in seeds), measure)


def _measured(
    cases: Iterable[T], measure: Callable[[T], tuple[dict[str, Any], str]], workers: int
) -> Iterator[tuple[dict[str, Any], str]]:
    if workers == 1:
        yield from map(measure, cases)
        return
    with get_context("spawn").Pool(workers) as pool:
        yield from pool.imap_unordered(measure, cases)
