"""Figures that are written by hand in README.md and docs/limits.md, each from the committed rows that give it.

    python -m benchmarks stated        names every figure, and every rendered page, that differs from the rows, and
                                       what docs/start.md shows otherwise than it is printed

`make docs` builds no site while one does. A sentence stands here once more, with a place `{}` for each figure.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from benchmarks import how_we_know, open_benchmark, shown
from benchmarks.accuracy import certified_page
from benchmarks.counted import (
    bank,
    clear,
    coefficients,
    explained_away,
    faint,
    fleet,
    in_false_discoveries,
    interval,
    otherwise,
    outside,
    share,
    taken_for_noise,
    verdicts,
    whole,
)
from benchmarks.fleet import page as fleet_page
from benchmarks.hidden_effects import measurement as hidden_effects
from benchmarks.hidden_effects import units
from benchmarks.hidden_effects.outcomes import hidden_in, names_outside, of_kind, strong_pairs
from benchmarks.intervals import proportion
from benchmarks.ordinary_test import page as ordinary_page
from benchmarks.real_records import records_page, still_logs, thermal_ramp_page
from benchmarks.record import ROOT, read
from benchmarks.speed import page as speed_page
from benchmarks.spoilt_records import measurement as spoilt_records
from benchmarks.wrong_model import page as wrong_model_page

RENDERED: dict[str, Callable[[], object]] = {  # pages that are rendered from rows alone
    "README.md": hidden_effects.render,
    "docs/hidden_effects.md": hidden_effects.render,
    "docs/ordinary_test.md": ordinary_page.write,
    "docs/gauntlet.md": spoilt_records.render,
    "docs/wrong_model.md": wrong_model_page.write,
    "docs/fleet.md": fleet_page.render,
    "docs/speed.md": speed_page.render,
    "docs/how_we_know.md": how_we_know.render,
    "docs/certified.md": lambda: certified_page.write(read("certified")),
    "docs/missing_effect.md": open_benchmark.render,
    "docs/records_of_others.md": lambda: records_page.write(read("records_of_others")["records"]),
    "docs/still_logs.md": still_logs.render,
    "docs/thermal_ramp.md": lambda: thermal_ramp_page.write(read("thermal_ramp")),
    "docs/units.md": units.render,
}


PRINTED = "start.md"  # the page that shows what is printed, and is run for it; the tests run every such page


class Stated(NamedTuple):
    """A sentence of a page with its figures.

    Attributes:
        page: its path.
        words: the sentence, `{}` for each figure; lines may be broken anywhere.
        figures: what the rows say now.
    """

    page: str
    words: str
    figures: Callable[[], Iterable[Any]]


def differing() -> Iterator[str]:
    """What a page says otherwise than the rows, a sentence each."""
    for one in STATED:
        if said := otherwise_than(one, (ROOT / one.page).read_text("utf-8")):
            yield said
    for page, before, after in rendered_anew():
        lines = zip(before.splitlines(), after.splitlines(), strict=False)
        first = next(((b, a) for b, a in lines if b != a), ("its end", "more or fewer lines"))
        yield f"{page}: it says {first[0][:200]!r}, rendered anew {first[1][:200]!r}"
    yield from shown.differing(PRINTED)


def otherwise_than(one: Stated, page: str) -> str:
    """How the text of a page differs from a sentence with its figures; empty if it does not."""
    text, words = " ".join(page.split()), " ".join(one.words.split())
    figures = [f"{f:,}" if isinstance(f, int) else str(f) for f in one.figures()]
    if (expected := words.format(*figures)) in text:
        return ""
    found = re.search(".{1,40}?".join(map(re.escape, words.split("{}"))), text)
    there = repr(found[0]) if found else "nothing of it"
    return f"{one.page}: the rows say {expected!r}, the page {there}"


def rendered_anew() -> Iterator[tuple[str, str, str]]:
    """Pages that their own rows give otherwise: the page, as it is and as it would be. None is left changed."""
    paths = {page: ROOT / page for page in RENDERED}
    before = {page: path.read_text("utf-8") for page, path in paths.items()}
    try:
        for render in dict.fromkeys(RENDERED.values()):
            render()
        after = {page: path.read_text("utf-8") for page, path in paths.items()}
    finally:
        for page, path in paths.items():
            path.write_text(before[page], "utf-8")
    yield from ((page, before[page], after[page]) for page in paths if before[page] != after[page])


def main(beside: Iterable[str] = ()) -> None:
    """Name what differs.

    Args:
        beside: what else is said.

    Raises:
        SystemExit: something does.
    """
    if found := [*beside, *differing()]:
        sys.exit("\n".join(found))
    print(
        f"{len(STATED)} sentences and {len(RENDERED)} pages are as the rows have them, {PRINTED} as it is printed"
    )


def spoilt(kind: str) -> tuple[int, int]:
    """Records, and how many were right."""
    count = verdicts(kind)
    return sum(count.values()), count["right"]


def seconds(instrument: str) -> list[str]:
    """Of a search, the median over an instrument's campaigns."""
    return [f"{np.median([row['seconds'] for row in bank()[instrument]]):.1f}"]


