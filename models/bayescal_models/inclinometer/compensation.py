"""On-line compensation of a two-axis inclinometer: tilts and uncertainties from the readings of both axes.

    made = inclinometer.compensate(calibration, reading_x, reading_y)
    made.x, made.sd_x                  rad

Two laws:

- "document" (source 4, with our sign): x' = x − S_x(y), y' = y − S_y(x), S the calibrated zero at the other axis'
  *uncompensated* reading. It neglects the change of S over the other axis' error (0.7″/deg over 100″ is 0.02″),
  and everything that depends on the axis' own tilt (S_e/cos x, κ, exact placement angle).
- "exact": the measurement equation itself is inverted for both axes at once,

      x = arcsin[ sin(reading_x)/(1 + κ_x) − cos x·zero_x(x, y) − m_x·sin y ],   y likewise,

  each by `bayescal.compensator` at the other's tilt, alternately, from the readings. Each iteration reduces the error
  by the factor of the zero's slope (10⁻³ to 10⁻²), so that four or five reach 10⁻¹² rad.

Tilts are computed at the posterior mean. Their uncertainty includes, to first order, that of the coefficients, of a new
mounting (learned standard deviation), and of the reading (noise). Effects of the test rig (dividing table, base) are
excluded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

import bayescal as bc
from bayescal_models.inclinometer.geometry import ARCSEC

MOST = np.pi / 2 + 0.01  # rad, largest reading; a placement angle may be half a turn
CLOSE, PASSES = 1e-12, 80  # rad, tolerance; maximum number of iterations
# Then half steps: with both axes at 45° the angle of projection has a square-root singularity: full steps oscillate.
WHOLE = 10
Law = Literal["exact", "document"]


@dataclass(frozen=True)
class Compensated:
    """Tilts, rad, one entry per pair of readings.

    Attributes:
        x, y: tilts at the posterior mean.
        sd_x, sd_y: combined standard uncertainty of coefficients, mounting and noise.
        passes: number of iterations; 1 for the document's law.
    """

    x: np.ndarray
    y: np.ndarray
    sd_x: np.ndarray
    sd_y: np.ndarray
    passes: int


@dataclass(frozen=True)
class _Axis:
    """One accelerometer in use."""

    used: bc.Compensator  # its compensator
    covariates: dict[str, Any]  # further covariates of effects, by name

    def tilt(self, reading: np.ndarray, cross: np.ndarray) -> Any:
        """Compensate readings at given tilts of the other axis, rad."""
        at = {"output": reading / ARCSEC, "placement_angle": cross, **self.covariates}
        compensated = self.used(**at, method="first order", warn=False)
        if np.any(wrong := ~np.isfinite(compensated.value)):
            row = int(np.argmax(wrong))
            raise bc.InputError(
                f"reading {row + 1}, {np.rad2deg(reading[row]):.6g}° is no tilt with this calibration. Check "
                "the unit (rad) of the readings"
            )
        return compensated

    def zero(self, cross: np.ndarray) -> Any:
        """Compensate a reading at zero: the tilt is −S, whatever the scale factor."""
        return self.tilt(0.0 * cross, cross)


def _axis(
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
) -> Compensated:
    """Compensate readings of both axes.

    Args:
        calibration: a fit of the inclinometer.
        reading_x, reading_y: readings of the axes, rad.
        law: "exact" or "document".
        axes: labels of the two accelerometers in the calibration.
        device: label of the inclinometer, if the calibration has several; an unknown label is a new one.
        covariates: further covariates of effects, such as temperature=23.0 (°C).

    Raises:
        InputError: unknown axis or law, pairs that correspond to no tilt, or a missing covariate of an effect in
            use.
    """
    rx, ry = (np.atleast_1d(np.asarray(r, float)) for r in (reading_x, reading_y))
    if law not in ("exact", "document"):
        raise bc.InputError(f'law={law!r} is unknown: choose "exact" or "document"')
    rx, ry = np.broadcast_arrays(rx, ry)
    for axis, reading in zip(axes, (rx, ry), strict=True):
        if np.any(wrong := ~(np.abs(reading) <= MOST)):
            row = int(np.argmax(wrong))
            raise bc.InputError(
                f"reading {row + 1} of axis {axis!r} is {reading[row]:g} rad, more than a right angle: give "
                "radians, such as np.deg2rad(readings)"
            )
    of_x, of_y = (_axis(calibration, axis, device, covariates) for axis in axes)
    if law == "document":
        x, y = of_x.zero(ry), of_y.zero(rx)
        return Compensated(rx + x.value, ry + y.value, x.uncertainty, y.uncertainty, 1)
    x, y, passes = _solve(of_x, of_y, rx, ry)
    sd_x, sd_y = of_x.tilt(rx, y).uncertainty, of_y.tilt(ry, x).uncertainty
    return Compensated(x, y, sd_x, sd_y, passes)


def _solve(
    of_x: _Axis, of_y: _Axis, rx: np.ndarray, ry: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return tilts at the posterior mean, rad, and the number of iterations.

    Raises:
        InputError: the iteration does not converge.
    """
    x, y = rx, ry
    for done in range(PASSES):
        new_x, new_y = of_x.tilt(rx, y).value, of_y.tilt(ry, x).value
        moved = max(np.max(np.abs(new_x - x)), np.max(np.abs(new_y - y)))
        if moved < CLOSE:
            return new_x, new_y, done + 1
        share = 1.0 if done < WHOLE else 0.5
        x, y = x + share * (new_x - x), y + share * (new_y - y)
    raise bc.InputError(
        f"after {PASSES} iterations the tilts still change by {moved:.1e} rad: check that the readings are in rad "
        "and that the calibration is of this inclinometer"
    )
