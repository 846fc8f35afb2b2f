"""MEMS gyroscope: zero-rate drift over temperature."""

import math

import lazy_loader

import bayescal as bc
from bayescal_models.supply import SUPPLY

SENSITIVITY = 0.83e-3  # V per °/s, source 1
VOLTAGE_STEP = 0.1e-3 / SENSITIVITY  # °/s, resolution of the printed voltage, source 1
THERMOMETER_SD = 0.5 / math.sqrt(3)  # °C, standard uncertainty; limits ±0.5 °C, uniform; source 1

COLUMNS = (
    bc.Column("run", None, "label of the run", required=False),
    bc.Column("time", "s", "one origin over all runs", required=False),
    bc.Column("temperature", "degC", "ambient thermometer", low=-273.15, high=250.0),
    SUPPLY,
    bc.Column("board_temperature", "degC", "electronics", required=False, low=-273.15, high=250.0),
    bc.Column("rate_input", "deg/s", "rate of the table about the input axis", required=False),
    bc.Column("output", "deg/s", "output, or V with the nominal scale"),
)
NOMINAL_SCALE = bc.NominalScale("V", gain=SENSITIVITY, offset=1.2)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
