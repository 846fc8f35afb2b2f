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


COS, PERP = np.cos(0.45 * DEGREE), "base_tilt.constant[perp]"
HARMONIC = 0.5 * 0.05 * (FULL / 1e3) ** 2  # µg, of K2 = 0.05 µg/mg²
CELLS = [  # effect, its size, positions, tilt in °; bias in µg and scale factor in ppm, and within what of them
    *(("fixture_tilt.constant", 582.0, n, 0.45, 582.0 * COS, -0.17, 5e-3) for n in (4, 12)),  # 2′
    # The base and its setting are scale factor, as far as the tilt says; the face turned over, with another sign.
    *((name, 1.0, 12, 0.45, 0.0, 617.0, 0.6) for name in (PERP, "tilt.setting")),
    *((name, 1.0, 12, 0.06, 0.0, 4630.0, 4.6) for name in (PERP, "tilt.setting")),
    *(
        (PERP, 5.0 / SECOND, 12, t, 0.0, s, 1.0)
        for t, s in ((0.45, 637), (0.3, 955), (-0.45, -637))
    ),
    # A constant tilt as large as the tide.
    *((PERP, 0.200 / SECOND, 12, t, 0.0, s, 0.5) for t, s in ((0.45, 25), (0.06, 191))),
    *((PERP, 0.242 / SECOND, 12, t, 0.0, s, 0.5) for t, s in ((0.45, 31), (0.06, 231))),
    ("second_order", 0.05, 4, 0.45, 0.0, 0.0, 1e-6),
    ("second_order", 0.05, 12, 0.45, HARMONIC, 0.0, 1e-6),
    ("third_order", 0.01, 4, 0.45, 0.0, 617.0, 1.0),
    ("third_order", 0.01, 12, 0.45, 0.0, 0.75 * 617.0, 1.0),
    *(("cross_coupling", 1e-4, 12, tilt, 0.0, 100.0 * COS, 4e-3) for tilt in (0.45, 0.30)),
    ("cross_coupling", 1e-4, 12, 179.55, 0.0, -100.0 * COS, 1e-3),
    ("fixture_tilt.constant", 100.0, 12, 179.55, -100.0, 0.0, 0.01),
]


@pytest.mark.parametrize(("effect", "size", "positions", "tilt", "bias", "scale", "within"), CELLS)
def test_aliases_are_those_of_the_document(
    effect, size, positions, tilt, bias, scale, within
) -> None:
    found = cells({effect: size}, positions, tilt)
    assert found == pytest.approx((bias, scale), abs=within)


def test_parallel_base_tilt_and_azimuth_are_one_in_a_cell() -> None:
    leaning = simulate_arrays(
        {"base_tilt.constant[parallel]": 1.0}, seed=1, campaign=STILL
    ).noise_free
    angle = np.degrees(ARCSEC / np.sin(0.45 * DEGREE))  # g·sin γ·δ = g·γ2∥
    turned = simulate_arrays({"rotation.constant": angle}, seed=1, campaign=STILL).noise_free
    level = simulate_arrays(seed=1, campaign=STILL).noise_free
    assert np.abs(leaning - level).max() == pytest.approx(SECOND, rel=1e-3)
    np.testing.assert_allclose(leaning, turned, atol=2e-3)


def test_second_order_is_a_harmonic_of_the_angle() -> None:
    assert pytest.approx(1.5, abs=0.05) == HARMONIC
    made = simulate_arrays({"second_order": 0.05}, seed=1, campaign=STILL)
    level = simulate_arrays(seed=1, campaign=STILL)
    change, angle = made.noise_free - level.noise_free, made.world.angle[:, 0]
    np.testing.assert_allclose(change, HARMONIC - HARMONIC * np.cos(2 * angle), atol=1e-6)


def test_dividing_error_is_invisible_and_wobble_is_not() -> None:
    level = simulate_arrays(seed=1, campaign=STILL).noise_free
    divided = simulate_arrays({"rotation.harmonic": 1.0}, seed=1, campaign=STILL).noise_free
    assert 0.02 < np.abs(divided - level).max() < 0.06
    wobbling = simulate_arrays({"rotation.wobble": 1.0}, seed=1, campaign=STILL).noise_free
    assert np.abs(wobbling - level).max() > SECOND
