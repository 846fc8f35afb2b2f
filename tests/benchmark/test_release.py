"""What is stated was measured: a sentence of a page against its rows, and rows against the last whole release."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import record, release
from benchmarks.release import HEADLINE, older_than_the_last
from benchmarks.stated import Stated, otherwise_than


def test_a_figure_that_was_altered_is_named() -> None:
    one = Stated("docs/page.md", "Of {} records {} were right", lambda: [1120, "94/94 (96–100 %)"])
    page = "…\nOf 1,120 records\n94/94 (96–100 %) were right."
    assert not otherwise_than(one, page)
    said = otherwise_than(one, page.replace("94/94", "93/94"))
    assert said.startswith("docs/page.md") and "'Of 1,120 records 93/94" in said
    assert otherwise_than(one, "nothing").endswith("nothing of it")


def test_rows_older_than_the_last_whole_release_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (record, release):
        monkeypatch.setattr(module, "RESULTS", tmp_path)
        monkeypatch.setattr(module, "core", lambda: "new")
    part = HEADLINE[0].name
    for case, core in enumerate(("old", "released", "new")):
        record.add_line(tmp_path / f"{part}.jsonl", {"case": case, "core": core})
    assert older_than_the_last() == [], "no release was measured whole"
    record.write("release", {"of": "released", "rows": {part: 3}})
    (said,) = older_than_the_last()
    assert said.startswith(f"{part}: 1 rows are older than the last release")
    assert release.rows_of(HEADLINE[0])[:2] == (3, 2)
