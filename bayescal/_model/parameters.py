"""Layout of a model's unknowns: in the Gaussian vector x, or in φ.

x holds the coefficients, in their reported units. φ holds what the model is not Gaussian in: noise, learned spreads,
shapes, and coefficients *promoted* because their product with another unknown matters. Each entry of φ has a coordinate
v on the whole line. A coefficient with one value per reading is no unknown but noise on an input: it stands at its
mean, and widens the variance of its reading by the square of the slope.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import ModelError
from bayescal._data.measurements import Measurements
from bayescal._model.effect import READING, Coefficient, Effect
from bayescal._model.frame import GROUPS, origins
from bayescal._model.instrument import factor_of
from bayescal._model.model import Model
from bayescal._model.prior import Flat, FlatLine, Normal, Positive, deviation
from bayescal._model.static import static

Place = Literal["x", "input", "phi", "fixed"]
UnknownKind = Literal["coefficient", "noise", "group_sd", "shape", "promoted"]
MOVING: tuple[UnknownKind, ...] = ("shape", "promoted")  # the output's Jacobian depends on them
Levels = Mapping[str, Sequence[str]]  # the members of each group
NO_REFERENCE: Mapping[str, Any] = MappingProxyType({})


def member_name(name: str, member: object) -> str:
    """Return the name of one member's coefficient."""
    return f"{name}({member})"


@dataclass(frozen=True)
class CoefficientBlock:
    """One coefficient of the model, with all its group members."""

    effect: Effect
    index: int
    name: str
    slot: str
    size: int
    factor: float
    place: Place
    start: int
    value: float
    origin: float  # what its values are counted from in x and φ, in its unit

    @property
    def mean(self) -> float:
        """Return the mean of its prior, counted from its origin."""
        return self.coefficient.mean - self.origin

    @property
    def coefficient(self) -> Coefficient:
        return self.effect.coefficients[self.index]

    @property
    def per(self) -> str | None:
        """Return the group whose members have one each; None for one value, and for noise on an input."""
        return None if self.coefficient.per == READING else self.coefficient.per

    @property
    def flat(self) -> bool:
        return self.coefficient.flat

    @property
    def group_sd_name(self) -> str | None:
        """Return the name of its learned standard deviation between members; None where there is none."""
        learned = self.coefficient.group_sd is not None
        return self.effect.group_sd_name(self.index) if learned else None

    @property
    def at(self) -> slice:
        """Return its entries of x."""
        return slice(self.start, self.start + self.size)

    def member_names(self, levels: Levels | None = None) -> list[str]:
        """Return the names of its entries, each after its member; by number, as in φ, where members have no names."""
        per = self.coefficient.per
        if per is None:
            return [self.name]
        members = (levels or {}).get(per, range(self.size))
        return [member_name(self.name, member) for member in members]


@dataclass(frozen=True)
class Unknown:
    """One scalar unknown."""

    name: str  # its own, with its group member, such as "bias.run(3)"
    key: str  # name that it shares with the other members of its group, "bias.run"
    unit: str  # in which it is reported
    effect: str  # name of its effect, or "noise"
    # what it is; the amplitude and the length of an unknown function are spreads of its coefficients
    kind: UnknownKind
    prior: Positive | Normal | FlatLine | None = None  # of an entry of φ, in its coordinate
    x: int | None = None  # index in x; None where it stands in φ
    v: int | None = None  # index in φ; None where it stands in x
    block: CoefficientBlock | None = None  # the coefficient, where it is one
    member: object = None  # label of its group member, or its number where members have no labels

    @property
    def group(self) -> str | None:
        """Return the group of its member; None for one value."""
        return None if self.block is None else self.block.coefficient.per

    @property
    def held(self) -> bool:
        """Return whether it is a number by definition."""
        return self.block is not None and self.block.index in self.block.effect.held

    @property
    def prior_sd(self) -> float | None:
        """Return the prior standard deviation, `unit`; None where the prior is flat, learned, or has no variance."""
        if self.block is None:
            return deviation(self.prior)
        c = self.block.coefficient
        learned = c.group_sd is not None or self.block.effect.weights is not None
        return None if c.flat or learned else c.size


