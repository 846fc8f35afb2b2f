"""Independent Gaussian noise of one unknown standard deviation."""

from __future__ import annotations

from typing import ClassVar

from bayescal._data.column import UNCERTAINTY
from bayescal._model.noise_law import WHITE, Noise, known_variance
from bayescal._model.prior import HalfCauchy, Positive


class White(Noise):
    """Independent Gaussian noise of one unknown standard deviation, beside each reading's known uncertainty.

    Attributes:
        scale: prior of the standard deviation, output unit.
    """

    scale: Positive = HalfCauchy(1.0)
    gaussian: ClassVar[bool] = True
    law: ClassVar[str] = "white"
    looks_like: ClassVar[str] = "white noise"
    first: ClassVar[bool] = True

    def parameters(self) -> dict[str, Positive]:
        return {WHITE: self.scale}

    @property
    def amplitudes(self) -> tuple[str, ...]:
        return (WHITE,)

    def even(self, frame) -> bool:
        return UNCERTAINTY not in frame.columns

    def shared_variance(self, values):
        return values[WHITE] ** 2

    def variance(self, parameters, frame):
        return self.shared_variance(parameters) + known_variance(frame)
