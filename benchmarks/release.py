"""Everything that a release states, measured by its code: `python -m benchmarks release [HOURS]`.

Rows of an older code are measured anew, in the order of `HEADLINE`, until the hours are over; the same command goes on
then. Pages are rendered from whatever rows stand, and say of each code how many; once a release was measured whole,
rows that are older than it are named, and no site is built of them. Six hours of two cores suffice, by the
seconds that the rows themselves state: `python -m benchmarks release plan` adds them up.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

from benchmarks import stated
from benchmarks.record import RESULTS, ROOT, core, read, read_lines, write

HOURS = 6.0
WHOLE = "release"  # the last one that was measured whole: its core, and how many rows there were


class Part(NamedTuple):
    """A benchmark of the release.

    Attributes:
        name: as `python -m benchmarks NAME` has it; its files of rows begin so.
        options: of its module, in `ordinary_test`, where it has processes of its own.
    """

    name: str
    options: tuple[str, ...] = ()

    @property
    def module(self) -> str:
        return f"benchmarks.ordinary_test.{'measurement' if self.name == 'ordinary_test' else self.name}"


PLANNED = ("--workers", "2")
HEADLINE = (
    Part("ordinary_test", ("--count", "60", "--readings", "200", "1600", *PLANNED)),
    Part("good_records", ("--count", "60", *PLANNED)),
    Part("own_unit", ("--count", "12", *PLANNED)),
    Part("no_family", ("--count", "21", *PLANNED)),
    Part("hidden_effects"),
    Part("false_discoveries"),
    Part("units"),
    Part("dividing_head"),
    Part("triad_coverage"),
    Part("triads"),
    Part("gauntlet"),
    Part("wrong_model"),
)


def rows_in(part: Part) -> list[dict[str, Any]]:
    return [row for path in RESULTS.glob(f"{part.name}*.jsonl") for row in read_lines(path)]


def rows_of(part: Part) -> tuple[int, int, float]:
    """How many rows there are, how many of them are of another code, and hours that these took."""
    rows = rows_in(part)
    older = [row for row in rows if row.get("core") != core()]
    return len(rows), len(older), sum(row.get("seconds", 0.0) for row in older) / 3600


def older_than_the_last() -> list[str]:
    """Of what is a headline, parts with rows that are neither of the last whole release's code nor of this one's."""
    if not (last := read(WHOLE)):
        return []
    known = {core(), last["of"]}
    count = {
        part.name: sum(row.get("core") not in known for row in rows_in(part)) for part in HEADLINE
    }
    return [
        f"{name}: {n:,} rows are older than the last release: python -m benchmarks release"
        for name, n in count.items()
        if n
    ]


def plan() -> str:
    """What is left to measure, a line each."""
    counts = [rows_of(part) for part in HEADLINE]
    lines = [
        f"{part.name:20s} {older:5d} of {every:5d} rows to measure, {hours:5.2f} h of one core"
        for part, (every, older, hours) in zip(HEADLINE, counts, strict=True)
    ]
    return "\n".join([*lines, f"{sum(h for *_, h in counts):.1f} h in all, of one core"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure until all rows are of this code, or the hours are over; then render and compare.

    Raises:
        SystemExit: what was given is no number of hours, or a page says otherwise than its rows.
    """
    given = list(arguments or ()) or [str(HOURS)]
    if given == ["plan"]:
        print(plan())
        return
    if len(given) > 1 or not given[0].replace(".", "", 1).isdigit():
        print(f"release takes hours, such as 6, or plan; not {' '.join(given)!r}", file=sys.stderr)
        sys.exit(2)
    end = time.time() + 3600 * float(given[0])
    asked = [part for part in HEADLINE if rows_of(part)[1]]
    for part in (part for part in asked if part.options):  # on two cores each
        measure(part, end)
    with ThreadPoolExecutor(2) as two:
        list(two.map(partial(measure, end=end), (part for part in asked if not part.options)))
    print(plan())
    if not any(rows_of(part)[1] for part in HEADLINE):
        write(WHOLE, {"of": core(), "rows": {part.name: rows_of(part)[0] for part in HEADLINE}})
    for render in dict.fromkeys(stated.RENDERED.values()):
        render()
    stated.main(older_than_the_last())


def measure(part: Part, end: float) -> None:
    """Measure what is left of a part, in a process of its own, until the time is over.

    Raises:
        subprocess.CalledProcessError: it ended in an error.
    """
    if time.time() > end:
        print(f"{part.name}: the time is over; run again to go on")
        return
    environment = os.environ | {"BAYESCAL_ANEW": "1", "BAYESCAL_SECONDS": "inf"}
    environment |= {"BAYESCAL_UNTIL": str(end)}  # of all its files together
    what = (part.module, *part.options) if part.options else ("benchmarks", part.name)
    subprocess.run([sys.executable, "-m", *what], cwd=ROOT, env=environment, check=True)


if __name__ == "__main__":
    main(sys.argv[1:])