@static
class Layout:
    """A model bound to group sizes. It has no arrays: equal layouts share one compiled program."""

    model: Model  # the model
    counts: tuple[tuple[str, int], ...]  # (group, number of members)
    promoted: tuple[str, ...] = ()  # names of coefficients that stand in φ
    # (coefficient, what outputs are counted from in the frame, output unit): it takes that back
    origin: tuple[tuple[str, float], ...] = ()

    @cached_property
    def blocks(self) -> tuple[CoefficientBlock, ...]:
        counts, fixed, above = dict(self.counts), dict(self.model.fixed), dict(self.origin)
        blocks, start = [], 0
        for effect in self.model.effects:
            for index, coefficient in enumerate(effect.coefficients):
                name = effect.coefficient_name(index)
                slot = self.model.instrument.slot(coefficient.slot or effect.slot)
                place: Place = "x"
                if name in fixed or coefficient.known:
                    place = "fixed"
                elif coefficient.per == READING:
                    place = "input"
                elif name in self.promoted:
                    place = "phi"
                size = 1 if coefficient.per in (None, READING) else counts[coefficient.per]
                factor = factor_of(self.model.instrument, effect, coefficient)
                origin = above.pop(name, 0.0) / factor
                value = fixed.get(name, coefficient.mean) - origin
                stands = (size, factor, place, start, value, origin)
                blocks.append(CoefficientBlock(effect, index, name, slot.name, *stands))
                start += size if place == "x" else 0
        if above:
            raise ModelError(
                f"outputs are counted from what {', '.join(above)} takes back, which is not in the model: "
                f"{', '.join(self.model.names)}"
            )
        return tuple(blocks)

    @property
    def x_blocks(self) -> tuple[CoefficientBlock, ...]:
        return tuple(b for b in self.blocks if b.place == "x")

    def of_x(self, values: Sequence[float]) -> Float[np.ndarray, "p"]:
        """Repeat one value for each block in x over the entries of x (p,)."""
        return np.repeat(np.asarray(values, float), [b.size for b in self.x_blocks])

    @property
    def origin_of_x(self) -> Float[np.ndarray, "p"]:
        """Return the origins from which the entries of x are counted, in their units."""
        return self.of_x([b.origin for b in self.x_blocks])

    @property
    def size(self) -> int:
        """Return the length of x."""
        return sum(b.size for b in self.x_blocks)

    @cached_property
    def hypers(self) -> tuple[Unknown, ...]:
        """Return the entries of φ in order: noise, spreads, shapes, promoted coefficients."""
        unit, fixed = self.model.instrument.unit, dict(self.model.fixed)
        rows: list[tuple[str, str, Any, UnknownKind, str]] = []  # name, unit, prior, kind, effect
        for name, prior in self.model.noise.parameters().items():
            rows.append((name, self.model.noise.unit(name, unit), prior, "noise", "noise"))
        for block in self.blocks:
            c = block.coefficient
            if (name := block.group_sd_name) is not None and block.place != "fixed":
                rows.append((name, c.unit, c.group_sd, "group_sd", block.effect.name))
        for effect in self.model.effects:
            for shape in effect.shapes:
                kind = "group_sd" if shape.name in effect.weight_shapes else "shape"
                row = shape.unit, shape.prior, kind, effect.name
                rows.append((effect.shape_name(shape), *row))
        for block in self.blocks:
            if block.place == "phi":
                row = block.coefficient.unit, _promoted_prior(block), "promoted", block.effect.name
                rows += [(name, *row) for name in block.member_names()]
        free = (row for row in rows if row[0] not in fixed)
        return tuple(
            Unknown(name, name, unit, effect, kind, prior, v=i)
            for i, (name, unit, prior, kind, effect) in enumerate(free)
        )

    @cached_property
    def index_in_phi(self) -> dict[str, int]:
        """Return the index in φ by name."""
        return {h.name: i for i, h in enumerate(self.hypers)}

    def entries_in(self, other: Layout) -> tuple[list[int], list[int]]:
        """Return the indices in x and in φ of the entries that another layout has too."""
        shared = {b.name for b in other.x_blocks}
        shared_blocks = (b for b in self.x_blocks if b.name in shared)
        in_x = [i for b in shared_blocks for i in range(b.start, b.start + b.size)]
        return in_x, [i for name, i in self.index_in_phi.items() if name in other.index_in_phi]

    def positions(self, *kinds: UnknownKind) -> list[int]:
        """Return the indices in φ of the entries of these kinds."""
        return [i for i, h in enumerate(self.hypers) if h.kind in kinds]

    @property
    def moving(self) -> list[int]:
        """Return the indices in φ of the entries that the expected output's Jacobian depends on."""
        return self.positions(*MOVING)

    def promote(self, *names: str) -> Layout:
        return replace(self, promoted=(*self.promoted, *names))

    @property
    def improper(self) -> bool:
        """Return whether some prior is flat, so that the evidence is not defined."""
        flat = any(b.coefficient.flat for b in self.blocks if b.place in ("x", "phi"))
        return flat or any(isinstance(h.prior, (Flat, FlatLine)) for h in self.hypers)


