"""What simulators share: plausible sizes, random numbers by what they are for, refusals of what cannot be hidden."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np


class Size(NamedTuple):
    """A plausible size: prior standard deviation (of a learned spread: its prior's scale) and its unit."""

    value: float
    unit: str = ""


def generators(names: Sequence[str], seed: int) -> dict[str, np.random.Generator]:
    """A generator for each use, so that what one draws changes nothing for the others."""
    seeds = np.random.SeedSequence(seed).spawn(len(names))
    return {name: np.random.default_rng(s) for name, s in zip(names, seeds, strict=True)}


def refuse_effects(effects: Mapping[str, float], known: Collection[str], where: str) -> None:
    """Refuse effects that no law hides.

    Args:
        effects: name → size.
        known: names that there are.
        where: in what they are hidden, such as "a gyro campaign".

    Raises:
        ValueError: an unknown name, or a size that is not finite.
    """
    for name, size in effects.items():
        if name not in known:
            raise ValueError(
                f"no effect {name!r} can be hidden in {where}: choose among {', '.join(known)}"
            )
        if not np.isfinite(size):
            raise ValueError(f"the size of {name!r} is {size!r}: give a finite number")
