"""Noise of readings that were taken while the arm changed its speed.

A reading is a mean over some time. What is of second order in the acceleration has there another mean than the mean
acceleration says, by the variance of the acceleration within the reading: so what such a reading says of a scale
factor is worth less than what those on a plateau say, by a share that is learned.
"""

from __future__ import annotations

from typing import Any, ClassVar

import bayescal as bc
from bayescal_models.differential_pair.campaign import G
from bayescal_models.differential_pair.effects import ends

SHARE = "noise.while_changing"


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
