"""Calibrate three accelerometers by poses at five temperatures, find what depends on the temperature, and correct.

python example.py
"""

import numpy as np

import bayescal as bc
from bayescal_models import accelerometer_triad as triad

hidden = {"bias.temperature": 0.3}  # mg/°C
campaign = triad.Campaign(poses=14, temperatures=(-20.0, 0.0, 25.0, 50.0, 70.0))
readings = triad.simulate(hidden, seed=1, campaign=campaign)

first = bc.fit(triad.INSTRUMENT.baseline(), readings)
print(first)
found = bc.discover(first)  # which effect is missing
print(found)

better = bc.fit(first.model + found.best, readings)
correct = bc.vector_correction(better)
force = correct(np.array([[0.012, -0.020, 1.047]]), temperature=40.0, noise=0.0)
size, uncertainty = force.magnitude
print(f"|f| = {size[0]:.4f} g, standard uncertainty {1e3 * uncertainty[0]:.2f} mg")
