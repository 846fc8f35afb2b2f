"""On-line compensation of a two-axis inclinometer: tilts and uncertainties from the readings of both axes.

    tilts = inclinometer.compensate(calibration, reading_x, reading_y)
    tilts.x, tilts.sd_x                rad

There are two laws (argument `law`):

- "document" (source 4, with our sign): x' = x − S_x(y), y' = y − S_y(x), with the calibrated zero S at the
  *uncompensated* reading of the other axis. It neglects the change of S due to that axis' error (0.7″/deg times 100″ is
  0.02″), and all terms that depend on the axis' own tilt (S_e/cos x, κ, exact placement angle).
- "exact": the measurement equations of both axes are solved together,

      x = arcsin[ sin(reading_x)/(1 + κ_x) − cos x·zero_x(x, y) − m_x·sin y ],   y likewise,

  by fixed-point iteration: `bayescal.compensator` of each axis at the other's tilt, starting from the readings. An
  iteration multiplies the error by the zero's slope (10⁻³ to 10⁻²), so that four or five iterations reach 10⁻¹² rad.

Tilts are computed at the posterior mean. Their standard uncertainty includes, to first order, the coefficients, a new
mounting (estimated standard deviation) and the noise of the reading, but no errors of the test rig (dividing table,
base).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

import bayescal as bc
from bayescal_models.inclinometer.geometry import ARCSEC

MAX_READING_RAD = np.pi / 2 + 0.01  # rad, largest valid reading
TOLERANCE_RAD, MAX_ITERATIONS = 1e-12, 80  # rad, tolerance; maximum number of iterations
# Then half steps: with both axes near 45° full steps oscillate, because of the square-root singularity of ω.
FULL_STEP_ITERATIONS = 10
Law = Literal["exact", "document"]


@dataclass(frozen=True)
class CompensatedTilts:
    """Tilts of both axes with standard uncertainties, rad, one entry per pair of readings.

    Attributes:
        x, y: tilts at the posterior mean.
        sd_x, sd_y: combined standard uncertainty of coefficients, mounting and noise.
        passes: number of iterations; 1 for the law "document".
    """

    x: np.ndarray
    y: np.ndarray
    sd_x: np.ndarray
    sd_y: np.ndarray
    passes: int


Compensated = CompensatedTilts  # the former name


@dataclass(frozen=True)
class _Axis:
    """Compensator of one accelerometer, with the values of further covariates, by name."""

    compensator: bc.Compensator
    covariates: dict[str, Any]

    def tilt(self, reading: np.ndarray, cross_tilt: np.ndarray) -> Any:
        """Return the compensated readings, rad, at tilts of the other axis, rad; InputError: no tilt for a reading."""
        inputs = {"output": reading / ARCSEC, "placement_angle": cross_tilt, **self.covariates}
        compensated = self.compensator(**inputs, method="first order", warn=False)
        if np.any(is_invalid := ~np.isfinite(compensated.value)):
            row = int(np.argmax(is_invalid))
            raise bc.InputError(
                f"reading {row + 1} ({reading[row]:.6g} rad) is outside the range of outputs of this "
                "calibration, so no tilt can be computed: check that the readings are in rad"
            )
        return compensated

    def zero(self, cross_tilt: np.ndarray) -> Any:
        """Return the compensated readings of zero: minus the zero offset S, for any scale factor."""
        return self.tilt(0.0 * cross_tilt, cross_tilt)


def _make_axis(
    calibration: bc.Calibration, axis: str, device: str | None, covariates: dict[str, Any]
) -> _Axis:
    members = {"axis": axis}
    if device in calibration.levels.get("device", ()):
        members["device"] = str(device)
    return _Axis(bc.compensator(calibration, members=members), covariates)


def compensate(
    calibration: bc.Calibration,
    reading_x: Any,
    reading_y: Any,
    *,
    law: Law = "exact",
    axes: tuple[str, str] = ("x", "y"),
    device: str | None = None,
    **covariates: Any,
) -> CompensatedTilts:
    """Compensate readings of both axes of an inclinometer.

    Args:
        calibration: fit of the inclinometer.
        reading_x, reading_y: readings of the two axes, rad.
        law: "exact" or "document" (see the module's docstring).
        axes: labels of the two accelerometers in the calibration.
        device: label of the inclinometer, if the calibration has several; an unknown label means a new device.
        covariates: further covariates of effects, such as temperature=23.0 (°C).

    Raises:
        InputError: unknown axis or law, a pair of readings that corresponds to no tilt, or a missing covariate.
    """
    rx, ry = (np.atleast_1d(np.asarray(r, float)) for r in (reading_x, reading_y))
    if law not in ("exact", "document"):
        raise bc.InputError(f'law={law!r} is unknown: choose "exact" or "document"')
    rx, ry = np.broadcast_arrays(rx, ry)
    for axis, reading in zip(axes, (rx, ry), strict=True):
        if np.any(is_invalid := ~(np.abs(reading) <= MAX_READING_RAD)):
            row = int(np.argmax(is_invalid))
            raise bc.InputError(
                f"reading {row + 1} of axis {axis!r} is {reading[row]:g} rad: expected a finite angle of at most "
                "about π/2 (90°). Give radians, such as np.deg2rad(readings)"
            )
    axis_x, axis_y = (_make_axis(calibration, axis, device, covariates) for axis in axes)
    if law == "document":
        x, y = axis_x.zero(ry), axis_y.zero(rx)
        return CompensatedTilts(rx + x.value, ry + y.value, x.uncertainty, y.uncertainty, 1)
    x, y, passes = _solve_tilts(axis_x, axis_y, rx, ry)
    sd_x, sd_y = axis_x.tilt(rx, y).uncertainty, axis_y.tilt(ry, x).uncertainty
    return CompensatedTilts(x, y, sd_x, sd_y, passes)


def _solve_tilts(
    axis_x: _Axis, axis_y: _Axis, rx: np.ndarray, ry: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return both tilts at the posterior mean, rad, and the number of iterations; InputError: no convergence."""
    x, y = rx, ry
    for iteration in range(MAX_ITERATIONS):
        new_x, new_y = axis_x.tilt(rx, y).value, axis_y.tilt(ry, x).value
        max_change = max(np.max(np.abs(new_x - x)), np.max(np.abs(new_y - y)))
        if max_change < TOLERANCE_RAD:
            return new_x, new_y, iteration + 1
        step_factor = 1.0 if iteration < FULL_STEP_ITERATIONS else 0.5
        x, y = x + step_factor * (new_x - x), y + step_factor * (new_y - y)
    raise bc.InputError(
        f"no convergence: after {MAX_ITERATIONS} iterations the tilts still change by {max_change:.1e} rad: check that "
        "the readings are in rad and that the calibration is of this inclinometer"
    )
