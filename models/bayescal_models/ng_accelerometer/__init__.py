"""ng accelerometer on a tilted table: bias and scale factor over temperature."""

import lazy_loader

import bayescal as bc
from bayescal_models.local_gravity import ASSUMED_GRAVITY
from bayescal_models.supply import SUPPLY

COLUMNS = (
    bc.Column("run", None, "label of the run, or of the set-up", required=False),
    bc.Column("temperature_point", "degC", "set point of the chamber", low=-273.15, high=250.0),
    bc.Column("time", "s", "one origin over all runs"),
    bc.Column("temperature", "degC", "the device's own thermometer", low=-273.15, high=250.0),
    bc.Column("lab_temperature", "degC", "of the laboratory", required=False, low=-50.0, high=60.0),
    SUPPLY,
    bc.Column("position_angle", "rad", "θ, rotation angle of the face", low=-7.0, high=7.0),
    bc.Column("tilt", "rad", "γ, tilt of the face", low=-3.2, high=3.2),
    bc.Column("output", "ug", "output, or V with the nominal scale"),
    ASSUMED_GRAVITY,
)
VOLTS = 5e-4  # V/µg, nominal scale factor: 5 V at 10 mg, assumed
NOMINAL_SCALE = bc.NominalScale("V", gain=VOLTS)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
