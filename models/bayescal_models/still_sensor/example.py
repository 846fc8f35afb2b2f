"""Any logged channel: a sensor at rest that warms up after power-on. Sizes are taken from the record itself.

python example.py
"""

import bayescal as bc
from bayescal_models import still_sensor

hidden = {"bias.warm_up": 400.0}  # µg at power-on, gone after some 20 minutes
readings = still_sensor.simulate(hidden, seed=1, interval=30)
kept_apart = still_sensor.simulate(hidden, seed=2, interval=30)

instrument = still_sensor.INSTRUMENT.for_readings(readings)  # its unit and plausible sizes
line = bc.fit(instrument.baseline(), readings)
print(bc.check(line))  # where the model fails

found = bc.discover(line)  # which effect is missing
print(found)

better = bc.fit(line.model + found.best, readings)
print(better)
for title, calibration in (("line", line), ("with what was found", better)):
    error = bc.predict(calibration, kept_apart).rmse
    print(f"rms error on hold-out data, {title}: {error:.1f} µg")
