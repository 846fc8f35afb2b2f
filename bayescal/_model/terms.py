"""What does not change of a structure, in plain data: its coefficients, what their columns depend on, their sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._model.effect import READING, Basis, Effect, basis_of
from bayescal._model.parameters import CoefficientBlock
from bayescal._model.prior import LogNormal, Normal


class ColumnsOf(NamedTuple):
    """What an effect's columns depend on.

    Attributes:
        basis: its own.
        shapes: that this takes, then those of the corrections.
        priors: of the shapes.
        corrections: of columns of the readings, by effects without an unknown but their shapes.
        ragged: whether they run too sharply along a shape to be interpolated, as a step does.
    """

    basis: Basis
    shapes: tuple[str, ...]
    priors: tuple[Any, ...]
    corrections: tuple[Correction, ...] = ()
    ragged: bool = False

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
        return cls(basis_of(effect), names, priors, ragged=any(s.ragged for s in shapes))


class Correction(NamedTuple):
    """What a column of the readings is corrected by: a column of an effect's own, times a number."""

    column: str
    of: ColumnsOf
    index: int
    factor: float
    shape_names: tuple[str, ...]

    @classmethod
    def of_block(cls, block: CoefficientBlock) -> Correction:
        effect = block.effect
        names = tuple(map(effect.shape_name, effect.column_shapes))
        return cls(block.slot, ColumnsOf.of(effect), block.index, block.factor * block.value, names)


class CoefficientTerms(NamedTuple):
    """What does not change of a coefficient, in plain data."""

    effect: Effect  # held, so that no other takes its place in memory
    of: str
    per: str | None
    mean: float
    prior_sd: float
    flat: bool
    learned: bool
    columns: ColumnsOf
    shape_names: tuple[str, ...]
    key: Any  # what its columns depend on, whoever has them

    @classmethod
    def of_block(
        cls, block: CoefficientBlock, corrections: Sequence[Correction]
    ) -> CoefficientTerms:
        c, effect, learned = block.coefficient, block.effect, block.coefficient.group_sd is not None
        columns = ColumnsOf.of(effect).on(corrections)
        names = (*map(effect.shape_name, effect.column_shapes),)
        names += tuple(name for by in corrections for name in by.shape_names)
        own = None if c.per == READING else c.per, block.mean, c.size, c.flat, learned
        return cls(effect, effect.name, *own, columns, names, columns.key)


class Term(NamedTuple):
    """One coefficient of the structure with all its members."""

    known: CoefficientTerms
    index: int
    slot: str
    size: int
    place: str
    factor: float
    value: float
    prior_sd: float
    group_sd_name: str | None
    members: tuple[str, ...]
    at: slice  # its entries of x

    @classmethod
    def of_block(
        cls,
        block: CoefficientBlock,
        plain: dict[Any, Any],
        size_factors: Mapping[str, float],
        corrections: Sequence[Correction] = (),
    ) -> Term:
        """Of a block, on readings of which columns are corrected; `plain` keeps what does not change."""
        needed = tuple(c for c in corrections if c.column in block.effect.columns)
        key = (id(block.effect), block.index, needed)
        if key not in plain:
            plain[key] = CoefficientTerms.of_block(block, needed)
        known: CoefficientTerms = plain[key]
        same = "index", "slot", "size", "place", "factor", "value"
        return cls(
            known=known,
            **{name: getattr(block, name) for name in same},
            prior_sd=known.prior_sd * size_factors.get(known.of, 1.0),
            group_sd_name=block.group_sd_name if known.learned else None,
            members=tuple(block.member_names()) if block.place == "phi" else (),
            at=slice(block.start, block.start + block.size),
        )


