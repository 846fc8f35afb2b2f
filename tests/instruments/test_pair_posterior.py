"""A differential pair, fitted: sensitivities, environment and acceleration are recovered, and the command says so."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal.workshop import summary
from bayescal_models import differential_pair as dp
from bayescal_models.differential_pair.environment import SHARED, order_names
from bayescal_models.differential_pair.noise import NoiseWhileChanging
from bayescal_models.differential_pair.pairing import criteria
from bayescal_models.differential_pair.pairing.selection import judge
from bayescal_models.differential_pair.simulator import columns_and_truth
from tests.support.command_line import needs_installation
from tests.support.made_up.pairs import SMALL

IN_PHI = bc.Marginal(promote=tuple(order_names(SHARED.name)))


@pytest.fixture(scope="module")
def batch() -> dp.SimulatedBatch:
    return dp.simulate_batch(seed=5, campaign=SMALL)


@pytest.fixture(scope="module")
def calibration(batch: dp.SimulatedBatch) -> bc.Calibration:
    return bc.fit(dp.INSTRUMENT.baseline(), batch.readings, IN_PHI)


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
    found = judge(devices)
    true = criteria.residual(batch.environment, batch.scale, found.of_ratio["median"])
    sd = found.residual.std(axis=0)
    assert np.abs((true - found.of_pair["expected_residual"]) / sd).max() < 4


def test_a_pair_measures_acceleration_within_its_uncertainty(calibration, batch) -> None:
    devices = dp.devices_of(calibration)
    outputs = batch.readings["output"].reshape(len(batch.names), -1)
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
    columns, truth = columns_and_truth({"scale.second_order": 1000.0}, seed=11, campaign=plan)
    whole = bc.Measurements.from_arrays(dp.INSTRUMENT, **columns)
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