def slowest() -> list[str]:
    """The slowest search of each instrument over the median: the least and the largest, to two digits."""
    taken = [[row["seconds"] for row in rows] for rows in bank().values()]
    ratios = sorted(max(one) / float(np.median(one)) for one in taken)
    return [f"{float(f'{ratio:.2g}'):.0f}" for ratio in (ratios[0], ratios[-1])]


def on_the_ramp() -> list[str]:
    """Processor seconds of a channel."""
    channels = read("thermal_ramp")["channels"].values()
    taken = [one["cpu_seconds"] for splits in channels for one in splits.values()]
    return [f"{min(taken):.0f}", f"{max(taken):.0f}"]


def of_three_axes() -> list[str]:
    """Processor seconds that a fit of 5 × 14 poses takes."""
    taken = read("triad_speed")["seconds"]["fit of 5 x 14 poses over temperature"]["processor"]
    return [f"{taken:.2f}"]


LIMITS, LONG = "docs/limits.md", "docs/how_long.md"
STATED = (
    *(
        Stated(LONG, f"the search alone (`{name}`" + words + " | {} |", partial(seconds, name))
        for name, words in {
            "inclinometer": "), median of a bank of campaigns",
            "still_sensor": ")",
            "quartz_beam_accelerometer": ")",
            "ng_accelerometer": ")",
            "differential_pair": ", whose response is nonlinear)",
        }.items()
    ),
    Stated(LONG, "The slowest search of each bank took {} to {} times the median", slowest),
    Stated(LONG, "one channel of the chamber ramp | {} to {} of processor", on_the_ramp),
    Stated("docs/how_to/three_axes.md", "{} s for one of 5 × 14 over temperature", of_three_axes),
    Stated(
        "README.md",
        "[The whole bank](docs/hidden_effects.md), {} campaigns, names every miss.",
        lambda: [sum(map(len, bank().values()))],
    ),
    Stated(
        LIMITS,
        "Of campaigns with something outside the catalogue, the right column was in the final model in {}",
        lambda: [
            share(names_outside(r, "final") for r in outside("column", "periodic", "step", "shock"))
        ],
    ),
    Stated(
        LIMITS,
        "of {} in which an outside effect followed nearly the curve of a listed one (correlation ≥ 0.7), {} were "
        "explained by that one",
        explained_away,
    ),
    Stated(
        LIMITS,
        "Of {} hidden periodic disturbances {}, and of {} shocks {}, were taken for correlated noise",
        lambda: [
            f(shape)
            for shape in ("periodic", "shock")
            for f in (lambda s: len(outside(s)), taken_for_noise)
        ],
    ),
    Stated(
        LIMITS,
        "nothing hidden, something added | {}",
        lambda: [share(bool(r["final"]) for r in of_kind(bank(), "empty"))],
    ),
    Stated(
        LIMITS,
        "the same under correlated noise | {} |",
        lambda: [share(bool(r["added"]) for r in in_false_discoveries("wandering noise"))],
    ),
    Stated(
        LIMITS,
        "the same with outliers | {} |",
        lambda: [share(bool(r["added"]) for r in in_false_discoveries("outliers"))],
    ),
    Stated(
        LIMITS,
        "one effect hidden and well visible (log Bayes factor above 15), not in the final model | {} |",
        lambda: [share(hidden_in(r) not in r["final"] for r in clear())],
    ),
    Stated(
        LIMITS,
        "the same, something else in the final model | {} |",
        lambda: [share(map(otherwise, clear()))],
    ),
    Stated(
        LIMITS,
        "one hidden, log Bayes factor below 5: found | {} |",
        lambda: [share(hidden_in(r) in r["final"] for r in faint())],
    ),
    Stated(
        LIMITS,
        "two effects hidden, one or both not in the final model | {} |",
        lambda: [share(not set(r["hidden"]) <= set(r["final"]) for r in strong_pairs(bank()))],
    ),
    Stated(
        LIMITS,
        "a false effect in a device where nothing is hidden | {} |",
        lambda: [proportion(fleet()["false"], fleet()["empty"])],
    ),
    Stated(
        LIMITS, "Of {} records spoilt as laboratory files are, {} (", lambda: spoilt("gauntlet")
    ),
    Stated(LIMITS, "a random {} records of six instruments: {} (", lambda: spoilt("covariates")),
    Stated(
        LIMITS,
        "{} intervals of 95 % held the truth ({}), where profiles differ {}",
        lambda: [
            f"{sum(coefficients(True))} of {len(coefficients(True))}",
            interval(coefficients(True)),
            f"{sum(coefficients(False))} of {len(coefficients(False))}",
        ],
    ),
    Stated(
        LIMITS,
        "Of {} records that are not spoilt, of six instruments, the gate shut on {}",
        lambda: [
            len(whole("good_records")),
            sum(r["status"] == 1 for r in whole("good_records")) or "none",
        ],
    ),
)


if __name__ == "__main__":
    main()
