"""The reference problem of 40 readings in unknown directions at 0.3 µT; what one is for stands in `bayescal_models`."""

from bayescal_models.magnetometer_triad.campaign import Campaign
from bayescal_models.magnetometer_triad.model import INSTRUMENT
from bayescal_models.simulated import reference_problem
from bayescal_models.triad.campaign import TWO_SESSIONS

CAMPAIGN = Campaign(poses=40)

model, readings, hidden = reference_problem(INSTRUMENT, CAMPAIGN, Campaign(**TWO_SESSIONS))
