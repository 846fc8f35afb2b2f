"""Mean, standard uncertainty and interval of a coefficient are of one distribution, wherever they are stated.

A lag is hidden that is found with a small probability of absence; simulated, mems_gyro, seeds as stated. Draws without
it would leave the mean outside its own 95 % interval.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro


@cache
def searched(size: float, seed: int) -> bc.SearchPath:
    readings = mems_gyro.simulate({"bias.thermal_lag": size}, seed=seed)
    return bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings)


CASES = [(0.014, 8), (0.018, 8)]


@pytest.mark.slow
@pytest.mark.parametrize(("size", "seed"), CASES)
def test_mean_uncertainty_and_interval_agree(size, seed) -> None:
    found = searched(size, seed).calibration
    rows: Any = found.to_pandas().reset_index().itertuples()
    for row in rows:
        draws = found.samples(row.unknown.partition("(")[0])
        if draws.ndim > 1 or row.effect not in searched(size, seed).final.calibration.model.names:
            continue
        assert row.low <= row.mean <= row.high, row.unknown
        assert 2.0 < (row.high - row.low) / row.sd < 6.0, row.unknown  # 3.9 of a normal one
        assert row.mean == pytest.approx(draws.mean())
        np.testing.assert_allclose([row.low, row.high], np.quantile(draws, [0.025, 0.975]))
