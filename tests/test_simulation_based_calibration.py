"""Intervals cover: over data sets drawn from the priors, the truth's rank among the draws is uniform.

Source: A. Talts et al., arXiv:1804.06788 (2018); the ranks here are those among weighted draws.
"""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy import stats

import bayescal as bc
from bayescal import _composition as composition
from bayescal._fit import bind
from bayescal._frame import build_frame, reference_of
from bayescal_models.mems_gyro import INSTRUMENT, Campaign, simulate
from bayescal_models.mems_gyro.model import THERMOMETER

SEED = 11
LEVEL = 0.01  # chance that a right program fails one of these tests
# A small campaign: four runs over 30 to 80 °C, one reading a step.
PLAN = simulate(seed=0, campaign=Campaign(average=300, runs=4))
BASELINE = INSTRUMENT.baseline()


def drawn(model: bc.Model, count: int, plan: bc.Measurements, seed: int = SEED):
    """Data sets drawn from the model's own priors and noise, and the truth of every unknown, (count, …)."""
    layout, _ = bind(model, plan)
    frame = build_frame(plan, reference_of(plan))

    def one(key):
        k1, k2 = jax.random.split(key)
        x, rows, v = composition.draw_prior(layout, frame, k1)
        hyper = composition.hyper_values(layout, v)
        values = composition.coefficients(layout, x, rows, hyper)
        return composition.draw_readings(layout, frame, x, rows, v, k2), {**hyper, **values}

    outputs, truth = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(seed), count))
    data = [plan.with_column("output", np.asarray(y)) for y in outputs]
    return data, {name: np.asarray(value) for name, value in truth.items()}


def ranks(batch: bc.Batch, truth: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Share of the weighted draws below the truth, (data sets,), for each unknown and group member."""
    weights = batch.weights()
    found: dict[str, list[float]] = {}
    for i, weight in enumerate(weights):
        for name, draws in batch.samples(i).items():
            if draws.ndim == 1:
                draws = draws[:, None]
            actual = np.atleast_1d(truth[name][i])
            for member in range(min(draws.shape[1], 4)):
                below = weight[draws[:, member] < actual[member]].sum()
                found.setdefault(f"{name}({member})", []).append(float(below))
    return {name: np.array(values) for name, values in found.items()}


def assert_uniform(found: dict[str, np.ndarray]) -> None:
    """Kolmogorov–Smirnov per unknown, and coverage of the 95 % interval; by Bonferroni over all of them."""
    share = LEVEL / (2 * len(found))
    for name, values in found.items():
        assert stats.kstest(values, "uniform").pvalue > share, (name, np.sort(values))
        covered = int(np.sum(np.abs(values - 0.5) < 0.475))
        chance = stats.binomtest(covered, len(values), 0.95).pvalue
        assert chance > share, (name, covered, len(values))


def check(
    model: bc.Model, count: int, *, promote: tuple[str, ...] = (), plan=PLAN, uneven: float = 0.05
) -> bc.Batch:
    """Ranks are uniform; weights uneven (k̂ > 0.7) in a share of the data sets at most."""
    data, truth = drawn(model, count, plan)
    batch = bc.fit_batch(model, data, bc.Marginal(proposals=1024, rounds=2, promote=promote))
    assert np.mean(batch.pareto_k > 0.7) <= uneven
    assert_uniform(ranks(batch, truth))
    return batch


def test_ranks_are_uniform_for_runs_over_a_parabola() -> None:
    check(BASELINE + "bias.run" + "bias.temperature_quadratic", 40)


@pytest.mark.slow
def test_ranks_are_uniform_for_runs_over_a_parabola_on_many_data_sets() -> None:
    check(BASELINE + "bias.run" + "bias.temperature_quadratic", 200)


@pytest.mark.slow
@pytest.mark.parametrize(
    "noise", [bc.HalfNormal(0.1), bc.HalfCauchy(0.1)], ids=lambda n: type(n).__name__
)
def test_ranks_are_uniform_for_the_baseline(noise) -> None:
    check(BASELINE.with_noise(bc.White(noise)), 200)


@pytest.mark.slow
def test_ranks_are_uniform_for_a_thermal_lag() -> None:
    check(BASELINE + "bias.thermal_lag", 200)


@pytest.mark.slow
def test_ranks_are_uniform_for_thermometer_errors() -> None:
    plan = PLAN.select(np.arange(22))
    batch = check(BASELINE + THERMOMETER, 200, promote=("bias.temperature",), plan=plan)
    assert batch.rows.shape[-2:] == (22, 1)


@pytest.mark.slow
def test_ranks_are_uniform_for_wandering_noise() -> None:
    wandering = bc.OrnsteinUhlenbeck(100.0, 3000.0, bc.HalfNormal(0.1), bc.HalfNormal(0.1))
    # From 11 readings a run the wander is often not told from white noise: a posterior of two arms.
    check(BASELINE.with_noise(wandering), 200, uneven=0.5)


def test_a_wrong_noise_law_would_be_noticed() -> None:
    # The noise that made the data is ten times as large as the priors of the fit allow.
    rough = BASELINE.with_noise(bc.White(bc.HalfNormal(1.0)))
    data, truth = drawn(rough, 40, PLAN)
    batch = bc.fit_batch(
        BASELINE.fix({"noise.white": 0.1}), data, bc.Marginal(proposals=256, rounds=1)
    )
    with pytest.raises(AssertionError):
        assert_uniform(ranks(batch, truth))
