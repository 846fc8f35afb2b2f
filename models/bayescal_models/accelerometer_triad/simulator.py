"""Simulator of three accelerometers in poses, an instance of `triad/simulator.py`."""

from bayescal_models.triad.campaign import Campaign
from bayescal_models.triad.simulator import MEMBER_COUNTS, make_pose_simulator

# Default coefficients of the simulated triad: bias mg, scale ppm, misalignment mrad; x, y, z (xy, xz, yz).
BASELINE = {
    "bias.constant": (12.0, -20.0, 35.0),
    "scale.constant": (8000.0, -5000.0, 12000.0),
    "misalignment.constant": (4.0, -6.0, 3.0),
}

simulate_columns = make_pose_simulator(BASELINE, tuple(MEMBER_COUNTS), 1e-3, Campaign)
