"""A column that the response itself takes, corrected: free, held, and with nothing else in the model."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import still_sensor

TRUE = 50.0  # arcsec, of the angle's error
NOISE = bc.White(bc.HalfCauchy(1.0))
ARM = 1e4  # arcsec: a sine bar, bent enough within its range
OFFSET = bc.Effect(
    "angle.offset",
    "angle",
    basis=lambda r: 1.0,
    coefficients=(bc.Coefficient("arcsec", bc.Normal(0.0, 100.0)),),
    columns=(),
    equation="c",
    source="a sine bar",
)
ZERO = effects.constant("zero", 100.0, "arcsec", source="a sine bar")
LEVEL = bc.Instrument(
    name="sine_bar",
    title="a sine bar",
    columns=(
        bc.Column("run", None, "run", required=False),
        bc.Column("temperature", "degC", "temperature", low=-40.0, high=85.0),
        bc.Column("angle", "arcsec", "set angle", low=-12_000.0, high=12_000.0),
        bc.Column("output", "arcsec", "output"),
    ),
    slots=(bc.Slot("zero", "arcsec", "zero"),),
    response=lambda slots, r: slots["zero"] + ARM * jnp.sin(r["angle"] / ARM),
    effects=(ZERO,),
    candidates=(OFFSET,),
    noise=NOISE,
    source="a sine bar",
)


def readings(zero: float) -> bc.Measurements:
    random = np.random.default_rng(0)
    angle = np.linspace(-9000.0, 9000.0, 60)
    output = zero + ARM * np.sin((angle + TRUE) / ARM) + random.normal(0.0, 1.0, 60)
    return bc.Measurements.from_arrays(
        LEVEL, angle=angle, temperature=random.uniform(0.0, 50.0, 60), output=output
    )


@pytest.mark.parametrize("held", [False, True], ids=["free", "held"])
def test_the_response_sees_the_corrected_column(held: bool) -> None:
    model = bc.Model(LEVEL, (ZERO, OFFSET), NOISE)
    found = bc.fit(model.fix({"angle.offset": TRUE}) if held else model, readings(20.0))
    zero = found.samples("zero.constant")
    assert abs(zero.mean() - 20.0) < 4 * zero.std()
    assert found.samples("noise.white").mean() == pytest.approx(1.0, abs=0.4)


def test_a_model_of_a_correction_alone() -> None:
    found = bc.fit(bc.Model(LEVEL, (OFFSET,), NOISE), readings(0.0))
    offset = found.samples("angle.offset")
    assert abs(offset.mean() - TRUE) < 4 * offset.std()
    assert bc.predict(found, readings(0.0)).mean.shape == (60,)


# A thermometer's offset in each run and its delay are effects, which mend the temperature.


QUICK = bc.LeastSquares(draws=200)
QUADRATIC = {"bias.temperature_quadratic": 0.4}


def fitted(readings: bc.Measurements, effect: bc.Effect) -> dict[str, tuple[float, float]]:
    model = still_sensor.INSTRUMENT.for_readings(readings).baseline()
    model = model + "bias.temperature_quadratic" + effect
    posterior = bc.fit(model, readings, QUICK).posterior
    return {
        str(n): (float(posterior[n].mean()), float(posterior[n].std()))
        for n in posterior
        if posterior[n].ndim == 2
    }


def test_an_offset_in_one_run_is_found_and_the_curve_is_right() -> None:
    readings = still_sensor.simulate(QUADRATIC, seed=2)
    warm = np.array(readings["temperature"])
    warm[readings["run"] == "3"] += 3.0
    spoilt = readings.with_column("temperature", warm)
    offset = effects.thermometer_offset(1.0, source="a re-seated thermometer")
    model = still_sensor.INSTRUMENT.for_readings(spoilt).baseline()
    found = bc.fit(model + "bias.temperature_quadratic" + offset, spoilt, QUICK)
    runs = found.posterior["temperature.run"].mean(("chain", "draw")).values
    assert runs[2] - 0.5 * (runs[0] + runs[1]) == pytest.approx(-3.0, abs=0.1)
    curve = found.samples("bias.temperature_quadratic")
    assert abs(curve.mean() - 0.4) < 4 * curve.std()


def test_a_late_thermometer_is_found_by_its_delay() -> None:
    readings = still_sensor.simulate(QUADRATIC, seed=2)
    late = np.array(readings["temperature"])
    for run in ("1", "2", "3"):
        rows, time = readings["run"] == run, readings["time"][readings["run"] == run]
        late[rows] = np.interp(time - 30.0, time, late[rows])
    spoilt = readings.with_column("temperature", late)
    found = fitted(spoilt, effects.thermometer_delay(60.0, source="a logger that asks in turn"))
    assert found["temperature.delay"][0] == pytest.approx(30.0, abs=3.0)
    assert found["bias.temperature"][0] == pytest.approx(40.0, abs=2.0)


def test_correct_thermometer_has_neither_offset_nor_delay() -> None:
    readings = still_sensor.simulate(QUADRATIC, seed=3)
    found = fitted(readings, effects.thermometer_delay(60.0, source="none"))
    mean, sd = found["temperature.delay"]
    assert abs(mean) < 4 * sd < 4.0
