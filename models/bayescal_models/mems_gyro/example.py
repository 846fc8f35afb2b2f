"""A gyro whose die lags behind the thermometer: find it, add it, and see the error fall.

python example.py
"""

import bayescal as bc
from bayescal_models import mems_gyro

instrument = mems_gyro.INSTRUMENT
hidden = {"bias.thermal_lag": 0.08}  # °/s per °C between die and thermometer
readings = mems_gyro.simulate(hidden, seed=1)
kept_apart = mems_gyro.simulate(hidden, seed=2)

line = bc.fit(instrument.baseline(), readings)
print(line)
print(bc.check(line))  # where the model fails

found = bc.discover(line)  # which effect is missing
print(found)

better = bc.fit(line.model + found.best, readings)
print(better)
for title, calibration in (("line", line), ("with what was found", better)):
    error = bc.predict(calibration, kept_apart).rmse
    print(f"rms error on hold-out data, {title}: {error:.3f} °/s")
