"""A column that the response itself takes, corrected: free, held, and with nothing else in the model."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal import effects

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
