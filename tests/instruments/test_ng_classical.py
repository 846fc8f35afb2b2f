"""The customary estimators of the ng accelerometer return what source 0 says of them, and refuse the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayescal_models import ng_accelerometer as ng

NO_SCATTER = {f"{slot}.cell": 0.0 for slot in ("bias", "scale", "fixture_tilt", "base_tilt")}
EXACT = replace(ng.INSTRUMENT_A, noise=0.0, thermometer_noise=0.0, chamber_wander=0.0)
HEATING = {
    **dict.fromkeys(EXACT.truth, 0.0),
    "bias.temperature": 10.0,
    "scale.temperature": 100.0,
    "fixture_tilt.temperature": 5.0,
}


def test_four_and_twelve_positions_agree_on_a_linear_instrument() -> None:
    readings = ng.simulate(NO_SCATTER, seed=1, campaign=EXACT)
    twelve, four = ng.classical_estimates(readings), ng.classical_estimates(readings, 4)
    assert (twelve.positions, four.positions) == (12, 4)
    np.testing.assert_allclose(twelve.bias, four.bias, atol=1.0)
    np.testing.assert_allclose(twelve.scale, four.scale, atol=1.0)
    for made in (twelve, four):
        assert made.scale_tempco.value == pytest.approx(60.0, abs=0.5)
        # the constant fixture tilt carries the scale factor's slope into the bias: 150 µrad × 60 ppm/°C
        assert made.bias_tempco.value == pytest.approx(10.0 + 150 * 60e-6, abs=0.003)
    np.testing.assert_allclose(twelve.bias[2], 850.0 + 150.0, atol=2.0)


def test_fixed_point_heating_has_three_answers() -> None:
    plan = replace(ng.fixed_point_heating(EXACT), truth=HEATING)
    made = ng.fixed_point_tempcos(ng.simulate(seed=1, campaign=plan), bias_tempco=10.0)
    assert made.zero_subtracted == pytest.approx((100, 100), abs=5)
    assert made.bias_subtracted == pytest.approx((737, -537), abs=5)
    assert made.nothing_subtracted == pytest.approx((2010, -1810), abs=5)
    assert made.bias_tempco == pytest.approx(15.0, abs=0.1)


def test_a_fixture_of_its_own_in_each_set_up_spoils_the_subtraction() -> None:
    plan = replace(ng.fixed_point_heating(EXACT), truth=HEATING)
    readings = ng.simulate({"fixture_tilt.run_temperature": 2.0}, seed=1, campaign=plan)
    plus, minus = ng.fixed_point_tempcos(readings).zero_subtracted
    assert abs(plus - minus) > 100
