"""What no named effect describes is named by its covariate, added, and gives way to the effect that explains it."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.inside import constants_of, frame_of
from tests.support.tiers import slow_but

INSTRUMENT = mems_gyro.INSTRUMENT
HUMID = {"unlisted.humidity": 0.02}  # °/s per percent: a recorded column, of no candidate


@pytest.fixture(scope="module")
def trail() -> bc.SearchPath:
    readings = mems_gyro.simulate(HUMID, seed=31)
    return bc.calibrate(INSTRUMENT.baseline(), readings, holdout=mems_gyro.simulate(HUMID, seed=32))


@pytest.mark.slow
def test_the_column_of_an_effect_outside_the_catalogue_is_added(trail: bc.SearchPath) -> None:
    assert [s.added for s in trail.steps] == [None, "unknown(humidity, line)"]
    before, after = trail.steps[0].holdout_rmse, trail.final.holdout_rmse
    assert before is not None
    assert after is not None
    assert after < 0.9 * before  # the other test has other humidities: there it extrapolates


GIVEN = ["unknown(humidity)", "unknown(time)", "bias.temperature_cubic", "bias.rate"]


@pytest.mark.slow
@pytest.mark.parametrize("name", GIVEN)
def test_effects_of_the_given_model_beyond_the_baseline_are_evaluated_again(
    trail: bc.SearchPath, name: str
) -> None:
    """A search that begins with it ends as one that does not, whether it belongs there or not, and says so."""
    readings = mems_gyro.simulate(HUMID, seed=31)
    again = bc.calibrate(INSTRUMENT.baseline() + name, readings, method=bc.LeastSquares())
    last = again.final.calibration
    assert set(last.model.names) == set(trail.final.calibration.model.names)
    left_out = any(name in note for note in last.verdict.notes)
    assert left_out == (name not in last.model.names)


def test_its_amplitude_is_the_size_that_is_reported(trail: bc.SearchPath) -> None:
    first = trail.steps[0].discovery
    assert first is not None
    found = next(c for c in first.candidates if c.effect == "unknown(humidity)")
    humidity = trail.final.calibration.readings["humidity"]
    true = 0.02 * 100 * float(np.std(humidity))  # percent are fractions inside
    assert found.kind == "finding"
    assert found.size is not None
    assert 0.3 * true < found.size < 6 * true  # the range's standard deviation, known to a factor
    assert found.unit == "deg/s"


def test_unknown_effect_has_prior_uncertainty_far_outside_the_fit() -> None:
    readings = mems_gyro.simulate(HUMID, seed=1)
    far = readings.with_column("humidity", readings["humidity"] + 10.0)
    frame = frame_of(far, constants_of(readings))
    shapes = {"length": jnp.asarray(0.3), "amplitude": jnp.asarray(1.0)}
    columns = INSTRUMENT.unknown("humidity").evaluate(frame, shapes)
    assert np.allclose(columns, 0.0, atol=1e-12)


def test_its_prior_is_a_smooth_process_of_the_stated_amplitude() -> None:
    frame = frame_of(mems_gyro.simulate({}, seed=1))
    effect = INSTRUMENT.unknown("temperature")
    shapes = {"length": jnp.asarray(0.3), "amplitude": jnp.asarray(2.0)}
    assert effect.weights is not None
    columns = np.asarray(effect.evaluate(frame, shapes)) * np.asarray(effect.weights(**shapes))
    position, kernel = np.asarray(frame.position("temperature")), columns @ columns.T
    inner = (position > 0.1) & (position < 0.9)
    exact = 4.0 * np.exp(-0.5 * ((position[:, None] - position[None, :]) / 0.3) ** 2)
    assert np.allclose(kernel[np.ix_(inner, inner)], exact[np.ix_(inner, inner)], atol=0.3)


def test_covariates_are_the_recorded_columns_and_what_is_derived_from_time() -> None:
    fit = bc.fit(INSTRUMENT.baseline(), mems_gyro.simulate(HUMID, seed=1), bc.LeastSquares())
    found = [e.covariate for e in bc.check(fit).entries if not e.by_group]
    assert {*found} >= {"temperature", "board_temperature", "time", "humidity", "elapsed"}
    assert "temperature rate" in found
    assert not {*found} & {"output", "run", "temperature_point"}


def test_two_named_effects_are_not_taken_for_one_unknown_function() -> None:
    """A drift and a curve in temperature look like one function of time; together they explain more than it does."""
    hidden = {"bias.temperature_quadratic": 5e-4, "bias.drift": 0.25}
    readings = mems_gyro.simulate(hidden, seed=35)
    found = bc.discover(bc.fit(INSTRUMENT.baseline(), readings, bc.LeastSquares(draws=200)))
    assert {name for s in found.findings for name in s.effects} >= set(hidden)
    assert found.best[0].name in hidden


# A package that jumps, an adhesive that softens, modes that cross: forms of an unknown dependence on a temperature.


AT = 52.3  # °C
WHAT = {
    "jump": lambda t: 0.4 * (t > AT),
    "kink": lambda t: 0.02 * np.maximum(0.0, t - AT),
    "peak": lambda t: 0.4 / (1 + ((t - AT) / 4.0) ** 2),
}


@pytest.mark.parametrize("form", slow_but(["jump"], WHAT))
def test_unknown_effect_is_located(form: str) -> None:
    readings = mems_gyro.simulate({}, seed=5)
    output = readings["output"] + WHAT[form](readings["temperature"])
    readings = readings.with_column("output", output, readings.unit("output"))
    trail = bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings, method=bc.LeastSquares())
    name = f"unknown(temperature, {form})"
    assert [s.added for s in trail.steps] == [None, name]
    found = trail.steps[0].discovery
    assert found is not None
    likely = [c.effect for c in found.candidates if c.probability and c.probability > 0.9]
    assert likely == ["unknown(temperature)"], "a form speaks for its family"
    final = trail.final.calibration
    low, high = readings["temperature"].min(), readings["temperature"].max()
    places = low + final.samples(f"{name}.place") * (high - low)
    steps = np.diff(np.unique(np.round(readings["temperature"])))
    assert abs(places.mean() - AT) < max(3 * places.std(), steps.max())
    assert trail.final.rmse == pytest.approx(0.05, rel=0.15)
    assert trail.gate.ok


# A jump and a cycle in time, of no known cause, are told from wandering noise and measured.


METHOD = bc.LeastSquares(draws=200)
PLACE, HEIGHT = 0.53, 0.2  # of the record, within the second run; °/s, four times the noise
CYCLE_RANGE, WAVE = 6.3, 0.06  # in the record; °/s


def part_of_the_record(readings: bc.Measurements) -> np.ndarray:
    time = readings["time"]
    return (time - time.min()) / np.ptp(time)


def changed(seed: int, contribution) -> bc.Measurements:
    readings = mems_gyro.simulate({}, seed=seed)
    at = part_of_the_record(readings)
    return readings.with_column("output", readings["output"] + contribution(at))


@pytest.fixture(scope="module")
def jumped() -> bc.SearchPath:
    readings = changed(41, lambda at: np.where(at > PLACE, HEIGHT, 0.0))
    return bc.calibrate(INSTRUMENT.baseline(), readings, method=METHOD)


@pytest.fixture(scope="module")
def cycled() -> bc.SearchPath:
    readings = changed(42, lambda at: WAVE * np.sin(2 * np.pi * CYCLE_RANGE * at + 0.4))
    return bc.calibrate(INSTRUMENT.baseline(), readings, method=METHOD)


@pytest.mark.slow
def test_jump_is_found_with_its_position_and_height(jumped: bc.SearchPath) -> None:
    final = jumped.final.calibration
    assert [s.added for s in jumped.steps if s.added] == ["unknown(time, jump)"]
    at = part_of_the_record(final.readings)
    beside = np.sort(at[np.argsort(np.abs(at - PLACE))[:2]])  # no reading tells more than these
    place = float(final.samples("unknown(time, jump).place").mean())
    assert beside[0] - 0.01 < place < beside[1] + 0.01
    height = final.samples("unknown(time, jump)[1]")
    assert abs(height.mean() - HEIGHT) < 4 * height.std()
    (note,) = (n for n in final.verdict.notes if getattr(n, "code", "") == "level.which")
    assert note.numbers["apart"] == pytest.approx(abs(float(height.mean())), rel=0.02)
    assert jumped.final.rmse == pytest.approx(0.05, rel=0.15)


@pytest.mark.slow
def test_a_cycle_is_found_with_its_period_and_amplitude(cycled: bc.SearchPath) -> None:
    final = cycled.final.calibration
    assert [s.added for s in cycled.steps] == [None, "unknown(time, cycle)"]
    assert final.model.noise.law == "white"
    cycles = float(final.samples("unknown(time, cycle).cycles").mean())
    assert cycles == pytest.approx(CYCLE_RANGE, abs=0.05)
    parts = [final.samples(f"unknown(time, cycle)[{i}]") for i in (1, 2)]
    wave = np.hypot(*parts)
    assert wave.mean() == pytest.approx(WAVE, rel=0.2)
