"""The reference problem of a bias over temperature; what one is for stands in `bayescal_models`."""

from bayescal_models.mems_gyro.campaign import Campaign
from bayescal_models.mems_gyro.model import INSTRUMENT
from bayescal_models.simulated import reference_problem

CAMPAIGN = Campaign(average=300, runs=4)  # over 30 to 80 °C, one reading a step: 44 rows
TURNING = (0.0, 100.0, -100.0)  # °/s, rates of the table, without which no scale factor shows


def _fuller(effects) -> Campaign:
    turning = any(INSTRUMENT.effect(name).slot == "scale" for name in effects)
    return Campaign(rate_input=TURNING if turning else None)


model, readings, hidden = reference_problem(INSTRUMENT, CAMPAIGN, _fuller)
