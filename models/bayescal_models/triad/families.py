"""One effect on a family of slots: a coefficient for each axis or pair of axes, found or dropped together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax.numpy as jnp

import bayescal as bc


def _constant(count: int, r: bc.Frame) -> Any:
    return jnp.ones((r.size, count))


def _departure(order: int, count: int, r: bc.Frame) -> Any:
    return jnp.broadcast_to(r.centred("temperature")[:, None] ** order, (r.size, count))


def _progress(count: int, r: bc.Frame) -> Any:
    return jnp.broadcast_to(r.progress[:, None], (r.size, count))


def _behind(count: int, r: bc.Frame, tau: Any) -> Any:
    return jnp.broadcast_to(r.lag(tau)[:, None], (r.size, count))


def family(
    name: str,
    slots: Sequence[str],
    size: float,
    unit: str,
    source: str,
    *,
    basis: Callable[..., Any] = _constant,
    equation: str = "c",
    per: str | None = None,
    learned: bool = True,
    **more: Any,
) -> bc.Effect:
    """An effect with one coefficient for each of some slots.

    Args:
        name: canonical name, such as "bias.temperature".
        slots: of the family; a coefficient's part is what stands after the first underscore.
        size: prior standard deviation of each, in `unit`; with `per` scale of the prior of the group's.
        unit: of each.
        source: where the size comes from.
        basis: function of the number of coefficients, of the readings and of shapes.
        equation: for people.
        per: a group, for one value for each member.
        learned: whether the standard deviation of these is estimated; it is `size` if not.
    """
    group = {"per": per, "group_sd": bc.HalfNormal(size) if learned else None} if per else {}
    return bc.Effect(
        name,
        slots[0],
        basis=partial(basis, len(slots)),
        coefficients=tuple(
            bc.Coefficient(
                unit, bc.Normal(0.0, size), part=slot.partition("_")[2], slot=slot, **group
            )
            for slot in slots
        ),
        equation=equation,
        source=source,
        **more,
    )


def over_temperature(order: int = 1) -> dict[str, Any]:
    """c·(T − T0) for each of some slots, or a power of it: what `family` takes of it."""
    return {
        "basis": partial(_departure, order),
        "equation": f"c·(T − T0){('', '²', '³')[order - 1]}",
        "columns": ("temperature",),
        "varies": ("temperature",),
    }


# What `family` takes of c·(t − t̄)/(tmax − tmin),
WITH_TIME: dict[str, Any] = {
    "basis": _progress,
    "equation": "c·progress",
    "columns": ("time",),
    "varies": ("time",),
}
# of c·(T̃ − T), one time for all slots: dies that follow the thermometer late,
BEHIND: dict[str, Any] = {
    "basis": _behind,
    "equation": "c·(T̃ − T),  τ·dT̃/dt = T − T̃",
    "shapes": (bc.Shape("tau", "s", 60.0, 1200.0, shared=True),),
    "columns": ("time", "temperature"),
    "varies": ("temperature",),
}
# and of a deviation of each run, their standard deviation estimated.
OF_RUN: dict[str, Any] = {"equation": "d[run],  d ~ N(0, s²)", "per": "run", "columns": ("run",)}


def unknown_directions(readings: bc.Measurements) -> str | None:
    """Why a rotation of the triad moves no reading."""
    return (
        None
        if readings.has("across_x")
        else "needs poses of known direction (direction_x, …, pose_uncertainty)"
    )
