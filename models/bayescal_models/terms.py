"""What the instruments' own effects are made of: bases of a word, and an effect whose coefficients are of one size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import bayescal as bc
from bayescal.effects.constant import one as one


def progress(r: bc.Frame) -> Any:
    """(t − t̄)/(tmax − tmin)."""
    return r.progress


def centred(r: bc.Frame) -> Any:
    """T − T0, °C."""
    return r.centred()


def term(
    name: str,
    basis: Callable[..., Any],
    size: float,
    unit: str,
    *,
    slot: str = "",
    parts: Sequence[str] = ("",),
    slots: Sequence[str] = (),
    per: str | None = None,
    group_sd: Any = None,
    varies: tuple[str, ...] | None = None,
    **more: Any,
) -> bc.Effect:
    """An effect whose coefficients, one for each part, are all of one size.

    Args:
        name: canonical, `slot.cause`.
        basis: of as many columns as there are parts.
        size: prior standard deviation, in `unit`.
        unit: of the coefficients.
        slot: where it is not the one that the name begins with.
        parts: names of the coefficients.
        slots: of each part, where they differ.
        per: group whose members have a coefficient each.
        group_sd: kind of the prior of their standard deviation, of scale `size`, where that is learned.
        varies: columns that must; all that it needs but the time where it is not said.
        more: further fields of the effect.
    """
    columns = more.get("columns", ())
    spread = None if group_sd is None else group_sd(size)
    return bc.Effect(
        name,
        slot or (slots[0] if slots else name.split(".")[0]),
        basis,
        coefficients=tuple(
            bc.Coefficient(unit, bc.Normal(0.0, size), part, own, per, spread)
            for part, own in zip(parts, slots or [None] * len(parts), strict=True)
        ),
        varies=tuple(c for c in columns if c != "time") if varies is None else varies,
        **more,
    )
