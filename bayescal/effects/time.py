"""Effects of time itself: drift over the test, warm-up within a run."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from bayescal._model.effect import Coefficient, Effect, Shape
from bayescal._model.frame import Frame
from bayescal._model.prior import Normal


def _progress(r: Frame) -> Any:
    return r.progress


def _decay(r: Frame, tau: Any) -> Any:
    return jnp.exp(-r.elapsed / tau)


def drift(slot: str, size: float, unit: str, *, source: str) -> Effect:
    """c·(t − t̄)/(tmax − tmin): c is the change over the test."""
    return Effect(
        f"{slot}.drift",
        slot,
        basis=_progress,
        coefficients=(Coefficient(unit, Normal(0.0, size)),),
        columns=("time",),
        equation="c·(t − t̄)/(tmax − tmin)",
        source=source,
    )


def warm_up(slot: str, size: float, unit: str, *, low: float, high: float, source: str) -> Effect:
    """c·exp(−(t − t_start)/τ) within each run; `low` and `high` bound τ plausibly, s."""
    return Effect(
        f"{slot}.warm_up",
        slot,
        basis=_decay,
        coefficients=(Coefficient(unit, Normal(0.0, size)),),
        shapes=(Shape("tau", "s", low, high),),
        columns=("time",),
        equation="c·exp(−(t − t_start)/τ)",
        source=source,
        along="elapsed",
    )
