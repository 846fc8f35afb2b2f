"""Classical estimator of a cell: bias and scale factor by four or more positions equally spaced over a turn.

It assumes that the tilt is as set, the input axis lies in the face, and the base is level; for the resulting errors
see `model.py`. Source: source 0, equations 9, 12 and 14.
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
    """Estimate K0, µg, and κ, ppm, of every cell, (cells,) each.

    With four positions K0 = (E0 + E2)/2 and K1 = (E1 − E3)/(2·g·sin γ); with n positions
    K0 is the mean and K1 the first harmonic, 2/n·Σ E·sin θ/(g·sin γ).

    Args:
        readings: one of each position in a cell, at one tilt, µg.
        positions: 4, to use only those at 0, 90, 180 and 270°; None for all.

    Raises:
        ValueError: fewer than four positions, positions not equally spaced from 0°, or several tilts in a cell.
    """
    names, cell = readings.groups("cell")
    estimates = [_cell(readings.select(cell == k), positions) for k in range(len(names))]
    bias, scale = np.array(estimates).reshape(-1, 2).T
    return bias, scale


def _cell(readings: bc.Measurements, positions: int | None) -> tuple[float, float]:
    turn = np.mod(readings["position_angle"] / (2 * np.pi) + 1e-7, 1.0) - 1e-7  # turns, from 0
    order = np.argsort(turn)
    if positions == 4:
        order = order[np.abs(4 * turn[order] - np.rint(4 * turn[order])) < 4e-5]
    angle, output, tilt = 2 * np.pi * turn[order], readings["output"][order], readings["tilt"]
    count = len(order)
    is_even = count >= 4 and np.allclose(turn[order], np.arange(count) / count, atol=1e-5)
    if not is_even or np.ptp(tilt) > 1e-6:
        raise ValueError(
            f"classical_estimates: positions {np.degrees(angle).round(3).tolist()}°; at least 4 at one tilt, equally "
            "spaced over a turn from 0°, are needed"
        )
    full = G * np.sin(tilt[0])
    if count == 4:
        return (output[0] + output[2]) / 2, 1e6 * ((output[1] - output[3]) / (2 * full) - 1)
    return output.mean(), 1e6 * (2 / count * output @ np.sin(angle) / full - 1)
