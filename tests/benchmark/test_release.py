"""Banks of campaigns: stopped, they go on; a release measures a part of them anew, each beside what it was."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks import bank, pages
from benchmarks.bank import Bank, same_outcome


def measured(seed: int) -> dict[str, Any]:
    return {"final": [str(1 / (seed - 1))]}


@pytest.fixture
def campaigns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bank:
    monkeypatch.setattr(bank, "RESULTS", tmp_path)
    return Bank("made_up", lambda: (((seed,), seed) for seed in range(40)), measured)


def test_bank_keeps_errors_and_measures_nothing_twice(campaigns: Bank) -> None:
    campaigns.run()
    rows = campaigns.rows
    assert [row["seed"] for row in rows] == list(range(40))
    assert [row["seed"] for row in rows if "crash" in row] == [1]
    campaigns.run()
    assert campaigns.rows == rows


def test_release_draws_campaigns_and_compares_them(campaigns: Bank) -> None:
    campaigns.run()
    changed = Bank("made_up", campaigns.cases, lambda seed: measured(seed + 2 * (seed % 2)))
    pairs = changed.again(10, "0.3.0")
    seeds = [new["seed"] for _, new in pairs]
    assert len(set(seeds)) == 10 and seeds != [new["seed"] for _, new in changed.again(10, "0.4.0")]
    assert [same_outcome(*pair) for pair in pairs] == [seed % 2 == 0 for seed in seeds]
    assert len(changed.rows) == 40


def test_right_statements_come_true_as_often_as_is_due() -> None:
    pairs = [(0.9, i % 10 > 0) for i in range(100)]
    assert pages.stated_and_true(pairs, 0.95, 1.0) == "–"
