"""Least squares where an estimate lies at an edge."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

import bayescal as bc
from bayescal_models import mems_gyro


def test_noise_that_is_best_at_zero_stays_a_number() -> None:
    """Readings of a wander without white noise beside it: the logarithm of that would go on for ever."""
    random, n = np.random.default_rng(3), 200
    time = 10.0 * np.arange(n)
    smooth = lfilter([0.3], [1.0, -0.8], random.standard_normal(n))  # as no white noise lets it be
    wander = lfilter([0.05], [1.0, -0.95], smooth)
    readings = bc.Measurements.from_arrays(
        mems_gyro.INSTRUMENT, time=time, temperature=30 + 10 * np.sin(time / 300), output=wander
    )
    law = bc.OrnsteinUhlenbeck(20.0, 2000.0)
    found = bc.fit(mems_gyro.INSTRUMENT.baseline().with_noise(law), readings, bc.LeastSquares())
    assert found.mode.v.min() >= -30.0
    assert found.samples("noise.white").max() < 0.01 * wander.std()
    assert np.isfinite(bc.predict(found).model_sd).all()
