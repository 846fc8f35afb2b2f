"""Prior of the scatter of poses: as large again as the noise seen at rest.

Six positions off their axes determine six coefficients and nothing of the noise, so that its prior decides. Without a
stated uncertainty that is an order of magnitude or two, and a bias known to 0.2 mg is stated as ±3 mg. Blocks at rest
have shown the sensor's own noise; what they cannot show (temperature from pose to pose, its own drift) is of its order.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import bayescal as bc

# Of readings of poses, and which of a pose they are.
UNCERTAINTY, WHICH = "output_uncertainty", "axis"
LOG_SD = 1.0  # standard deviation of the logarithm: within a factor of 7 for 95 %, so that readings soon decide


def with_scatter(
    instrument: bc.Instrument, readings: bc.Measurements | None, scatter: float | None = None
) -> bc.Instrument:
    """Return the instrument with a noise prior as large as the poses' stated uncertainties, if all state one.

    Args:
        instrument: of three axes.
        readings: poses.
        scatter: what is believed beforehand, in the outputs' unit; None: root mean square of what the poses state.
    """
    if scatter is None:
        stated = _stated(readings)
        if not len(stated) or not np.all(stated > 0):
            return instrument
        scatter = float(f"{np.sqrt(np.mean(stated**2)):.3g}")
    noise = bc.White(bc.LogNormal(scatter, LOG_SD))
    return replace(instrument, noise=noise, tailor=None, settings=(("scatter", scatter),))


def _stated(readings: bc.Measurements | None) -> np.ndarray:
    """Return the stated uncertainties of outputs along the input; across it a direction's uncertainty counts too."""
    if readings is None or not readings.has(UNCERTAINTY):
        return np.zeros(0)
    along = readings[WHICH] == "magnitude" if readings.has(WHICH) else slice(None)
    return readings[UNCERTAINTY][along]
