"""Constant effects, and random deviations of runs, cells, axes or devices from them."""

from __future__ import annotations

from bayescal._model.effect import Coefficient, Effect, Group
from bayescal._model.frame import Frame
from bayescal._model.prior import Flat, HalfNormal, Normal


def one(frame: Frame) -> float:
    """Return the constant basis function: 1, for every reading."""
    return 1.0


def constant(slot: str, size: float | None, unit: str, *, source: str) -> Effect:
    """Return a constant effect c; `size`: prior standard deviation of c, in `unit`, or None for a flat prior."""
    prior = Flat() if size is None else Normal(0.0, size)
    return Effect(
        f"{slot}.constant",
        slot,
        basis=one,
        coefficients=(Coefficient(unit, prior),),
        equation="c",
        source=source,
        kind="constant",
    )


def deviation(slot: str, per: Group, size: float, unit: str, *, source: str) -> Effect:
    """Return an effect with a deviation N(0, s²) per group member; size: scale of s's half-normal prior, in `unit`."""
    columns = {"cell": ("temperature_point",)}.get(per, (per,))
    return Effect(
        f"{slot}.{per}",
        slot,
        basis=one,
        coefficients=(Coefficient(unit, Normal(0.0, size), per=per, group_sd=HalfNormal(size)),),
        columns=columns,
        equation=f"d[{per}],  d ~ N(0, s²)",
        source=source,
    )
