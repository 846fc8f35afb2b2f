"""A new member of a group whose coefficients have weights is as uncertain as these say: budgets and predictions.

A rate sensor whose bias wanders within each run by a polynomial of three orders, each a third as large as the one
before; 24 runs, seed 5.
"""

from __future__ import annotations

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal import effects

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
    random = np.random.default_rng(5)
    time = np.tile(100.0 * np.arange(N), RUNS)
    run = np.repeat(np.arange(RUNS), N)
    t = 2 * time / 1900.0 - 1
    columns = np.stack([np.ones_like(t), t, 1.5 * t**2 - 0.5], axis=1)
    drawn = sizes(AMPLITUDE) * random.standard_normal((RUNS, 3))
    output = 1.0 + np.sum(columns * drawn[run], axis=1) + 0.05 * random.standard_normal(len(t))
    readings = bc.Measurements.from_arrays(
        SENSOR, run=run.astype(str), time=time + 5000.0 * run, output=output
    )
    return bc.fit(SENSOR.baseline(), readings, seed=2)


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
