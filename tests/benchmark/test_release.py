"""What is stated was measured: a sentence of a page against its rows, and rows against the last release."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import record, release
from benchmarks.hidden_effects import resume, triads
from benchmarks.release import Part, older_than_the_last
from benchmarks.stated import Stated, otherwise_than


def test_a_figure_that_was_altered_is_named() -> None:
    one = Stated("docs/page.md", "Of {} records {} were right", lambda: [1120, "94/94 (96–100 %)"])
    page = "…\nOf 1,120 records\n94/94 (96–100 %) were right."
    assert not otherwise_than(one, page)
    said = otherwise_than(one, page.replace("94/94", "93/94"))
    assert said.startswith("docs/page.md") and "'Of 1,120 records 93/94" in said
    assert otherwise_than(one, "nothing").endswith("nothing of it")


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for module in (record, release):
        monkeypatch.setattr(module, "RESULTS", tmp_path)
    for module in (record, release, resume):
        monkeypatch.setattr(module, "core", lambda: "new")
    return tmp_path


def test_rows_older_than_the_last_release_are_named(results: Path) -> None:
    part = Part("own_unit", 3)
    for case, core in enumerate(("old", "released", "released", "new")):
        record.add_line(results / "own_unit.jsonl", {"case": case, "core": core, "seconds": 1800.0})
    assert older_than_the_last() == [], "nothing was released"
    record.write("release", {"of": "released", "rows": {}})
    (said,) = older_than_the_last()
    assert said.startswith("own_unit: 1 rows more"), "3 of the 4 suffice to a sample of 12 of them"
    assert release.left(part) == (4, 1, 2, 1.0)
    assert release.left(part, every=True) == (4, 1, 3, 1.5)


def test_a_release_draws_cases_and_says_how_many_came_out_as_before(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = results / "own_unit.jsonl"
    for seed in range(40):
        record.add_line(file, {"seed": seed, "final": ["lag"], "core": "old"})
    monkeypatch.setenv("BAYESCAL_ANEW", "1")
    monkeypatch.setenv("BAYESCAL_SAMPLE", "10")
    for _ in range(2):  # once more measures nothing more
        resume.go_on_by_seed(
            file, range(80), lambda seed: ({"seed": seed, "final": ["lag"] * (seed % 2)}, "")
        )
    rows = record.read_lines(file)
    anew = [row for row in rows if row["core"] == "new"]
    assert len(rows) == 40 and len(anew) == 10, "of cases that have a row, before others"
    assert sorted(row["seed"] for row in anew) != list(range(10)), "drawn, not the first"
    same = sum(row["before"]["same"] for row in anew)
    assert same == sum(row["seed"] % 2 for row in anew)
    assert f"Of 10 measured anew {same} came out as before" in record.cores_of(rows)
    assert release.outcome(Part("own_unit", 10)) == {
        "rows": 40, "of it": 10, "anew": 10, "as before": same,
    }  # fmt: skip


def test_counts_of_three_axes_are_summed_up(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(triads, "RESULTS", results)
    row = {"instrument": "gyro_triad", "hidden": {"square.constant": 1.0}, "oracle": 20.0}
    row |= {"final": ["square.constant"], "sets": [], "seconds": 2.0}
    record.add_line(results / "triads.jsonl", row)
    triads.summarise()
    assert record.read("triads")["all"]["found where the oracle is above 15"].startswith("1/1")
    assert "gyro_triad" in capsys.readouterr().out
