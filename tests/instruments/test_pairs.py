"""A differential pair, fitted: sensitivities, environment and acceleration are recovered, and the command says so."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

import bayescal as bc
from bayescal.workshop import summary
from bayescal_models import differential_pair as dp
from bayescal_models.differential_pair.environment import SHARED, list_order_names
from bayescal_models.differential_pair.noise import NoiseWhileChanging
from bayescal_models.differential_pair.pairing import criteria
from bayescal_models.differential_pair.pairing.selection import CRITERIA, evaluate_pairs
from bayescal_models.differential_pair.simulator import Truth
from tests.support.command_line import needs_installation
from tests.support.made_up.pairs import SMALL, made_up, simulated_batch

IN_PHI = bc.Marginal(promote=tuple(list_order_names(SHARED)[:6]))


@pytest.fixture(scope="module")
def batch() -> Truth:
    return simulated_batch(SMALL, seed=5)[0]


@pytest.fixture(scope="module")
def calibration() -> bc.Calibration:
    return bc.fit(dp.INSTRUMENT.baseline(), simulated_batch(SMALL, seed=5)[1], IN_PHI)


@pytest.mark.slow
def test_sensitivities_are_recovered(calibration, batch) -> None:
    drawn = calibration.samples("environment.shared[sensitivity]")
    assert calibration.verdict.sampler == "importance sampling" and calibration.verdict.ess > 400
    z = (drawn.mean(axis=0) - batch.sensitivity) / drawn.std(axis=0)
    assert np.abs(z).max() < 3.5
    ratios = np.log(drawn[:, :3, None] / drawn[:, None, 3:])
    true = np.log(batch.sensitivity[:3, None] / batch.sensitivity[None, 3:])
    assert np.abs((ratios.mean(axis=0) - true) / ratios.std(axis=0)).max() < 3.5
    assert ratios.std(axis=0).max() < 0.12  # the spread over devices alone would leave 0.28


@pytest.mark.slow
def test_the_environment_and_the_pairs_residual_are_recovered(calibration, batch) -> None:
    devices = dp.devices_of(calibration)
    assert devices.names == batch.names
    off = devices.environment.mean(axis=0) - batch.environment
    assert np.sqrt(np.mean(off**2)) < 25.0  # µg, of 1 mg; the noise of a reading is 18
    found, scale = evaluate_pairs(devices), batch.scale
    true = criteria.compute_residual_rms(batch.environment, scale, found.ratio_fields["median"])
    sd = found.residual.std(axis=0)
    assert np.abs((true - found.pair_fields["expected_residual"]) / sd).max() < 4


def test_a_pair_measures_acceleration_within_its_uncertainty(calibration, batch) -> None:
    devices = dp.devices_of(calibration)
    outputs = calibration.readings["output"].reshape(len(batch.names), -1)
    table = dp.select(devices)
    i, j = (batch.names.index(name) for name in table.best)
    found = dp.measure(devices, *table.best, outputs[i], outputs[j])
    error = found.acceleration - batch.acceleration
    rms = np.sqrt(np.mean(error**2))
    alone = np.sqrt(np.mean((outputs[i] - batch.acceleration) ** 2))
    assert rms < 2.0 * found.sd.mean()
    assert found.sd.mean() < 0.1 * alone and rms < 0.1 * alone


@pytest.mark.slow
@needs_installation
def test_a_second_order_is_told_from_the_scale_though_the_arm_changes_its_speed() -> None:
    """Readings are means: over a ramp the mean of the square is not the square of the mean, and is no noise of all."""
    plan = dp.Campaign(samples=80)
    truth, whole = simulated_batch(plan, seed=11, **{"scale.second_order": 1000.0})
    readings = whole.select(np.arange(0, len(whole), 2))
    base = dp.INSTRUMENT.for_readings(readings).baseline() + "scale.second_order"
    model = bc.Model(base.instrument, base.effects, NoiseWhileChanging(), base.fixed)
    found = bc.fit(model, readings, bc.LeastSquares(draws=200), strict=False)
    rows, hypers = summary(found)
    own = {row["name"]: row for row in rows}
    scales = [own[f"scale.device({name})"] for name in truth.names]
    true = 1e6 * (truth.scale - 1.0)
    assert max(abs(r["mean"] - t) / r["sd"] for r, t in zip(scales, true, strict=True)) < 3.3
    (white,) = (row["mean"] for row in hypers if row["name"] == "noise.white")
    assert white == pytest.approx(plan.noise / np.sqrt(plan.duration / plan.samples), rel=0.15)
    # Of means over half the time between two readings a quarter, where the acceleration goes evenly from one to the
    # next; a ramp of three readings goes faster than the change over two says.
    second, within = (
        np.array([own[f"scale.second_order{part}({name})"]["mean"] for name in truth.names])
        for part in ("", "[within]")
    )
    assert 0.25 < float(second @ within / (second @ second)) < 0.5


# Pairs are judged with probabilities, and the printed rule is shown for what it prefers.


@pytest.mark.parametrize("criterion", CRITERIA)
def test_probabilities_add_up_and_the_first_pair_is_the_best(criterion: str) -> None:
    table = dp.select(made_up(), criterion=criterion)
    assert len(table.pairs) == 12
    for name in ("residual", "ratio_variance", "ratio_variance_raw"):
        assert sum(vars(p)[f"probability_smallest_{name}"] for p in table.pairs) == pytest.approx(1)
    assert table.best == (table.pairs[0].outer, table.pairs[0].inner)
    if criterion == "residual":
        assert table.pairs[0].expected_loss == min(p.expected_loss for p in table.pairs) >= 0


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_set_of_pairs_is_disjoint_and_optimal(seed: int) -> None:
    devices = made_up(seed)
    table, cost = dp.select(devices), evaluate_pairs(devices).pair_fields["expected_residual"]
    for side in zip(*table.matching, strict=True):
        assert len(set(side)) == 3
    total = sum(table.of(*pair).expected_residual for pair in table.matching)
    best = min(sum(cost[i, j] for i, j in enumerate(order)) for order in permutations(range(4), 3))
    assert total == pytest.approx(best)


def test_the_residual_is_the_rms_that_its_formula_says() -> None:
    devices = made_up(draws=3)
    ratio = np.full((3, 4), 0.9)
    found = criteria.compute_residual_rms(devices.environment, devices.scale, ratio)
    one, two = devices.environment[1, 2], devices.environment[1, 5]
    left = (one - 0.9 * two) / (devices.scale[1, 2] + 0.9 * devices.scale[1, 5])
    assert found[1, 2, 2] == pytest.approx(np.sqrt(np.mean(left**2)))


def test_ideal_pairs_have_a_raw_variance_near_three_quarters() -> None:
    """By the printed rule, on raw records at constant acceleration."""
    plan = replace(SMALL, profile="plateau", alike=True, noise=0.0)
    truth, readings = simulated_batch(plan, seed=11)
    records = readings["output"].reshape(len(truth.names), -1)
    found = criteria.ratio_variance(criteria.fit_polynomial(plan.time, records), truth.outer)
    np.testing.assert_allclose(found, 0.75, atol=0.01)


def test_the_documents_ratio_needs_a_mean_and_takes_offsets_for_environment() -> None:
    time = np.linspace(0, 1, 50)
    u = 1000 * (0.5 + np.sin(5 * time))
    records = np.stack([1.2 * u, 0.8 * u])
    assert criteria.compute_ratio_of_sums(records, 1)[0, 0] == pytest.approx(1.5)
    assert abs(criteria.compute_ratio_of_sums(records + [[0], [300.0]], 1)[0, 0] - 1.5) > 0.2
