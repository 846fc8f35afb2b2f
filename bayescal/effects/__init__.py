"""The catalogue of general effects: one small file per family.

Each function returns an `Effect` for a slot, a size and a unit; an instrument picks those that its physics
allows, under their canonical names.
"""

from bayescal._model.unknown_effect import cycle as cycle
from bayescal._model.unknown_effect import jump as jump
from bayescal._model.unknown_effect import kink as kink
from bayescal._model.unknown_effect import line as line
from bayescal._model.unknown_effect import peak as peak
from bayescal._model.unknown_effect import unknown as unknown
from bayescal.effects.constant import constant as constant
from bayescal.effects.constant import deviation as deviation
from bayescal.effects.temperature import cubic as cubic
from bayescal.effects.temperature import linear as linear
from bayescal.effects.temperature import quadratic as quadratic
from bayescal.effects.temperature import quartic as quartic
from bayescal.effects.thermal import body as body
from bayescal.effects.thermal import hysteresis as hysteresis
from bayescal.effects.thermal import rate as rate
from bayescal.effects.thermal import temperature_x_lag as temperature_x_lag
from bayescal.effects.thermal import thermal_lag as thermal_lag
from bayescal.effects.thermometer import thermometer as thermometer
from bayescal.effects.thermometer import thermometer_delay as thermometer_delay
from bayescal.effects.thermometer import thermometer_offset as thermometer_offset
from bayescal.effects.thermometer import uncertain_input as uncertain_input
from bayescal.effects.time import drift as drift
from bayescal.effects.time import warm_up as warm_up
