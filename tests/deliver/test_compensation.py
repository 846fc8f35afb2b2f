"""Readings are turned back into what was measured, with an uncertainty that holds."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal_models import accelerometer_dividing_head, mems_gyro
from tests.support.made_up import bent_sensor
from tests.support.shown_output import load_module

HEAD = accelerometer_dividing_head.INSTRUMENT
pytestmark = pytest.mark.filterwarnings("ignore:outside the calibrated range")


@pytest.fixture(scope="module")
def bent() -> bc.Compensator:
    return bc.compensator(bent_sensor.calibration())


@pytest.fixture(scope="module")
def gyro() -> bc.Compensator:
    return bc.compensator(bent_sensor.gyro())


def test_the_stimulus_of_new_readings_is_found_within_its_uncertainty(bent) -> None:
    """A bent equation with memory, inverted by root finding for every draw."""
    new = bent_sensor.readings(2)
    found = bent(new)
    error = found.value - new["acceleration"]
    assert found.unit == "ug"
    assert np.sqrt(np.mean(error**2)) < 1.5 * bent_sensor.NOISE + 1.0
    assert np.mean(np.abs(error) <= 2 * found.uncertainty) > 0.9
    # And what was not compensated is far off:
    assert np.sqrt(np.mean((new["output"] - new["acceleration"]) ** 2)) > 100


def test_draws_and_first_order_agree_where_the_posterior_is_narrow(bent, gyro) -> None:
    for compensate, new in ((bent, bent_sensor.readings(2)), (gyro, bent_sensor.gyro().readings)):
        draws, first = compensate(new), compensate(new, method="first order")
        assert np.max(np.abs(draws.value - first.value) / first.uncertainty) < 0.2
        np.testing.assert_allclose(draws.uncertainty, first.uncertainty, rtol=0.15)


def test_noise_is_counted_on_request(gyro) -> None:
    given = {"output": 30.0, "temperature": 40.0}
    without = gyro(**given, noise=False, method="first order").uncertainty
    with_noise = gyro(**given, method="first order").uncertainty
    known = gyro(**given, output_uncertainty=0.5, method="first order").uncertainty
    slope = 1 + 1e-6 * bent_sensor.gyro().samples("scale.constant").mean()
    noise = bc.budget(gyro, {"temperature": 40.0}).noise
    np.testing.assert_allclose(with_noise, np.hypot(without, noise), rtol=1e-9)
    np.testing.assert_allclose(known, np.hypot(with_noise, 0.5 / slope), rtol=1e-9)


def test_a_new_run_brings_its_spread(gyro) -> None:
    new = {u.name: i for i, u in enumerate(gyro.program.unknowns)}["bias.run(new run)"]
    spread = bent_sensor.gyro().samples("bias.run.group_sd")
    covariance = np.array(gyro.program.covariance)
    assert gyro.program.unknowns[new].mean == 0.0
    np.testing.assert_allclose(covariance[new, new], np.mean(spread**2), rtol=1e-12)
    np.testing.assert_array_equal(np.delete(covariance[new], new), 0.0)
    (known,) = [r for r in bent_sensor.gyro().levels["run"] if r == "1"]
    same = bc.compensator(bent_sensor.gyro(), members={"run": known})
    assert same.equation is not None
    names = [e.name for e in same.equation.unknowns]
    assert "bias.run(1)" in names


def test_outside_its_calibrated_range_it_warns_and_flags(gyro) -> None:
    with pytest.warns(UserWarning):
        found = gyro(output=[30.0, 30.0], temperature=[50.0, 95.0])
    np.testing.assert_array_equal(found.outside["temperature"], [False, True])
    with pytest.warns(UserWarning):
        gyro(output=400.0, temperature=50.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not gyro(output=30.0, temperature=50.0).outside


def test_a_time_has_no_upper_end_where_what_follows_it_has_died_out(bent, tmp_path) -> None:
    """The decay of where a run begins, of 400 s, is over after the two hours of the test; a creep is not."""
    creep = bc.effect("bias.creep", "c * elapsed", c="0.01 ug/s")
    creeping = bent_sensor.SENSOR.baseline() + creep
    fit = bc.fit(creeping, bent_sensor.readings(1), bc.LeastSquares(draws=60))
    late = {"temperature": 30.0, "humidity": 40.0, "temperature_lag": 0.0, "elapsed": [100.0, 1e6]}
    for made, flagged in ((bent, []), (bc.compensator(fit), ["elapsed"])):
        module = load_module(made.export(tmp_path / "c.py"))
        now = {i.name: i.middle for i in made.inputs} | {"elapsed": 1e6}
        assert list(module.compensate(bent_sensor.BIAS, **now)[-1]) == flagged
        assert list(made(output=bent_sensor.BIAS, warn=False, **late).outside) == flagged


@pytest.mark.parametrize("seed", [3, 8])
def test_a_time_constant_that_is_hardly_known_stays_in_its_range(seed: int) -> None:
    """Warm-up of 1.5 standard deviations of the noise: a draw of τ below zero made 1e85 µg of a reading."""
    random, count = np.random.default_rng(seed), 48
    elapsed = np.tile(140.0 * np.arange(count), 2)
    angle = np.tile(np.arange(count) % 12 * np.pi / 6, 2)
    temperature, acts = 25 + 30 * np.sin(elapsed / 1500), 1e6 * np.sin(angle)
    bias = 100 + 10 * (temperature - 25) + 12 * np.exp(-elapsed / 1000)
    readings = bc.Measurements.from_arrays(
        HEAD,
        run=np.repeat(["a", "b"], count),
        time=elapsed + np.repeat([0.0, 9e4], count),
        temperature=temperature,
        position_angle=angle,
        output=acts + bias + 8 * random.standard_normal(2 * count),
    )
    quick = bc.Marginal(draws=1000, chains=False)
    calibration = bc.fit(HEAD.baseline() + "bias.warm_up", readings, quick, strict=False)
    found = bc.compensator(calibration)(readings, warn=False)
    assert np.max(abs(found.value - acts) / found.uncertainty) < 4.5
    assert np.max(found.uncertainty) < 16


TABLE = np.linspace(-60.0, 120.0, 40)
WIDTH, TAU = bc.Shape("width", "degC", 10.0, 90.0), bc.Shape("tau", "s", 60.0, 900.0)


def own_effect(basis: Callable[..., Any], unit: str, shape: bc.Shape) -> bc.Compensator:
    """A compensator of a gyro with an effect of the user's own."""
    campaign = mems_gyro.Campaign(average=300, runs=3, rate_input=(0.0, 100.0, -100.0))
    coefficients = (bc.Coefficient(unit, bc.Normal(0.0, 100.0)),)
    own = bc.Effect("own.part", "bias", basis, coefficients, (shape,), columns=("temperature",))
    model = mems_gyro.INSTRUMENT.baseline() + "scale.constant" + own
    readings = mems_gyro.simulate(seed=3, campaign=campaign)
    return bc.compensator(bc.fit(model, readings, bc.LeastSquares(draws=60), strict=False))


