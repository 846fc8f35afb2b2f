"""What these readings cannot tell apart, another experiment can: ranked in closed form, and it holds when simulated."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.inside import CampaignPrediction, compute_divergence

INSTRUMENT = mems_gyro.INSTRUMENT
RIVALS = ("bias.thermal_lag", "bias.reference_voltage")
HIDDEN = {"bias.thermal_lag": 0.006}


@pytest.fixture(scope="module")
def line() -> bc.Calibration:
    readings = mems_gyro.simulate(HIDDEN, seed=5)
    return bc.fit(INSTRUMENT.baseline(), readings, bc.LeastSquares())


def normal(mean, covariance) -> CampaignPrediction:
    return CampaignPrediction(np.asarray(mean, float), np.asarray(covariance, float))


def test_the_divergence_is_that_of_two_normals() -> None:
    rng = np.random.default_rng(1)
    roots = rng.standard_normal((2, 3, 3))
    one = normal([0, 1, 2], roots[0] @ roots[0].T + np.eye(3))
    other = normal([1, 1, 0], roots[1] @ roots[1].T + np.eye(3))
    draws = rng.multivariate_normal(one.mean, one.covariance, 200_000)

    def log_density(o):
        r = draws - o.mean
        inner = np.einsum("ij,jk,ik->i", r, np.linalg.inv(o.covariance), r)
        return -0.5 * (inner + np.linalg.slogdet(o.covariance)[1])

    ratio = log_density(one) - log_density(other)
    error = ratio.std() / np.sqrt(ratio.size)
    assert abs(compute_divergence(one, other) - ratio.mean()) < 5 * error
    assert compute_divergence(one, one) == pytest.approx(0, abs=1e-9)


def test_more_runs_tell_more_than_the_same_again(line: bc.Calibration) -> None:
    plans = {
        name: bc.Measurements.from_arrays(INSTRUMENT, **dict(INSTRUMENT.experiments)[name]())
        for name in ("the same again", "twice as many runs")
    }
    ranked = bc.next_experiment(line, RIVALS, plans)
    assert [e.name for e in ranked.experiments] == ["twice as many runs", "the same again"]
    assert ranked.experiments[0].minimum > ranked.experiments[1].minimum
