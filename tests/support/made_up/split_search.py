"""A search that ends with several structures: an effect too small to be told from its rivals."""

from __future__ import annotations

from functools import cache

import bayescal as bc
from bayescal_models import mems_gyro


def readings(seed: int = 3) -> bc.Measurements:
    """A gyroscope whose lag is a tenth of what this campaign shows at a glance."""
    return mems_gyro.simulate({"bias.thermal_lag": 0.006}, seed=seed)


@cache
def trail() -> bc.SearchPath:
    return bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings())
