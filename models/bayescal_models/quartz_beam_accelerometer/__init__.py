"""Quartz resonant beam accelerometer: bias and scale factor over temperature, with two thermometers."""

import lazy_loader

import bayescal as bc
from bayescal_models.supply import SUPPLY

COLUMNS = (
    bc.Column("run", None, "label of the run, from power-on to power-off", required=False),
    bc.Column("temperature_point", "degC", "soak temperature; empty on ramps", required=False),
    bc.Column("time", "s", "one origin over all runs", required=False),
    bc.Column("temperature_circuit", "degC", "t1, at the drive circuit", low=-273.15, high=250.0),
    bc.Column("temperature_head", "degC", "t2, in the sensor head", low=-273.15, high=250.0),
    SUPPLY,
    bc.Column("acceleration", "ug", "known input along the input axis (file: g)"),
    bc.Column("frequency_sum", "Hz", "sum of both beams' frequencies", required=False),
    bc.Column("output", "ug", "output; or the beams' frequency difference in Hz"),
)
SCALE_FACTOR = 100.0  # Hz/g, nominal, assumed (source 2 states none)
PER_G = 1e-6  # g/µg
NOMINAL_SCALE = bc.NominalScale("Hz", gain=SCALE_FACTOR * PER_G)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
