"""Calibrate three gyroscopes on a rate table over temperature, find what depends on gravity, and correct.

python example.py
"""

import numpy as np

import bayescal as bc
from bayescal_models import gyro_triad as triad

hidden = {"bias.g_sensitivity": 0.03, "bias.temperature": 0.01}  # °/s/g, °/s/°C
campaign = triad.Campaign(temperatures=(-20.0, 0.0, 25.0, 50.0, 70.0))
readings = triad.simulate(hidden, seed=1, campaign=campaign)

first = bc.fit(triad.INSTRUMENT.baseline(), readings)
print(first)
found = bc.discover(first)  # which effects are missing
print(found)

better = bc.fit(first.model + found.best, readings)
print(better)