def _promoted_prior(block: CoefficientBlock) -> Normal | FlatLine:
    c = block.coefficient
    if c.group_sd is not None:
        return Normal(0.0, 1.0)  # in units of its learned spread
    return FlatLine(c.size) if c.flat else Normal(block.mean, c.size)


def bind(
    model: Model,
    readings: Measurements,
    more: Iterable[Effect] = (),
    reference: Mapping[str, Any] = NO_REFERENCE,
) -> tuple[Layout, dict[str, tuple[str, ...]]]:
    """Lay out the model's unknowns for these readings; return the layout and the members of each group.

    Groups of effects that may be added (`more`) are counted too; outputs are counted from the reference's origins.

    Raises:
        ModelError: fewer readings than flat coefficients, or a group effect without its group.
    """
    further = (
        c.per for effect in more for c in effect.coefficients if c.per not in (None, READING)
    )
    groups = dict.fromkeys((*GROUPS, *model.groups, *map(str, further)))
    present = {group for group in groups if group in GROUPS or readings.has(group)}
    levels = {group: readings.groups(group)[0] if group in present else () for group in groups}
    counts = {group: len(names) for group, names in levels.items()}
    origin = {name: o for terms in origins(reference).values() for name, o in terms.items()}
    layout = Layout(model, tuple(counts.items()), origin=tuple(origin.items()))
    flat = sum(b.size for b in layout.x_blocks if b.coefficient.flat)
    if len(readings) <= flat:
        raise ModelError(
            f"{readings.file} has {len(readings)} readings for {flat} coefficients with a flat prior: "
            "measure more, take effects out, or give them a Normal prior"
        )
    noisy = [b.effect.name for b in layout.blocks if b.place == "input"]
    if not model.noise.independent and noisy:
        raise ModelError(
            f"Effect {noisy[0]!r} is noise on an input of each reading, which is not combined with "
            f"{model.noise.law} noise: take the effect out, or use White() noise"
        )
    if not model.noise.independent and not readings.has("time"):
        raise ModelError(
            f"{model.noise.law} noise needs the column 'time', which {readings.file} lacks: record it, or use "
            "White() noise"
        )
    for b in layout.blocks:
        if b.size == 0:
            raise ModelError(
                f"Effect {b.effect.name!r} has one coefficient for each {b.coefficient.per}, and "
                f"{readings.file} has none: name them in a column, or take the effect out"
            )
    return layout, levels
