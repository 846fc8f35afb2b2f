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

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

import bayescal as bc
from bayescal_models.inclinometer.geometry import ARCSEC
from bayescal_models.inclinometer.terms import ARCSEC_PER

ACTING = ("zero", "scale", "cross_axis")  # slots of the instrument itself
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
    rx, ry = (
        np.atleast_1d(np.asarray(reading_x, float)),
        np.atleast_1d(np.asarray(reading_y, float)),
    )
    _refuse(calibration, rx, ry, law, axes, device)
    halves = tuple(_Half(calibration, axis, device, draws, covariates) for axis in axes)
    if law == "exact":
        x, y, passes = _solved(halves, rx, ry)
        of_x, of_y = halves[0].tilts(rx, x, y), halves[1].tilts(ry, y, x)
    else:
        passes = 1
        of_x, of_y = halves[0].corrected(rx, ry), halves[1].corrected(ry, rx)
    means = [values.mean(axis=0) for values in (of_x, of_y)]
    shares = {
        axis: half.shares(values, own, cross)
        for axis, half, values, own, cross in zip(
            axes, halves, (of_x, of_y), means, means[::-1], strict=True
        )
    }
    total = [np.sqrt(sum(s**2 for s in shares[axis].values())) for axis in axes]
    return Compensated(means[0], means[1], total[0], total[1], shares, passes)


def _solved(
    halves: tuple[_Half, ...], rx: np.ndarray, ry: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int]:
    """Tilts at the posterior mean, rad, and how many passes they took.

    Raises:
        InputError: readings that lead nowhere.
    """
    x, y = rx, ry
    for done in range(PASSES):
        new_x, new_y = halves[0].tilt(rx, x, y), halves[1].tilt(ry, y, x)
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
    _refuse(calibration, 0 * angle, 0 * angle, "document", (axis, axis), device)
    half = _Half(calibration, axis, device, draws, covariates)
    return half.slots(None, angle)["zero"] / ARCSEC


