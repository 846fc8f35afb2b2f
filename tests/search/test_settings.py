"""Numbers that decide outcomes can be seen and changed, and what was changed is written into the result."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

import bayescal as bc
from bayescal._calibration.settings import searching
from bayescal._core.settings_in_force import unusual
from bayescal._inference.trust import unevenness
from bayescal._report.result_json import result
from bayescal_models import mems_gyro
from tests.support.made_up import split_search

KINDS = [
    bc.SearchSettings,
    bc.GuardSettings,
    bc.RecordSettings,
    bc.SamplingSettings,
    bc.FleetSettings,
]


@pytest.mark.parametrize("kind", KINDS)
def test_every_setting_has_its_reason(kind) -> None:
    said = dict(re.findall(r"^        (\w+): (.+)$", kind.__doc__, re.MULTILINE))
    for field in dataclasses.fields(kind):
        assert len(said[field.name]) > 30, field.name


def test_settings_hold_inside_and_no_further() -> None:
    with bc.use_settings(bc.SearchSettings(found=0.99), bc.GuardSettings(outlier=5.0)):
        assert searching().found == 0.99
        assert unusual() == {"found": 0.99, "outlier": 5.0}
    assert searching().found == 0.95 and unusual() == {}


def test_each_name_is_one_setting() -> None:
    """The result names settings without their kind."""
    names = [field.name for kind in KINDS for field in dataclasses.fields(kind)]
    assert len(set(names)) == len(names)


def test_a_record_is_judged_by_them() -> None:
    def made() -> bc.Measurements:
        return bc.Measurements.from_arrays(
            mems_gyro.INSTRUMENT, output=[1.0, 2.0], temperature=[20.0, 20.3], time=[0.0, 1.0]
        )

    assert len(made()) == 2
    with (
        bc.use_settings(bc.RecordSettings(temperature_span=0.5)),
        pytest.raises(bc.InputError, match="one temperature only"),
    ):
        made()


def test_draws_are_judged_by_them() -> None:
    weights = np.full(150, 1 / 150)
    assert "150 effective draws" in unevenness(weights, 0.2)
    with bc.use_settings(bc.SamplingSettings(enough=100)):
        assert unevenness(weights, 0.2) == ""
    with bc.use_settings(bc.SamplingSettings(enough=100, k_hat=0.1)):
        assert unevenness(weights, 0.2) != ""


def test_other_things_are_no_settings() -> None:
    with pytest.raises(
        TypeError, match=r"are SearchSettings, GuardSettings and the like, not 0\.9"
    ):
        bc.use_settings(0.9).__enter__()  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
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
