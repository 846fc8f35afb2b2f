"""How large an unknown dependence plausibly is, the readings say: no other effect's name or size does."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
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


def test_the_prior_of_its_coefficients_is_in_their_unit() -> None:
    """An amplitude of 0.3 m, not one metre, is what a coefficient is measured against."""
    c = waved("start")
    kept, of = (c.tree.children[name].dataset for name in ("log_prior", "posterior"))
    name = "unknown(time, cycle)[1]"
    sd = of["unknown(time, cycle).amplitude"].values
    expected = -0.5 * (of[name].values / sd) ** 2 - np.log(sd * np.sqrt(2 * np.pi))
    np.testing.assert_allclose(kept[name].values, expected)
