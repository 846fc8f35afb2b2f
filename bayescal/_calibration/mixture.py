"""A calibration averaged over structures: which effects its draws have, and the same of those that can do without some.

Of a draw of a structure that has not an effect all coefficients of this effect are exactly zero.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from jaxtyping import Bool

from bayescal._calibration.fitted import Fitted
from bayescal._inference.method import CHAINS, Draws
from bayescal._inference.trust import CHAIN_DRAWS
from bayescal._model.frame import GROUPS

F = TypeVar("F", bound=Fitted)


def has_effect(calibration: Fitted, name: str) -> Bool[np.ndarray, "draws"]:
    """Which draws are of a structure that has an effect."""
    x, _ = calibration.draws()
    own = [b for b in calibration.layout.x_blocks if b.effect.name == name]
    if not own:  # held, or sampled with φ: not averaged over
        return np.ones(len(x), dtype=bool)
    return np.any([np.any(x[:, b.start : b.start + b.size] != 0, axis=1) for b in own], axis=0)


def inclusion(calibration: Fitted) -> dict[str, float]:
    """The share of draws that have each effect; one for all, where nothing was averaged."""
    return {
        e.name: float(has_effect(calibration, e.name).mean()) for e in calibration.model.effects
    }


def likeliest(calibration: Fitted) -> set[str]:
    """The effects of the most probable structure: those that most draws have together."""
    names = [e.name for e in calibration.model.effects]
    held = np.column_stack([has_effect(calibration, name) for name in names])
    each, counts = np.unique(held, axis=0, return_counts=True)
    return {n for n, there in zip(names, each[counts.argmax()], strict=True) if there}


def with_columns(calibration: F, columns: Iterable[str]) -> F:
    """The average over those structures that need no other columns, where that leaves enough of them."""
    there = set(columns)
    lacking = [e.name for e in calibration.model.effects if not there.issuperset(e.columns)]
    return without(calibration, lacking) if lacking else calibration


def usual_columns(calibration: Fitted) -> set[str]:
    """Columns that effects more probable than not need; a group is none: what is used is a new member of it."""
    shares = inclusion(calibration)
    likely = (e for e in calibration.model.effects if shares[e.name] > 0.5)
    return set().union(GROUPS, *(e.columns for e in likely))


def without(calibration: F, names: Collection[str]) -> F:
    """The average over the structures that have none of these effects; the same where these have nearly all of it."""
    x, v = calibration.draws()
    kept = ~np.any([has_effect(calibration, name) for name in names], axis=0)
    if kept.sum() < CHAIN_DRAWS:
        return calibration
    effects = tuple(e for e in calibration.model.effects if e.name not in names)
    layout = replace(calibration.layout, model=replace(calibration.model, effects=effects))
    in_x, in_v = calibration.layout.entries_in(layout)
    pick = np.flatnonzero(kept)[: CHAINS * (int(kept.sum()) // CHAINS)]
    x, v, mode = x[pick][:, in_x], v[pick][:, in_v], calibration.mode
    inner = mode.covariance[np.ix_(in_v, in_v)]
    mode = mode._replace(x=x.mean(axis=0), v=mode.v[in_v], covariance=inner, flat=mode.flat[in_x])
    joint = Draws.of(x, v)
    return replace(calibration, model=layout.model, layout=layout, joint=joint, mode=mode)
