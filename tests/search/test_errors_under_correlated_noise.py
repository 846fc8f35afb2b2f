"""Errors of neighbouring readings under correlated noise are few independent ones: a rise of their rms says little."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._calibration.leave_group_out import LeaveOneGroupOut
from bayescal._search.gate import holdout_better, left_out_better
from bayescal._search.search_path import Step

WALK = bc.SummedNoise(1.0, 100.0, ("walk",))


def step(noise: bc.Noise, left_out: float, score: float, holdout: float, sd: float) -> Step:
    """A step with these errors, and nothing else of one."""
    calibration: Any = SimpleNamespace(model=SimpleNamespace(noise=noise), unit="ug")
    groups = LeaveOneGroupOut(
        "run", ("1", "2"), np.full(2, score), np.full(4, left_out), np.ones(2)
    )
    nothing: Any = None
    return Step(calibration, None, 1.0, 1.0, holdout, groups, 1.0, nothing, None, holdout_sd=sd)


BASE = step(bc.White(), 1.0, -50.0, 1.0, 0.5)


@pytest.mark.parametrize(
    ("noise", "score", "worse"),
    [(WALK, -20.0, False), (WALK, -60.0, True), (WALK, np.nan, True), (bc.White(), -20.0, True)],
)
def test_groups_left_out_are_judged_by_their_density_under_correlated_noise(
    noise, score, worse
) -> None:
    found = left_out_better(step(noise, 1.3, score, 1.0, 1.0), [BASE])
    assert (found is BASE) == worse


@pytest.mark.parametrize(
    ("noise", "sd", "worse"), [(WALK, 0.7, False), (WALK, 0.6, True), (bc.White(), 1.5, True)]
)
def test_hold_out_data_are_judged_by_what_correlated_noise_lets_one_expect(
    noise, sd, worse
) -> None:
    found = holdout_better(step(noise, 1.0, -20.0, 1.3, sd), [BASE])
    assert (found is BASE) == worse


def test_what_is_no_rise_is_no_rise_under_any_law() -> None:
    last = step(bc.White(), 1.04, -60.0, 1.04, 0.5)
    for better in (left_out_better, holdout_better):
        assert better(last, [BASE]) is None and better(last, []) is None
