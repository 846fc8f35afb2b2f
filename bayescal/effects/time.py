"""Effects of time itself: drift over the test, warm-up within a run."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from bayescal._core.xp import xp
from bayescal._model.effect import Coefficient, Effect, Shape
from bayescal._model.frame import Frame
from bayescal._model.prior import Normal
from bayescal.effects.thermal import Modes, make_slab_modes

BEND_RANGE = (0.03, 3.0)  # time in which a logarithmic drift's rate halves, in test durations
RATIO_RANGE = (0.05, 0.5)  # shorter over longer time constant of a two-exponential warm-up


def _evaluate_drift(frame: Frame) -> Any:
    return frame.progress


def _evaluate_logarithmic_drift(frame: Frame, bend: Any) -> Any:
    fraction = xp.maximum(frame.position("time"), 0.0)
    return xp.log1p(fraction / bend) / xp.log1p(1.0 / bend) - 0.5


def _evaluate_decay(modes: Modes, frame: Frame, tau: Any) -> Any:
    return sum(w * xp.exp(-frame.elapsed / (m * tau)) for m, w in modes)


def _evaluate_two_decays(frame: Frame, tau: Any, ratio: Any) -> Any:
    return xp.stack([xp.exp(-frame.elapsed / tau), xp.exp(-frame.elapsed / (ratio * tau))], axis=-1)


def drift(slot: str, size: float, unit: str, *, source: str) -> Effect:
    """Return an effect of linear drift, c·(t − t̄)/(tmax − tmin), with the form c·(ln(1 + s/b)/ln(1 + 1/b) − ½).

    c is the change over the test, of prior standard deviation `size`; s is the elapsed fraction of the test, b a shape.
    Resonators and stressed packages age logarithmically (MIL-PRF-55310E (2006), 6.4.2: f(t) = A·ln(B·t + 1)).
    """
    linear_drift = Effect(
        f"{slot}.drift",
        slot,
        basis=_evaluate_drift,
        coefficients=(Coefficient(unit, Normal(0.0, size)),),
        columns=("time",),
        equation="c·(t − t̄)/(tmax − tmin)",
        source=source,
        kind="drift",
    )
    logarithmic_drift = replace(
        linear_drift,
        name=f"{slot}.drift.logarithmic",
        basis=_evaluate_logarithmic_drift,
        shapes=(Shape("bend", "1", *BEND_RANGE),),
        equation="c·(ln(1 + s/b)/ln(1 + 1/b) − ½),  s = (t − tmin)/(tmax − tmin)",
    )
    return replace(linear_drift, forms=(logarithmic_drift,))


def warm_up(slot: str, size: float, unit: str, *, low: float, high: float, source: str) -> Effect:
    """Return an effect of warm-up, c·exp(−(t − t_start)/τ), in each run; its forms: two exponentials, heat diffusion.

    Args:
        size: prior standard deviation of c, in `unit`.
        low, high: plausible range of τ, s.
    """
    single_decay = Effect(
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
    double_decay = replace(
        single_decay,
        name=f"{slot}.warm_up.two_times",
        basis=_evaluate_two_decays,
        coefficients=(*single_decay.coefficients, Coefficient(unit, Normal(0.0, size), "fast")),
        shapes=(*single_decay.shapes, Shape("ratio", "1", *RATIO_RANGE, scale="bounded")),
        equation="c·exp(−t/τ) + d·exp(−t/(r·τ)),  t from the run's start",
    )
    series = " + ".join(f"{w:.3g}·exp(−t/({m:.3g}·τ))" for m, w in make_slab_modes())
    fields = {"basis": partial(_evaluate_decay, make_slab_modes()), "equation": f"c·({series})"}
    series_decay = replace(single_decay, name=f"{slot}.warm_up.diffusion", **fields)
    return replace(single_decay, forms=(double_decay, series_decay))
