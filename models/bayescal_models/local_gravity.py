"""Nuisance effect of an unstated local gravity: the relative error that it causes in outputs.

At sea level gravity is 9.780 m/s² at the equator and 9.832 m/s² at a pole. Outputs in m/s² that were divided by a
standard value have a common relative error with a rectangular distribution (JCGM 100:2008, 4.3.7) of standard deviation
0.052/√12 m/s², relative 1.53 · 10⁻³.
"""

from __future__ import annotations

from typing import Any

import bayescal as bc

SD_PPM = 1530.0  # relative standard uncertainty
ASSUMED_GRAVITY = bc.Column(
    "assumed_gravity",
    "1",
    "1 where the output was converted with an assumed local gravity, 0 elsewhere",
    required=False,
    low=0.0,
    high=1.0,
)


def make_nuisance_effect(slot: str, size: float = SD_PPM, unit: str = "ppm") -> bc.Effect:
    """Return the nuisance effect of an unstated local gravity on an instrument with gravity as input.

    Args:
        slot: slot of the input's magnitude, or of its relative deviation.
        size, unit: standard uncertainty of this slot from that of local gravity, and its unit.
    """
    return bc.Effect(
        f"{slot}.local_gravity",
        slot,
        _evaluate_assumption,
        coefficients=(bc.Coefficient(unit, bc.Normal(0.0, size)),),
        equation="c,  deviation of local gravity from the assumed value",
        source="range of normal gravity (GRS 80) as a rectangular distribution (JCGM 100:2008)",
        untestable=_explain_stated_gravity,
    )


def _evaluate_assumption(r: bc.Frame) -> Any:
    return r[ASSUMED_GRAVITY.name] if ASSUMED_GRAVITY.name in r.columns else 0.0 * r.step


def _explain_stated_gravity(readings: bc.Measurements) -> str | None:
    is_stated = not readings.has(ASSUMED_GRAVITY.name) or not readings[ASSUMED_GRAVITY.name].any()
    return "needs outputs in m/s² and an unknown local gravity" if is_stated else None
