"""An accelerometer that is bent in what it measures and remembers its past: what the tests of compensation share."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import bayescal as bc
from bayescal import effects
from tests.support.references import shared

SOURCE = "made up for tests"
BIAS, TEMPCO, SCALE, SECOND, LAG, TAU, NOISE = 100.0, 3.0, 500.0, 1e4, 4.0, 400.0, 1.0


def _humid(r):
    return jnp.stack(
        [
            jnp.where(r["humidity"] > 45.0, jnp.tanh((r["humidity"] - 45.0) / 20.0), 0.0),
            jnp.sqrt(r["humidity"]) * jnp.sum(jnp.array([0.5, -0.25]) @ jnp.eye(2)),
        ],
        axis=1,
    )


HUMIDITY = bc.Effect(  # the user's own, with what a catalogue would not think of
    "bias.humidity",
    "bias",
    basis=_humid,
    coefficients=(
        bc.Coefficient("ug", bc.Normal(0.0, 5.0)),
        bc.Coefficient("ug", bc.Normal(0.0, 5.0), part="root"),
    ),
    columns=("humidity",),
)


def _on_its_rig(slots, r):
    a = r["acceleration"]
    scale, second_order = slots["scale"], slots["second_order"]
    return slots["bias"] + (1 + scale) * a + second_order * a**2 + slots["rig"]


SENSOR = bc.Instrument(
    name="bent sensor",
    title="an accelerometer */ that is bent",  # a title that would end a comment in C
    columns=(
        bc.Column("time", "s", required=False),
        bc.Column("temperature", "degC", "of the housing"),
        bc.Column("humidity", "%"),
        bc.Column("acceleration", "ug"),
        bc.Column("output", "ug"),
    ),
    slots=(
        bc.Slot("bias", "ug"),
        bc.Slot("scale", "1"),
        bc.Slot("second_order", "1/ug"),
        bc.Slot("rig", "ug", "of the test rig: not there in use"),
    ),
    response=_on_its_rig,
    effects=(
        effects.constant("bias", 1000.0, "ug", source=SOURCE),
        effects.linear("bias", 10.0, "ug/degC", source=SOURCE),
        effects.constant("scale", 1000.0, "ppm", source=SOURCE),
        effects.constant("second_order", 1e5, "ug/g^2", source=SOURCE),
        effects.constant("rig", 20.0, "ug", source=SOURCE),
        effects.thermal_lag(
            "bias", 5.0, "ug/degC", low=60, high=1200, start=1.0, start_unit="ug", source=SOURCE
        ),
        HUMIDITY,
    ),
    noise=bc.White(bc.HalfCauchy(1.0)),
    use=bc.Use("acceleration", "ug", slots=("bias", "scale", "second_order")),
)


def readings(seed: int, rows: int = 200) -> bc.Measurements:
    """A record at wandering temperature under known accelerations, every 30 s."""
    random = np.random.default_rng(seed)
    time = 30.0 * np.arange(rows)
    temperature = 30 + 20 * np.sin(time / 1500)
    behind = np.zeros(rows)
    for i in range(1, rows):  # a body that follows with the time constant TAU
        share = np.exp(-30.0 / TAU)
        step = temperature[i] - temperature[i - 1]
        behind[i] = share * behind[i - 1] + step * np.expm1(-30.0 / TAU) / (30.0 / TAU)
    a = random.uniform(-1e6, 1e6, rows)
    bias = BIAS + TEMPCO * (temperature - 30) + LAG * behind
    output = bias + (1 + 1e-6 * SCALE) * a + SECOND * (1e-6 * a) ** 2
    return bc.Measurements.from_arrays(
        SENSOR,
        time=time,
        temperature=temperature,
        humidity=random.uniform(20, 80, rows),
        acceleration=a,
        output=output + random.normal(0, NOISE, rows),
    )


@shared
def calibration() -> bc.Calibration:
    return bc.fit(SENSOR.baseline(), readings(1), bc.LeastSquares(draws=800))


@shared
def gyro() -> bc.Calibration:
    """A gyro on its table: a straight line in the rate, runs that differ, and nothing of the past."""
    from bayescal_models import mems_gyro

    model = mems_gyro.INSTRUMENT.baseline() + ("scale.constant", "bias.run")
    turning = mems_gyro.Campaign(average=300, runs=4, rate_input=(0.0, 100.0, -100.0))
    found = mems_gyro.simulate(seed=1, campaign=turning)
    return bc.fit(model, found, bc.LeastSquares(draws=800))
