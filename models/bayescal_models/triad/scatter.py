"""Prior of the noise between poses, taken from the noise within the poses.

Six positions near the axes determine six coefficients but not the noise, so that the posterior of the noise is its
prior: under a prior that spans one or two orders of magnitude a bias known to 0.2 mg would be reported as ±3 mg. The
samples of a pose at rest determine its noise; variations between poses (temperature, drift) are of the same order.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import bayescal as bc

# Column names: uncertainty of a pose's reading, and kind of reading.
UNCERTAINTY_COLUMN, KIND_COLUMN = "output_uncertainty", "axis"
NOISE_LOG_SD = 1.0  # sd of the logarithm: 95 % within a factor of 7; few readings outweigh it


def set_noise_prior(
    instrument: bc.Instrument, readings: bc.Measurements | None, scatter: float | None = None
) -> bc.Instrument:
    """Return the instrument with a noise prior centred on `scatter`; unchanged if that is None and cannot be computed.

    Args:
        instrument: three-axis instrument.
        readings: readings of poses.
        scatter: prior median, in the outputs' unit; None: root mean square of the poses' stated uncertainties, if all
            poses state a positive one.
    """
    if scatter is None:
        uncertainties = _collect_stated_uncertainties(readings)
        if not len(uncertainties) or not np.all(uncertainties > 0):
            return instrument
        scatter = float(f"{np.sqrt(np.mean(uncertainties**2)):.3g}")
    noise = bc.White(bc.LogNormal(scatter, NOISE_LOG_SD))
    return replace(instrument, noise=noise, tailor=None, settings=(("scatter", scatter),))


def _collect_stated_uncertainties(readings: bc.Measurements | None) -> np.ndarray:
    """Return the stated uncertainties of the magnitude readings, (n,); empty if the readings state none."""
    if readings is None or not readings.has(UNCERTAINTY_COLUMN):
        return np.zeros(0)
    selection = slice(None)
    if readings.has(KIND_COLUMN):
        selection = readings[KIND_COLUMN] == "magnitude"
    return readings[UNCERTAINTY_COLUMN][selection]
