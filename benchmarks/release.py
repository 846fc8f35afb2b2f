"""Everything that a release states, measured by its code: `python -m benchmarks release [HOURS]`.

Of each file of rows a part drawn at random, other cases for every code, is measured anew, in the order of `HEADLINE`;
each row says whether its case came out as it had by the code before, so that the rows not measured anew are vouched
for by those that are. `release all [HOURS]` measures every row. Both stop when the hours are over, and go on with the
same command. Pages are rendered from whatever rows stand, and say of each code how many; once a release was measured,
a file with fewer rows of it than `HEADLINE` asks is named, and no site is built of it. `release plan` and
`release all plan` add up what is left, by the seconds that the rows themselves state.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from benchmarks import stated
from benchmarks.record import RELEASE, RESULTS, ROOT, core, read, read_lines, write

HOURS = 6.0


class Part(NamedTuple):
    """A benchmark of the release.

    Attributes:
        name: as `python -m benchmarks NAME` has it; its files of rows begin so.
        sample: rows of each of its files that a release measures.
        options: of its module, in `ordinary_test`, where it has processes of its own.
    """

    name: str
    sample: int
    options: tuple[str, ...] = ()

    @property
    def module(self) -> str:
        return f"benchmarks.ordinary_test.{'measurement' if self.name == 'ordinary_test' else self.name}"


PLANNED = ("--workers", "2")
HEADLINE = (
    Part("ordinary_test", 24, ("--count", "60", "--readings", "200", "1600", *PLANNED)),
    Part("good_records", 24, ("--count", "60", *PLANNED)),
    Part("own_unit", 12, ("--count", "12", *PLANNED)),
    Part("no_family", 12, ("--count", "21", *PLANNED)),
    Part("hidden_effects", 70),
    Part("false_discoveries", 30),
    Part("units", 2),
    Part("dividing_head", 40),
    Part("triad_coverage", 20),
    Part("triads", 60),
    Part("gauntlet", 6),
    Part("wrong_model", 10),
)


class Left(NamedTuple):
    """What of a part is to be measured: its rows, those of this code, those still asked for, hours of one core."""

    rows: int
    own: int
    asked: int
    hours: float


def files_of(part: Part) -> list[list[dict[str, Any]]]:
    """Rows of each of its files."""
    return [read_lines(path) for path in sorted(RESULTS.glob(f"{part.name}*.jsonl"))]


def left(part: Part, every: bool = False) -> Left:
    """What is still to be measured of a part; `every`: of all its rows, rather than of a sample."""
    rows = own = asked = 0
    hours = 0.0
    for file in files_of(part):
        those = sum(row.get("core") == core() for row in file)
        missing = max(0, (len(file) if every else min(part.sample, len(file))) - those)
        mean = sum(row.get("seconds", 0.0) for row in file) / max(1, len(file))
        rows, own, asked = rows + len(file), own + those, asked + missing
        hours += missing * mean / 3600
    return Left(rows, own, asked, hours)


def older_than_the_last() -> list[str]:
    """Of what is a headline, parts with too few rows of the last release's code or of this one's."""
    if not (last := read(RELEASE)):
        return []
    known = {core(), last["of"]}
    count = {
        part.name: sum(
            max(0, min(part.sample, len(file)) - sum(row.get("core") in known for row in file))
            for file in files_of(part)
        )
        for part in HEADLINE
    }
    return [
        f"{name}: {n:,} rows more are to be of the last release's code: python -m benchmarks release"
        for name, n in count.items()
        if n
    ]


def plan(every: bool = False) -> str:
    """What is left to measure, a line each."""
    what = {part.name: left(part, every) for part in HEADLINE}
    lines = [
        f"{name:20s} {one.own:5d} of {one.rows:5d} rows by this code, {one.asked:5d} more asked for, "
        f"{one.hours:5.2f} h of one core"
        for name, one in what.items()
    ]
    return "\n".join(
        [*lines, f"{sum(one.hours for one in what.values()):.1f} h in all, of one core"]
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure until enough rows are of this code, or the hours are over; then render and compare.

    Raises:
        SystemExit: what was given is no number of hours, or a page says otherwise than its rows.
    """
    given = list(arguments or ())
    if every := given[:1] == ["all"]:
        given = given[1:]
    if given == ["plan"]:
        print(plan(every))
        return
    given = given or [str(HOURS)]
    if len(given) > 1 or not given[0].replace(".", "", 1).isdigit():
        print(
            f"release takes hours, such as 6, or plan, each after all or alone; not {' '.join(given)!r}",
            file=sys.stderr,
        )
        sys.exit(2)
    end = time.time() + 3600 * float(given[0])
    asked = [part for part in HEADLINE if left(part, every).asked]
    for part in (part for part in asked if part.options):  # on two cores each
        measure(part, end, every)
    with ThreadPoolExecutor(2) as two:
        list(two.map(lambda p: measure(p, end, every), (p for p in asked if not p.options)))
    print(plan(every))
    if not any(left(part).asked for part in HEADLINE):
        write(RELEASE, {"of": core(), "rows": {p.name: outcome(p) for p in HEADLINE}})
    for render in dict.fromkeys(stated.RENDERED.values()):
        render()
    stated.main(older_than_the_last())


def outcome(part: Part) -> dict[str, int]:
    """Of its rows, those of this code, and how many of these came out as they had by the code before."""
    rows = [row for file in files_of(part) for row in file]
    own = [row for row in rows if row.get("core") == core()]
    again = [row["before"]["same"] for row in own if "before" in row]
    return {"rows": len(rows), "of it": len(own), "anew": len(again), "as before": sum(again)}


def measure(part: Part, end: float, every: bool = False) -> None:
    """Measure what is left of a part, in a process of its own, until the time is over.

    Raises:
        subprocess.CalledProcessError: it ended in an error.
    """
    if time.time() > end:
        print(f"{part.name}: the time is over; run again to go on")
        return
    environment = os.environ | {"BAYESCAL_ANEW": "1", "BAYESCAL_SECONDS": "inf"}
    environment |= {"BAYESCAL_UNTIL": str(end)}  # of all its files together
    environment |= {"BAYESCAL_SAMPLE": "0" if every else str(part.sample)}
    what = (part.module, *part.options) if part.options else ("benchmarks", part.name)
    subprocess.run([sys.executable, "-m", *what], cwd=ROOT, env=environment, check=True)


if __name__ == "__main__":
    main(sys.argv[1:])
