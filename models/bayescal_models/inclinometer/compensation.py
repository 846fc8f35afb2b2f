"""On-line compensation of a two-axis inclinometer: readings of both axes in, tilts and their uncertainty out.

Two laws:

- "document" (source 4, with our sign): x' = x − S_x(y), y' = y − S_y(x), S the calibrated zero at the other axis'
  *uncompensated* reading. What it leaves of S·(…): the change of S over the other axis' own error (0.7″/deg over
  100″ is 0.02″), and all that depends on the axis' own tilt (S_e/cos x, κ, exact placement angle).
- "exact": the measurement equation itself is inverted for both axes at once,

      x = arcsin[ sin(reading_x)/(1 + κ_x) − cos x·zero_x(x, y) − m_x·sin y ],   y likewise,

  by iteration from the readings. Each pass shrinks the error by the size of the zero and of its slope, in rad
  (10⁻³ to 10⁻²), so that four or five reach 10⁻¹² rad. κ, S_e/cos x and the like count where the model has them.

Uncertainty: of the coefficients from posterior draws, each put through one more pass at the mean solution (what that
leaves out is a spread of an arcsecond times 10⁻³); of a mounting not seen, from the learned spread; of the reading
itself, from the noise. What belongs to the test rig (dividing table, base) does not act.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

import bayescal as bc
from bayescal_models.inclinometer.calibrated_axis import CalibratedAxis
from bayescal_models.inclinometer.geometry import ARCSEC

MOST = np.pi / 2 + 0.01  # rad, of a reading; of a placement angle half a turn is allowed
CLOSE, PASSES = 1e-12, 80  # rad, and most passes of the iteration
# Then half a step each: with both axes at 45° the angle of projection bends like a root, and whole steps go to and fro.
WHOLE = 10
Law = Literal["exact", "document"]


@dataclass(frozen=True)
class Compensated:
    """Tilts, rad, one entry per pair of readings.

    Attributes:
        x, y: posterior mean.
        sd_x, sd_y: standard uncertainty, all shares together.
        shares: of each axis, by cause: "coefficients", "mounting", "noise".
        passes: of the iteration; 1 for the document's law.
    """

    x: np.ndarray
    y: np.ndarray
    sd_x: np.ndarray
    sd_y: np.ndarray
    shares: dict[str, dict[str, np.ndarray]]
    passes: int


def compensate(
    calibration: bc.Calibration,
    reading_x: Any,
    reading_y: Any,
    *,
    law: Law = "exact",
    axes: tuple[str, str] = ("x", "y"),
    device: str | None = None,
    draws: int = 1000,
    **covariates: Any,
) -> Compensated:
    """Compensate readings of both axes.

    Args:
        calibration: a fit of the inclinometer.
        reading_x, reading_y: what the axes read, rad.
        law: "exact" or "document".
        axes: labels of the two accelerometers in the calibration.
        device: the inclinometer's label, where the calibration has several; another is a new one.
        draws: most posterior draws to use.
        covariates: what effects need beside the tilts, such as temperature=23.0 (°C).

    Raises:
        InputError: unknown axis, device or law, readings of unequal length, or pairs that no tilt gives.
        ModelError: an effect in use needs a covariate that is not given, or, under the document's law, tilts.
    """
    rx, ry = (np.atleast_1d(np.asarray(r, float)) for r in (reading_x, reading_y))
    _refuse(calibration, rx, ry, law, axes)
    calibrated = tuple(
        CalibratedAxis(calibration, axis, device, draws=draws, covariates=covariates)
        for axis in axes
    )
    if law == "exact":
        x, y, passes = _solved(calibrated, rx, ry)
        of_x, of_y = calibrated[0].tilts(rx, x, y), calibrated[1].tilts(ry, y, x)
    else:
        passes = 1
        of_x, of_y = calibrated[0].corrected(rx, ry), calibrated[1].corrected(ry, rx)
    each = [one.shares(values) for one, values in zip(calibrated, (of_x, of_y), strict=True)]
    sd_x, sd_y = (np.sqrt(sum(s**2 for s in own.values())) for own in each)
    shares = dict(zip(axes, each, strict=True))
    return Compensated(of_x.mean(axis=0), of_y.mean(axis=0), sd_x, sd_y, shares, passes)


def _solved(
    calibrated: tuple[CalibratedAxis, ...], rx: np.ndarray, ry: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int]:
    """Tilts at the posterior mean, rad, and how many passes they took.

    Raises:
        InputError: readings that lead nowhere.
    """
    x, y = rx, ry
    for done in range(PASSES):
        new_x, new_y = calibrated[0].tilt(rx, x, y), calibrated[1].tilt(ry, y, x)
        moved = max(np.max(np.abs(new_x - x)), np.max(np.abs(new_y - y)))
        if moved < CLOSE:
            return new_x, new_y, done + 1
        share = 1.0 if done < WHOLE else 0.5
        x, y = x + share * (new_x - x), y + share * (new_y - y)
    raise bc.InputError(
        f"after {PASSES} passes the tilts still move by {moved:.1e} rad: check that the readings are in rad and "
        "that the calibration is of this inclinometer"
    )


def zero_of(
    calibration: bc.Calibration,
    placement_angle: Any,
    *,
    axis: str,
    device: str | None = None,
    draws: int = 1000,
    **covariates: Any,
) -> np.ndarray:
    """Draws of the zero S(ω) at no tilt, arcsec, (draws, n).

    Args:
        calibration: a fit of the inclinometer.
        placement_angle: rad.
        axis, device, draws, covariates: as of `compensate`.

    Raises:
        InputError: unknown axis or device.
        ModelError: an effect needs a covariate that is not given.
    """
    angle = np.atleast_1d(np.asarray(placement_angle, float))
    _refuse(calibration, 0 * angle, 0 * angle, "document", (axis,) * 2)
    one = CalibratedAxis(calibration, axis, device, draws=draws, covariates=covariates)
    return one.slots(None, angle)["zero"] / ARCSEC


def _refuse(calibration, rx, ry, law, axes) -> None:
    """Refuse what cannot be compensated."""
    if law not in ("exact", "document"):
        raise bc.InputError(f'law={law!r} is none: choose "exact" or "document"')
    if rx.shape != ry.shape or rx.ndim != 1:
        raise bc.InputError(
            f"readings of x and y must be vectors of one length, these are {rx.shape} and {ry.shape}"
        )
    for axis, reading in zip(axes, (rx, ry), strict=True):
        wrong = ~(np.abs(reading) <= MOST)
        if np.any(wrong):
            row = int(np.argmax(wrong))
            raise bc.InputError(
                f"reading {row + 1} of axis {axis!r} is {reading[row]:g} rad, no angle up to a right one: give "
                "radians, such as np.deg2rad(readings)"
            )
    for axis in axes:
        if axis not in (known := calibration.levels["axis"]):
            raise bc.InputError(f"the calibration has no axis {axis!r}; it has: {', '.join(known)}")
