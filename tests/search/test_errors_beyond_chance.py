"""Errors of hold-out data and of groups left out: a rise counts where chance does not explain it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bayescal._calibration.leave_group_out import LeaveOneGroupOut
from bayescal._search.gate import holdout_better, left_out_better
from bayescal._search.search_path import Step


def step(score: float, error: float, p: float = 1.0) -> Step:
    """A step with this density of the groups left out, this error of them and of hold-out data, nothing else of one."""
    calibration: Any = SimpleNamespace(unit="ug")
    groups = LeaveOneGroupOut(
        "run", ("1", "2"), np.full(2, score), np.full(4, error), np.ones(2), np.ones(2)
    )
    nothing: Any = None
    test: Any = SimpleNamespace(worse_than=lambda _: p)
    return Step(calibration, None, 1.0, 1.0, error, groups, 1.0, nothing, None, holdout_test=test)


BASE = step(-50.0, 1.0)


@pytest.mark.parametrize(
    ("score", "worse"), [(-20.0, False), (-52.0, False), (-53.0, True), (np.nan, True)]
)
def test_groups_left_out_are_judged_by_their_density(score, worse) -> None:
    """The odds of a hundred to one are 4.6 nats, of both groups together."""
    assert (left_out_better(step(score, 1.3), [BASE]) is BASE) == worse


@pytest.mark.parametrize(("p", "worse"), [(0.02, False), (0.005, True)])
def test_hold_out_data_are_judged_by_a_test(p, worse) -> None:
    assert (holdout_better(step(-20.0, 1.3, p), [BASE]) is BASE) == worse


def test_what_is_no_rise_is_no_rise() -> None:
    last = step(-60.0, 1.04, 0.0)
    for better in (left_out_better, holdout_better):
        assert better(last, [BASE]) is None and better(last, []) is None
