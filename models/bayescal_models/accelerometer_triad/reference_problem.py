"""The reference problem of 24 poses in unknown directions at 0.5 mg; what one is for stands in `bayescal_models`."""

from bayescal_models.accelerometer_triad.campaign import Campaign
from bayescal_models.accelerometer_triad.model import INSTRUMENT
from bayescal_models.simulated import reference_problem
from bayescal_models.triad.campaign import TWO_SESSIONS

CAMPAIGN = Campaign()

model, readings, hidden = reference_problem(INSTRUMENT, CAMPAIGN, Campaign(**TWO_SESSIONS))
