"""A batch gives of every device the numbers and the objections that `fit` gives of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.made_up.gyro_lot import MODEL, NOISE

INSTRUMENT = mems_gyro.INSTRUMENT


def line(seed: int, offset: float = 0.0, count: int = 25, **more: np.ndarray) -> bc.Measurements:
    """Readings of a gyro's line, with a constant added to the output."""
    rng = np.random.default_rng(seed)
    temperature = rng.uniform(-40, 85, count)
    output = 2.0 + 0.03 * (temperature - 20.0) + rng.normal(0, NOISE, count) + offset
    units = dict.fromkeys(more, "1")
    columns = {"temperature": temperature, "output": output, **more}
    return bc.Measurements.from_arrays(INSTRUMENT, units=units, **columns)


def assert_as_alone(
    model: bc.Model, device: Any, readings: bc.Measurements, method: Any
) -> bc.Calibration:
    """Compare a device with its own fit: means to 10⁻⁹ of a standard uncertainty, or of themselves, and these."""
    alone = bc.fit(model, readings, method, strict=False)
    for name in device.names:
        whole, _, member = name.partition("(")
        draws = alone.samples(whole)
        if member:
            (group,) = alone.posterior[whole].dims[2:]
            labels = list(alone.posterior[group].values)
            draws = draws[:, labels.index(member.rstrip(")"))]
        mean, sd = device[name]
        own = draws.std(ddof=1)
        if np.ptp(draws) == 0:  # held at its estimate
            assert mean == pytest.approx(draws[0], rel=1e-9) and np.isnan(sd)
        else:
            assert mean == pytest.approx(draws.mean(), rel=1e-9, abs=1e-9 * own)
            assert sd == pytest.approx(own, rel=1e-9)
    assert device.ok == (alone.verdict.ok and not alone.conflicts)
    return alone


def test_offsets_of_up_to_a_milliard_noises_give_the_numbers_of_fit() -> None:
    lot = {
        f"{offset:g}": line(seed, offset * NOISE)
        for seed, offset in enumerate([0.0, *(10.0 ** np.arange(1, 10))])
    }
    found = bc.fit_batch(MODEL, lot)
    for name, readings in lot.items():
        assert_as_alone(MODEL, found[name], readings, bc.LeastSquares())


def test_a_generator_draws_the_seed() -> None:
    lot, first = {"a": line(1), "b": line(2)}, int(np.random.default_rng(3).integers(2**31))
    drawn = bc.fit_batch(MODEL, lot, seed=np.random.default_rng(3))
    assert str(drawn.table()) == str(bc.fit_batch(MODEL, lot, seed=first).table())


def test_ten_thousand_degrees_per_second_added_leave_the_slope_and_are_objected_to() -> None:
    lot = {"plain": line(1), "odd": line(2, 10_000.0)}
    found = bc.fit_batch(MODEL, lot)
    slope, sd = found["odd"]["bias.temperature"]
    assert abs(slope - 0.03) < 4 * sd and sd < 0.002
    assert found["plain"].ok and not found["odd"].ok and found["odd"].reason
    alone = bc.fit(MODEL, lot["odd"], bc.LeastSquares())
    assert {claim.code for claim in alone.conflicts} == {"prior.contradicted"}


def test_a_column_that_ran_with_the_thermometer_widens_a_device_as_it_widens_a_fit() -> None:
    rng = np.random.default_rng(3)
    plain = line(4)
    humidity = 0.4 + 0.002 * plain["temperature"] + 0.001 * rng.standard_normal(len(plain))
    readings = line(4, humidity=humidity)
    found = bc.fit_batch(MODEL, {"beside": readings, "plain": plain})
    assert_as_alone(MODEL, found["beside"], readings, bc.LeastSquares())
    assert found["beside"]["bias.temperature"][1] > 1.2 * found["plain"]["bias.temperature"][1]


def test_any_method_and_model_give_the_numbers_of_fit() -> None:
    lag = mems_gyro.simulate({"bias.thermal_lag": 0.05}, seed=1)
    model = MODEL + "bias.thermal_lag"
    found = bc.fit_batch(model, {"lag": lag, "again": lag})
    assert_as_alone(model, found["lag"], lag, bc.LeastSquares())
    method = bc.Marginal(draws=400)
    readings = line(5)
    found = bc.fit_batch(MODEL, {"one": readings, "two": line(6)}, method=method)
    assert_as_alone(MODEL, found["one"], readings, method)


def test_what_fit_refuses_a_batch_refuses() -> None:
    plain = line(7)
    stuck = plain.with_column("output", np.full(len(plain), 1.5))
    digits = plain.with_column("output", 1e15 + plain["output"])
    few = plain.select([0, 1])
    lot = {"plain": plain, "stuck": stuck, "digits": digits, "few": few}
    found = bc.fit_batch(MODEL, lot)
    assert found["plain"].ok
    for name in ("stuck", "digits"):
        with pytest.raises(bc.ModelError):
            bc.fit(MODEL, lot[name], bc.LeastSquares())
        assert found[name].reason and not found[name].ok and not found[name].names
    assert not found["few"].ok
