"""The ng accelerometer's equation against source 0's table of aliases, and against vectors turned one by one."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from bayescal_models import ng_accelerometer as ng
from bayescal_models.ng_accelerometer.model import accelerations
from bayescal_models.ng_accelerometer.simulator import gravity, simulate_arrays
from bayescal_models.simulated import ARCSEC, DEGREE

IDEAL = dict.fromkeys(ng.INSTRUMENT_A.truth, 0.0)
STILL = replace(
    ng.INSTRUMENT_A,
    temperatures=(29.0, 31.0),
    runs=1,
    noise=0.0,
    thermometer_noise=0.0,
    laboratory_wander=0.0,
    laboratory_daily=0.0,
    truth=IDEAL,
)
FULL = 1e6 * np.sin(0.45 * DEGREE)  # µg
SECOND = 1e6 * ARCSEC  # 1″ in µrad


def cells(
    effects: dict[str, float], positions: int = 12, tilt: float = 0.45
) -> tuple[float, float]:
    """K0, µg, and K1 − 1, ppm, that the classical estimator makes of an ideal instrument with these effects."""
    plan = replace(STILL, tilts=(tilt * DEGREE,))
    made = ng.classical_estimates(
        ng.simulate(effects, seed=1, campaign=plan), 4 if positions == 4 else None
    )
    assert made.positions == positions
    return float(made.bias.mean()), float(made.scale.mean())


def test_two_independent_geometries_agree() -> None:
    rng = np.random.default_rng(1)
    tilt, angle, fixture, parallel, perp = rng.uniform(-3, 3, (5, 200))
    closed = accelerations(tilt, angle, fixture, parallel, perp)
    turned = gravity(tilt + perp, parallel, angle, fixture)
    np.testing.assert_allclose(closed.along, turned[0], atol=1e-8)
    np.testing.assert_allclose(closed.normal, turned[1], atol=1e-14)


def test_small_angles_are_the_document_s() -> None:
    rng = np.random.default_rng(2)
    tilt = 0.45 * DEGREE
    angle = rng.uniform(0, 2 * np.pi, 50)
    fixture, parallel, perp = 1e-5 * rng.standard_normal((3, 50))
    exact = accelerations(jnp.asarray(tilt), jnp.asarray(angle), fixture, parallel, perp).along
    small = 1e6 * (
        np.sin(tilt) * np.sin(angle)
        + fixture * np.cos(tilt)
        + parallel * np.cos(angle)
        + perp * np.cos(tilt) * np.sin(angle)
    )
    np.testing.assert_allclose(exact, small, atol=1e-3)


@pytest.mark.parametrize("positions", [4, 12])
def test_fixture_tilt_is_bias_and_spares_the_scale_factor(positions: int) -> None:
    bias, scale = cells({"fixture_tilt.constant": 582.0}, positions)  # 2′
    assert bias == pytest.approx(582.0 * np.cos(0.45 * DEGREE), rel=1e-6)
    assert scale == pytest.approx(-0.17, abs=0.005)


@pytest.mark.parametrize(("tilt", "ppm"), [(0.45, 617), (0.06, 4630)])
@pytest.mark.parametrize("name", ["base_tilt.constant[perp]", "tilt.setting"])
def test_a_second_of_arc_of_base_or_setting_is_scale_factor(
    name: str, tilt: float, ppm: float
) -> None:
    bias, scale = cells({name: 1.0}, tilt=tilt)
    assert scale == pytest.approx(ppm, rel=0.001)
    assert bias == pytest.approx(0.0, abs=1e-3)


def test_parallel_base_tilt_and_azimuth_are_one_in_a_cell() -> None:
    leaning = simulate_arrays(
        {"base_tilt.constant[parallel]": 1.0}, seed=1, campaign=STILL
    ).noise_free
    angle = np.degrees(ARCSEC / np.sin(0.45 * DEGREE))  # g·sin γ·δ = g·γ2∥
    turned = simulate_arrays({"rotation.constant": angle}, seed=1, campaign=STILL).noise_free
    level = simulate_arrays(seed=1, campaign=STILL).noise_free
    assert np.abs(leaning - level).max() == pytest.approx(SECOND, rel=1e-3)
    np.testing.assert_allclose(leaning, turned, atol=2e-3)


def test_second_order_is_harmless_at_four_positions_and_a_harmonic_at_twelve() -> None:
    effect = {"second_order": 0.05}
    assert cells(effect, 4) == pytest.approx((0.0, 0.0), abs=1e-6)
    half = 0.5 * 0.05 * (FULL / 1e3) ** 2
    bias, scale = cells(effect, 12)
    assert (bias, scale) == pytest.approx((half, 0.0), abs=1e-6)
    assert bias == pytest.approx(1.5, abs=0.05)
    made = simulate_arrays(effect, seed=1, campaign=STILL)
    level = simulate_arrays(seed=1, campaign=STILL)
    change, angle = made.noise_free - level.noise_free, made.world.angle[:, 0]
    np.testing.assert_allclose(change, half - half * np.cos(2 * angle), atol=1e-6)


def test_third_order_adds_to_the_scale_factor() -> None:
    effect = {"third_order": 0.01}
    assert cells(effect, 4)[1] == pytest.approx(617.0, abs=1.0)
    assert cells(effect, 12)[1] == pytest.approx(0.75 * 617.0, abs=1.0)


def test_cross_coupling_is_scale_factor_until_the_face_is_turned_over() -> None:
    effect = {"cross_coupling": 1e-4}
    upright = cells(effect)[1]
    assert upright == pytest.approx(100.0 * np.cos(0.45 * DEGREE), rel=1e-6)
    assert cells(effect, tilt=0.30)[1] - upright == pytest.approx(0.0, abs=0.004)
    assert cells(effect, tilt=179.55)[1] == pytest.approx(-upright, rel=1e-6)
    assert cells({"fixture_tilt.constant": 100.0}, tilt=179.55)[0] == pytest.approx(
        -100.0, rel=1e-4
    )


@pytest.mark.parametrize(("tilt", "ppm"), [(0.45, 637), (0.30, 955), (-0.45, -637)])
def test_other_tilts_tell_the_base_from_the_scale_factor(tilt: float, ppm: float) -> None:
    effect = {"base_tilt.constant[perp]": 5.0 / SECOND}
    assert cells(effect, tilt=tilt)[1] == pytest.approx(ppm, abs=1.0)


@pytest.mark.parametrize(
    ("tilt", "peak", "ppm"),
    [(0.45, 200.0, 25), (0.06, 200.0, 191), (0.45, 242.0, 31), (0.06, 242.0, 231)],
)
def test_a_constant_tilt_as_large_as_the_tide(tilt: float, peak: float, ppm: float) -> None:
    effect = {"base_tilt.constant[perp]": 1e-3 * peak / SECOND}
    assert cells(effect, tilt=tilt)[1] == pytest.approx(ppm, abs=0.5)


def test_dividing_error_is_invisible_and_wobble_is_not() -> None:
    level = simulate_arrays(seed=1, campaign=STILL).noise_free
    divided = simulate_arrays({"rotation.harmonic": 1.0}, seed=1, campaign=STILL).noise_free
    assert 0.02 < np.abs(divided - level).max() < 0.06
    wobbling = simulate_arrays({"rotation.wobble": 1.0}, seed=1, campaign=STILL).noise_free
    assert np.abs(wobbling - level).max() > SECOND
