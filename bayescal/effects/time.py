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

BEND_RANGE = (0.03, 3.0)  # time in which the rate of a logarithmic drift halves, over the test
RATIO_RANGE = (0.05, 0.5)  # shorter over longer time constant of a two-exponential warm-up


def _evaluate_drift(r: Frame) -> Any:
    return r.progress


def _evaluate_ageing(r: Frame, bend: Any) -> Any:
    fraction = xp.maximum(r.position("time"), 0.0)
    return xp.log1p(fraction / bend) / xp.log1p(1.0 / bend) - 0.5


def _evaluate_decay(modes: Modes, r: Frame, tau: Any) -> Any:
    return sum(w * xp.exp(-r.elapsed / (m * tau)) for m, w in modes)


def _evaluate_two_decays(r: Frame, tau: Any, ratio: Any) -> Any:
    return xp.stack([xp.exp(-r.elapsed / tau), xp.exp(-r.elapsed / (ratio * tau))], axis=-1)


def drift(slot: str, size: float, unit: str, *, source: str) -> Effect:
    """Return a linear drift c·(t − t̄)/(tmax − tmin) over the test, with a logarithmic form, c·ln(1 + s/b)/ln(1 + 1/b).

    c is the change over the test, s the elapsed fraction. Resonators and stressed packages age logarithmically.
    Source of the logarithmic form: MIL-PRF-55310E (2006), 6.4.2, f(t) = A·ln(B·t + 1).
    """
    linear = Effect(
        f"{slot}.drift",
        slot,
        basis=_evaluate_drift,
        coefficients=(Coefficient(unit, Normal(0.0, size)),),
        columns=("time",),
        equation="c·(t − t̄)/(tmax − tmin)",
        source=source,
        kind="drift",
    )
    logarithmic = replace(
        linear,
        name=f"{slot}.drift.logarithmic",
        basis=_evaluate_ageing,
        shapes=(Shape("bend", "1", *BEND_RANGE),),
        equation="c·(ln(1 + s/b)/ln(1 + 1/b) − ½),  s = (t − tmin)/(tmax − tmin)",
    )
    return replace(linear, forms=(logarithmic,))


def warm_up(slot: str, size: float, unit: str, *, low: float, high: float, source: str) -> Effect:
    """Return a warm-up c·exp(−(t − t_start)/τ) in each run; alternative forms: two exponentials, heat diffusion.

    Args:
        size: prior standard deviation of c, in `unit`.
        low, high: plausible range of τ, s.
    """
    single = Effect(
        f"{slot}.warm_up",
        slot,
        basis=partial(_evaluate_decay, ((1.0, 1.0),)),
        coefficients=(Coefficient(unit, Normal(0.0, size)),),
        shapes=(Shape("tau", "s", low, high),),
        columns=("time",),
        equation="c·exp(−(t − t_start)/τ)",
        source=source,
        along="elapsed",
        kind="warm-up",
    )
    double = replace(
        single,
        name=f"{slot}.warm_up.two_times",
        basis=_evaluate_two_decays,
        coefficients=(*single.coefficients, Coefficient(unit, Normal(0.0, size), "fast")),
        shapes=(*single.shapes, Shape("ratio", "1", *RATIO_RANGE, scale="bounded")),
        equation="c·exp(−t/τ) + d·exp(−t/(r·τ)),  t from the run's start",
    )
    terms = " + ".join(f"{w:.3g}·exp(−t/({m:.3g}·τ))" for m, w in slab())
    diffusion = {"basis": partial(_evaluate_decay, slab()), "equation": f"c·({terms})"}
    by_diffusion = replace(single, name=f"{slot}.warm_up.diffusion", **diffusion)
    return replace(single, forms=(double, by_diffusion))