def terms_of(
    blocks: Sequence[CoefficientBlock],
    source: Any,
    plain: dict[Any, Any] | None = None,
    size_factors: Mapping[str, float] | None = None,
) -> tuple[tuple[Term, ...], tuple[str, ...]]:
    """The terms of a structure, and the columns of the readings that some of them correct.

    What corrects a column without an unknown but its shapes, as the temperature of a body does, is no term where the
    response does not take that column itself: it is part of the other effects' columns, and these stay linear in their
    coefficients.

    Args:
        blocks: its coefficients.
        source: of columns and responses; what acts on a name that is none of its slots corrects that column.
        plain: keeps what does not change of a coefficient, for other structures.
        size_factors: on the plausible sizes of an effect's coefficients, by the effect's name; one where not named.
    """
    correcting = [b for b in blocks if b.slot not in source.slots]
    corrected = tuple(dict.fromkeys(b.slot for b in correcting))
    own = {b.effect.name for b in correcting}
    corrections: tuple[Correction, ...] = ()
    held = all(b.place == "fixed" and b.coefficient.per is None for b in correcting)
    if correcting and held and source.read.isdisjoint(corrected):
        corrections, corrected = tuple(map(Correction.of_block, correcting)), ()
        blocks = [b for b in blocks if b.slot in source.slots]
    plain = {} if plain is None else plain

    def term(b: CoefficientBlock) -> Term:
        acting = () if b.effect.name in own else corrections
        return Term.of_block(b, plain, size_factors or {}, acting)

    return tuple(map(term, blocks)), corrected


class Sizes:
    """Prior standard deviations of x as a function of φ's values; one where the prior is flat."""

    def __init__(self, terms: Sequence[Term], effects: Sequence[Effect], size: int):
        self.plain = np.ones(size)
        for t in terms:
            if not t.known.flat and t.group_sd_name is None:
                self.plain[t.at] = t.prior_sd
        self.learned = [(t.at, t.group_sd_name) for t in terms if t.group_sd_name is not None]
        self.weighted: list[tuple[Any, list[tuple[str, str]], list[slice | None]]] = []
        for effect in effects:
            if effect.weights is not None:
                names = [(name, f"{effect.name}.{name}") for name in effect.weight_shapes]
                own = {t.index: t.at for t in terms if t.known.of == effect.name}
                places = [own.get(i) for i in range(len(effect.coefficients))]
                self.weighted.append((effect.weights, names, places))
        self.members: dict[str, Float[np.ndarray, "p"]] = {}  # of each learned spread, ones
        for place, name in self.learned:
            self.members.setdefault(name, np.zeros(size))[place] = 1.0
        # of each shape that sizes follow
        self.weighing = {
            name: i for i, (_, names, _) in enumerate(self.weighted) for _, name in names
        }

    def log_weights(self, name: str, hyper: Mapping[str, Any]) -> Float[np.ndarray, "p"]:
        """Logarithms of what the sizes that follow a shape are multiplied by; zero for others."""
        weights, names, places = self.weighted[self.weighing[name]]
        # Sizes that follow a shape, as the spectrum of a Gaussian process its length, are a factor on each
        # coefficient's sd.
        found = np.zeros(len(self.plain))
        made = np.broadcast_to(
            weights(**{short: hyper[one] for short, one in names}), (len(places),)
        )
        for at, one in zip(places, np.log(np.maximum(made, 1e-300)), strict=True):
            if at is not None:
                found[at] = one
        return found

    def at(
        self, hyper: Mapping[str, Any], count: tuple[int, ...] = ()
    ) -> Float[np.ndarray, "*b p"]:
        """At one φ, its values by name; at `count` of them, the values of each (b,)."""

        def each(name: str) -> Any:
            return np.reshape(hyper[name], (-1, 1)) if count else hyper[name]

        # Fixed, then learned spreads, then the weights of what has a shape: each coefficient has one of the first
        # two.
        sd = np.broadcast_to(self.plain, (*count, len(self.plain))).copy()
        for place, name in self.learned:
            sd[..., place] = each(name)
        for weights, names, places in self.weighted:
            made = weights(**{short: each(name) for short, name in names})
            for i, at in enumerate(places):
                if at is not None:
                    sd[..., at] *= np.broadcast_to(made, (*count, len(places)))[..., i, None]
        return sd


def coordinates(prior: Any, values: Float[np.ndarray, "b"]) -> Float[np.ndarray, "b"]:
    """Coordinates of a shape's values."""
    if isinstance(prior, LogNormal):
        return np.log(values / prior.median) / prior.sd
    if isinstance(prior, Normal):
        return (values - prior.mean) / prior.sd
    return np.array([prior.coordinate(float(one)) for one in values])
