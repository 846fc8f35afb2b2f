"""The gyro's zero-rate output from the physics of its two resonances (source 1).

Drive mode x and sense mode y, per unit mass: `ẍ + b_d·ẋ + ω_d²·x = F(t)` and
`ÿ + b_s·ẏ + ω_s²·y = −2Ω·ẋ`. Young's modulus falls with temperature,
`E(T) = E0·(1 − K_ET·(T−T0))`, and takes both stiffnesses with it; a quadrature coupling then
reaches the zero-rate output through the same resonance denominator `D(T)` as the rate does.

Source: source 1 (mode equations, modulus); the K_ET values, the ratio and Q are ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayescal import xp
from bayescal_models.simulated import refuse_unknown


def resonance_denominator(change: Any, k_drive: Any, k_sense: Any, ratio: Any, quality: Any) -> Any:
    """Return the denominator D of the sense amplitude at the drive resonance, in units of ω_d0².

    `D = √[(r²(1−ε_s) − (1−ε_d))² + (1−ε_d)/Q²]`, `ε = K_ET·(T−T0)` for each mode.

    Args:
        change: T − T0 of the structure, °C, any shape.
        k_drive, k_sense: K_ET of each mode, 1/°C.
        ratio: r = ω_s0/ω_d0 at T0, without unit.
        quality: Q = ω_d0/b_s at T0, without unit.

    Source: source 1's mode equations, solved for the sense amplitude.
    """
    drive, sense = 1 - k_drive * change, 1 - k_sense * change
    return xp.sqrt((ratio**2 * sense - drive) ** 2 + drive / quality**2)


@dataclass(frozen=True)
class Resonance:
    """The two modes of a gyro, as far as its zero-rate output needs them.

    With one K_ET in both modes and the amplitude held, the slope at T0 is `quadrature·K_ET`: the
    defaults give 0.0535 °/s/°C, the slope of the document's table, and are nearly straight.

    Attributes:
        quadrature: quadrature times the demodulation phase error, °/s, at T0.
        k_drive, k_sense: relative loss of modulus per degree, 1/°C, of each mode.
        ratio: sense over drive frequency at T0, without unit.
        quality: Q of the sense mode at T0, without unit.
        held: what the drive loop holds, "amplitude" or "force".
    """

    quadrature: float = 669.0
    k_drive: float = 8e-5
    k_sense: float = 8e-5
    ratio: float = 1.05
    quality: float = 1000.0
    held: str = "amplitude"

    def __post_init__(self) -> None:
        refuse_unknown(self, held=("amplitude", "force"))

    def zero_rate(self, temperature: ArrayLike, T0: float, constant: float) -> NDArray[np.float64]:
        """Return the zero-rate output, °/s: `constant + q·(D(T0)/D(T)·f − 1)`, so `constant` at T0.

        `f` is (1−ε_d)^−½ where the drive force is held (its amplitude then grows), else 1.

        Args:
            temperature: temperature of the structure, °C, any shape.
            T0: reference temperature, °C.
            constant: zero-rate output at T0, °/s.
        """
        modes = (self.k_drive, self.k_sense, self.ratio, self.quality)
        change = np.asarray(temperature, dtype=float) - T0
        gain = resonance_denominator(0.0, *modes) / resonance_denominator(change, *modes)
        if self.held == "force":
            gain = gain / np.sqrt(1.0 - self.k_drive * change)
        return constant + self.quadrature * (gain - 1.0)
