"""Calibrate three gyroscopes on a rate table over temperature, find what depends on gravity, and correct.

python example.py
"""

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
correct = bc.vector_correction(better)
rate = correct([[10.0, -50.0, 3.0]], temperature=40.0, beside=[0.0, 0.0, 1.0])  # °/s, °C, g
print(rate.vector[0], rate.covariance[0])
