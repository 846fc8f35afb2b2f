"""The ng accelerometer's equation against source 0's table of aliases, and against vectors turned one by one."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal import workshop as ws
from bayescal_models import ng_accelerometer as ng
from bayescal_models.ng_accelerometer import reference_problem
from bayescal_models.ng_accelerometer.model import resolve_gravity
from bayescal_models.ng_accelerometer.simulator import gravity, simulate_arrays
from bayescal_models.simulated import ARCSEC, DEGREE
from tests.support import references

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
    readings = ng.simulate(effects, seed=1, campaign=plan)
    bias, scale = ng.classical_estimates(readings, 4 if positions == 4 else None)
    return float(bias.mean()), float(scale.mean())


def test_two_independent_geometries_agree() -> None:
    rng = np.random.default_rng(1)
    tilt, angle, fixture, parallel, perp = rng.uniform(-3, 3, (5, 200))
    closed = resolve_gravity(tilt, angle, fixture, parallel, perp)
    turned = gravity(tilt + perp, parallel, angle, fixture)
    np.testing.assert_allclose(closed.input_axis, turned[0], atol=1e-8)
    np.testing.assert_allclose(closed.normal, turned[1], atol=1e-14)


def test_small_angles_are_the_document_s() -> None:
    rng = np.random.default_rng(2)
    tilt = 0.45 * DEGREE
    angle = rng.uniform(0, 2 * np.pi, 50)
    fixture, parallel, perp = 1e-5 * rng.standard_normal((3, 50))
    angles = (jnp.asarray(tilt), jnp.asarray(angle), fixture, parallel, perp)
    exact = resolve_gravity(*angles).input_axis
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
    *(
        ("cross_coupling", 1e-4, 12, t, 0.0, 100.0 * np.cos(t * DEGREE), 1e-4)
        for t in (0.45, 0.30, 179.55)
    ),
    ("fixture_tilt.constant", 100.0, 12, 179.55, -100.0 * COS, 0.0, 0.01),
]


@pytest.mark.parametrize(("effect", "size", "positions", "tilt", "bias", "scale", "within"), CELLS)
def test_aliases_are_those_of_the_document(
    effect, size, positions, tilt, bias, scale, within
) -> None:
    found = cells({effect: size}, positions, tilt)
    assert found == (pytest.approx(bias, abs=min(within, 1e-3)), pytest.approx(scale, abs=within))


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
    change, angle = made.noise_free - level.noise_free, made.conditions.angle[:, 0]
    np.testing.assert_allclose(change, HARMONIC - HARMONIC * np.cos(2 * angle), atol=1e-6)


def test_dividing_error_is_invisible_and_wobble_is_not() -> None:
    level = simulate_arrays(seed=1, campaign=STILL).noise_free
    divided = simulate_arrays({"rotation.harmonic": 1.0}, seed=1, campaign=STILL).noise_free
    assert 0.02 < np.abs(divided - level).max() < 0.06
    wobbling = simulate_arrays({"rotation.wobble": 1.0}, seed=1, campaign=STILL).noise_free
    assert np.abs(wobbling - level).max() > SECOND


# The customary estimators of the ng accelerometer return what source 0 says of them.


NO_SCATTER = {f"{slot}.cell": 0.0 for slot in ("bias", "scale", "fixture_tilt", "base_tilt")}
EXACT = replace(ng.INSTRUMENT_A, noise=0.0, thermometer_noise=0.0, chamber_wander=0.0)
HEATING = {**IDEAL, "bias.temperature": 10.0, "scale.temperature": 100.0}
HEATING |= {"fixture_tilt.temperature": 5.0}


@pytest.mark.parametrize("positions", [None, 4])
def test_classical_estimates_return_the_line_of_a_linear_instrument(positions: int | None) -> None:
    readings = ng.simulate(NO_SCATTER, seed=1, campaign=EXACT)
    bias, scale = ng.classical_estimates(readings, positions)
    cell = readings.groups("cell")[1]
    temperature = np.array([readings["temperature"][cell == k].mean() for k in range(15)])
    assert np.polyfit(temperature, scale, 1)[0] == pytest.approx(60.0, abs=0.5)
    # the constant fixture tilt carries the scale factor's slope into the bias: 150 µrad × 60 ppm/°C
    assert np.polyfit(temperature, bias, 1)[0] == pytest.approx(10.0 + 150 * 60e-6, abs=0.003)
    np.testing.assert_allclose(bias[2], 850.0 + 150.0, atol=2.0)


def test_classical_estimates_of_two_tilts_in_a_cell_are_refused() -> None:
    plan = replace(EXACT, tilts=(0.008, -0.008))
    with pytest.raises(ValueError, match="at one tilt"):
        ng.classical_estimates(ng.simulate(NO_SCATTER, seed=1, campaign=plan), 4)


def heated(effects: dict[str, float], bias_tempco: float | None) -> list[float]:
    """Scale-factor tempcos, ppm/°C, by fixed-point heating at both ends, less the zero's slope or that given, µg/°C."""
    plan = replace(ng.fixed_point_heating(EXACT), truth=HEATING)
    readings = ng.simulate(effects, seed=1, campaign=plan)
    sine = np.sin(readings["position_angle"]).round()
    slope = {
        s: np.polyfit(readings["temperature"][sine == s], readings["output"][sine == s], 1)[0]
        for s in (-1, 0, 1)
    }
    assert slope[0] == pytest.approx(15.0, abs=0.1) or effects
    reference = slope[0] if bias_tempco is None else bias_tempco
    return [1e6 * (slope[s] - reference) / (s * FULL) for s in (1, -1)]


