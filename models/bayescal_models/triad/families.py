"""Effects on several slots of a triad, with one coefficient for each axis or pair of axes.

Factories as in `catalogue`. A thermal lag has one time constant for all slots: the dies lag behind the thermometer.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import bayescal as bc
from bayescal import xp
from bayescal_models.catalogue import Factory, effect, family, one, progress


def constant(slots: Sequence[str], equation: str = "c") -> Factory:
    """Return a factory that creates an effect with one constant for each slot."""
    return family(slots, one, equation, kind="constant")


def tempco(slots: Sequence[str], order: int = 1) -> Factory:
    """Return a factory that creates a temperature effect with one term c·(T − T0)^order for each slot."""
    exponent, kind = ("", "²", "³")[order - 1], ("linear", "quadratic", "cubic")[order - 1]
    basis = partial(_evaluate_departure_power, order)
    return family(slots, basis, f"c·(T − T0){exponent}", "temperature", kind=kind)


def drift(slots: Sequence[str]) -> Factory:
    """Return a factory that creates a drift effect with one term c·(t − t̄)/(tmax − tmin) for each slot."""
    return family(slots, progress, "c·progress", "time", varies=("time",), kind="drift")


def run_offset(slots: Sequence[str]) -> Factory:
    """Return a factory that creates an effect with a random deviation of each slot in each run, N(0, s²)."""
    fields: dict[str, Any] = {"per": "run", "group_sd_prior": bc.HalfNormal, "varies": ()}
    return family(slots, one, "d[run],  d ~ N(0, s²)", "run", **fields)


def thermal_lag(slots: Sequence[str]) -> Factory:
    """Return a factory that creates a thermal lag c·(T̃ − T) of each slot, with a common time constant τ."""
    return effect(
        partial(_evaluate_lag_columns, len(slots)),
        "c·(T̃ − T),  τ·dT̃/dt = T − T̃",
        *("time", "temperature"),
        parts=[slot.partition("_")[2] for slot in slots],
        slots=slots,
        shapes=(bc.Shape("tau", "s", 60.0, 1200.0, shared=True),),
        kind="lag",
    )


def _evaluate_departure_power(order: int, r: bc.Frame) -> Any:
    return r.centred("temperature") ** order


def _evaluate_lag_columns(count: int, r: bc.Frame, tau: Any) -> Any:
    return xp.broadcast_to(r.lag(tau)[..., None], (r.size, count))


def explain_unknown_rotation(readings: bc.Measurements) -> str | None:
    """Return why readings do not identify a rotation of the triad in its body; None if they do."""
    reason = "needs poses of known direction (columns direction_x, …, pose_uncertainty)"
    return None if readings.has("across_x") else reason


def triad_rotation(slots: Sequence[str]) -> Factory:
    """Return a factory that creates a rotation of the triad in its body; it needs poses of known direction."""
    return family(slots, one, "c", untestable=explain_unknown_rotation)
