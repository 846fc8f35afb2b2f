"""The budget splits the variance of a compensated value without remainder: by coefficient, and by its sources."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import mems_gyro
from tests.support.made_up import bent_sensor, split_search

READINGS = "noise of the calibration's readings"


@pytest.fixture(scope="module")
def gyro() -> bc.Budget:
    return bc.budget(bent_sensor.gyro(), {"temperature": 70.0, "rate_input": 80.0})


def test_shares_add_up_and_the_sum_is_what_the_compensator_states(gyro) -> None:
    compensate = bc.compensator(bent_sensor.gyro())
    value = compensate(output=gyro.reading, temperature=70.0, method="first order", noise=False)
    np.testing.assert_allclose(value.value, 80.0, rtol=1e-9)
    np.testing.assert_allclose(gyro.uncertainty, value.uncertainty[0], rtol=1e-9)
    np.testing.assert_allclose(sum(c.share for c in gyro.coefficients), 1.0, rtol=1e-9)
    np.testing.assert_allclose(sum(s.share for s in gyro.sources), 1.0, rtol=1e-9)


def test_shares_count_correlations_by_hand() -> None:
    """u² of c₀ + c₁(T − T0) − reading, from the posterior's covariance alone."""
    fit = bent_sensor.gyro()
    found = bc.budget(fit, {"temperature": 70.0, "rate_input": 0.0})
    names = ["bias.constant", "bias.temperature"]
    covariance = np.cov(np.array([fit.samples(n) for n in names]))
    lever = np.array([1.0, 70.0 - float(fit.frame.reference["T0"])]) / (
        1 + 1e-6 * fit.samples("scale.constant").mean()
    )
    new_run = np.mean(fit.samples("bias.run.group_sd") ** 2) * lever[0] ** 2
    total = lever @ covariance @ lever + new_run
    np.testing.assert_allclose(found.uncertainty**2, total, rtol=1e-9)
    shares = {c.name: c.share for c in found.coefficients}
    for i, name in enumerate(names):
        by_hand = lever[i] * (covariance @ lever)[i] / found.uncertainty**2
        np.testing.assert_allclose(shares[name], by_hand, rtol=1e-9)


def test_a_nuisance_that_does_not_act_in_use_is_named_as_the_source() -> None:
    """The rig's constant, of prior sd 20 µg, is an alias of the bias: nearly all the width is its prior's."""
    found = bc.budget(
        bent_sensor.calibration(),
        {"acceleration": 0.0, "temperature": 30.0, "humidity": 30.0, "elapsed": 1e4},
    )
    assert not any(c.name.startswith("rig") for c in found.coefficients)
    largest = found.sources[0]
    assert (largest.name, largest.kind) == ("prior of rig.constant", "B")
    assert largest.share > 0.8 and 15 < largest.contribution < 21
    readings = next(s for s in found.sources if s.name == READINGS)
    assert readings.kind == "A" and readings.share < 0.1


def test_of_few_runs_the_coverage_is_said_to_be_short_and_their_spread_is_type_a() -> None:
    readings = mems_gyro.simulate({"bias.run": 0.05}, seed=2, campaign=mems_gyro.Campaign(runs=3))
    model = mems_gyro.INSTRUMENT.baseline() + "bias.run"
    found = bc.budget(bc.fit(model, readings, bc.LeastSquares(draws=200)))
    spread = next(s for s in found.sources if s.name.startswith("bias.run"))
    assert spread.kind == "A"


@pytest.mark.slow
def test_not_to_know_the_structure_is_a_source() -> None:
    """The average's variance is what the compensator states; what structures add is half of it, and is named."""
    average = split_search.trail().calibration
    found, compensate = bc.budget(average, {"temperature": 70.0}), bc.compensator(average)
    given: dict[str, Any] = {n: v for n, v in found.at.items() if n != "rate_input"}
    value = compensate(output=found.reading, **given, method="first order", noise=False)
    np.testing.assert_allclose(found.uncertainty, value.uncertainty[0], rtol=1e-9)
    assert sum(s.share for s in found.sources) == pytest.approx(1)
    largest = max(found.sources, key=lambda s: s.share)
    assert largest.share > 0.3
    # Also where no effect is in more than half of the draws.
    assert min(s.share for s in found.sources) > -0.05


