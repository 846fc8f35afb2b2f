"""The reference problem of a tumble on a dividing head; what one is for stands in `bayescal_models`."""

from bayescal_models.accelerometer_dividing_head.campaign import Campaign
from bayescal_models.accelerometer_dividing_head.model import INSTRUMENT
from bayescal_models.simulated import reference_problem

CAMPAIGN = Campaign(positions=12, temperatures=(0.0, 25.0, 50.0))  # 36 readings
UP_AND_DOWN = Campaign(temperatures=(-20.0, 25.0, 70.0, 25.0, -20.0), runs=3)

model, readings, hidden = reference_problem(INSTRUMENT, CAMPAIGN, UP_AND_DOWN)
