"""Families of three axes: one effect on several slots, a coefficient for each axis or pair of axes.

They are those of the catalogue; a lag has one time constant for all slots (dies that lag behind the thermometer).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import bayescal as bc
from bayescal import xp
from bayescal_models.catalogue import Maker, effect, family, one, progress


def constant(slots: Sequence[str], equation: str = "c") -> Maker:
    """Build a constant for each slot."""
    return family(slots, one, equation, kind="constant")


def over_temperature(slots: Sequence[str], order: int = 1) -> Maker:
    """Build c·(T − T0) for each slot, or a power of it."""
    sign, kind = ("", "²", "³")[order - 1], ("linear", "quadratic", "cubic")[order - 1]
    basis = partial(_departure, order)
    return family(slots, basis, f"c·(T − T0){sign}", "temperature", kind=kind)


def with_time(slots: Sequence[str]) -> Maker:
    """Build c·(t − t̄)/(tmax − tmin) for each slot."""
    return family(slots, progress, "c·progress", "time", varies=("time",), kind="drift")


def of_run(slots: Sequence[str]) -> Maker:
    """Build a deviation of each slot in each run, with learned standard deviation."""
    fields: dict[str, Any] = {"per": "run", "learned": bc.HalfNormal, "varies": ()}
    return family(slots, one, "d[run],  d ~ N(0, s²)", "run", **fields)


def behind(slots: Sequence[str]) -> Maker:
    """Build c·(T̃ − T) for each slot, with one time constant."""
    return effect(
        partial(_behind, len(slots)),
        "c·(T̃ − T),  τ·dT̃/dt = T − T̃",
        *("time", "temperature"),
        parts=[slot.partition("_")[2] for slot in slots],
        slots=slots,
        shapes=(bc.Shape("tau", "s", 60.0, 1200.0, shared=True),),
        kind="lag",
    )


def _departure(order: int, r: bc.Frame) -> Any:
    return r.centred("temperature") ** order


def _behind(count: int, r: bc.Frame, tau: Any) -> Any:
    return xp.broadcast_to(r.lag(tau)[..., None], (r.size, count))


def unknown_directions(readings: bc.Measurements) -> str | None:
    """Return the reason why a rotation of the triad is not identified; None if it is."""
    return (
        None
        if readings.has("across_x")
        else "needs poses of known direction (direction_x, …, pose_uncertainty)"
    )


def frame_of_sensors(slots: Sequence[str]) -> Maker:
    """Build a rotation of the triad in the body, unidentified by poses of unknown direction."""
    return family(slots, one, "c", untestable=unknown_directions)
