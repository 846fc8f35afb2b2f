"""What no named effect describes is named by its covariate, added, and gives way to the effect that explains it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.inside import constants_of, frame_of
from tests.support.tiers import slow_but

INSTRUMENT = mems_gyro.INSTRUMENT
HUMID = {
    "unlisted.humidity": 0.02
}  # °/s per percent: no candidate of the catalogue, but a recorded column


@pytest.fixture(scope="module")
def trail() -> bc.SearchPath:
    readings = mems_gyro.simulate(HUMID, seed=31)
    return bc.calibrate(INSTRUMENT.baseline(), readings, holdout=mems_gyro.simulate(HUMID, seed=32))


@pytest.mark.slow
def test_the_column_of_an_effect_outside_the_catalogue_is_named_and_added(
    trail: bc.SearchPath,
) -> None:
    assert [s.added for s in trail.steps] == [None, "unknown(humidity, line)"]
    before, after = trail.steps[0].holdout_rmse, trail.final.holdout_rmse
    assert before is not None
    assert after is not None
    assert after < 0.9 * before  # the other test has other humidities: there it extrapolates


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    slow_but(
        ["bias.rate"], ["unknown(humidity)", "unknown(time)", "bias.temperature_cubic", "bias.rate"]
    ),
)
def test_what_the_model_given_has_beside_the_baseline_is_weighed_anew(
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


@pytest.mark.slow
def test_least_squares_fits_and_predicts_with_it(trail: bc.SearchPath) -> None:
    """Its amplitude must not run away while its coefficients shrink: draws of their product would be worthless."""
    sampled, readings = trail.final.calibration, trail.final.calibration.readings
    fitted = bc.fit(sampled.model, readings, bc.LeastSquares(draws=400), strict=False)
    assert fitted.verdict.ok
    within = bc.predict(sampled).rmse
    assert bc.predict(fitted).rmse < 1.05 * within
    amplitude = "unknown(humidity, line).amplitude"
    ratio = fitted.samples(amplitude).mean() / np.median(sampled.samples(amplitude))
    assert 0.2 < ratio < 5


def test_far_beyond_the_range_of_the_fit_it_says_nothing() -> None:
    readings = mems_gyro.simulate(HUMID, seed=1)
    far = readings.with_column("humidity", readings["humidity"] + 10.0)
    frame = frame_of(far, constants_of(readings))
    shapes = {"length": jnp.asarray(0.3), "amplitude": jnp.asarray(1.0)}
    columns = INSTRUMENT.unknown("humidity").evaluate(frame, shapes)
    assert np.allclose(columns, 0.0, atol=1e-12)


def test_its_prior_is_a_smooth_process_of_the_stated_amplitude() -> None:
    readings = mems_gyro.simulate({}, seed=1)
    frame = frame_of(readings)
    effect = INSTRUMENT.unknown("temperature")
    shapes = {"length": jnp.asarray(0.3), "amplitude": jnp.asarray(2.0)}
    assert effect.weights is not None
    columns = np.asarray(effect.evaluate(frame, shapes)) * np.asarray(effect.weights(**shapes))
    position = np.asarray(frame.position("temperature"))
    kernel = columns @ columns.T
    inner = (position > 0.1) & (position < 0.9)
    exact = 4.0 * np.exp(-0.5 * ((position[:, None] - position[None, :]) / 0.3) ** 2)
    assert np.allclose(kernel[np.ix_(inner, inner)], exact[np.ix_(inner, inner)], atol=0.3)


@pytest.mark.slow
def test_its_gradient_is_finite_at_any_length() -> None:
    readings = mems_gyro.simulate({}, seed=1).select(np.arange(20))
    frame = frame_of(readings)
    effect = INSTRUMENT.unknown("time")

    def total(length):
        assert effect.weights is not None
        shapes = {"length": length, "amplitude": jnp.asarray(1.0)}
        return (effect.evaluate(frame, shapes) * effect.weights(**shapes)).sum()

    for length in (1e-3, 0.3, 100.0):
        assert np.isfinite(jax.grad(total)(length))


def test_covariates_are_the_recorded_columns_and_what_is_derived_from_time() -> None:
    fit = bc.fit(INSTRUMENT.baseline(), mems_gyro.simulate(HUMID, seed=1), bc.LeastSquares())
    found = [e.against for e in bc.check(fit).entries if not e.by_group]
    assert {*found} >= {"temperature", "board_temperature", "time", "humidity", "elapsed"}
    assert "temperature rate" in found
    assert not {*found} & {"output", "run", "temperature_point"}


def test_two_named_effects_are_not_taken_for_one_unknown_function() -> None:
    """A drift and a curve in temperature look like one function of time; together they explain more than it does."""
    hidden = {"bias.temperature_quadratic": 5e-4, "bias.drift": 0.25}
    readings = mems_gyro.simulate(hidden, seed=35)
    found = bc.discover(bc.fit(INSTRUMENT.baseline(), readings, bc.LeastSquares(draws=200)))
    assert {name for s in found.sets for name in s.effects} >= set(hidden)
    assert found.best[0].name in hidden


@pytest.mark.slow
def test_a_named_effect_is_preferred_to_an_unknown_dependence_on_its_covariate() -> None:
    curved = mems_gyro.simulate({"bias.temperature_quadratic": 1e-3}, seed=34)
    found = bc.discover(bc.fit(INSTRUMENT.baseline(), curved))
    assert [e.name for e in found.best] == ["bias.temperature_quadratic"]
