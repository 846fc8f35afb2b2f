"""Three outer and three inner accelerometers on a centrifuge arm: which two make the differential pair?

python example.py
"""

import numpy as np

import bayescal as bc
from bayescal_models import differential_pair as dp

batch = dp.simulate_batch(seed=3, campaign=dp.Campaign(samples=20))
calibration = bc.fit(dp.INSTRUMENT.baseline(), batch.readings)
print(calibration.verdict, "\n")

devices = dp.devices_of(calibration)
table = dp.select(devices)
print(table)

# The pair measures an acceleration that it was not told: here the record it was calibrated on.
outer, inner = table.best
i, j = batch.names.index(outer), batch.names.index(inner)
outputs = batch.readings["output"].reshape(len(batch.names), -1)
found = dp.measure(devices, outer, inner, outputs[i], outputs[j])
single = outputs[i] - batch.acceleration
error = found.acceleration - batch.acceleration
print(f"\nrms error of {outer} alone: {np.sqrt(np.mean(single**2)):.0f} µg")
print(
    f"rms error of the pair: {np.sqrt(np.mean(error**2)):.0f} µg, stated {found.sd.mean():.0f} µg"
)