def bell(xp: Any) -> bc.Compensator:
    return own_effect(lambda r, width: xp.exp(-((r["temperature"] / width) ** 2)), "deg/h", WIDTH)


def behind(xp: Any) -> bc.Compensator:
    return own_effect(lambda r, tau: xp.tanh(r["time"] / 9e3) * r.lag(tau), "deg/h/degC", TAU)


@pytest.mark.parametrize("made", [pytest.param(bell, marks=pytest.mark.slow), behind])
def test_an_effect_written_for_jax_alone_compensates_and_exports(made) -> None:
    plain, ours = made(jnp), made(bc.xp)
    readings = plain.calibration.readings
    for method in ("draws", "first order"):
        found, wanted = (one(readings, method=method) for one in (plain, ours))
        np.testing.assert_allclose(found.value, wanted.value, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(found.uncertainty, wanted.uncertainty, rtol=1e-7)
    assert len(plain.program.equation.operations) == len(ours.program.equation.operations)


def test_an_operation_that_firmware_lacks_is_computed_by_jax_with_its_slope(tmp_path) -> None:
    def looked_up(r, width):
        return jnp.interp(30 * r["temperature"] / width, TABLE, np.sin(TABLE / 30))

    made = own_effect(looked_up, "deg/h", WIDTH)
    equation, mean = made.equation, made._moments.mean
    place = [u.key for u in equation.unknowns].index("own.part.width")
    at = np.zeros(5), {"temperature": np.linspace(-20.0, 70.0, 5)}
    step = 1e-5 * mean[place] * np.eye(len(mean))[place]
    up, down = equation.evaluate_draws(np.array([mean + step, mean - step]), *at)
    slope = equation.linearise(mean, *at)[2][:, place]
    np.testing.assert_allclose(slope, (up - down) / (2 * step[place]), rtol=1e-5, atol=1e-12)
    with pytest.raises(bc.ModelError, match="cannot be exported"):
        made.export(tmp_path / "gyro.h")


def test_where_the_output_stops_a_reading_has_no_value_and_the_stimulus_no_budget() -> None:
    gyro = mems_gyro.INSTRUMENT
    stopped = replace(gyro, response=lambda s, r: bc.xp.clip(gyro.response(s, r), -50.0, 50.0))
    fit = bc.fit(stopped.baseline(), mems_gyro.simulate(seed=3), bc.LeastSquares(draws=60))
    compensate = bc.compensator(fit)
    for method in ("draws", "first order"):
        found = compensate(output=[20.0, 70.0], temperature=40.0, method=method, warn=False)
        assert np.isnan([found.value, found.uncertainty]).tolist() == [[False, True]] * 2
    with pytest.raises(bc.InputError):
        bc.budget(compensate, {compensate.stimulus: 90.0})


def test_what_is_missing_is_refused_by_name(bent, gyro) -> None:
    for lacking in ({"output": 1.0}, {"temperature": 30.0}):
        with pytest.raises(bc.InputError):
            gyro(**lacking)
    with pytest.raises(bc.InputError):
        bent(output=1.0, temperature=30.0, humidity=40.0)
    with pytest.raises(bc.InputError):
        bc.compensator(bent_sensor.gyro(), members={"device": "A"})


@pytest.mark.slow
def test_corrected_readings_of_a_later_test_are_within_k_2_as_often_as_is_said() -> None:
    """120 simulated gyroscopes, a second test of each: k = 2 covers 95.45 %, here within the 99.9 % binomial band."""
    campaign, inside = mems_gyro.Campaign(rate_input=(0.0, 100.0, -100.0), nonlinearity=0.0), 0
    for seed in range(120):
        readings, later = (
            mems_gyro.simulate(seed=s, campaign=campaign) for s in (seed, seed + 1000)
        )
        model = mems_gyro.INSTRUMENT.baseline() + "scale.constant"
        fit = bc.fit(model, readings, bc.LeastSquares(draws=400), seed=seed)
        found = bc.compensator(fit)(later, method="first order", warn=False)
        one = np.random.default_rng(seed).integers(len(later))
        inside += abs(found.value[one] - later["rate_input"][one]) <= 2 * found.uncertainty[one]
    assert inside >= 106
