"""Terms of a structure, as plain data: its coefficients, the dependences of their columns, and their sizes."""

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
    """Dependences of an effect's columns: its basis, the shapes of this, and those of corrections.

    Corrections are of columns of the readings, by effects without an unknown but their shapes.
    """

    basis: Basis
    shapes: tuple[str, ...]
    priors: tuple[Any, ...]
    corrections: tuple[Correction, ...] = ()

    def on(self, corrections: Sequence[Correction]) -> ColumnsOf:
        """Add corrections of columns of the readings."""
        shapes, priors = self.shapes, self.priors
        for c in corrections:
            shapes, priors = shapes + c.of.shapes, priors + c.of.priors
        return self._replace(shapes=shapes, priors=priors, corrections=tuple(corrections))

    @property
    def own(self) -> tuple[str, ...]:
        """Return the shapes that the basis takes itself."""
        return self.shapes[: len(self.shapes) - sum(len(c.of.shapes) for c in self.corrections)]

    @property
    def key(self) -> Any:
        """Return the dependences as one hashable value."""
        return self.basis, self.priors, self.corrections

    @classmethod
    def of(cls, effect: Effect) -> ColumnsOf:
        shapes = effect.column_shapes
        names, priors = tuple(s.name for s in shapes), tuple(s.prior for s in shapes)
        return cls((effect.basis, len(effect.coefficients), effect.name), names, priors)


class Correction(NamedTuple):
    """Correction of a column of the readings, with all its past: a column of an effect's own, times a number."""

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

    columns: ColumnsOf  # dependences of its effect's columns
    shape_names: tuple[str, ...]  # names in φ of the shapes that these take
    prior_sd: float  # its unit


def terms_of(
    blocks: Sequence[CoefficientBlock],
    source: Any = None,
    size_factors: Mapping[str, float] | None = None,
) -> tuple[tuple[Term, ...], tuple[str, ...]]:
    """Return the terms of a structure, and the columns of the readings that some of them correct.

    A correction of a column without an unknown but its shapes, such as the temperature of a body, is no term where the
    response does not take that column itself: it is part of the other effects' columns, and these stay linear in their
    coefficients. Else its slot is the path of that column. Without a source there are no corrections. Plausible sizes
    are multiplied by factors, by effect.
    """
    correcting = [b for b in blocks if source is not None and b.slot not in source.slots]
    corrected = tuple(dict.fromkeys(b.slot for b in correcting))
    skip = {b.effect.name for b in correcting}
    corrections: tuple[Correction, ...] = ()
    all_fixed = all(b.place == "fixed" and b.coefficient.per is None for b in correcting)
    if correcting and all_fixed and source.read.isdisjoint(corrected):
        corrections, corrected = tuple(map(Correction.of_block, correcting)), ()
        blocks = [b for b in blocks if b.slot in source.slots]
    columns: dict[str, tuple[ColumnsOf, tuple[str, ...]]] = {}
    for effect in {b.effect.name: b.effect for b in blocks}.values():
        needed = [c for c in corrections if effect.name not in skip and c.column in effect.columns]
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
    """Prior sizes of an effect's coefficients as functions of shapes, such as the length of a Gaussian process."""

    weights: Callable[..., Any]
    shapes: dict[str, str]  # keyword of the weights → name in φ
    count: int  # of its coefficients
    index: Int[np.ndarray, "p"]  # which of them each entry of x is of; −1 for none

    def at(self, hyper: Mapping[str, Any], lead: tuple[int, ...] = ()) -> Any:
        """Return the factors of the prior standard deviations of x, (*lead, p)."""
        factors = self.weights(**{short: hyper[name] for short, name in self.shapes.items()})
        factors = xp.broadcast_to(factors, (*lead, self.count))
        return xp.where(self.index >= 0, factors[..., self.index], 1.0)


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
            weighted = _Weighted(effect.weights, names, len(effect.coefficients), index)
            self.weighing |= dict.fromkeys(names.values(), weighted)

    def log_weights(self, name: str, hyper: Mapping[str, Any]) -> Float[np.ndarray, "p"]:
        """Return the log factors of the sizes that follow a shape; zero for others."""
        return np.log(np.maximum(self.weighing[name].at(hyper), 1e-300))

    def at(self, hyper: Mapping[str, Any], count: tuple[int, ...] = ()) -> Float[Any, "*b p"]:
        """Return the sizes at one φ, its values by name; at `count` of them, the values of each (b,)."""
        if count:
            hyper = {name: np.reshape(value, (-1, 1)) for name, value in hyper.items()}
        # Fixed sizes or learned spreads, one for each coefficient, then the weights of effects that have some.
        sd = self.plain
        for name, members in self.members.items():
            sd = xp.where(members > 0, hyper[name], sd)
        for weighted in {id(w): w for w in self.weighing.values()}.values():
            sd = sd * weighted.at(hyper, count)
        return xp.broadcast_to(sd, (*count, len(self.plain)))
