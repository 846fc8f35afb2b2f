"""Numbers that decide outcomes can be seen and changed, and what was changed is written into the result."""

from __future__ import annotations

import dataclasses
import re

import pytest

import bayescal as bc
from bayescal._calibration.settings import searching, unusual
from bayescal._report.result_json import result
from tests.support.made_up import split_search


@pytest.mark.parametrize("kind", [bc.SearchSettings, bc.GuardSettings])
def test_every_setting_has_its_reason(kind) -> None:
    said = dict(re.findall(r"^        (\w+): (.+)$", kind.__doc__, re.MULTILINE))
    for field in dataclasses.fields(kind):
        assert len(said[field.name]) > 30, field.name


def test_settings_hold_inside_and_no_further() -> None:
    with bc.use_settings(bc.SearchSettings(found=0.99), bc.GuardSettings(outlier=5.0)):
        assert searching().found == 0.99
        assert unusual() == {"found": 0.99, "outlier": 5.0}
    assert searching().found == 0.95 and unusual() == {}


def test_other_things_are_no_settings() -> None:
    with pytest.raises(TypeError, match=r"are SearchSettings or GuardSettings, not 0\.9"):
        bc.use_settings(0.9).__enter__()  # pyright: ignore[reportArgumentType]


def test_a_search_goes_by_them_and_the_result_says_so() -> None:
    readings = split_search.readings()
    first = split_search.trail().steps[0].discovery
    assert first is not None and first.sets
    with bc.use_settings(bc.SearchSettings(found=0.9999)):
        trail = bc.calibrate(split_search.trail().steps[0].calibration.model, readings)
        assert result(trail)["settings"] == {"found": 0.9999}
    other = trail.steps[0].discovery
    assert other is not None
    assert [s.effects for s in other.sets] != [s.effects for s in first.sets]
