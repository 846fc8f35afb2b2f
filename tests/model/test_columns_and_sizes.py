"""How large an unknown dependence plausibly is, the readings say: no other effect's name or size does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import mems_gyro

NOISE, WAVE = 0.1, 0.4  # m


def falling_body(start: str, size: float = 50.0) -> bc.Instrument:
    """Its height over time, from a start of some name and plausible size."""
    effects = (
        bc.Effect(f"height.{start}", "height", lambda r: 1.0, _unknown("m", 0.0, size)),
        bc.Effect(
            "height.speed",
            "height",
            lambda r: r["time"],
            _unknown("m/s", 0.0, 10.0),
            columns=("time",),
        ),
        bc.Effect(
            "height.gravity",
            "height",
            lambda r: -0.5 * r["time"] ** 2,
            _unknown("m/s^2", 9.8, 0.1),
            columns=("time",),
        ),
    )
    return bc.Instrument(
        "falling_body",
        "a height over time",
        (bc.Column("output", "m"), bc.Column("time", "s")),
        (bc.Slot("height", "m"),),
        lambda slots, r: slots["height"],
        effects,
        noise=bc.White(bc.HalfCauchy(0.1)),
    )


def _unknown(unit: str, mean: float, sd: float) -> tuple[bc.Coefficient, ...]:
    return (bc.Coefficient(unit, bc.Normal(mean, sd)),)


def fall(instrument: bc.Instrument) -> bc.Measurements:
    random, t = np.random.default_rng(1), np.linspace(0.0, 3.0, 120)
    height = 48 + 1.5 * t - 4.9 * t**2 + WAVE * np.sin(2 * np.pi * t + 0.3)
    height += NOISE * random.standard_normal(t.size)
    return bc.Measurements.from_arrays(instrument, time=t, output=height)


def waved(start: str, size: float = 50.0) -> bc.Calibration:
    instrument = falling_body(start, size)
    return bc.fit(instrument.baseline() + "unknown(time, cycle)", fall(instrument))


def test_a_wave_is_as_large_as_it_is_under_any_name_of_the_start() -> None:
    one, other = waved("start"), waved("constant")
    for c in (one, other):
        wave = np.hypot(*(c.samples(f"unknown(time, cycle)[{i}]") for i in (1, 2)))
        assert abs(wave.mean() - WAVE) < 4 * wave.std()
    amplitude = "unknown(time, cycle).amplitude"
    np.testing.assert_array_equal(one.samples(amplitude), other.samples(amplitude))
    assert 0.1 < np.median(one.samples(amplitude)) < 1.0
    far = waved("start", 5000.0)
    assert far.model.effects[-1].shapes == one.model.effects[-1].shapes


def test_the_range_reaches_from_what_could_be_shown_to_more_than_is_left() -> None:
    shape = waved("start").model.effects[-1].shapes[-1]
    assert shape.low == pytest.approx(NOISE / np.sqrt(120), rel=0.5)
    assert 3 * WAVE < shape.high < 30 * WAVE


def test_candidates_of_a_search_are_sized_as_by_a_user() -> None:
    instrument = falling_body("start")
    readings, model = fall(instrument), instrument.baseline()
    quick = bc.LeastSquares(draws=10)
    path = bc.calibrate(model, readings, method=quick, max_effects=1, widen_noise=False)
    found = path.final.calibration.model.effects[-1]
    assert found.name == "unknown(time, cycle)"
    own = bc.fit(model + found.name, readings, quick, strict=False).model
    assert found.shapes == own.effects[-1].shapes


def test_a_model_found_on_one_record_keeps_its_sizes_on_another(tmp_path) -> None:
    first, second = (mems_gyro.simulate(seed=s) for s in (1, 2))
    second = second.with_column("output", 3 * second["output"])
    method = bc.LeastSquares(draws=20)
    found = bc.fit(mems_gyro.INSTRUMENT.baseline() + "unknown(temperature)", first, method).model
    again = bc.fit(found, second, method, strict=False)
    assert again.model.effects[-1].shapes == found.effects[-1].shapes
    again.save(tmp_path / "c.nc")
    assert bc.load(tmp_path / "c.nc").model.effects[-1].shapes == found.effects[-1].shapes


# Effects of a column that is no temperature, in its own unit: fitted to simulated readings with truth, seed 9.


S = "ours"
N = 400
PRESSURE = 100.0 + 60.0 * np.sin(2 * np.pi * np.arange(N) / 130.0)  # kPa
LOW, HIGH = float(PRESSURE.min()), float(PRESSURE.max())
MIDDLE = 0.5 * (LOW + HIGH)


def sensor(*more: bc.Effect) -> bc.Instrument:
    return bc.Instrument(
        name="sensor",
        title="a pressure sensor",
        columns=(
            bc.Column("run", None, required=False),
            bc.Column("time", "s"),
            bc.Column("pressure", "kPa"),
            bc.Column("output", "mV"),
        ),
        slots=(bc.Slot("response", "mV"),),
        response=lambda s, r: s["response"],
        effects=(effects.constant("response", 50.0, "mV", source=S), *more),
        noise=bc.White(bc.HalfCauchy(0.1)),
        source=S,
    )


def fitted(truth: Any, *more: bc.Effect, **how: Any) -> bc.Calibration:
    instrument, random = sensor(*more), np.random.default_rng(9)
    readings = bc.Measurements.from_arrays(
        instrument,
        time=10.0 * np.arange(N),
        pressure=PRESSURE,
        output=truth + 0.05 * random.standard_normal(N),
    )
    return bc.fit(instrument.baseline(), readings, bc.LeastSquares(), **how)


POLYNOMIALS = {
    1: effects.linear("response", 1.0, "mV/kPa", source=S, column="pressure"),
    2: effects.quadratic("response", 0.02, "mV/kPa^2", source=S, column="pressure"),
    3: effects.cubic("response", 3e-4, "mV/kPa^3", source=S, column="pressure"),
    4: effects.quartic("response", 5e-6, "mV/kPa^4", source=S, column="pressure"),
}


@pytest.mark.parametrize(("centre", "reference"), [(MIDDLE, None), (0.0, {"pressure_0": 0.0})])
def test_a_polynomial_counts_a_column_from_its_reference_value(centre, reference) -> None:
    x = PRESSURE - centre
    size = [0.3, 4e-3, 5e-5, 4e-7]
    truth = 20.0 + sum(c * x**k for k, c in enumerate(size, start=1))
    found = fitted(truth, *POLYNOMIALS.values(), reference=reference)
    assert found.hold_at["pressure_0"] == pytest.approx(centre)
    for effect, want in zip(POLYNOMIALS.values(), size, strict=True):
        draws = found.samples(effect.name)
        assert draws.mean() == pytest.approx(want, abs=4 * draws.std())
        assert draws.std() < 0.1 * want


def test_hysteresis_has_widths_in_the_unit_of_its_column() -> None:
    turned, truth = 0.0, []
    for change in np.diff(PRESSURE, prepend=PRESSURE[0]):  # dD/dp = (sign(dp) − D)/w, w = 10 kPa
        share = np.exp(-abs(change) / 10.0)
        turned = share * turned + (1 - share) * np.sign(change)
        truth.append(20.0 + 0.8 * turned)
    effect = effects.hysteresis(
        "response", 1.0, "mV", source=S, column="pressure", widths=(1.0, 100.0, "kPa")
    )
    found = fitted(np.array(truth), effect)
    assert found.samples("response.hysteresis").mean() == pytest.approx(0.8, rel=0.05)
    assert found.samples("response.hysteresis.width").mean() == pytest.approx(10.0, rel=0.1)


@pytest.mark.parametrize("method", [bc.LeastSquares(), bc.Marginal(draws=400)], ids=str)
def test_hysteresis_is_that_of_the_body_behind_the_thermometer(method) -> None:
    """On the host, as `Marginal` has it, and in programs of JAX, as `LeastSquares` has it."""
    sensor, random = mems_gyro.INSTRUMENT, np.random.default_rng(8)
    time, run = np.tile(60.0 * np.arange(120), 2), np.repeat(["1", "2"], 120)
    warmth = 55 + 20 * np.sin(time / 700.0 + (run == "2"))
    body, turned = warmth.copy(), np.zeros(240)
    for i in np.flatnonzero(time > 0):
        h = 60.0 / 400.0
        ramp = -np.expm1(-h) / h
        body[i] = np.exp(-h) * body[i - 1] + [ramp - np.exp(-h), 1 - ramp] @ warmth[i - 1 : i + 1]
        share = np.exp(-abs(body[i] - body[i - 1]) / 3.0)
        turned[i] = share * turned[i - 1] + (1 - share) * np.sign(body[i] - body[i - 1])
    output = 20 + 0.05 * (body - 55) + 0.3 * turned + 0.02 * random.standard_normal(240)
    columns = {"run": run, "time": time, "temperature": warmth, "output": output}
    readings = bc.Measurements.from_arrays(sensor, **columns)
    lags = sensor.effect("bias.thermal_lag.body"), sensor.effect("bias.hysteresis")
    found = bc.fit(sensor.baseline() + lags[0] + lags[1], readings, method)
    for name, truth in (("thermal_lag.body.tau", 400.0), ("hysteresis", 0.3)):
        draws = found.samples(f"bias.{name}")
        assert draws.mean() == pytest.approx(truth, abs=4 * draws.std(), rel=0.02), name
    assert found.samples("noise.white").mean() == pytest.approx(0.02, rel=0.15)


def test_a_delay_of_a_column_without_rates_is_refused() -> None:
    late = effects.thermometer_delay(10.0, source=S, column="pressure")
    with pytest.raises(bc.ModelError, match="pressure"):
        fitted(0.3 * PRESSURE, POLYNOMIALS[1], late)


@pytest.mark.parametrize(
    "prior", [bc.HalfNormal(1.0), bc.HalfNormal, bc.LogNormal(1.0, 0.5), bc.HalfCauchy(1.0)]
)
def test_a_coefficient_has_no_prior_that_is_not_gaussian(prior) -> None:
    with pytest.raises(bc.ModelError, match="Normal"):
        bc.Coefficient("mV", prior)


@pytest.mark.parametrize(
    ("law", "named"),
    [
        (bc.Heteroscedastic("run"), "run"),
        (bc.Heteroscedastic("elapsed"), "elapsed"),
        (bc.Heteroscedastic("output"), "output"),
        (bc.SummedNoise(10.0, 1000.0, ("correlated",), scatter="run"), "run"),
        (bc.Quantised(1e6), "1e"),
    ],
)
def test_a_law_that_cannot_be_of_these_readings_is_refused(law, named) -> None:
    instrument = sensor()
    readings = bc.Measurements.from_arrays(
        instrument, run=np.repeat("a", N), time=np.arange(N), pressure=PRESSURE, output=PRESSURE
    )
    with pytest.raises(bc.ModelError, match=named):
        bc.fit(instrument.baseline().with_noise(law), readings)
