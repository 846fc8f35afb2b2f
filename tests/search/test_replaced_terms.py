"""A coefficient that something else stands for is not measured, however well the fit converged and predicts."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro, still_sensor
from tests.support.inside import find_replaced_terms

QUICK = bc.LeastSquares(draws=100)


def fits(readings: bc.Measurements, *effects: str) -> tuple[bc.Calibration, bc.Calibration]:
    base = still_sensor.INSTRUMENT.for_readings(readings).baseline()
    if readings.unit("output") == "deg/s":
        base = mems_gyro.INSTRUMENT.baseline()
    return bc.fit(base, readings, QUICK), bc.fit(base + list(effects), readings, QUICK)


def left_out(calibration: bc.Calibration) -> Any:
    """Each group predicted from the others, as a search of nothing asks of its one model."""
    how: dict[str, Any] = {"method": QUICK, "max_effects": 0, "widen_noise": False}
    path = bc.calibrate(calibration.model, calibration.readings, **how)
    assert path.final.leave_one_group_out is not None
    return path.final.leave_one_group_out


def spoilt(seed: int, change) -> bc.Measurements:
    """Ramps, in the last run of which the thermometer was changed."""
    readings = still_sensor.simulate(seed=seed)
    warm, last = readings["temperature"].copy(), readings["run"] == "3"
    warm[last] = change(warm[last])
    return readings.with_column("temperature", warm)


def noisy(values: np.ndarray) -> np.ndarray:
    return values + np.random.default_rng(5).normal(0, 7.0, len(values))


@cache
def of_a_bad_thermometer() -> tuple[bc.Calibration, bc.Calibration]:
    return fits(spoilt(1, noisy), "unknown(elapsed)")


def test_a_function_of_the_time_in_runs_that_repeat_stands_for_a_bad_thermometer() -> None:
    (found,) = find_replaced_terms(*of_a_bad_thermometer())
    assert found.term.name == "bias.temperature"
    assert not found.is_measured
    assert found.ratio < 0.1
    assert (found.claim.code, found.claim.subjects) == ("term.replaced", ("bias.temperature",))
    assert found.claim.numbers["by"] == ("unknown(elapsed)",)


def test_what_has_no_name_and_repeats_as_the_profile_does_is_confounded_with_it_by_design() -> None:
    """A slow lag, described by a function of the time within runs: of another profile it says nothing."""
    readings = still_sensor.simulate({"bias.thermal_lag_slow": 8.0}, seed=4)
    (found,) = find_replaced_terms(*fits(readings, "unknown(elapsed)"))
    assert found.is_confounded and not found.is_measured
    assert found.claim.code == "term.replaceable"
    str(found.claim)
    str(found._replace(runs=1).claim)


@pytest.mark.parametrize(
    ("hidden", "size"), [("bias.warm_up", 200.0), ("bias.drift", 200.0), ("bias.run", 150.0)]
)
def test_a_cause_that_corrects_a_term_takes_nothing_over(hidden: str, size: float) -> None:
    readings = still_sensor.simulate({hidden: size}, seed=5)
    assert all(one.is_measured for one in find_replaced_terms(*fits(readings, hidden)))


def test_effects_of_the_same_column_take_nothing_over() -> None:
    readings = still_sensor.simulate({"bias.temperature_quadratic": 0.4}, seed=5)
    assert not find_replaced_terms(
        *fits(readings, "bias.temperature_quadratic", "bias.thermal_lag")
    )


def test_a_second_thermometer_that_is_a_cause_takes_nothing_over() -> None:
    readings = mems_gyro.simulate({"bias.reference_voltage": 0.02}, seed=5)
    found = find_replaced_terms(*fits(readings, "bias.reference_voltage"))
    assert [one.is_measured for one in found] == [True]


def test_a_description_that_moves_a_coefficient_beyond_chance_leaves_it_unmeasured() -> None:
    """A cause with a name may; which of both values is right, what has none does not tell."""
    (found,) = find_replaced_terms(*of_a_bad_thermometer())
    for moved, left, measured in ((3.0, 0.9, True), (8.0, 0.9, False), (8.0, 0.2, True)):
        one = found._replace(shift=moved, tolerance=left, ratio=0.9)
        assert (one.is_unnamed, one.is_measured) == (True, measured)


def test_runs_that_are_alike_surprise_none_of_the_others() -> None:
    for seed in (6, 7):
        found = left_out(fits(still_sensor.simulate(seed=seed))[0])
        assert np.all((found.error_ratio > 0.7) & (found.error_ratio < 1.4))
