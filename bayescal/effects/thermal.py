"""Effects of a changing temperature: its rate, and a body that lags behind the thermometer."""

from __future__ import annotations

import jax.numpy as jnp

from bayescal._coefficient import Coefficient, Shape
from bayescal._effect import Effect
from bayescal._prior import Normal


def rate(slot: str, size: float, unit: str, *, source: str, column: str = "temperature") -> Effect:
    """c·dT/dt, the causal least-squares slope of the last minute."""
    return Effect(
        f"{slot}.rate",
        slot,
        basis=lambda r: r.rate(column),
        coefficients=(Coefficient(unit, Normal(0.0, size)),),
        columns=("time", column),
        varies=(column,),
        equation="c·dT/dt",
        source=source,
    )


def thermal_lag(
    slot: str,
    size: float,
    unit: str,
    *,
    low: float,
    high: float,
    start: float,
    start_unit: str,
    source: str,
    column: str = "temperature",
) -> Effect:
    """c·(T̃ − T), with T̃ a first-order body that lags T by τ.

    Where the body was not at T when a run began, exp(−t/τ) remains: one coefficient a run, of size `start`.

    Args:
        size: prior standard deviation of c, in `unit`.
        low, high: plausible range of τ, s.
        start: prior standard deviation of the initial state's effect, in `start_unit`.
    """
    return Effect(
        f"{slot}.thermal_lag",
        slot,
        basis=lambda r, tau: jnp.stack([r.lag(tau, column), jnp.exp(-r.elapsed / tau)], axis=1),
        coefficients=(
            Coefficient(unit, Normal(0.0, size)),
            Coefficient(start_unit, Normal(0.0, start), part="start", per="run"),
        ),
        shapes=(Shape("tau", "s", low, high),),
        columns=("time", column),
        varies=(column,),
        equation="c·(T̃ − T) + d[run]·exp(−(t − t_start)/τ),  τ·dT̃/dt = T − T̃",
        source=source,
    )
