"""Differential pair: two accelerometers of one type, mounted opposed, whose difference cancels the environment."""

import lazy_loader

import bayescal as bc
from bayescal_models.supply import SUPPLY

COLUMNS = (
    bc.Column("device", None, "label of the device"),
    bc.Column("group", None, "side of the arm", allowed=("outer", "inner")),
    bc.Column("time", "s", "times common to all devices"),
    bc.Column("acceleration", "ug", "commanded acceleration, outward along the arm", low=0.0),
    bc.Column("temperature", "degC", "of the fixture", required=False, low=-273.15, high=250.0),
    SUPPLY,
    bc.Column("output", "ug", "output, or V with a nominal scale"),
)
NOMINAL_SCALE = bc.NominalScale("V", gain=1e-6, offset=0.0)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
