"""Zero-rate output of a MEMS gyro from the physics of its two resonances.

Drive mode x and sense mode y, per unit mass: `ẍ + b_d·ẋ + ω_d²·x = F(t)` and `ÿ + b_s·ẏ + ω_s²·y = −2Ω·ẋ`. Young's
modulus decreases with temperature, `E(T) = E0·(1 − K_ET·(T−T0))`, and with it both stiffnesses. A quadrature error
contributes to the zero-rate output through the same resonance denominator `D(T)` as the rate.

Mode equations and modulus: source 1; the values of K_ET, the frequency ratio and Q are assumed by us.
"""

from __future__ import annotations

from typing import Any

from bayescal import xp


def compute_denominator(change: Any, k_drive: Any, k_sense: Any, ratio: Any, quality: Any) -> Any:
    """Return the denominator D of the sense amplitude at the drive resonance, in units of ω_d0².

    `D = √[(r²(1−ε_s) − (1−ε_d))² + (1−ε_d)/Q²]`, `ε = K_ET·(T−T0)` for each mode.

    Args:
        change: temperature change T − T0 of the structure, °C, any shape.
        k_drive, k_sense: K_ET of the drive and the sense mode, 1/°C.
        ratio: r = ω_s0/ω_d0 at T0, dimensionless.
        quality: Q = ω_d0/b_s at T0, dimensionless.
    """
    drive, sense = 1 - k_drive * change, 1 - k_sense * change
    return xp.sqrt((ratio**2 * sense - drive) ** 2 + drive / quality**2)


def compute_amplitude_law(change: Any, *modes: Any) -> Any:
    """Return D(T0)/D(T) − 1, the change of the zero-rate output per unit quadrature at constant drive amplitude."""
    return compute_denominator(0.0, *modes) / compute_denominator(change, *modes) - 1


def compute_force_law(change: Any, k_drive: Any, *modes: Any) -> Any:
    """Return (1−ε_d)^−½·D(T0)/D(T) − 1, the change of the zero-rate output per unit quadrature at constant force."""
    gain = 1 + compute_amplitude_law(change, k_drive, *modes)
    return gain / xp.sqrt(1 - k_drive * change) - 1
