"""Two-axis quartz inclinometer: zero offset against placement angle, and its on-line compensation."""

import math

import lazy_loader

import bayescal as bc
from bayescal_models.supply import SUPPLY

COLUMNS = (
    bc.Column("device", None, "label of the inclinometer", required=False),
    bc.Column("axis", None, "label of the accelerometer, such as x or y", required=False),
    bc.Column("run", None, "label of one mounting of one axis", required=False),
    bc.Column(
        "placement_angle",
        "rad",
        "ω from pendulum toward door attitude; the other axis' tilt",
        low=-math.pi,
        high=math.pi,
    ),
    bc.Column(
        "true_angle", "rad", "known tilt; no column: no tilt", required=False, low=-1.6, high=1.6
    ),
    bc.Column("temperature", "degC", "of the device", required=False, low=-273.15, high=250.0),
    SUPPLY,
    bc.Column("time", "s", "one origin over all runs", required=False),
    bc.Column("direction", None, "of the sweep", required=False, allowed=("forward", "backward")),
    bc.Column("output", "arcsec", "reading; without tilt the zero offset", also=("zero_offset",)),
)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
