"""A pendulous accelerometer on a dividing head: K0, K1, K2, K3 and the head's zero over temperature."""

import lazy_loader

import bayescal as bc
from bayescal_models.local_gravity import ASSUMED_GRAVITY

COLUMNS = (
    bc.Column("run", None, "label of the run, or of the mounting", required=False),
    bc.Column("time", "s", "one origin over all runs", required=False),
    bc.Column("temperature", "degC", "the device's own thermometer", low=-80.0, high=200.0),
    bc.Column(
        "position_angle", "rad", "θ, set on the head; 0 with the axis level", low=-7.0, high=7.0
    ),
    bc.Column("output", "ug", "output, or V with the nominal scale"),
    ASSUMED_GRAVITY,
)
VOLTS = 1.3e-6  # V/µg, nominal scale factor: 1.3 mA/g over 1 kΩ
NOMINAL_SCALE = bc.NominalScale("V", gain=VOLTS)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
