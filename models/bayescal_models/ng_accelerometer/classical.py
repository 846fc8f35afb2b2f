"""Classical estimator of bias and scale factor from four or more positions equally spaced over a turn.

It assumes that the set tilt is exact, the input axis lies in the face and the base is level; `model.py` describes the
resulting errors. Source: source 0, equations 9, 12 and 14.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import bayescal as bc

Array = NDArray[np.float64]

G = 1e6  # µg


def classical_estimates(
    readings: bc.Measurements, positions: int | None = None
) -> tuple[Array, Array]:
    """Estimate K0, µg, and κ = K1 − 1, ppm, of every cell, (cells,) each, from the outputs E.

    With four positions K0 = (E0 + E2)/2 and K1 = (E1 − E3)/(2·g·sin γ); with n positions K0 is the mean of E and K1
    is the first harmonic, 2/n·Σ E·sin θ/(g·sin γ).

    Args:
        readings: one reading at each position of a cell, at one tilt, µg.
        positions: 4: use only the positions at 0, 90, 180 and 270°; None: use all.

    Raises:
        ValueError: fewer than four positions, positions not equally spaced from 0°, or several tilts in a cell.
    """
    names, cell = readings.groups("cell")
    estimates = [_estimate_cell(readings.select(cell == k), positions) for k in range(len(names))]
    bias, scale = np.array(estimates).reshape(-1, 2).T
    return bias, scale


def _estimate_cell(readings: bc.Measurements, positions: int | None) -> tuple[float, float]:
    turns = np.mod(readings["position_angle"] / (2 * np.pi) + 1e-7, 1.0) - 1e-7  # turns, from 0
    index = np.argsort(turns)
    if positions == 4:
        index = index[np.abs(4 * turns[index] - np.rint(4 * turns[index])) < 4e-5]
    angle, output, tilt = 2 * np.pi * turns[index], readings["output"][index], readings["tilt"]
    count = len(index)
    is_uniform = count >= 4 and np.allclose(turns[index], np.arange(count) / count, atol=1e-5)
    if not is_uniform or np.ptp(tilt) > 1e-6:
        raise ValueError(
            "classical_estimates needs at least 4 positions at one tilt, equally spaced over a turn from 0°; a cell "
            f"has the positions {np.degrees(angle).round(3).tolist()}°"
        )
    max_input = G * np.sin(tilt[0])
    if count == 4:
        return (output[0] + output[2]) / 2, 1e6 * ((output[1] - output[3]) / (2 * max_input) - 1)
    return output.mean(), 1e6 * (2 / count * output @ np.sin(angle) / max_input - 1)
