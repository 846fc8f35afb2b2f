"""Effects of time itself: drift over the test, warm-up within a run."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from bayescal._core.xp import xp
from bayescal._model.effect import Coefficient, Effect, Shape
from bayescal._model.frame import Frame
from bayescal._model.prior import Normal
from bayescal.effects.thermal import Modes, slab

BENDS = (0.03, 3.0)  # of the test, after which a drift has slowed down to a half
RATIOS = (0.05, 0.5)  # of the shorter time of a warm-up of two to the longer


def _progress(r: Frame) -> Any:
    return r.progress


def _ageing(r: Frame, bend: Any) -> Any:
    share = xp.maximum(r.position("time"), 0.0)
    return xp.log1p(share / bend) / xp.log1p(1.0 / bend) - 0.5


def _decays(modes: Modes, r: Frame, tau: Any) -> Any:
    return sum(w * xp.exp(-r.elapsed / (m * tau)) for m, w in modes)


def _two_decays(r: Frame, tau: Any, ratio: Any) -> Any:
    return xp.stack([xp.exp(-r.elapsed / tau), xp.exp(-r.elapsed / (ratio * tau))], axis=-1)


def drift(slot: str, size: float, unit: str, *, source: str) -> Effect:
    """Return c·(t − t̄)/(tmax − tmin), or c·ln(1 + s/b)/ln(1 + 1/b), s from 0 to 1: c is the change over the test.

    The logarithm is how resonators and stressed packages age: fast at first, and ever more slowly.
    Source of the second form: MIL-PRF-55310E (2006), 6.4.2, f(t) = A·ln(B·t + 1).
    """
    steady = Effect(
        f"{slot}.drift",
        slot,
        basis=_progress,
        coefficients=(Coefficient(unit, Normal(0.0, size)),),
        columns=("time",),
        equation="c·(t − t̄)/(tmax − tmin)",
        source=source,
        kind="drift",
    )
    slowing = replace(
        steady,
        name=f"{slot}.drift.logarithmic",
        basis=_ageing,
        shapes=(Shape("bend", "1", *BENDS),),
        equation="c·(ln(1 + s/b)/ln(1 + 1/b) − ½),  s = (t − tmin)/(tmax − tmin)",
    )
    return replace(steady, forms=(slowing,))


def warm_up(slot: str, size: float, unit: str, *, low: float, high: float, source: str) -> Effect:
    """Return c·exp(−(t − t_start)/τ) within each run; in other forms with two times, or by diffusion of heat.

    Args:
        size: prior standard deviation of c, in `unit`.
        low, high: plausible range of τ, s.
    """
    first = Effect(
        f"{slot}.warm_up",
        slot,
        basis=partial(_decays, ((1.0, 1.0),)),
        coefficients=(Coefficient(unit, Normal(0.0, size)),),
        shapes=(Shape("tau", "s", low, high),),
        columns=("time",),
        equation="c·exp(−(t − t_start)/τ)",
        source=source,
        along="elapsed",
        kind="warm-up",
    )
    two = replace(
        first,
        name=f"{slot}.warm_up.two_times",
        basis=_two_decays,
        coefficients=(*first.coefficients, Coefficient(unit, Normal(0.0, size), "fast")),
        shapes=(*first.shapes, Shape("ratio", "1", *RATIOS, scale="bounded")),
        equation="c·exp(−t/τ) + d·exp(−t/(r·τ)),  t from the run's start",
    )
    terms = " + ".join(f"{w:.3g}·exp(−t/({m:.3g}·τ))" for m, w in slab())
    diffusion = {"basis": partial(_decays, slab()), "equation": f"c·({terms})"}
    heat = replace(first, name=f"{slot}.warm_up.diffusion", **diffusion)
    return replace(first, forms=(two, heat))
