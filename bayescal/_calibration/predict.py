"""Expected output of a calibrated model on readings, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.on_readings import Vectors, moments
from bayescal._readings.measurements import Measurements


@dataclass(frozen=True)
class Prediction:
    """Expected output per reading.

    Attributes:
        mean: posterior mean of the expected output, output unit, (n,).
        model_sd: standard uncertainty of the expected output, from coefficients and, for groups that the fit
            has not seen, from their spread.
        sd: standard uncertainty of a reading: with noise.
        residual: output − mean.
    """

    mean: np.ndarray
    model_sd: np.ndarray
    sd: np.ndarray
    residual: np.ndarray

    @property
    def rmse(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))


def predict(
    calibration: Calibration,
    readings: Measurements | None = None,
    *,
    new_groups: bool = True,
    draws: int = 1000,
) -> Prediction:
    """Predict readings.

    Args:
        calibration: a fit.
        readings: to predict; the fitted ones if not given.
        new_groups: take every run, cell or device as one that the fit has not seen: its deviation is zero,
            give or take its spread. False uses the deviations of members that the fit knows by name. An axis
            is part of its instrument: one that the fit knows is itself either way.
        draws: posterior draws to average over, at most.

    Raises:
        ModelError: the readings lack a column that an effect needs.
    """
    known = readings is None
    readings = calibration.readings if readings is None else readings
    calibration.model.require(readings)
    frame = calibration.frame_of(readings)
    if new_groups:
        frame = eqx.tree_at(
            lambda f: f.codes,
            frame,
            {k: c if k == "axis" else -jnp.ones_like(c) for k, c in frame.codes.items()},
        )
    x, rows, v = calibration.draws(draws)
    if not (known and not new_groups) or rows.shape[1] != len(readings):
        rows = np.zeros((len(x), len(readings), rows.shape[2]))
    assembly = calibration.assembly_on(readings, frame)
    found = moments(assembly, Vectors(x, rows, v))
    model_variance = found.variance + found.beside
    total = np.sqrt(model_variance + found.noise)
    residual = readings["output"] - found.mean
    return Prediction(found.mean, np.sqrt(model_variance), total, residual)
