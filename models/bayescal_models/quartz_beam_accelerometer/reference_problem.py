"""The reference problem of a device with two thermometers; what one is for stands in `bayescal_models`."""

from bayescal_models.quartz_beam_accelerometer.campaign import Campaign
from bayescal_models.quartz_beam_accelerometer.model import INSTRUMENT
from bayescal_models.simulated import reference_problem

# Two tumbles over five temperatures and a ramp at each of three attitudes, a reading every ten minutes.
CAMPAIGN = Campaign(
    temperatures=(-40.0, -10.0, 20.0, 45.0, 70.0), interval=600.0, average=60.0, soak=3600.0
)

model, readings, hidden = reference_problem(INSTRUMENT, CAMPAIGN, Campaign())
