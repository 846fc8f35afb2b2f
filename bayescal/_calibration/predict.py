"""Expected output of a calibrated model on readings, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dpttrf, dpttrs  # pyright: ignore[reportAttributeAccessIssue]

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.on_readings import Vectors, moments
from bayescal._engine.whitening import known_variance
from bayescal._model.correlated_noise import CORRELATION_TIME, OrnsteinUhlenbeck, correlated_size
from bayescal._readings.measurements import Measurements
from bayescal._recording.time_in_runs import run_codes


@dataclass(frozen=True)
class Prediction:
    """Expected output per reading.

    Attributes:
        mean: posterior mean of the expected output, output unit, (n,).
        model_sd: standard uncertainty of the expected output, from coefficients and, for groups that the fit
            has not seen, from their spread.
        sd: standard uncertainty of a reading: with noise.
        residual: output − mean.
        wander: posterior mean of the correlated (Ornstein–Uhlenbeck) noise, for readings between those of the
            fit in the same record; NaN beyond them, None where it was not asked for or the noise is not correlated.
        wander_sd: its standard deviation.
    """

    mean: np.ndarray
    model_sd: np.ndarray
    sd: np.ndarray
    residual: np.ndarray
    wander: np.ndarray | None = None
    wander_sd: np.ndarray | None = None

    @property
    def rmse(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))


def predict(
    calibration: Calibration,
    readings: Measurements | None = None,
    *,
    new_groups: bool = True,
    same_record: bool = False,
    draws: int = 1000,
) -> Prediction:
    """Predict readings.

    Args:
        calibration: a fit.
        readings: to predict; the fitted ones if not given.
        new_groups: take every run, cell or device as one that the fit has not seen: its deviation is zero,
            give or take its spread. False uses the deviations of members that the fit knows by name. An axis
            is part of its instrument: one that the fit knows is itself either way.
        same_record: the readings belong to the very record that was fitted, on its clock and with its labels: groups
            are known, and between fitted readings `wander` is what these say of the correlated noise.
        draws: posterior draws to average over, at most.

    Raises:
        ModelError: the readings lack a column that an effect needs.
    """
    known = readings is None
    readings = calibration.readings if readings is None else readings
    calibration.model.require(readings)
    frame = calibration.frame_of(readings)
    if same_record:
        new_groups = False
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
    made = Prediction(found.mean, np.sqrt(model_variance), total, residual)
    if not same_record or not isinstance(calibration.model.noise, OrnsteinUhlenbeck):
        return made
    mean, sd = _wander(calibration, readings)
    return replace(made, wander=mean, wander_sd=sd)


def _wander(calibration: Calibration, readings: Measurements) -> tuple[np.ndarray, np.ndarray]:
    """The record's correlated noise at these readings' times, at the mode; NaN beyond the fitted ones of a run."""
    fitted, assembly = calibration.readings, calibration.assembly
    left = predict(calibration, new_groups=False).residual
    values = assembly.hyper(calibration.mode.v)
    white = values["noise.white"] ** 2 + known_variance(assembly.record)
    white = np.broadcast_to(white, left.shape)
    (names, known), (asked, codes) = run_codes(fitted), run_codes(readings)
    mean, variance = np.full((2, len(readings)), np.nan)
    for code, name in enumerate(asked):
        rows = np.flatnonzero(known == names.index(name)) if name in names else []
        if not len(rows):
            continue
        time, at = fitted["time"][rows], readings["time"]
        inside = (codes == code) & (at >= time.min()) & (at <= time.max())
        found = wander_given(values, time, left[rows], white[rows], at[inside])
        mean[inside], variance[inside] = found
    return mean, np.sqrt(variance)


def wander_given(
    values: dict[str, float],
    time: Float[np.ndarray, "n"],
    left: Float[np.ndarray, "n"],
    white: Float[np.ndarray, "n"],
    at: Float[np.ndarray, "m"],
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Mean and variance of correlated noise at some times of a run, given what a model leaves of its readings.

    Args:
        values: φ by name.
        time: of the readings, s.
        left: of the readings, output unit.
        white: variance of each reading's own noise.
        at: where it is asked for, s.

    Source: H. Rue and L. Held, Gaussian Markov Random Fields (2005), ch. 2: its precision over sorted times
    has three diagonals.
    """
    grid = np.union1d(time, at)
    variance, step = float(correlated_size(values)) ** 2, np.diff(grid) / values[CORRELATION_TIME]
    kept, fresh = np.exp(-step), -np.expm1(-2 * step)
    diagonal = np.ones(grid.size)
    diagonal[1:] = 1 / fresh
    diagonal[:-1] += kept**2 / fresh
    place, pull, diagonal = np.searchsorted(grid, time), np.zeros(grid.size), diagonal / variance
    np.add.at(diagonal, place, 1 / white)
    np.add.at(pull, place, left / white)
    pivots, below, _ = dpttrf(diagonal, -kept / fresh / variance)
    mean = dpttrs(pivots, below, pull[:, None])[0][:, 0]
    spread, beyond = 1 / pivots, 0.0
    for i in range(grid.size - 1, -1, -1):  # the diagonal of the inverse
        spread[i] += beyond
        beyond = below[i - 1] ** 2 * spread[i] if i else 0.0
    asked = np.searchsorted(grid, at)
    return mean[asked], spread[asked]
