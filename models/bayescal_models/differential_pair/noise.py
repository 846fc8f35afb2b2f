"""Changes of a column within the averaging time of a reading: end values, derivative, and a noise law.

The mean of a squared acceleration exceeds the square of the mean acceleration by the variance of the acceleration
within the reading. The noise law gives readings with a changing acceleration less weight than those on a plateau; the
size of this reduction is estimated.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import bayescal as bc
from bayescal import xp
from bayescal_models.differential_pair.campaign import G

SPLINE_DECAY = math.sqrt(3.0) - 2.0  # ratio z of successive weights
NEIGHBOUR_COUNT = 12  # number of neighbours on either side; the next has the weight 10⁻⁷
SHARE_NAME = "noise.while_changing"


def differentiate(r: bc.Frame, values: Any) -> Any:
    """Return the mean time derivative of a column within each reading, unit/s, (n,).

    A reading lasts from the midpoint between its time and the previous reading's to the midpoint to the next reading's.
    """
    interval_before = xp.where(r.step > 0, r.step, 0.0)
    interval_after = xp.append(interval_before[1:], 0.0)
    count = (interval_before > 0).astype(float) + (interval_after > 0)  # of intervals
    duration = xp.scatter(r.order, (interval_before + interval_after) / xp.maximum(count, 1.0))
    start_value, end_value = end_values(r, values)
    return (end_value - start_value) / xp.where(duration > 0, duration, 1.0)


def end_values(r: bc.Frame, values: Any) -> tuple[Any, Any]:
    """Return the values of a column at the beginning and the end of each reading, (n,) each, from its means (n,).

    The means determine the integral of the column at the ends of the readings. The end values e are the slopes of the
    cubic spline through it: for equal steps eₖ₋₁ + 4·eₖ + eₖ₊₁ = 3·(mean before + mean after), hence a weighted mean
    of the means with weights z^|j|, z = √3 − 2. Outside a record the column is extrapolated as constant.
    Source: C. de Boor, A Practical Guide to Splines (1978), ch. VIII (area matching).
    """
    sorted_values, position = xp.asarray(values)[r.order], xp.arange(r.size)
    is_run_start = r.step <= 0
    first_index = xp.maximum.accumulate(xp.where(is_run_start, position, 0))
    last_indices = xp.where(xp.append(is_run_start[1:], True), position, r.size - 1)
    last_index = xp.minimum.accumulate(last_indices[::-1])[::-1]

    def shift_values(shift: int) -> Any:
        return sorted_values[xp.clip(position + shift, first_index, last_index)]

    weights = {j: SPLINE_DECAY ** abs(j) for j in range(-NEIGHBOUR_COUNT, NEIGHBOUR_COUNT + 1)}
    norm = 2.0 * sum(weights.values())
    starts = sum(w * (shift_values(j - 1) + shift_values(j)) for j, w in weights.items()) / norm
    ends = sum(w * (shift_values(j) + shift_values(j + 1)) for j, w in weights.items()) / norm
    return xp.scatter(r.order, starts), xp.scatter(r.order, ends)


class NoiseWhileChanging(bc.Noise):
    """White noise that is larger while the acceleration changes by Δaᵢ, g, within a reading: σᵢ = σ·√(1 + (k·Δaᵢ²)²).

    Attributes:
        scale: prior of σ, output unit.
        share: prior of k, 1/g².
    """

    scale: bc.HalfCauchy = bc.HalfCauchy(100.0)
    share: bc.HalfCauchy = bc.HalfCauchy(1.0)
    is_gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "while_changing"
    words: ClassVar[str] = "larger while the acceleration changes"
    looks_like: ClassVar[str] = "noise of readings taken while the acceleration changed"

    @property
    def needs(self) -> tuple[str, ...]:
        return ("time", "acceleration")

    def parameters(self) -> dict[str, Any]:
        return {"noise.white": self.scale, SHARE_NAME: self.share}

    @property
    def amplitudes(self) -> tuple[str, ...]:
        return ("noise.white",)

    def unit(self, name: str, output: str) -> str:
        return "1/g^2" if name == SHARE_NAME else output

    def variance(self, parameters: Any, frame: bc.Frame) -> Any:
        start, end = end_values(frame, frame["acceleration"])
        change = (end - start) / G
        return parameters["noise.white"] ** 2 * (1.0 + (parameters[SHARE_NAME] * change**2) ** 2)
