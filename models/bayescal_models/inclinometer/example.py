"""Calibrate a two-axis inclinometer's zero, see that a line misses the projection law, and compensate readings.

python example.py
"""

import numpy as np

import bayescal as bc
from bayescal_models import inclinometer

instrument = inclinometer.INSTRUMENT
hidden = {"zero.projection": 60.0}  # arcsec
readings = inclinometer.simulate(hidden, seed=1)

line = bc.fit(instrument.baseline(), readings)
print(line)
found = bc.discover(line)  # which effect is missing
print(found)

better = bc.fit(line.model + found.best, readings)
verification = inclinometer.Verification.of(
    inclinometer.simulate(hidden, seed=2, campaign=inclinometer.VERIFICATION)
)


def largest(errors: tuple[np.ndarray, np.ndarray]) -> str:
    """Largest error of each axis, in degrees."""
    x, y = (np.abs(np.rad2deg(e)).max() for e in errors)
    return f"x {x:.4f}°, y {y:.4f}°"


print(f"largest error as read: {largest(verification.errors)}")
for title, calibration in (("line", line), ("with what was found", better)):
    made = inclinometer.compensate(calibration, verification.reading_x, verification.reading_y)
    left = (made.x - verification.true_x, made.y - verification.true_y)
    print(f"compensated, {title}: {largest(left)}")
