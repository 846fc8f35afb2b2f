"""A second fit of the same structure compiles nothing: not for other readings, another seed, another prediction."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import bayescal as bc
from bayescal_models.mems_gyro import INSTRUMENT
from tests.support.compilations import compiled

traced: list[int] = []


def counted(r):
    traced.append(r.size)
    return r["humidity"] - 50.0


HUMIDITY = bc.Effect(
    "bias.humidity",
    "bias",
    basis=counted,
    coefficients=(bc.Coefficient("deg/s/%", bc.Normal(0.0, 0.01)),),
    columns=("humidity",),
)
MODEL = INSTRUMENT.baseline() + HUMIDITY + "bias.run"
METHODS = [bc.Marginal(), bc.LeastSquares(draws=400)]


def readings(seed: int) -> bc.Measurements:
    rng = np.random.default_rng(seed)
    temperature = rng.uniform(30.0, 80.0, 30)
    return bc.Measurements.from_arrays(
        INSTRUMENT,
        units={"humidity": "%"},
        run=np.repeat(["a", "b", "c"], 10),
        temperature=temperature,
        humidity=rng.uniform(30.0, 70.0, 30),
        output=20 + 0.05 * temperature + 0.1 * rng.standard_normal(30),
    )


def test_the_listener_hears_compilations() -> None:
    assert compiled(lambda: jax.jit(lambda x: x + 1.2345)(np.ones(3)))


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
def test_a_second_fit_of_the_same_structure_compiles_nothing(method) -> None:
    first, second = readings(1), readings(2)
    calibration = bc.fit(MODEL, first, method)
    bc.predict(calibration)
    traced.clear()

    def again() -> None:
        # The model is made anew, so that equality and not identity counts.
        other = bc.fit(INSTRUMENT.baseline() + HUMIDITY + "bias.run", second, method, seed=5)
        bc.predict(other)
        bc.predict(other, first)

    assert compiled(again) == []
    assert len(traced) < 5  # a basis may be run by itself, on numbers; it is not traced again


FEW = 12  # programs of padded sizes that were not met before


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)
def test_another_structure_compiles_only_for_columns_and_sizes_not_seen_before(method) -> None:
    table = readings(1)
    bc.fit(MODEL, table, method)  # all of the columns
    assert len(compiled(lambda: bc.fit(INSTRUMENT.baseline() + HUMIDITY, table, method))) <= FEW
    assert len(compiled(lambda: bc.fit(INSTRUMENT.baseline() + "bias.run", table, method))) <= FEW
    further = compiled(lambda: bc.fit(MODEL + "bias.temperature_cubic", table, method))
    assert len(further) <= FEW
