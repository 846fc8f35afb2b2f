"""The page *How we know*: a table of all tests, with the data they use and their results."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from benchmarks import evidence_greedy, pages
from benchmarks.accuracy.certified import worst
from benchmarks.hidden_effects import measurement as bank
from benchmarks.ordinary_test import page as ordinary
from benchmarks.pages import Rows, proportion
from benchmarks.record import read
from benchmarks.spoilt_records import measurement as spoilt
from benchmarks.wrong_model import coverage as foreign

ABOUT = """
All tests, the data they use, and their results; brackets are exact 95 % binomial intervals. Consequences for your own
results: [limitations](limits.md). Not tested: a laboratory of our own (all campaigns with a known truth are simulated;
records of others have no known truth), instruments with an error that is in no simulator, more than a few thousand
campaigns (rates below one in a thousand are not known), whether you interpret the result as intended.
"""
Line = tuple[str, str, str]


def lines() -> Iterator[Line]:
    """Yield the lines: test, result, and the page with details."""
    certified, page = read("certified"), "[certified data](certified.md)"
    for kind, sets in (("nonlinear", "27 sets from both starts"), ("linear", "11 sets")):
        words = f"digits of the worst parameter {worst(certified[kind])[0]}"
        yield f"NIST, {kind}, {sets}", words, page
    shift = max(abs(r["shift"]) for r in certified["posteriordb"])
    within = f"6 posteriors within {shift:.2f} standard deviations"
    yield "posteriordb: means against reference draws", within, page
    yield from _coverage()
    page = "[public records](records_of_others.md)"
    yield "public records of eleven sensors", "each beside customary methods", page
    yield from _ordinary()
    yield from _hidden()
    yield from evidence_greedy.lines()
    yield from _spoilt()
    all_rows = [row for rows in foreign.results().values() for row in rows]
    for words, say in foreign.CLAIMS[:2]:
        page = "[model misspecification](wrong_model.md)"
        words = f"{len(all_rows)} campaigns with laws outside the catalogue, {words}"
        yield words, say(all_rows), page
    yield from _released()


def _coverage() -> Iterator[Line]:
    instruments: dict[str, Any] = read("coverage")["instruments"]
    sets, unknowns = (
        sum(instrument[k] for instrument in instruments.values()) for k in ("data_sets", "unknowns")
    )
    farthest = max(instrument["largest_distance"] for instrument in instruments.values())
    words = f"{sets:,} data sets drawn from the priors of {len(instruments)} instruments, {unknowns} unknowns: ranks"
    words, page = f"{words} of the truth", "[mathematics](mathematics.md#identifiability)"
    yield f"{words} (simulation-based calibration)", f"within {farthest:.2f} of uniform", page


def _ordinary() -> Iterator[Line]:
    rows, page = ordinary.whole("ordinary_test"), "[simulated chamber tests](ordinary_test.md)"
    good, strange = ordinary.whole("good_records"), ordinary.strange(ordinary.whole("no_family"))
    words = f"{len(rows)} chamber tests: hidden, clear effects are named"
    yield words, ordinary.named(rows), page
    yield "the same: a wrong name", ordinary.wrong_name(rows), page
    words = "the same: 95 % intervals, different profiles"
    yield words, ordinary.inside(rows, repeats=False), page
    yield "the same, one profile repeated", ordinary.inside(rows, repeats=True), page
    yield f"{len(good)} records without faults: not reliable", ordinary.shut(good), page
    words = "effects outside the catalogue: a wrong name"
    yield words, ordinary.wrong_name(strange), page


def _hidden() -> Iterator[Line]:
    groups, page = bank.results(), "[hidden effects](hidden_effects.md)"
    all_rows: Rows = [row for rows in groups.values() for row in rows]
    words = f"{len(all_rows):,} campaigns of {len(groups)} instruments: {bank.SHORT[0][0]}"
    yield words, bank.SHORT[0][1](all_rows), page
    for words, say in bank.SHORT[1:]:
        yield words, say(all_rows), page


def _spoilt() -> Iterator[Line]:
    known, before = "known when checks were written", "listed before any check"
    for banks, words in ((spoilt.SPOILT, known), (spoilt.SIXTY, before)):
        count = spoilt.verdicts([row for rows in spoilt.results(banks).values() for row in rows])
        three = "; ".join(f"{v} {proportion(count[v], count.total())}" for v in spoilt.VERDICTS[:3])
        words = f"{count.total():,} files with faults of laboratories, of kinds {words}"
        yield words, three, "[corrupted records](gauntlet.md)"


def _released() -> Iterator[Line]:
    """Yield the campaigns measured again for a release, and the number with an unchanged outcome."""
    release = read("release")
    version = release["version"]
    for name, row in release["banks"].items():
        words = f"{name.replace('_', ' ')}, {row['anew']} of {row['rows']:,} rows repeated by version {version}"
        yield words, f"unchanged {proportion(row['same'], row['anew'])}", ""


def render() -> pages.Texts:
    """Render the page from the stored results."""
    days = [r["day"] for b in (*bank.results().values(), *spoilt.results().values()) for r in b]
    table = pages.table(["test", "result", "details"], lines())
    return pages.page("how_we_know", "Validation", "render", days, ABOUT, table)
