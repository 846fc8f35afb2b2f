"""Columns of a simulated campaign of three accelerometers; the world is that of `triad/simulator.py`."""

from bayescal_models.triad.campaign import Campaign
from bayescal_models.triad.simulator import COUNTS, simulator_of

# The triad that is there unless effects say otherwise: bias mg, scale ppm, misalignment mrad; x, y, z (xy, xz, yz).
BASELINE = {
    "bias.constant": (12.0, -20.0, 35.0),
    "scale.constant": (8000.0, -5000.0, 12000.0),
    "misalignment.constant": (4.0, -6.0, 3.0),
}

simulated_columns = simulator_of(BASELINE, tuple(COUNTS), 1e-3, Campaign)
