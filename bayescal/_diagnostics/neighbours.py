"""Neighbouring readings: the noise that no smooth effect could remove."""

from __future__ import annotations

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._diagnostics.efficient_score import residuals


def noise_floor(calibration: Calibration) -> float:
    """Noise that no model of smooth effects could remove, output unit.

    From each residual against the mean of its two neighbours (in time within a run; in temperature where there
    is no time), as in a von Neumann ratio: what varies slowly cancels.
    """
    residual = residuals(calibration).raw
    readings = calibration.readings
    if readings.has("time"):
        order, step = calibration.assembly.record.in_time
        linked = step >= 0
    else:
        key = readings["temperature"] if readings.has("temperature") else np.arange(len(readings))
        order, linked = np.argsort(key, kind="stable"), np.ones(len(readings), bool)
        linked[0] = False
    r = residual[order]
    inner = linked[1:-1] & linked[2:]
    bend = (r[1:-1] - 0.5 * (r[:-2] + r[2:]))[inner]
    if bend.size < 3:
        return float(np.sqrt(np.mean(residual**2)))
    return float(np.sqrt(np.mean(bend**2) / 1.5))
