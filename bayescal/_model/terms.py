"""What does not change of a structure, in plain data: its coefficients, what their columns depend on, their sizes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayescal._core.xp import xp
from bayescal._model.effect import Basis, Effect
from bayescal._model.frame import PATH
from bayescal._model.parameters import CoefficientBlock
from bayescal._model.prior import Known


class ColumnsOf(NamedTuple):
    """What an effect's columns depend on: its basis, the shapes that this takes, and those of the corrections.

    Corrections are of columns of the readings, by effects without an unknown but their shapes.
    """

    basis: Basis
    shapes: tuple[str, ...]
    priors: tuple[Any, ...]
    corrections: tuple[Correction, ...] = ()

    def on(self, corrections: Sequence[Correction]) -> ColumnsOf:
        """The same where columns of the readings are corrected."""
        shapes, priors = self.shapes, self.priors
        for c in corrections:
            shapes, priors = shapes + c.of.shapes, priors + c.of.priors
        return self._replace(shapes=shapes, priors=priors, corrections=tuple(corrections))

    @property
    def own(self) -> tuple[str, ...]:
        """Shapes that the basis takes itself."""
        return self.shapes[: len(self.shapes) - sum(len(c.of.shapes) for c in self.corrections)]

    @property
    def key(self) -> Any:
        """What they depend on, as a value."""
        return self.basis, self.priors, self.corrections

    @classmethod
    def of(cls, effect: Effect) -> ColumnsOf:
        shapes = effect.column_shapes
        names, priors = tuple(s.name for s in shapes), tuple(s.prior for s in shapes)
        return cls((effect.basis, len(effect.coefficients), effect.name), names, priors)


class Correction(NamedTuple):
    """What a column of the readings is corrected by, with all its past: a column of an effect's own, times a number."""

    column: str
    of: ColumnsOf
    index: int
    factor: float
    shape_names: tuple[str, ...]

    @classmethod
    def of_block(cls, block: CoefficientBlock) -> Correction:
        names = tuple(map(block.effect.shape_name, block.effect.column_shapes))
        columns = ColumnsOf.of(block.effect)
        return cls(block.slot, columns, block.index, block.factor * block.value, names)


@dataclass(frozen=True)
class Term(CoefficientBlock):
    """One coefficient of the structure with all its members, on readings."""

    columns: ColumnsOf  # what its effect's columns depend on
    shape_names: tuple[str, ...]  # names in φ of the shapes that these take
    prior_sd: float  # its unit


def terms_of(
    blocks: Sequence[CoefficientBlock],
    source: Any = None,
    size_factors: Mapping[str, float] | None = None,
) -> tuple[tuple[Term, ...], tuple[str, ...]]:
    """The terms of a structure, and the columns of the readings that some of them correct.

    What corrects a column without an unknown but its shapes, as the temperature of a body does, is no term where the
    response does not take that column itself: it is part of the other effects' columns, and these stay linear in their
    coefficients. Else its slot is the path of that column. Without a source nothing corrects a column. Plausible sizes
    are multiplied by factors, by effect.
    """
    correcting = [b for b in blocks if source is not None and b.slot not in source.slots]
    corrected = tuple(dict.fromkeys(b.slot for b in correcting))
    own = {b.effect.name for b in correcting}
    corrections: tuple[Correction, ...] = ()
    held = all(b.place == "fixed" and b.coefficient.per is None for b in correcting)
    if correcting and held and source.read.isdisjoint(corrected):
        corrections, corrected = tuple(map(Correction.of_block, correcting)), ()
        blocks = [b for b in blocks if b.slot in source.slots]
    columns: dict[str, tuple[ColumnsOf, tuple[str, ...]]] = {}
    for effect in {b.effect.name: b.effect for b in blocks}.values():
        needed = [c for c in corrections if effect.name not in own and c.column in effect.columns]
        names = [*map(effect.shape_name, effect.column_shapes)]
        names += [name for c in needed for name in c.shape_names]
        columns[effect.name] = ColumnsOf.of(effect).on(needed), tuple(names)
    factors = size_factors or {}

    def term(b: CoefficientBlock) -> Term:
        of, names = columns[b.effect.name]
        sd = b.coefficient.size * factors.get(b.effect.name, 1.0)
        path = b.slot in corrected and isinstance(b.coefficient.prior, Known)
        slot = b.slot + PATH if path else b.slot
        return Term(**{**vars(b), "slot": slot}, columns=of, shape_names=names, prior_sd=sd)

    return tuple(map(term, blocks)), corrected


class _Weighted(NamedTuple):
    """An effect of which shapes weigh the coefficients, as a process's length does by its spectrum."""

    weights: Callable[..., Any]
    shapes: dict[str, str]  # keyword of the weights → name in φ
    count: int  # of its coefficients
    index: Int[np.ndarray, "p"]  # which of them each entry of x is of; −1 for none

    def at(self, hyper: Mapping[str, Any], lead: tuple[int, ...] = ()) -> Any:
        """Return what the prior standard deviations of x are multiplied by, (*lead, p)."""
        made = self.weights(**{short: hyper[name] for short, name in self.shapes.items()})
        made = xp.broadcast_to(made, (*lead, self.count))
        return xp.where(self.index >= 0, made[..., self.index], 1.0)


class Sizes:
    """Prior standard deviations of x as a function of φ's values; one where the prior is flat."""

    def __init__(self, terms: Sequence[Term], effects: Sequence[Effect], size: int):
        self.plain = np.ones(size)
        self.members: dict[str, Float[np.ndarray, "p"]] = {}  # of each learned spread, ones
        for t in terms:
            if t.group_sd_name is not None:
                self.members.setdefault(t.group_sd_name, np.zeros(size))[t.at] = 1.0
            elif not t.flat:
                self.plain[t.at] = t.prior_sd
        self.weighing: dict[str, _Weighted] = {}  # by each shape that sizes follow
        for effect in (e for e in effects if e.weights is not None):
            index = np.full(size, -1)
            for t in terms:
                if t.effect.name == effect.name:
                    index[t.at] = t.index
            names = {name: f"{effect.name}.{name}" for name in effect.weight_shapes}
            own = _Weighted(effect.weights, names, len(effect.coefficients), index)
            self.weighing |= dict.fromkeys(names.values(), own)

    def log_weights(self, name: str, hyper: Mapping[str, Any]) -> Float[np.ndarray, "p"]:
        """Return logarithms of what the sizes that follow a shape are multiplied by; zero for others."""
        return np.log(np.maximum(self.weighing[name].at(hyper), 1e-300))

    def at(self, hyper: Mapping[str, Any], count: tuple[int, ...] = ()) -> Float[Any, "*b p"]:
        """Return them at one φ, its values by name; at `count` of them, the values of each (b,)."""
        if count:
            hyper = {name: np.reshape(value, (-1, 1)) for name, value in hyper.items()}
        # Fixed, then learned spreads, then the weights of what has a shape: each coefficient has one of the first
        # two.
        sd = self.plain
        for name, members in self.members.items():
            sd = xp.where(members > 0, hyper[name], sd)
        for weighted in {id(w): w for w in self.weighing.values()}.values():
            sd = sd * weighted.at(hyper, count)
        return xp.broadcast_to(sd, (*count, len(self.plain)))
