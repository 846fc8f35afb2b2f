"""The page *How we know*: what was tried, on whose numbers, and how often it was right, said to be doubtful, or wrong.

`python -m benchmarks how_we_know` renders it from the committed rows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

from benchmarks import counted
from benchmarks.accuracy.certified_page import shortfalls
from benchmarks.hidden_effects.outcomes import hidden_in, of_kind, said
from benchmarks.intervals import proportion
from benchmarks.markdown import table
from benchmarks.ordinary_test import page as ordinary
from benchmarks.record import DOCS, RELEASE, lines_of, read

PAGE = DOCS / "how_we_know.md"
HEAD = """# How we know

Ten minutes. What was tried, on whose numbers, and what came of it. Every count is made from rows that are kept beside
the code (`benchmarks/results`), by `python -m benchmarks how_we_know`; brackets hold its 95 % interval
(Clopper–Pearson). A page says by which code its rows were measured, and the last part below whether the code of today
gives the same.
What follows from it for your own result: [what it will not tell you](limits.md).
"""
LAST = """## What was not tried

- A laboratory of our own: every campaign with a known truth is simulated, and records of others come without their
  truth, but for their published calibrations.
- Instruments with an error that nobody wrote into a simulator.
- More than a few thousand campaigns: a rate below one in a thousand is not known.
- Whether you read the result as it is meant.
"""


def main() -> None:
    """Render the page."""
    render()


def render() -> None:
    """Write the page from the rows that stand."""
    parts = [HEAD]
    for title, words, rows in chapters():
        parts += [f"## {title}\n", f"{words}\n", table(["tried", "came out", "more"], rows)]
    PAGE.write_text("\n".join([*parts, LAST]), encoding="utf-8")


Chapter = tuple[str, str, list[list[str]]]


def chapters() -> Iterable[Chapter]:
    """Title, words and rows of each part."""
    yield (
        "Numbers that others certified",
        "NIST's data sets have answers to eleven digits, posteriordb's posteriors ten thousand draws each. Nothing of "
        "bayescal made them.",
        certified(),
    )
    yield (
        "Records of others",
        "Files that other laboratories published, as they stand. Truth is what their authors say.",
        [
            [
                "NIST's instruments, sensors on a bench and in a chamber, logs of inertial units",
                "each beside its author's own calibration, failures too",
                "[records of others](records_of_others.md), [a chamber ramp](thermal_ramp.md), "
                "[still logs](still_logs.md)",
            ]
        ],
    )
    yield (
        "Physics that is not the catalogue's",
        "Chambers, dies and packages integrated numerically; no formula is shared with what is searched for.",
        ordinary_test(),
    )
    yield (
        "The instruments' own simulators",
        "Physics written for each instrument, from its document; effects hidden at sizes drawn at random, from hardly "
        "visible to obvious.",
        own_simulators(),
    )
    yield (
        "Files as laboratories have them",
        "Campaigns spoilt in known ways: units, clocks, dead thermometers, outliers, lost rows. *Said*: refused, shut, "
        "or named in a flag.",
        [
            spoilt("gauntlet", "of kinds known when the checks were written"),
            spoilt("covariates", "of sixty further kinds"),
        ],
    )
    yield (
        "Stated probabilities and intervals",
        "An interval of 95 % should hold the truth in 95 of 100.",
        intervals(),
    )
    yield (
        "The same, by the code as it is released",
        "Rows are kept from code to code. `python -m benchmarks release` measures of every bank cases drawn at random "
        "anew, others each time. *As before*: the same final model, status or interval, on the same readings.",
        released(),
    )


def certified() -> list[list[str]]:
    found, page = read("certified"), "[certified data](certified.md)"
    digits = min(r["parameters"] for r in found["nonlinear"])
    linear = min(r["parameters"] for r in found["linear"])
    shifts = max(abs(r["shift"]) for r in found["posteriordb"])
    starts = len(found["nonlinear"])
    met = starts - len(
        shortfalls({"nonlinear": found["nonlinear"], "linear": [], "posteriordb": []})
    )
    return [
        [
            "NIST, nonlinear, from both starts",
            f"{met} of {starts}; worst parameter {digits:.1f} digits",
            page,
        ],
        ["NIST, linear", f"{len(found['linear'])} sets; worst parameter {linear:.1f} digits", page],
        [
            "posteriordb: means against reference draws",
            f"{len(found['posteriordb'])} posteriors within {shifts:.2f} standard deviations",
            page,
        ],
    ]


def ordinary_test() -> list[list[str]]:
    """The ordinary laboratory test, good records, hold-out data."""
    rows, page = counted.whole("ordinary_test"), "[the ordinary test](ordinary_test.md)"
    clear = [(r, h) for r in rows for h in r["hidden"] if r["oracle"][h] >= ordinary.CLEAR]
    units, good = counted.whole("own_unit"), counted.whole("good_records")
    strange = [r for r in counted.whole("no_family") if r["oracle"]["further"] >= ordinary.CLEAR]
    found = {
        f"{len(rows)} chamber tests: what is hidden and clear is named": (
            h not in ordinary.lost(r) for r, h in clear
        ),
        "the same: something named that is not there": (bool(ordinary.invented(r)) for r in rows),
        "the same: intervals of 95 %, profiles that differ": counted.coefficients(False),
        "the same, one profile repeated": counted.coefficients(True),
        f"{len(good)} records with nothing wrong: shut": (r["status"] == 1 for r in good),
        "hold-out data of another unit: shut": (not r["held_unit"]["open"] for r in units),
        "something that nothing in the catalogue describes: a wrong name": (
            bool(ordinary.invented(r)) for r in strange
        ),
    }
    return [[claim, counted.share(holds), page] for claim, holds in found.items()]


def own_simulators() -> list[list[str]]:
    bank, clear, empty = counted.bank(), counted.clear(), of_kind(counted.bank(), "empty")
    page, three = "[hidden effects](hidden_effects.md)", "[three axes](how_to/three_axes.md)"
    triads, head = read("triads"), "[its page](instruments/accelerometer_dividing_head.md)"
    return [
        [
            f"{sum(map(len, bank.values())):,} campaigns of six instruments: one effect, clear, in the model or a set",
            counted.share(hidden_in(r) in said(r) for r in clear),
            page,
        ],
        [
            "the same, nothing hidden: something added",
            counted.share(bool(r["final"]) for r in empty),
            page,
        ],
        ["three accelerometers: found; invented", _both(triads["accelerometer_triad"]), three],
        ["three gyroscopes: found; invented", _both(triads["gyro_triad"]), three],
        ["a dividing head: found; invented", _both(read("dividing_head")), head],
        [
            "10,000 gyroscopes: a false effect in a device without any",
            proportion(counted.fleet()["false"], counted.fleet()["empty"]),
            "[fleets](fleet.md)",
        ],
    ]


def _both(counts: dict[str, str]) -> str:
    found, invented = "found where the oracle is above 15", "invented where nothing was hidden"
    return f"{counts[found]}; {counts[invented]}"


def spoilt(kind: str, words: str) -> list[str]:
    count: Counter[str] = counted.verdicts(kind)
    every = sum(count.values())
    three = "; ".join(f"{v} {proportion(count[v], every)}" for v in ("right", "said", "wrong"))
    return [f"{every:,} records {words}", three, "[spoilt records](gauntlet.md)"]


def intervals() -> list[list[str]]:
    coverage: dict[str, Any] = read("coverage")["instruments"]
    sets = sum(one["data_sets"] for one in coverage.values())
    unknowns = sum(one["unknowns"] for one in coverage.values())
    farthest = max(one["largest_distance"] for one in coverage.values())
    used = read("compensation")["instruments"]
    held, campaigns = (sum(u[k] for u in used.values()) for k in ("covered", "campaigns"))
    foreign = sum(map(len, lines_of("wrong_model").values()))
    return [
        [
            f"{sets:,} data sets drawn from the priors of {len(coverage)} instruments, {unknowns} unknowns: ranks of "
            "the truth (simulation-based calibration)",
            f"their distribution within {farthest:.2f} of uniform",
            "[mathematics](mathematics.md#what-is-measured-and-what-is-not)",
        ],
        [
            "corrected readings of later campaigns, 95.4 % intervals",
            proportion(held, campaigns),
            "[mathematics](mathematics.md#what-is-measured-and-what-is-not)",
        ],
        [
            f"{foreign} campaigns whose physics is foreign to the catalogue",
            "by instrument and quantity, on its page",
            "[where the model may be wrong](wrong_model.md)",
        ],
    ]


def released() -> list[list[str]]:
    """Cases measured anew, and those of them that came out as they had."""
    return [
        [
            f"{name.replace('_', ' ')}: {row['of it']:,} of {row['rows']:,} rows anew",
            f"as before {proportion(row['as before'], row['anew'])}",
            "",
        ]
        for name, row in read(RELEASE).get("rows", {}).items()
    ]
