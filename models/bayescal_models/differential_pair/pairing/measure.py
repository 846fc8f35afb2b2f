"""Acceleration from a differential pair, with its uncertainty (source 3, step 3).

    a = [a10 − λbd·a20 − Σλ1w·w1 + λbd·Σλ2w·w2]/(λ1 + λbd·λ2)

    devices = dp.devices_of(calibration)
    result = dp.measure(devices, *dp.select(devices).best, outer_output, inner_output)

a10 and a20 are the outputs of the outer and the inner device, λ1 and λ2 their scale factors, λ1w·w1 and λ2w·w2 their
biases, and λbd is the posterior median of the environment ratio. The uncertainty includes the environment that remains
in a new record; u and v are assumed to have the same rms there as in the calibration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

import bayescal as bc
from bayescal_models.differential_pair.pairing.devices import Devices, devices_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PairMeasurement:
    """Acceleration measured by a differential pair, with its uncertainty.

    Attributes:
        acceleration: outward acceleration along the arm, µg, (n,).
        sd: standard uncertainty of the acceleration, µg, (n,), from scale factors and biases, the environment that
            remains after differencing (rms over a record), and the noise of the two outputs.
        ratio: environment ratio λbd of the pair.
    """

    acceleration: Array
    sd: Array
    ratio: float


Measured = PairMeasurement  # the former name


def measure(
    batch: bc.Calibration | Devices,
    outer: str,
    inner: str,
    outer_output: ArrayLike,
    inner_output: ArrayLike,
) -> PairMeasurement:
    """Compute the acceleration from the outputs of a calibrated pair.

    Args:
        batch: calibration of a batch, or its devices.
        outer, inner: names of the outer and the inner device.
        outer_output, inner_output: outputs of the two devices at the same times, µg, (n,).

    Raises:
        InputError: unknown device names, outputs that are not vectors of equal length, or a model with effects that
            the equation in the module's docstring does not contain.
    """
    devices = batch if isinstance(batch, Devices) else devices_of(batch)
    if devices.others:
        raise bc.InputError(
            f"the model has effects that the equation of a pair does not contain ({', '.join(devices.others)}): "
            "correct the outputs for them, then fit the baseline"
        )
    i, j = devices.device_index(outer, is_outer=True), devices.device_index(inner, is_outer=False)
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
    mean_square = np.mean(devices.shared**2, axis=1)  # of u over a record
    residual = (sensitivity[:, i] - ratio * sensitivity[:, j]) ** 2 * mean_square
    residual = residual + (devices.departure**2 + devices.noise**2) * (1 + ratio**2)
    variance = draws.var(axis=0) + np.mean(residual / divisor**2)
    return PairMeasurement(draws.mean(axis=0), np.sqrt(variance), ratio)
