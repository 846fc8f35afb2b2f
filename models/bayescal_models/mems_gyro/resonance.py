"""The gyro's zero-rate output from the physics of its two resonances (source 1).

Drive mode x and sense mode y, per unit mass: `ẍ + b_d·ẋ + ω_d²·x = F(t)` and
`ÿ + b_s·ẏ + ω_s²·y = −2Ω·ẋ`. Young's modulus falls with temperature,
`E(T) = E0·(1 − K_ET·(T−T0))`, and takes both stiffnesses with it; a quadrature coupling then
reaches the zero-rate output through the same resonance denominator `D(T)` as the rate does.

Source: source 1 (mode equations, modulus); the K_ET values, the ratio and Q are ours.
"""

from __future__ import annotations

from typing import Any

from bayescal import xp


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


def with_amplitude_held(change: Any, *modes: Any) -> Any:
    """Return D(T0)/D(T) − 1, the zero rate's change per quadrature; arguments as of `resonance_denominator`."""
    return resonance_denominator(0.0, *modes) / resonance_denominator(change, *modes) - 1


def with_force_held(change: Any, k_drive: Any, *modes: Any) -> Any:
    """Return (1−ε_d)^−½·D(T0)/D(T) − 1: the drive amplitude grows as its mode softens."""
    gain = 1 + with_amplitude_held(change, k_drive, *modes)
    return gain / xp.sqrt(1 - k_drive * change) - 1
