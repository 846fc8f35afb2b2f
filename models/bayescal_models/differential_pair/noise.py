"""Averaging within a reading: a column at the reading's ends, its slope, and noise while it changes.

The mean of a term of second order in the acceleration exceeds its value at the mean acceleration
by the variance of the acceleration within the reading. Such readings have less weight for the scale factor
than those on a plateau, by a parameter that is learned.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import bayescal as bc
from bayescal import xp
from bayescal_models.differential_pair.campaign import G

SPLINE = math.sqrt(3.0) - 2.0
REACH = 12  # neighbours on either side: the next has the weight 10⁻⁷
SHARE = "noise.while_changing"


def slope(r: bc.Frame, values: Any) -> Any:
    """Return the mean time derivative of a column within each reading, unit/s: its change over the duration.

    A reading lasts from half way to the one before it to half way to the next.
    """
    back = xp.where(r.step > 0, r.step, 0.0)
    ahead = xp.append(back[1:], 0.0)
    sides = (back > 0).astype(float) + (ahead > 0)
    lasts = xp.placed(r.order, (back + ahead) / xp.maximum(sides, 1.0))
    before, after = ends(r, values)
    return (after - before) / xp.where(lasts > 0, lasts, 1.0)


def ends(r: bc.Frame, values: Any) -> tuple[Any, Any]:
    """Return a column at the beginning and the end of each reading, given its means over the readings.

    These are the slopes e of the cubic spline through the integral of the column, which the means give exactly: of a
    record of even steps eₖ₋₁ + 4·eₖ + eₖ₊₁ = 3·(mean before + mean after), so that e is a mean of neighbours' means
    with weights z^|j|, z = √3 − 2. Beyond its ends a record is extrapolated as constant.
    Source: C. de Boor, A Practical Guide to Splines (1978), ch. VIII (area matching).
    """
    ordered, place = xp.asarray(values)[r.order], xp.arange(r.size)
    begins = r.step <= 0
    first = xp.maximum.accumulate(xp.where(begins, place, 0))
    closing = xp.where(xp.append(begins[1:], True), place, r.size - 1)
    last = xp.minimum.accumulate(closing[::-1])[::-1]

    def at(shift: int) -> Any:
        return ordered[xp.clip(place + shift, first, last)]

    weights = {j: SPLINE ** abs(j) for j in range(-REACH, REACH + 1)}
    total = 2.0 * sum(weights.values())
    before = sum(w * (at(j - 1) + at(j)) for j, w in weights.items()) / total
    after = sum(w * (at(j) + at(j + 1)) for j, w in weights.items()) / total
    return xp.placed(r.order, before), xp.placed(r.order, after)


class NoiseWhileChanging(bc.Noise):
    """White noise, larger where the acceleration changes: σᵢ = σ·√(1 + (k·Δaᵢ²)²), Δaᵢ over a reading, g.

    Attributes:
        scale: prior of σ, output unit.
        share: prior of k, 1/g².
    """

    scale: bc.HalfCauchy = bc.HalfCauchy(100.0)
    share: bc.HalfCauchy = bc.HalfCauchy(1.0)
    gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "while_changing"
    words: ClassVar[str] = "larger while the acceleration changes"
    looks_like: ClassVar[str] = "noise of readings taken while the acceleration changed"

    @property
    def needs(self) -> tuple[str, ...]:
        return ("time", "acceleration")

    def parameters(self) -> dict[str, Any]:
        return {"noise.white": self.scale, SHARE: self.share}

    @property
    def amplitudes(self) -> tuple[str, ...]:
        return ("noise.white",)

    def unit(self, name: str, output: str) -> str:
        return "1/g^2" if name == SHARE else output

    def variance(self, parameters: Any, frame: bc.Frame) -> Any:
        before, after = ends(frame, frame["acceleration"])
        change = (after - before) / G
        return parameters["noise.white"] ** 2 * (1.0 + (parameters[SHARE] * change**2) ** 2)
