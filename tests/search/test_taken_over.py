"""A coefficient that something else stands for is not measured, however well the fit converged and predicts."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._search import search_path
from bayescal._search.calibrate import step_of
from bayescal._search.gate import gate, judged
from bayescal._search.one_profile import another_run
from bayescal._search.taken_over import taken_over
from bayescal_models import mems_gyro, still_sensor

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
    assert path.final.left_out is not None
    return path.final.left_out


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
    (found,) = taken_over(*of_a_bad_thermometer())
    assert found.term.name == "bias.temperature"
    assert not found.measured
    assert found.kept < 0.1
    assert (found.claim.code, found.claim.of) == ("term.replaced", ("bias.temperature",))
    assert found.claim.numbers["by"] == ("unknown(elapsed)",)


def test_the_gate_says_so_and_the_result_is_not_converged() -> None:
    first, last = (step_of(c) for c in of_a_bad_thermometer())
    found = gate([first, last])
    assert not found.ok
    assert gate([first]).reason != found.reason


def test_what_has_no_name_and_repeats_as_the_profile_does_is_confounded_with_it_by_design() -> None:
    """A slow lag, described by a function of the time within runs: of another profile it says nothing."""
    readings = still_sensor.simulate({"bias.thermal_lag_slow": 8.0}, seed=4)
    (found,) = taken_over(*fits(readings, "unknown(elapsed)"))
    assert found.confounded and not found.measured
    assert found.claim.code == "term.replaceable"
    str(found.claim)
    str(found._replace(runs=1).claim)


def test_a_stepped_test_gives_no_pace_of_its_ramps() -> None:
    """Between its readings the temperature goes faster than any rate that they show."""
    ramped, _ = of_a_bad_thermometer()
    assert "°C/min" in another_run(ramped, ["temperature"])
    rates = {"temperature": 1e-3 * ramped.frame.rates["temperature"]}
    stepped = SimpleNamespace(
        readings=ramped.readings,
        frame=SimpleNamespace(rates=rates),
        model=ramped.model,
        samples=ramped.samples,
        posterior=ramped.posterior,
    )
    assert "°C/min" not in another_run(stepped, ["temperature"])  # pyright: ignore[reportArgumentType]


def test_a_cause_that_is_confounded_with_a_term_is_a_note() -> None:
    """Two thermometers 0.3 °C rms apart."""
    readings = mems_gyro.simulate({}, seed=4)
    near = readings["temperature"] + np.random.default_rng(1).normal(0, 0.3, len(readings))
    both = fits(readings.with_column("board_temperature", near), "bias.reference_voltage")
    (found,) = taken_over(*both)
    assert (
        found.confounded and found.measured
    )  # 46 former uncertainties away, and less than one of the new
    _steps, passed = judged([step_of(c) for c in both])
    assert passed.ok


@pytest.mark.parametrize(
    ("hidden", "size"),
    [("bias.warm_up", 200.0), ("bias.drift", 200.0), ("bias.run", 150.0)],
)
def test_a_cause_that_corrects_a_term_takes_nothing_over(hidden: str, size: float) -> None:
    readings = still_sensor.simulate({hidden: size}, seed=5)
    assert all(one.measured for one in taken_over(*fits(readings, hidden)))


def test_effects_of_the_same_column_take_nothing_over() -> None:
    readings = still_sensor.simulate({"bias.temperature_quadratic": 0.4}, seed=5)
    assert taken_over(*fits(readings, "bias.temperature_quadratic", "bias.thermal_lag")) == []


def test_a_second_thermometer_that_is_a_cause_takes_nothing_over() -> None:
    readings = mems_gyro.simulate({"bias.reference_voltage": 0.02}, seed=5)
    found = taken_over(*fits(readings, "bias.reference_voltage"))
    assert [one.measured for one in found] == [True]


def test_a_description_that_moves_a_coefficient_beyond_chance_leaves_it_unmeasured() -> None:
    """A cause with a name may; which of both values is right, what has none does not tell."""
    (found,) = taken_over(*of_a_bad_thermometer())
    for moved, left, measured in ((3.0, 0.9, True), (8.0, 0.9, False), (8.0, 0.2, True)):
        one = found._replace(moved=moved, left=left, kept=0.9)
        assert (one.unnamed, one.measured) == (True, measured)


@pytest.mark.parametrize("change", [lambda t: t + 3.0, lambda t: 1.1 * t], ids=["offset", "gain"])
def test_a_run_with_a_thermometer_of_its_own_is_no_surprise_to_none(change) -> None:
    first, _ = fits(spoilt(2, change))
    found = left_out(first)
    assert found.members[int(np.argmax(found.surprise))] == "3"
    assert found.surprise[2] > 3


def test_runs_that_are_alike_surprise_none_of_the_others() -> None:
    for seed in (6, 7):
        found = left_out(fits(still_sensor.simulate(seed=seed))[0])
        assert np.all((found.surprise > 0.7) & (found.surprise < 1.4))


def test_what_a_late_thermometer_would_make_is_said_to_be_open() -> None:
    readings = still_sensor.simulate({"bias.thermal_lag": 15.0}, seed=1)
    base, last = fits(readings, "bias.thermal_lag", "bias.warm_up")
    steps, _verdict = judged([step_of(base), step_of(last)])
    (said,) = (n for n in steps[-1].calibration.verdict.notes if n.startswith("Not decidable"))
    named = "the sensor has bias.thermal_lag and bias.warm_up, or the thermometer (temperature)"
    assert named in said
    steps, _ = judged([step_of(base)])


def test_a_drift_that_was_not_expected_may_be_the_thermometers() -> None:
    """One of the first model is expected, and says nothing of the thermometer."""
    base, last = fits(still_sensor.simulate({"bias.drift": 300.0}, seed=1), "bias.drift")
    for first, count in ((base, 1), (last, 0)):
        steps, _ = judged([step_of(first), step_of(last)])
        notes = [n for n in steps[-1].calibration.verdict.notes if n.startswith("Not decidable")]
        assert len(notes) == count


def test_a_group_of_one_reading_says_nothing() -> None:
    readings = still_sensor.simulate(seed=6, interval=300)
    single = readings.with_column("run", np.arange(len(readings)).astype(str))
    assert np.isnan(left_out(fits(single)[0]).surprise).all()


def test_an_effect_below_one_half_is_not_called_more_probable_than_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(search_path, "steps_parts", lambda rows: [])
    added = {"bias.run": 0.99, "bias.warm_up": 0.7, "bias.drift": 0.28, "unknown(elapsed)": None}
    path: Any = SimpleNamespace(rows=[], added=added, complete=True)
    assert search_path.SearchPath._parts(path) == [
        "found: bias.run",
        "more probable than not: bias.warm_up (0.70)",
        "in the model shown, one of several: bias.drift (0.28)",
    ]
