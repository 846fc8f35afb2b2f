"""Simulator of a campaign of three magnetometers, by `triad/simulator.py`."""

from bayescal_models.magnetometer_triad.campaign import Campaign
from bayescal_models.triad.simulator import COUNTS, simulator_of

# The simulated triad, unless effects override it: bias µT, scale ppm, misalignment mrad; x, y, z (xy, xz, yz).
BASELINE = {
    "bias.constant": (15.0, -25.0, 8.0),
    "scale.constant": (60000.0, -40000.0, 90000.0),
    "misalignment.constant": (30.0, -20.0, 40.0),
}
NOT_OF_FIELDS = ("square.constant", "cross.constant", "cube.constant", "bias.thermal_lag")
EFFECTS = tuple(name for name in COUNTS if name not in NOT_OF_FIELDS)

simulated_columns = simulator_of(BASELINE, EFFECTS, 1.0, Campaign)