# A new member of a group whose coefficients have weights is as uncertain as these say: budgets and predictions.


AMPLITUDE, FALL, RUNS, N = 6.0, 1 / 3, 24, 20


def orders(r):
    t = 2 * r["elapsed"] / 1900.0 - 1
    return jnp.stack([jnp.ones_like(t), t, 1.5 * t**2 - 0.5], axis=1)


def sizes(amplitude):
    """Of each order, in parts of 1 °/s."""
    return amplitude * FALL ** np.arange(3)


WANDER = bc.Effect(
    "bias.wander",
    "bias",
    basis=orders,
    coefficients=tuple(
        bc.Coefficient("deg/s", bc.Normal(0.0, 1.0), part=f"order {k}", per="run") for k in range(3)
    ),
    shapes=(bc.Shape("amplitude", "1", 0.2, 20.0),),
    weights=sizes,
    columns=("run", "time"),
    source="ours",
)
SENSOR = bc.Instrument(
    name="rate_sensor",
    title="a rate sensor",
    columns=(
        bc.Column("run", None),
        bc.Column("time", "s"),
        bc.Column("rate", "deg/s", required=False),
        bc.Column("output", "deg/s"),
    ),
    slots=(bc.Slot("bias", "deg/s"),),
    response=lambda s, r: s["bias"],
    effects=(effects.constant("bias", 10.0, "deg/s", source="ours"), WANDER),
    noise=bc.White(bc.HalfCauchy(0.1)),
    use=bc.Use("rate", "deg/s", equation=lambda rate, s, r: s["bias"] + rate),
    source="ours",
)


@cache
def fitted() -> bc.Calibration:
    random, time = np.random.default_rng(5), np.tile(100.0 * np.arange(N), RUNS)
    run = np.repeat(np.arange(RUNS), N)
    t = 2 * time / 1900.0 - 1
    columns = np.stack([np.ones_like(t), t, 1.5 * t**2 - 0.5], axis=1)
    drawn = sizes(AMPLITUDE) * random.standard_normal((RUNS, 3))
    output = 1.0 + np.sum(columns * drawn[run], axis=1) + 0.05 * random.standard_normal(len(t))
    readings = bc.Measurements.from_arrays(
        SENSOR, run=run.astype(str), time=time + 5000.0 * run, output=output
    )
    return bc.fit(SENSOR.baseline(), readings, bc.LeastSquares(), seed=2)


@pytest.mark.parametrize("elapsed", [0.0, 950.0, 1900.0])
def test_a_budget_and_a_prediction_have_the_spread_of_a_new_run(elapsed) -> None:
    t = 2 * elapsed / 1900.0 - 1
    want = np.linalg.norm(sizes(AMPLITUDE) * [1.0, t, 1.5 * t**2 - 0.5])
    found = bc.budget(fitted(), {"elapsed": elapsed})
    new = bc.Measurements.from_arrays(
        SENSOR, run=np.full(3, "new"), time=np.array([0.0, elapsed, 1900.0]), output=np.zeros(3)
    )
    predicted = bc.predict(fitted(), new).model_sd[1]
    assert found.uncertainty == pytest.approx(want, rel=0.25)  # 24 runs, 3 orders: 12 %
    assert predicted == pytest.approx(found.uncertainty, rel=0.1)


def test_a_place_without_a_number_and_a_single_draw_are_refused() -> None:
    with pytest.raises(bc.InputError, match="temperature = nan: give a finite number"):
        bc.budget(bent_sensor.gyro(), {"temperature": np.nan, "rate_input": 80.0})
    with pytest.raises(bc.InputError, match="draws=1: an uncertainty needs at least 2"):
        bc.compensator(bent_sensor.gyro(), draws=1)