@dataclass(frozen=True)
class _Half:
    """One accelerometer of a calibration."""

    calibration: bc.Calibration
    axis: str
    device: str | None
    draws: int
    covariates: Mapping[str, Any]

    def slots(self, own: np.ndarray | None, cross: np.ndarray) -> dict[str, np.ndarray]:
        """Zero (rad), scale and m (rad) of each draw at these tilts, (draws, n)."""
        model, at = self.calibration.model, self._at(own, cross)
        frame = self.calibration.frame_of(at)
        found: dict[str, Any] = dict.fromkeys(ACTING, np.zeros((1, cross.size)))
        for effect in model.effects:
            if all((c.slot or effect.slot) not in ACTING for c in effect.coefficients):
                continue
            _need(effect, at)
            basis = np.asarray(effect.evaluate(frame, self._shapes(effect)))
            for i, c in enumerate(effect.coefficients):
                value = self._value(effect.coefficient_name(i), c)
                if value is not None:
                    slot = c.slot or effect.slot
                    found[slot] = found[slot] + ARCSEC_PER[c.unit] * value[:, None] * basis[:, i]
        return {n: v if n == "scale" else ARCSEC * v for n, v in found.items()}

    def tilt(self, reading: np.ndarray, own: np.ndarray, cross: np.ndarray) -> np.ndarray:
        """One pass of the iteration at the posterior mean, rad, (n,)."""
        mean = {n: v.mean(axis=0, keepdims=True) for n, v in self.slots(own, cross).items()}
        return self._solve(reading, own, cross, mean)[0]

    def tilts(self, reading: np.ndarray, own: np.ndarray, cross: np.ndarray) -> np.ndarray:
        """One pass for each draw, rad, (draws, n)."""
        return self._solve(reading, own, cross, self.slots(own, cross))

    def _solve(self, reading, own, cross, slots: Mapping[str, np.ndarray]) -> np.ndarray:
        sine = np.sin(reading) / (1 + slots["scale"])
        sine = sine - np.cos(own) * slots["zero"] - slots["cross_axis"] * np.sin(cross)
        if np.any(np.abs(sine) > 1):
            row = int(np.argmax(np.any(np.abs(sine) > 1, axis=0)))
            raise bc.InputError(
                f"reading {row + 1} of axis {self.axis!r}, {np.rad2deg(reading[row]):.6g}°: no tilt gives it "
                "with this calibration. Check the unit (rad) of the readings"
            )
        return np.arcsin(sine)

    def corrected(self, reading: np.ndarray, cross: np.ndarray) -> np.ndarray:
        """Source 4's own: the reading less the zero at the other's reading, rad, (draws, n)."""
        slots = self.slots(None, cross)
        return reading - slots["zero"] - slots["cross_axis"] * np.sin(cross)

    def shares(
        self, values: np.ndarray, own: np.ndarray, cross: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Standard uncertainties by cause, rad, (n,) each."""
        noise = self.calibration.samples("noise.white")
        # d(tilt)/d(reading) is 1 to within κ and the zero's slope.
        return {
            "coefficients": values.std(axis=0),
            "mounting": np.full(own.size, ARCSEC * self._new_members()),
            "noise": np.full(own.size, ARCSEC * float(np.sqrt(np.mean(noise**2)))),
        }

    def _new_members(self) -> float:
        """Standard deviation of what a mounting (or device) not seen adds to the zero, arcsec."""
        variance = 0.0
        for effect in self.calibration.model.effects:
            for i, c in enumerate(effect.coefficients):
                acts = (c.slot or effect.slot) == "zero" and c.unit == "arcsec"
                if acts and c.spread is not None and self._member(c.per) is None:
                    spread = self.calibration.samples(f"{effect.coefficient_name(i)}.spread")
                    variance += float(np.mean(spread**2))
        return float(np.sqrt(variance))

    def _member(self, per: str | None) -> int | None:
        """Place of this accelerometer in a group, None where it is a new member."""
        label = {"axis": self.axis, "device": self.device}.get(per or "")
        levels = self.calibration.levels.get(per or "", ())
        return levels.index(label) if label in levels else None

    def _value(self, name: str, coefficient: bc.Coefficient) -> np.ndarray | None:
        """Draws of a coefficient as it acts here, or None where it is a deviation of a new member."""
        fixed = dict(self.calibration.model.fixed)
        if name in fixed:
            return np.array([fixed[name]])
        samples = self.calibration.samples(name)
        samples = samples[:: max(1, -(-len(samples) // self.draws))]
        if coefficient.per is None:
            return samples
        member = self._member(coefficient.per)
        return None if member is None else samples[:, member]

    def _shapes(self, effect: bc.Effect) -> dict[str, Any]:
        """Shapes at their posterior means."""
        fixed = dict(self.calibration.model.fixed)
        names = {s.name: effect.shape_name(s) for s in effect.shapes}
        return {
            key: np.asarray(fixed[name] if name in fixed else self.calibration.samples(name).mean())
            for key, name in names.items()
        }

    def _at(self, own: np.ndarray | None, cross: np.ndarray) -> bc.Measurements:
        """Set-ups of this accelerometer, without outputs."""
        columns = {"axis": self.axis, "placement_angle": cross, "output": np.zeros(cross.size)}
        if own is not None:
            columns["true_angle"] = own
        if self.device is not None:
            columns["device"] = self.device
        return bc.Measurements.from_arrays(
            self.calibration.model.instrument,
            allow_one_temperature=True,
            **columns,
            **self.covariates,
        )


def _need(effect: bc.Effect, readings: bc.Measurements) -> None:
    for column in effect.columns:
        known = column in ("run", "device") and effect.coefficients[0].per == column
        if not readings.has(column) and not known:
            said = (
                'which the document\'s law does not know: use law="exact"'
                if column == "true_angle"
                else f"which is not given: compensate(…, {column}=…)"
            )
            raise bc.ModelError(f"Effect {effect.name!r} acts in use and needs {column!r}, {said}")


def _refuse(calibration, rx, ry, law, axes, device) -> None:
    """Refuse what cannot be compensated.

    Raises:
        InputError: see `compensate`.
    """
    if law not in ("exact", "document"):
        raise bc.InputError(f'law={law!r} is none: choose "exact" or "document"')
    if rx.shape != ry.shape or rx.ndim != 1:
        raise bc.InputError(
            f"readings of x and y must be vectors of one length, these are {rx.shape} and {ry.shape}"
        )
    if not (np.all(np.isfinite(rx)) and np.all(np.isfinite(ry))):
        raise bc.InputError("readings of x and y must be finite numbers in rad")
    for axis, reading in zip(axes, (rx, ry), strict=True):
        if np.any(np.abs(reading) > MOST):
            row = int(np.argmax(np.abs(reading) > MOST))
            raise bc.InputError(
                f"reading {row + 1} of axis {axis!r} is {reading[row]:g} rad, beyond a right angle: give radians, "
                "such as np.deg2rad(readings)"
            )
    for group, label in (*(("axis", a) for a in axes), ("device", device)):
        known = calibration.levels[group]
        if label is not None and label not in known and group == "axis":
            raise bc.InputError(
                f"the calibration has no {group} {label!r}; it has: {', '.join(known)}"
            )
