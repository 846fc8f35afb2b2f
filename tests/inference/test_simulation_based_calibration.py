"""Intervals cover: over data sets drawn from the priors, the truth's rank among the draws is uniform.

Ranks, band and binomial test: `benchmarks/accuracy/ranks.py`, with their sources. A thousand data sets for each
instrument are the benchmark `coverage`; here are a hundred.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import bayescal as bc
from bayescal_models import INSTRUMENTS
from bayescal_models.mems_gyro import INSTRUMENT, Campaign, simulate
from bayescal_models.mems_gyro.model import THERMOMETER
from benchmarks.accuracy import coverage
from benchmarks.accuracy.ranks import band, drawn, judge, ranks

SEED = 11
LEVEL = 0.01  # chance that a right program fails one of these tests
REPLICATES = 100  # for each instrument
# Share of data sets that are left to chains by `fit`, where it is more than 5 %: spreads of six cells each, two of them
# identified by their sum of squares only; products of what two devices share. What the weights
# give there is tested all the same.
UNEVEN = {"ng_accelerometer": 0.3, "differential_pair": 0.1}
# A small campaign: four runs over 30 to 80 °C, one reading a step.
PLAN = simulate(seed=0, campaign=Campaign(average=300, runs=4))
BASELINE = INSTRUMENT.baseline()


def assert_uniform(found: dict[str, list[float]]) -> None:
    """The ECDF band and the 95 % interval's coverage for each unknown; by Bonferroni over all of them."""
    for name, values in found.items():
        judgement = judge(values, LEVEL / len(found))
        assert judgement.ok, (name, judgement, np.sort(values))


def check(
    model: bc.Model,
    *,
    count: int = 200,
    promote: tuple[str, ...] = (),
    plan=PLAN,
    uneven: float = 0.05,
    rounds: int = 2,
) -> None:
    """Ranks are uniform; weights uneven (k̂ > 0.7) in a share of the data sets at most."""
    data, truth = drawn(model, count, plan, SEED)
    method = bc.Marginal(proposals=1024, rounds=rounds, promote=promote)
    made, k_hats = coverage.drawn_one_by_one(model, data, method, SEED)
    assert np.mean(np.asarray(k_hats) > 0.7) <= uneven
    assert_uniform(ranks(made, truth))


def test_band_has_its_stated_false_alarm_rate_for_uniform_ranks() -> None:
    limits, random = band(100, 0.05), np.random.default_rng(SEED)
    left = 0
    for _ in range(2000):
        numbers = np.sort(random.random(100))
        counts = np.searchsorted(numbers, limits.points, side="right")
        left += not np.all((limits.low <= counts) & (counts <= limits.high))
    # 100 are expected at most, with a standard deviation of 10; counts are whole, so a few fewer.
    assert 60 < left < 140


@pytest.mark.parametrize("wrong", ["narrow", "wide", "shifted"])
def test_band_detects_a_wrong_posterior(wrong: str) -> None:
    # The ranks, where the truth is normal and the posterior too narrow, too wide, or a third of an sd aside.
    truth = np.random.default_rng(SEED).standard_normal(400)
    scale, shift = {"narrow": (0.7, 0.0), "wide": (1.4, 0.0), "shifted": (1.0, 0.33)}[wrong]

    assert judge(norm.cdf(truth), LEVEL).ok
    assert not judge(norm.cdf((truth - shift) / scale), LEVEL).uniform


# Weights are uneven in two of five data sets, which `fit` leaves to chains; by weights alone intervals are too narrow.
BY_CHAINS = pytest.mark.xfail(reason="bias against scale factor, both of a few poses: needs chains")


# Six minutes of the pair: at night.
MARKS = {
    "magnetometer_triad": [BY_CHAINS, pytest.mark.slow],
    "differential_pair": pytest.mark.nightly,
}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=MARKS.get(n, pytest.mark.slow)) for n in INSTRUMENTS]
)
def test_intervals_cover_for_every_instrument(name: str) -> None:
    # What fails on a hundred data sets is tried on twice as many others: chance does not fail twice, a fault does.
    ground = coverage.Ground.of(name)
    rows = [ground.run(index) for index in range(REPLICATES // ground.chunk)]
    assert coverage.uneven(rows) <= UNEVEN.get(name, 0.05)
    failed = failures(rows)
    if failed:
        rows = [ground.run(index) for index in range(len(rows), 3 * len(rows))]
        assert not failures(rows), failed


def failures(rows) -> dict:
    return {n: v for n, v in coverage.judged(coverage.joined(rows)).items() if not v.ok}


HALF = bc.HalfNormal(0.1)
SUMMED = bc.SummedNoise(300.0, 3300.0, ("correlated", "flicker"), HALF, HALF)
# A model, and what is asked of it beside 200 data sets on the plan.
RANKED = {
    "half-normal noise": (BASELINE.with_noise(bc.White(HALF)), {}),
    "half-Cauchy noise": (BASELINE.with_noise(bc.White(bc.HalfCauchy(0.1))), {}),
    "runs over a parabola": (BASELINE + "bias.run" + "bias.temperature_quadratic", {}),
    "thermal lag": (BASELINE + "bias.thermal_lag", {}),
    "thermometer errors": (
        BASELINE + THERMOMETER,
        {"count": 60, "promote": ("bias.temperature",), "plan": PLAN.select(np.arange(22))},
    ),
    # From 11 readings a run the wander is often not told from white noise: a posterior of two arms.
    "wandering noise": (
        BASELINE.with_noise(bc.OrnsteinUhlenbeck(100.0, 3000.0, HALF, HALF)),
        {"uneven": 0.5},
    ),
    # Each φ costs a pass over the readings here, so that the draws of all rounds count.
    "sums of noise terms": (BASELINE.with_noise(SUMMED), {"uneven": 0.1, "rounds": 12}),
}


@pytest.mark.slow
@pytest.mark.parametrize(("model", "asked"), RANKED.values(), ids=RANKED)
def test_ranks_are_uniform(model: bc.Model, asked: dict[str, Any]) -> None:
    check(model, **asked)


@pytest.mark.slow
def test_ranks_detect_a_wrong_noise_law() -> None:
    # The noise that made the data is ten times as large as the priors of the fit allow.
    rough = BASELINE.with_noise(bc.White(bc.HalfNormal(1.0)))
    data, truth = drawn(rough, 40, PLAN, SEED)
    small, method = BASELINE.fix({"noise.white": 0.1}), bc.Marginal(proposals=256, rounds=1)
    made, _ = coverage.drawn_one_by_one(small, data, method, SEED)
    with pytest.raises(AssertionError):
        assert_uniform(ranks(made, truth))
