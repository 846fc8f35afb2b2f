"""Each test beyond the fast ones has its turn: once in so many days, whatever day one begins with."""

from __future__ import annotations

from datetime import date, timedelta

import pytest

from tests.support.tiers import DAYS, has_its_turn, slow_but

TESTS = [f"tests/room/test_{k % 7}.py::test_it[{k}]" for k in range(300)]
BEGUN = date(2026, 12, 24)  # the turn goes on over the end of a year


@pytest.mark.parametrize("begun", [BEGUN, BEGUN + timedelta(days=5)])
def test_each_test_has_one_turn_in_the_days_that_there_are(begun: date) -> None:
    days = [begun + timedelta(days=k) for k in range(DAYS)]
    turns = [[test for test in TESTS if has_its_turn(test, day)] for day in days]
    assert sorted(test for own in turns for test in own) == sorted(TESTS)
    assert max(map(len, turns)) < 3 * len(TESTS) / DAYS


def test_cases_that_are_not_fast_are_marked() -> None:
    fast, slow = slow_but(["a"], ["a", "b"])
    assert fast == "a"
    assert [mark.name for mark in slow.marks] == ["slow"]
