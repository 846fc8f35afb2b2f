"""Simulator of three magnetometers in poses, an instance of `triad/simulator.py`."""

from bayescal_models.magnetometer_triad.campaign import Campaign
from bayescal_models.triad.simulator import MEMBER_COUNTS, make_pose_simulator

# Default coefficients of the simulated triad: bias µT, scale ppm, misalignment mrad; x, y, z (xy, xz, yz).
BASELINE = {
    "bias.constant": (15.0, -25.0, 8.0),
    "scale.constant": (60000.0, -40000.0, 90000.0),
    "misalignment.constant": (30.0, -20.0, 40.0),
}
EXCLUDED_EFFECTS = ("square.constant", "cross.constant", "cube.constant", "bias.thermal_lag")
EFFECTS = tuple(name for name in MEMBER_COUNTS if name not in EXCLUDED_EFFECTS)

simulate_columns = make_pose_simulator(BASELINE, EFFECTS, 1.0, Campaign)
