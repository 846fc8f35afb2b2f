"""A jump and a cycle in time, of no known cause, are told from wandering noise, measured, drafted and saved."""

from __future__ import annotations

import re

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro

INSTRUMENT = mems_gyro.INSTRUMENT
METHOD = bc.LeastSquares(draws=200)
PLACE, HEIGHT = 0.53, 0.2  # of the record, within the second run; °/s, four times the noise
CYCLES, WAVE = 6.3, 0.06  # in the record; °/s


def part_of_the_record(readings: bc.Measurements) -> np.ndarray:
    time = readings["time"]
    return (time - time.min()) / np.ptp(time)


def changed(seed: int, contribution) -> bc.Measurements:
    readings = mems_gyro.simulate({}, seed=seed)
    at = part_of_the_record(readings)
    return readings.with_column("output", readings["output"] + contribution(at))


def drafted(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found is not None, text
    return float(found[1])


@pytest.fixture(scope="module")
def jumped() -> bc.SearchPath:
    readings = changed(41, lambda at: np.where(at > PLACE, HEIGHT, 0.0))
    return bc.calibrate(INSTRUMENT.baseline(), readings, method=METHOD)


@pytest.fixture(scope="module")
def cycled() -> bc.SearchPath:
    readings = changed(42, lambda at: WAVE * np.sin(2 * np.pi * CYCLES * at + 0.4))
    return bc.calibrate(INSTRUMENT.baseline(), readings, method=METHOD)


@pytest.mark.slow
def test_a_jump_is_found_where_it_is_and_as_high_as_it_is(jumped: bc.SearchPath) -> None:
    final = jumped.final.calibration
    assert [s.added for s in jumped.steps if s.added] == ["unknown(time, jump)"]
    at = part_of_the_record(final.readings)
    beside = np.sort(at[np.argsort(np.abs(at - PLACE))[:2]])  # no reading tells more than these
    place = float(final.samples("unknown(time, jump).place").mean())
    assert beside[0] - 0.01 < place < beside[1] + 0.01
    height = final.samples("unknown(time, jump)[1]")
    assert abs(height.mean() - HEIGHT) < 4 * height.std()
    assert jumped.final.rmse == pytest.approx(0.05, rel=0.15)
    told = [s for s in final.verdict.notes if "which of two levels" in s]
    apart = drafted(r"which of two levels, (\S+) °/s apart", " ".join(told))
    assert apart == pytest.approx(abs(float(height.mean())), rel=0.02)
    assert len(told) == 1


@pytest.mark.slow
def test_a_cycle_is_found_with_its_period_and_amplitude(cycled: bc.SearchPath) -> None:
    final = cycled.final.calibration
    assert [s.added for s in cycled.steps] == [None, "unknown(time, cycle)"]
    assert final.model.noise.law == "white"
    cycles = float(final.samples("unknown(time, cycle).cycles").mean())
    assert cycles == pytest.approx(CYCLES, abs=0.05)
    parts = [final.samples(f"unknown(time, cycle)[{i}]") for i in (1, 2)]
    wave = np.hypot(*parts)
    assert wave.mean() == pytest.approx(WAVE, rel=0.2)


@pytest.mark.slow
def test_a_fast_wave_is_found_and_measured_by_the_default_method() -> None:
    readings = changed(44, lambda at: WAVE * np.sin(2 * np.pi * 13.2 * at))
    trail = bc.calibrate(INSTRUMENT.baseline(), readings)
    assert trail.final.calibration.verdict.ok
    draws = trail.final.calibration.samples("unknown(time, cycle).cycles")
    assert abs(draws.mean() - 13.2) < max(4 * draws.std(), 0.02)
    assert 0 < draws.std() < 0.1


@pytest.mark.slow
def test_a_jump_is_measured_by_the_default_method() -> None:
    readings = changed(45, lambda at: np.where(at > PLACE, HEIGHT, 0.0))
    sampled = bc.fit(INSTRUMENT.baseline() + "unknown(time, jump)", readings)
    assert sampled.verdict.ok
    height = sampled.samples("unknown(time, jump)[1]")
    assert abs(height.mean() - HEIGHT) < 4 * height.std()
    assert 0 < sampled.samples("unknown(time, jump).place").std() < 0.02
