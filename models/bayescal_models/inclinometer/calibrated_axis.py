"""One accelerometer of a calibrated inclinometer: its slots at given tilts, draw by draw, and the tilt it reads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import bayescal as bc
from bayescal_models.inclinometer.geometry import ARCSEC
from bayescal_models.inclinometer.model import ARCSEC_PER

ACTING = ("zero", "scale", "cross_axis")  # slots of the instrument itself


@dataclass(frozen=True)
class CalibratedAxis:
    """One accelerometer of a calibration.

    Attributes:
        calibration: a fit of the inclinometer.
        axis, device: labels of the accelerometer; another device than the calibration's is a new one.
        draws: most posterior draws to use.
        covariates: what effects need beside the tilts, by name.
    """

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

    def shares(self, tilts: np.ndarray) -> dict[str, np.ndarray]:
        """Standard uncertainties of tilts, (draws, n), by cause, rad, (n,) each."""
        noise, count = self.calibration.samples("noise.white"), tilts.shape[1]
        # d(tilt)/d(reading) is 1 to within κ and the zero's slope.
        return {
            "coefficients": tilts.std(axis=0),
            "mounting": np.full(count, ARCSEC * self._new_members()),
            "noise": np.full(count, ARCSEC * float(np.sqrt(np.mean(noise**2)))),
        }

    def _new_members(self) -> float:
        """Standard deviation of what a mounting (or device) not seen adds to the zero, arcsec."""
        variance = 0.0
        for effect in self.calibration.model.effects:
            for i, c in enumerate(effect.coefficients):
                acts = (c.slot or effect.slot) == "zero" and c.unit == "arcsec"
                if acts and c.group_sd is not None and self._member(c.per) is None:
                    spread = self.calibration.samples(f"{effect.coefficient_name(i)}.group_sd")
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
