"""Hysteresis of a joint that sticks and then slips: its effect, and whether readings can show it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import bayescal as bc
from bayescal_models.quartz_beam_accelerometer.laws import size

SLIP = 1.0  # °C, width of the play
SEEN = 0.02  # share of the readings that a direction must have to count as one


def _slipped(r: bc.Frame) -> Any:
    """(t2 − seat)/width, the seat dragged along within ±width, anew in each run: from −1 to 1."""
    here = r["temperature_head"][r.order]
    begins = r.step < 0

    def advance(seat, row):
        now, begin = row
        seat = jnp.where(begin, now, jnp.clip(seat, now - SLIP, now + SLIP))
        return seat, (now - seat) / SLIP

    _, strain = jax.lax.scan(advance, here[0], (here, begins))
    return jnp.zeros_like(strain).at[r.order].set(strain)


def _one_way(readings: bc.Measurements) -> str | None:
    """Why readings cannot show hysteresis: the head's temperature goes one way only."""
    _, run = readings.groups("run")
    rises = falls = 0
    for k in np.unique(run):
        chosen = np.flatnonzero(run == k)
        order = chosen[np.argsort(readings["time"][chosen], kind="stable")]
        change = np.diff(readings["temperature_head"][order])
        rises, falls = rises + (change > 0.05).sum(), falls + (change < -0.05).sum()
    if min(rises, falls) >= SEEN * len(readings):
        return None
    return "needs temperature_head to rise and to fall within runs; it goes one way only"


def hysteresis(slot: str) -> bc.Effect:
    """c times the strain of a joint that sticks for 1 °C and then slips: the direction of the last change."""
    value, unit = size(slot, "hysteresis")
    columns = ("time", "temperature_head", *(("acceleration",) if slot == "scale" else ()))
    return bc.Effect(
        f"{slot}.hysteresis",
        slot,
        basis=_slipped,
        coefficients=(bc.Coefficient(unit, bc.Normal(0.0, value)),),
        columns=columns,
        varies=columns[1:],
        untestable=_one_way,
        equation=f"c·(t2 − s)/w,  s dragged along within ±w = {SLIP:g} °C: the direction of the last change",
        source="ours",
    )
