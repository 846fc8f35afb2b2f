"""The reference problem of five rates in three mountings; what one is for stands in `bayescal_models`."""

from bayescal_models.gyro_triad.campaign import Campaign
from bayescal_models.gyro_triad.model import INSTRUMENT
from bayescal_models.simulated import reference_problem

CAMPAIGN = Campaign(mountings=("x", "y", "z"))
TWO_SESSIONS = Campaign(temperatures=(-20.0, 25.0, 70.0), runs=2)

model, readings, hidden = reference_problem(INSTRUMENT, CAMPAIGN, TWO_SESSIONS)
