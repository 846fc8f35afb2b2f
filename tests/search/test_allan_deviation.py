"""Allan deviation: the estimator against published values, its terms and units, and the noise law beside it."""

from __future__ import annotations

import allantools
import numpy as np
import pytest
from scipy.stats import chi2

import bayescal as bc
from bayescal_models import still_sensor
from tests.support.inside import EvenRuns, allan_variances, compute_edf

# W. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008), section 12: the data, their overlapping Allan
# deviations at one and two readings, and at 1, 10 and 100.
NBS_SHORT = np.array([892.0, 809.0, 823.0, 798.0, 671.0, 644.0, 883.0, 903.0, 677.0])
NBS_SHORT_DEVIATIONS = {1: 91.22945, 2: 85.95287}
NBS_LONG_DEVIATIONS = {1: 2.922319e-1, 10: 9.159953e-2, 100: 3.241343e-2}


def nbs_long() -> np.ndarray:
    """Its thousand numbers, of the multiplicative congruential generator given there."""
    made = [1234567890]
    for _ in range(999):
        made.append(16807 * made[-1] % 2147483647)
    assert made[1:4] == [395529916, 1209410747, 633705974]
    return np.array(made) / 2147483647


class Factors(EvenRuns):
    """One run, averaged over numbers of readings of one's own."""

    chosen: np.ndarray

    @property
    def factors(self) -> np.ndarray:
        return self.chosen


@pytest.mark.parametrize(
    ("data", "published"), [(NBS_SHORT, NBS_SHORT_DEVIATIONS), (nbs_long(), NBS_LONG_DEVIATIONS)]
)
def test_the_estimator_gives_the_published_deviations(data, published) -> None:
    runs = Factors((np.arange(len(data)),), 1.0)
    runs.chosen = np.array([*published], float)
    variance, count = allan_variances(data, runs)
    assert np.sqrt(variance) == pytest.approx([*published.values()], rel=1e-6)
    assert list(count) == [len(data) + 1 - 2 * m for m in published]
    both, _ = allan_variances(np.column_stack([data, 2 * data]), runs)
    assert both == pytest.approx(5 * variance, rel=1e-9)


@pytest.mark.parametrize("kind", [0, -1, -2])
@pytest.mark.parametrize("readings", [30, 110, 331, 10_000])
def test_degrees_of_freedom_are_those_of_allantools(kind: int, readings: int) -> None:
    runs = EvenRuns((np.arange(readings),), 1.0)
    found = compute_edf(runs, np.full(len(runs.factors), kind))
    theirs = [
        allantools.edf_greenhall(kind, 2, int(m), readings + 1, overlapping=True)
        for m in runs.factors
    ]
    assert found == pytest.approx(theirs, rel=1e-12)


def test_the_interval_is_that_of_a_chi_squared() -> None:
    found = bc.allan_deviation(record(np.random.default_rng(0).standard_normal(300), 1.0))
    ends = [found.deviation * np.sqrt(found.edf / chi2.ppf(p, found.edf)) for p in (0.975, 0.025)]
    assert np.array([found.low, found.high]) == pytest.approx(np.array(ends), rel=1e-10)


def record(output: np.ndarray, step: float, unit: str = "deg/s", runs: int = 1) -> bc.Measurements:
    count = len(output)
    return bc.Measurements.from_arrays(
        still_sensor.INSTRUMENT,
        units={"output": unit},
        time=np.arange(count) * step,
        temperature=25 + 5 * np.sin(np.arange(count) / (0.1 * count)),
        run=np.repeat([str(i) for i in range(runs)], count // runs),
        output=output,
    )


def ornstein_uhlenbeck(
    rng: np.random.Generator, count: int, time: float, diffusion: float
) -> np.ndarray:
    """At steps of one second, s in the stationary state."""
    rho, size = np.exp(-1 / time), diffusion * np.sqrt(time / 2)
    drawn = rng.standard_normal(count) * size
    for i in range(1, count):
        drawn[i] = rho * drawn[i - 1] + np.sqrt(1 - rho**2) * drawn[i]
    return drawn


LAW = bc.OrnsteinUhlenbeck(1.0, 1e9)


@pytest.mark.parametrize("time", [2.0, 30.0, 1e8])
def test_the_laws_curve_is_that_of_simulated_readings(time: float) -> None:
    """Mean of 100 simulations, of which each curve is known to a few per cent at the longest time (seed 8)."""
    rng, count = np.random.default_rng(8), 600
    runs = EvenRuns((np.arange(count),), 1.0)
    seen = [
        allan_variances(
            ornstein_uhlenbeck(rng, count, time, 0.1) + 0.2 * rng.standard_normal(count), runs
        )[0]
        for _ in range(100)
    ]
    values = {"noise.white": 0.2, "noise.diffusion": 0.1, "noise.correlated.time": time}
    law = LAW.allan_variance(values, 0.2**2 + 0.1**2 * time / 2, runs.factors, 1.0)
    error = np.std(seen, axis=0) / 10
    assert np.all(np.abs(np.mean(seen, axis=0) - law) < 4 * error)


def test_correlated_noise_over_short_times_is_a_random_walk() -> None:
    """The closed form meets its limit where the one hands over to the other."""
    factors = 2.0 ** np.arange(12)
    for time in factors[-1] * np.array([0.9e5, 1.1e5]):
        values = {"noise.white": 0.0, "noise.diffusion": 0.1, "noise.correlated.time": time}
        law = LAW.allan_variance(values, 0.1**2 * time / 2, factors, 1.0)
        assert law == pytest.approx(0.1**2 * (2 * factors**2 + 1) / (6 * factors), rel=1e-4)


NOISE = np.random.default_rng(5).standard_normal(100)


def test_lost_readings_leave_averages_of_the_others() -> None:
    """White noise: on average the deviations are those of all readings, single ones of pairs that are there."""
    ratios = []
    for seed in range(40):
        random = np.random.default_rng(seed)
        values, kept = random.standard_normal(800), random.random(800) > 0.1
        kept[[0, -1]] = True
        some = bc.allan_deviation(record(values, 0.5).select(np.flatnonzero(kept)))
        whole = bc.allan_deviation(record(values, 0.5))
        np.testing.assert_array_equal(some.tau, whole.tau)
        assert np.all(some.edf[:4] < whole.edf[:4])
        assert some.differences[0] < 0.9 * whole.differences[0]
        ratios.append((some.deviation / whole.deviation) ** 2)
    assert np.mean(ratios, axis=0)[:6] == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("kind", ["cut to milliseconds", "two readings on one stamp"])
def test_stamps_that_stay_near_an_even_grid_are_that_grid(kind: str) -> None:
    """At 400 Hz: stamps in whole milliseconds, or of pairs that arrived together."""
    exact = np.arange(len(NOISE)) / 400
    stamps = np.floor(exact * 1e3) / 1e3 if kind.startswith("cut") else exact[::2].repeat(2)
    even, cut = (record(NOISE, 1.0).with_column("time", t) for t in (exact, stamps))
    found, like = bc.allan_deviation(cut), bc.allan_deviation(even)
    np.testing.assert_allclose(found.step, 1 / 400, rtol=2e-3)
    np.testing.assert_allclose(found.deviation, like.deviation, rtol=1e-12)
