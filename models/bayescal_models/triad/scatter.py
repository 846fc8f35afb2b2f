"""Prior of the scatter of poses, equal to the noise observed at rest.

Six positions near the axes determine six coefficients but not the noise, which its prior then determines. Without a
stated uncertainty that prior covers one or two orders of magnitude, and a bias known to 0.2 mg is reported as ±3 mg.
Blocks at rest show the sensor's noise; variations between poses (temperature, drift) are of the same order.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import bayescal as bc

# Columns: uncertainty of a pose's reading, and kind of reading.
UNCERTAINTY, WHICH = "output_uncertainty", "axis"
LOG_SD = 1.0  # standard deviation of the logarithm: within a factor of 7 for 95 %, so that readings soon decide


def with_scatter(
    instrument: bc.Instrument, readings: bc.Measurements | None, scatter: float | None = None
) -> bc.Instrument:
    """Return the instrument with a noise prior as large as the poses' stated uncertainties, if all state one.

    Args:
        instrument: three-axis instrument.
        readings: readings of poses.
        scatter: prior median, in the outputs' unit; None: root mean square of the poses' stated uncertainties.
    """
    if scatter is None:
        stated = _stated(readings)
        if not len(stated) or not np.all(stated > 0):
            return instrument
        scatter = float(f"{np.sqrt(np.mean(stated**2)):.3g}")
    noise = bc.White(bc.LogNormal(scatter, LOG_SD))
    return replace(instrument, noise=noise, tailor=None, settings=(("scatter", scatter),))


def _stated(readings: bc.Measurements | None) -> np.ndarray:
    """Return the stated uncertainties of magnitude readings; projections include the direction's uncertainty."""
    if readings is None or not readings.has(UNCERTAINTY):
        return np.zeros(0)
    along = readings[WHICH] == "magnitude" if readings.has(WHICH) else slice(None)
    return readings[UNCERTAINTY][along]
