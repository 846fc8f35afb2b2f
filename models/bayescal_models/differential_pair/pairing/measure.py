"""Acceleration from a differential pair, with its uncertainty (source 3, step 3).

    a = [a10 − λbd·a20 − Σλ1w·w1 + λbd·Σλ2w·w2]/(λ1 + λbd·λ2)

    devices = dp.devices_of(calibration)
    found = dp.measure(devices, *dp.select(devices).best, outer_output, inner_output)

λbd is the calibrated ratio, the posterior median. The residual environment is part of the uncertainty: the next record
has another u and other departures, of the same sizes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

import bayescal as bc
from bayescal_models.differential_pair.pairing.devices import Devices, devices_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """Acceleration over time with its uncertainty.

    Attributes:
        acceleration: acceleration along the arm, outward, µg.
        sd: standard uncertainty of each reading, µg: of scale and bias, of the residual environment of differencing
            (rms over a record), and of the noise of the two readings.
        ratio: λbd used.
    """

    acceleration: Array
    sd: Array
    ratio: float


def measure(
    found: bc.Calibration | Devices,
    outer: str,
    inner: str,
    outer_output: ArrayLike,
    inner_output: ArrayLike,
) -> Measured:
    """Compute the acceleration from the outputs of a calibrated pair.

    Args:
        found: a calibration of a batch, or its devices.
        outer, inner: names of the two devices.
        outer_output, inner_output: their outputs at the same times, µg.

    Raises:
        InputError: no such devices, outputs of unequal length, or a model with effects that the equation
            above does not contain.
    """
    devices = found if isinstance(found, Devices) else devices_of(found)
    if devices.others:
        raise bc.InputError(
            f"the model has {', '.join(devices.others)}, which depend on the acceleration or on time, and "
            "the pair's equation does not contain them: correct the outputs first, and calibrate the baseline"
        )
    i, j = devices.place(outer, outer=True), devices.place(inner, outer=False)
    y1, y2 = (np.asarray(a, dtype=float) for a in (outer_output, inner_output))
    if y1.shape != y2.shape or y1.ndim != 1:
        raise bc.InputError(
            f"the outputs of {outer!r} and {inner!r} have shapes {y1.shape} and {y2.shape}: give one reading of "
            "each at the same times"
        )
    sensitivity = devices.sensitivity
    ratio = float(np.median(sensitivity[:, i] / sensitivity[:, j]))
    divisor = devices.scale[:, i] + ratio * devices.scale[:, j]
    bias = devices.bias[:, i] - ratio * devices.bias[:, j]
    draws = ((y1 - ratio * y2)[None, :] - bias[:, None]) / divisor[:, None]
    size = np.mean(devices.shared**2, axis=1)  # of u, in a record like this one
    residual = (sensitivity[:, i] - ratio * sensitivity[:, j]) ** 2 * size
    residual = residual + (devices.departure**2 + devices.noise**2) * (1 + ratio**2)
    variance = draws.var(axis=0) + np.mean(residual / divisor**2)
    return Measured(draws.mean(axis=0), np.sqrt(variance), ratio)
