"""A search that ends with several structures: an effect too small to be told from its rivals."""

from __future__ import annotations

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.references import shared


def readings(seed: int = 3) -> bc.Measurements:
    """A gyroscope whose lag is a tenth of what this campaign shows at a glance."""
    return mems_gyro.simulate({"bias.thermal_lag": 0.006}, seed=seed)


@shared
def trail() -> bc.SearchPath:
    return bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings())