@pytest.mark.parametrize(
    ("subtracted", "tempcos"), [(None, (100, 100)), (10.0, (737, -537)), (0.0, (2010, -1810))]
)
def test_fixed_point_heating_has_three_answers(subtracted, tempcos) -> None:
    assert heated({}, subtracted) == pytest.approx(tempcos, abs=5)


def test_a_fixture_of_its_own_in_each_set_up_spoils_the_subtraction() -> None:
    plus, minus = heated({"fixture_tilt.run_temperature": 2.0}, None)
    assert abs(plus - minus) > 100


# A ng accelerometer's posterior recovers the truth and keeps the width that nuisance angles leave.


LINE = ("bias.constant", "bias.temperature", "scale.constant", "scale.temperature")


@pytest.fixture(scope="module")
def proved() -> bc.Calibration:
    return references.calibration("ng_accelerometer")


def test_the_line_is_recovered_within_its_uncertainty(proved: bc.Calibration) -> None:
    assert proved.verdict.ok
    for name in LINE:
        draws = proved.samples(name)
        assert abs(draws.mean() - reference_problem.CAMPAIGN.truth[name]) < 3 * draws.std(), name
    for name in ("bias.temperature", "scale.temperature"):
        sd = proved.model.effect(name).coefficients[0].size
        assert proved.samples(name).std() < 0.2 * sd, name  # learned, not the prior


def test_bias_keeps_the_width_that_the_fixture_tilt_leaves(proved: bc.Calibration) -> None:
    bias, tilt = proved.samples("bias.constant"), proved.samples("fixture_tilt.constant")
    # priors of 200 µg and 291 µg for what only adds up: 1/√(1/200² + 1/291²) = 165 µg
    assert bias.std() == pytest.approx(165.0, rel=0.1)
    assert np.std(bias + tilt) < 10.0
    scale = proved.samples("scale.constant").std()  # γ2⊥ and the setting, 617 ppm each
    assert np.sqrt(2) * 617 * 0.85 < scale < np.sqrt(2) * 617 * 1.15


def test_setting_and_base_tilt_are_told_apart_by_their_priors_alone(proved: bc.Calibration) -> None:
    setting, base = (proved.samples(n) for n in ("tilt.setting", "base_tilt.constant[perp]"))
    assert setting.std() == pytest.approx(1.0, rel=0.15)
    assert base.std() == pytest.approx(1.0, rel=0.15)


@pytest.fixture(scope="module")
def full() -> bc.Calibration:
    # Draws enough to know the ends of 99 % intervals: of 500, that of a coefficient moves by a third of its sd.
    many = bc.Marginal(draws=8000, proposals=20_000)
    return bc.fit(ng.INSTRUMENT.baseline(), ng.simulate(seed=2), many, seed=2)


@pytest.mark.slow
def test_one_factor_of_scale_times_fixture_tilt_is_promoted(full: bc.Calibration) -> None:
    for name in LINE:
        low, high = np.quantile(full.samples(name), [0.005, 0.995])
        assert low < ng.INSTRUMENT_A.truth[name] < high, name


def test_a_pair_of_which_one_prior_sets_both_uncertainties_is_not_measured() -> None:
    readings, name = ng.simulate(seed=1), "cross_coupling.temperature"
    model = ng.INSTRUMENT.for_readings(readings).baseline() + name
    model = model.resize(name, 4 * model.effect(name).coefficients[0].size)
    fitted = bc.fit(model, readings, bc.LeastSquares(draws=500))
    claims = {claim.subjects: claim for claim in ws.null_directions(fitted)}
    for pair in (
        ("bias.constant", "fixture_tilt.constant"),
        ("rotation.constant", "base_tilt.constant[parallel]"),
    ):
        r = np.corrcoef(*(fitted.samples(n) for n in pair))[0, 1]
        assert claims[pair].numbers["correlation"] == pytest.approx(r, abs=1e-3) and r < -0.999
        assert claims[pair].code == "direction.pair" and f"prior of {pair[1]}" in claims[pair]
    # Of an exact combination only what has more than a hundredth of its largest term is named, largest first.
    (exact,) = (claim for of, claim in claims.items() if name in of)
    assert exact.subjects[0] == name and exact.code.endswith("_exactly") and "e-0" not in exact
