"""Where a model fails: along a covariate, along two together, in one member of a group; and how often it cries wolf."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro

MODEL = mems_gyro.INSTRUMENT.baseline()
FAST = bc.LeastSquares(draws=200)
NOISE = 0.05  # °/s, the simulator's


@pytest.fixture(scope="module")
def readings() -> bc.Measurements:
    return mems_gyro.simulate({}, seed=61)


def fitted(readings: bc.Measurements) -> bc.Calibration:
    return bc.fit(MODEL, readings, FAST, strict=False)


def scaled(values: np.ndarray) -> np.ndarray:
    return (values - values.mean()) / values.std()


def test_a_product_of_two_covariates_is_named_as_such(readings) -> None:
    product = scaled(readings["temperature"]) * scaled(readings["time"])
    bent = readings.with_column("output", readings["output"] + NOISE * product)
    found = bc.check(fitted(bent))
    first = found.pairs[0]
    alone = {e.covariate: e.log_bayes_factor for e in found.entries}
    assert "temperature" in first.covariates
    assert first.log_bayes_factor > 5
    assert first.log_bayes_factor > max(alone[name] for name in first.covariates)


def test_no_product_is_reported_where_there_is_none(readings) -> None:
    found = bc.check(fitted(readings))
    assert all(p.log_bayes_factor < 3 for p in found.pairs)


def test_outlying_run_is_named(readings) -> None:
    levels, codes = readings.groups("run")
    apart = readings.with_column("output", readings["output"] + 2 * NOISE * (codes == 1))
    entry = next(e for e in bc.check(fitted(apart)).entries if e.covariate == "run")
    assert entry.by_group
    assert entry.worst.group == levels[1]
    assert entry.log_bayes_factor > 5


@pytest.mark.parametrize("seed", [1, 2])
def test_outliers_on_one_side_are_told_from_outliers_on_both(seed: int) -> None:
    readings, random = mems_gyro.simulate({}, seed=seed), np.random.default_rng(seed)
    high = random.uniform(0.3, 1.5, len(readings)) * (random.random(len(readings)) < 0.2)
    heavy, found = MODEL.with_noise(bc.StudentT(bc.HalfCauchy(0.1))), []
    for more in (high, high * random.choice([-1.0, 1.0], len(readings))):
        spoilt = readings.with_column("output", readings["output"] + more)
        found.append(bc.check(bc.fit(heavy, spoilt, FAST, strict=False)))
    assert found[0].one_sided < 1e-5 < 1e-3 < found[1].one_sided


def test_scatter_that_grows_on_both_sides_of_the_output_is_told() -> None:
    """Noise in proportion to a signal of both signs: along no column does it grow from end to end."""
    readings = mems_gyro.simulate({}, seed=5)
    expected = np.array(readings["output"])
    size = np.abs(expected - np.median(expected)) / np.ptp(expected)
    tails = MODEL.with_noise(bc.StudentT(bc.HalfCauchy(0.1)))
    random = np.random.default_rng(5).standard_normal(len(readings))
    spoilt = readings.with_column("output", expected + 1.5 * size * random)
    along = "the output's distance from its median"
    for model in (MODEL, tails):
        found = bc.check(bc.fit(model, spoilt, FAST, strict=False))
        assert found.scatter_with[along] < 1e-5
        assert min(found.scatter_with, key=found.scatter_with.__getitem__) == along


def test_a_law_that_is_right_leaves_normal_scores() -> None:
    """Where the tails are those of the law, or the scatter follows what it says, no test of the noise objects."""
    readings, random = mems_gyro.simulate({}, seed=9), np.random.default_rng(9)
    z = 2 * (readings["temperature"] - 30.0) / 50.0 - 1
    cases = [
        (bc.StudentT(bc.HalfCauchy(0.1)), 0.1 * random.standard_t(2.0, len(readings))),
        (
            bc.Heteroscedastic("temperature", bc.HalfCauchy(0.1)),
            0.2 * np.exp(z) * random.standard_normal(len(readings)),
        ),
    ]
    for law, more in cases:
        spoilt = readings.with_column("output", readings["output"] + more)
        found = bc.check(bc.fit(MODEL.with_noise(law), spoilt, FAST, strict=False))
        assert found.pit_p > 1e-3
        assert found.scatter_with == {}
        assert bc.check(fitted(spoilt)).pit_p < 1e-5 or bc.check(fitted(spoilt)).scatter_with


def test_two_periods_that_even_readings_confuse_are_two_modes() -> None:
    """At even times a wave of frequency f is one of 1/Δ − f; at uneven times there is one mode."""
    wave = bc.Effect(
        "bias.wave",
        "bias",
        basis=lambda r, period: jnp.cos(2 * jnp.pi * r["time"] / period),
        coefficients=(bc.Coefficient("deg/s", bc.Normal(0.0, 0.5)),),
        shapes=(bc.Shape("period", "s", 25.0, 200.0, ragged=True),),
        columns=("time",),
    )
    random = np.random.default_rng(5)
    even, noise = 30.0 * np.arange(60), 0.05 * random.standard_normal(60)
    doubts = []
    for time in (even, even + random.uniform(-14.0, 14.0, 60)):
        output = 0.3 * np.cos(2 * np.pi * time / 130.0) + noise
        columns = {"time": time, "temperature": np.linspace(30, 80, 60), "output": output}
        run, gyro = np.full(60, "a"), mems_gyro.INSTRUMENT
        readings = bc.Measurements.from_arrays(gyro, run=run, **columns)
        model = gyro.baseline() + wave
        path = bc.calibrate(model, readings, method=FAST, max_effects=0, widen_noise=False)
        doubts.append(path.final.multimodality)
    (reason,), none = doubts
    assert none == ()
    assert (reason.code, reason.subjects) == ("mode.two", ("bias.wave.period",))
