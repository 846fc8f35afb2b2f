"""Figures written by hand are those of the committed rows, and rows of an older code give place to new ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.hidden_effects.resume import go_on_by_seed
from benchmarks.record import add_line, core, read_lines
from benchmarks.stated import ROOT, STATED, Stated, otherwise_than


@pytest.mark.parametrize("one", STATED, ids=lambda one: one.words[:40])
def test_a_page_says_what_the_rows_say(one: Stated) -> None:
    page = (ROOT / one.page).read_text("utf-8")
    assert otherwise_than(one, page) == ""
    figure = next(str(f) for f in one.figures() if any(c.isdigit() for c in str(f)))
    first = next(c for c in figure if c.isdigit())
    words = " ".join(one.words.split()).format(
        *(f"{f:,}" if isinstance(f, int) else f for f in one.figures())
    )
    altered = words.replace(first, str((int(first) + 1) % 10))
    said = otherwise_than(one, " ".join(page.split()).replace(words, altered))
    assert one.page in said and words in said


def test_a_release_measures_older_rows_anew(tmp_path: Path, monkeypatch) -> None:
    file = tmp_path / "rows.jsonl"
    for seed in (1, 2):
        add_line(file, {"seed": seed, "found": "before", "core": "older"})
    go_on_by_seed(file, range(1, 4), lambda seed: ({"seed": seed, "found": "now"}, ""))
    assert [row["found"] for row in read_lines(file)] == ["before", "before", "now"]
    monkeypatch.setenv("BAYESCAL_ANEW", "1")
    go_on_by_seed(file, range(1, 3), lambda seed: ({"seed": seed, "found": "anew"}, ""))
    rows = {row["seed"]: row for row in read_lines(file)}
    assert {seed: row["found"] for seed, row in rows.items()} == {1: "anew", 2: "anew", 3: "now"}
    assert {row["core"] for row in rows.values()} == {core()} and len(read_lines(file)) == 3
