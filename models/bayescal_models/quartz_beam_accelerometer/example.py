"""A quartz beam accelerometer on soaks and ramps: from one thermometer to two, and the error left on other ramps.

python example.py
"""

import bayescal as bc
from bayescal_models import quartz_beam_accelerometer as quartz

plan = quartz.Campaign(device="beams", interval=300.0)  # a device whose truth is no polynomial
readings = quartz.simulate(seed=1, campaign=plan)
kept_apart = quartz.simulate(
    seed=2, campaign=quartz.Campaign(device="beams", repeats=0, ramp_speeds=(3.0,), interval=300.0)
)

one = bc.fit(quartz.of_circuit(3), readings, bc.LeastSquares())
print(bc.check(one))  # where a polynomial of one thermometer fails: in time, ramp by ramp

two = bc.fit(quartz.two_thermometers(), readings, bc.LeastSquares())
print(two)  # its last lines name the combinations that no readings can tell

for title, calibration in (("t1 alone, order 3", one), ("two thermometers", two)):
    error = bc.predict(calibration, kept_apart).rmse
    print(f"rms error on hold-out ramps, {title}: {error:.1f} µg")
