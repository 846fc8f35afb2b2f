"""A ng accelerometer whose base tilts with the laboratory's temperature: test, fit, look, ask what is missing.

python example.py
"""

from __future__ import annotations

import bayescal as bc
from bayescal_models import ng_accelerometer

HIDDEN = {"base_tilt.lab_temperature": 5.0}  # µrad per °C of the laboratory

readings = ng_accelerometer.simulate(HIDDEN, seed=1)
classical = ng_accelerometer.classical_estimates(readings)
print(f"{classical.positions} positions, cell by cell, lines by least squares:")
print(
    f"  bias tempco {classical.bias_tempco} µg/°C, scale-factor tempco {classical.scale_tempco} ppm/°C\n"
)

calibration = bc.fit(ng_accelerometer.INSTRUMENT.baseline(), readings)
print(calibration, "\n")
print(bc.discover(calibration))
