"""Calibrate three magnetometers turned by hand, and take a heading with its uncertainty.

python example.py
"""

import numpy as np

import bayescal as bc
from bayescal_models import magnetometer_triad as triad

readings = triad.simulate(seed=1)
calibration = bc.fit(triad.INSTRUMENT.baseline(), readings)
print(calibration)

correct = bc.vector_correction(calibration)
field = correct(np.array([[35.0, -20.0, -25.0]]))
heading, uncertainty = field.heading  # of a level body
print(
    f"heading {np.rad2deg(heading[0]):.2f}°, standard uncertainty {np.rad2deg(uncertainty[0]):.2f}°"
)
