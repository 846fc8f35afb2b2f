"""Probabilities of conformity, guard bands and risks are those of JCGM 106:2012 and of other published tables."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from tests.support.inside import DrawnQuantity, Limits, compute_global_risks, find_acceptance

QUANTILES = stats.norm.ppf((np.arange(100_000) + 0.5) / 100_000)  # a normal distribution as draws
TABLE_1 = ((0.80, 0.84), (0.90, 1.28), (0.95, 1.64), (0.99, 2.33))


def normal(mean: float, sd: float, scatter: float = 0.0) -> DrawnQuantity:
    draws = mean + sd * (QUANTILES if scatter == 0 else QUANTILES[10::20])  # smooth by its scatter
    return DrawnQuantity(draws[:, None], np.array([scatter]))


@pytest.mark.parametrize(
    ("mean", "sd", "limits", "printed", "digits"),
    [
        *((-z, 1.0, (-np.inf, 0.0), p, 0.005) for p, z in TABLE_1),
        *((z, 1.0, (0.0, np.inf), p, 0.005) for p, z in TABLE_1),
        (-5.47, 0.05, (-np.inf, -5.40), 0.92, 0.005),  # 7.3, V of a breakdown
        (13.6, 1.8, (12.5, 16.3), 0.66, 0.005),  # 7.4, mm²/s of a motor oil
    ],
)
def test_probabilities_of_conformity_as_printed(mean, sd, limits, printed, digits) -> None:
    """JCGM 106, 7.3 and 7.4: table 1 of the standardised distance from a single limit, and the examples."""
    assert normal(mean, sd).probability(Limits(*limits)) == pytest.approx(printed, abs=digits)


def test_resistors_between_acceptance_limits() -> None:
    """JCGM 106, 9.5, example: 1500 Ω ± 0.2 Ω, made with u₀ = 0.12 Ω, measured with u = 0.04 Ω.

    With estimates accepted within 0.18 Ω the consumer's risk is printed as 1 % and the producer's as 7 %. The same by
    two-dimensional simulation, which shares nothing with the closed form.
    """
    limits, accepted = Limits(1499.8, 1500.2), Limits(1499.82, 1500.18)
    found = compute_global_risks(1500.0, 0.12, 0.04, limits, accepted)
    assert (round(100 * found.consumer), round(100 * found.producer)) == (1, 7)
    random = np.random.default_rng(106)
    true = random.normal(1500.0, 0.12, 400_000)
    read = true + random.normal(0.0, 0.04, true.size)
    good = (true >= limits.low) & (true <= limits.high)
    taken = (read >= accepted.low) & (read <= accepted.high)
    for one, counted in (
        (found.conforming, good),
        (found.accepted, taken),
        (found.consumer, taken & ~good),
        (found.producer, good & ~taken),
    ):
        assert one == pytest.approx(counted.mean(), abs=0.002)


@pytest.mark.parametrize(
    ("conforming", "per_cent"),
    [
        (0.6, 4.838603),
        (0.7, 3.922341),
        (0.8, 2.855830),
        (0.9, 1.599953),
        (0.95, 0.871009),
        (0.99, 0.199917),
    ],
)
def test_consumers_risk_of_four_to_one_by_the_table_of_rp_19(conforming, per_cent) -> None:
    """NCSLI RP-19 (draft): false accepts in % by the share of devices in tolerance, u₀/u = 4, no guard band.

    The digits are those against which Suncal's own tests check (github.com/sandialabs/suncal, test_risk.py).
    """
    sd = float(1 / stats.norm.ppf(0.5 * (1 + conforming)))
    found = compute_global_risks(0.0, sd, sd / 4, Limits(-1.0, 1.0), Limits(-1.0, 1.0))
    assert found.conforming == pytest.approx(conforming, abs=1e-9)
    assert 100 * found.consumer == pytest.approx(per_cent, abs=2e-6)


@pytest.mark.parametrize("uncertainty", [0.003, 0.3, 3.0])
def test_global_risks_hold_where_one_width_is_far_smaller_than_the_other(uncertainty) -> None:
    limits, accepted = Limits(-0.5, np.inf), Limits(-0.4, np.inf)
    found = compute_global_risks(0.1, 0.7, uncertainty, limits, accepted)

    def density(y: float) -> float:
        return float(stats.norm.pdf(y, 0.1, 0.7) * stats.norm.sf(accepted.low, y, uncertainty))

    points = [accepted.low + k * uncertainty for k in (-6, -2, 0, 2, 6)]
    inside = [p for p in points if -9 < p < limits.low]
    by_scipy, _ = integrate.quad(density, -9, limits.low, points=inside or None, epsabs=1e-13)
    assert found.consumer == pytest.approx(by_scipy, abs=1e-10)


def test_guard_bands_of_a_normal_distribution_are_its_quantiles() -> None:
    """JCGM 106, 8.3.2: one-sided, w = z(1 − α)·u; a tolerance far wider than u has the same at either end."""
    for alpha in (0.025, 0.05):
        z = stats.norm.ppf(1 - alpha)
        found = find_acceptance(normal(1.0, 0.5), Limits(-4.0, 4.0), alpha)
        np.testing.assert_allclose(found, (-4 + 0.5 * z, 4 - 0.5 * z), atol=1e-3)
        found = find_acceptance(normal(1.0, 0.5), Limits(-np.inf, 4.0), alpha)
        np.testing.assert_allclose(found, (-np.inf, 4 - 0.5 * z), atol=1e-3)
    # Of a tolerance that is not wide, both ends count together: p_c at the edge by the normal distribution.
    low, high = find_acceptance(normal(0.3, 0.5), Limits(-1.3, 1.3), 0.05) or Limits(0, 0)
    at_edge = stats.norm.cdf(1.3, high, 0.5) - stats.norm.cdf(-1.3, high, 0.5)
    assert (at_edge, low) == pytest.approx((0.95, -high), abs=1e-3)


def test_readings_conform_as_often_as_their_scatter_lets_them() -> None:
    """One reading of y ~ N(1, 0.3²) with noise 0.4 is N(1, 0.5²)."""
    found = normal(1.0, 0.3, scatter=0.4)
    for limits in (Limits(0.0, 1.5), Limits(-np.inf, 1.2), Limits(0.9, np.inf)):
        want = stats.norm.cdf(limits.high, 1, 0.5) - stats.norm.cdf(limits.low, 1, 0.5)
        assert found.probability(limits) == pytest.approx(want, abs=1e-4)
    _, high = find_acceptance(found, Limits(-3.0, 3.0), 0.025) or Limits(0, 0)
    assert high == pytest.approx(3 - 0.5 * stats.norm.ppf(0.975), abs=1e-3)


def test_one_reading_is_tested_at_its_least_favourable_point() -> None:
    """Readings about values −b and b at two points: each alone is N(0, 0.5²)."""
    b = 0.3 * QUANTILES[10::20]
    found = DrawnQuantity(np.column_stack([-b, b]), np.full(2, 0.4))
    found = found.probability(Limits(-np.inf, 0.9))
    assert found == pytest.approx(stats.norm.cdf(0.9, 0, 0.5), abs=1e-4)


def test_a_curve_conforms_where_all_of_it_does() -> None:
    """Of a straight line y = a + b·t, t from −1 to 1, a and b normal: by simulation of every t."""
    random = np.random.default_rng(2)
    a, b = random.normal(0.1, 0.2, 20_000), random.normal(0.3, 0.1, 20_000)
    low, high = a - np.abs(b), a + np.abs(b)
    found = DrawnQuantity(np.column_stack([low, high]), np.zeros(2)).probability(Limits(-0.7, 0.7))
    line = a[:, None] + b[:, None] * np.linspace(-1, 1, 51)
    assert found == np.mean(np.all(np.abs(line) <= 0.7, axis=1))
    at_the_end = stats.norm.cdf(0.7, 0.4, np.hypot(0.2, 0.1))
    assert found < at_the_end  # no single place is as strict as all of them
