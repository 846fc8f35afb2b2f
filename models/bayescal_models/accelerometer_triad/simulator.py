"""Simulator of a campaign of three accelerometers, by `triad/simulator.py`."""

from bayescal_models.triad.campaign import Campaign
from bayescal_models.triad.simulator import COUNTS, simulator_of

# The simulated triad, unless effects override it: bias mg, scale ppm, misalignment mrad; x, y, z (xy, xz, yz).
BASELINE = {
    "bias.constant": (12.0, -20.0, 35.0),
    "scale.constant": (8000.0, -5000.0, 12000.0),
    "misalignment.constant": (4.0, -6.0, 3.0),
}

simulated_columns = simulator_of(BASELINE, tuple(COUNTS), 1e-3, Campaign)
