"""Numbers that a user may change can be seen and changed, and what was changed is written into the result."""

from __future__ import annotations

import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.inside import result_of
from tests.support.made_up import split_search


def line_of(*temperatures: float) -> bc.Measurements:
    count = len(temperatures)
    columns = {"temperature": [*temperatures], "time": [float(i) for i in range(count)]}
    output = [1.0 + 0.1 * i for i in range(count)]
    return bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, output=output, **columns)


def test_a_record_is_judged_by_them_inside_and_no_further() -> None:
    with bc.use_settings(bc.Settings(temperature_span=0.5)), pytest.raises(bc.InputError):
        line_of(20.0, 20.3)
    assert len(line_of(20.0, 20.3)) == 2


@pytest.mark.slow
def test_draws_are_judged_by_them() -> None:
    readings = line_of(*range(20, 40))
    model, few = mems_gyro.INSTRUMENT.baseline(), bc.Marginal(draws=100, proposals=100)
    with bc.use_settings(bc.Settings(effective_draws=1e6)):
        assert not bc.fit(model, readings, few, strict=False).verdict.ok
    with bc.use_settings(bc.Settings(effective_draws=10)):
        assert bc.fit(model, readings, few, strict=False).verdict.ok


@pytest.mark.slow
def test_a_search_goes_by_them_and_the_result_says_so() -> None:
    readings = split_search.readings()
    first = split_search.trail().steps[0].discovery
    assert first is not None and first.sets
    with bc.use_settings(bc.Settings(found_probability=0.9999)):
        trail = bc.calibrate(split_search.trail().steps[0].calibration.model, readings)
        assert result_of(trail)["settings"] == {"found_probability": 0.9999}
    other = trail.steps[0].discovery
    assert other is not None
    assert [s.effects for s in other.sets] != [s.effects for s in first.sets]
