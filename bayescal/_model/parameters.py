"""Unknowns of a model, and their layout in two vectors: coefficients x (Gaussian given φ), hyper-parameters φ.

x holds the coefficients, in their reported units. φ holds noise parameters, standard deviations between group members,
nonlinear parameters (shapes), and coefficients *promoted* to φ because they multiply another unknown. Each entry of φ
has an unconstrained coordinate v. A coefficient with one value per reading is noise on an input (errors in variables):
fixed at its mean, it adds (∂output/∂input)²·sd² to the variance of its reading.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from bayescal._core.errors import ModelError
from bayescal._data.measurements import Measurements
from bayescal._model.effect import READING, Coefficient, Effect
from bayescal._model.frame import GROUPS, select_origins
from bayescal._model.instrument import compute_factor
from bayescal._model.model import Model
from bayescal._model.prior import Flat, FlatLine, Normal, Positive, compute_sd
from bayescal._model.static import static

Place = Literal["x", "input", "phi", "fixed"]  # the vector that holds a coefficient, or none
UnknownKind = Literal["coefficient", "noise", "group_sd", "shape", "promoted"]
NONLINEAR_KINDS: tuple[UnknownKind, ...] = ("shape", "promoted")  # the Jacobian depends on them
Levels = Mapping[str, Sequence[str]]  # group → labels of its members
NO_REFERENCE: Mapping[str, Any] = MappingProxyType({})


def name_member(name: str, member: object) -> str:
    """Return the name of one group member's coefficient, such as "bias.run(3)"."""
    return f"{name}({member})"


@dataclass(frozen=True)
class CoefficientBlock:
    """One coefficient of the model with all its group members, and its indices in x."""

    effect: Effect
    index: int  # among the coefficients of the effect
    name: str
    slot: str
    size: int  # number of group members, 1 without a group
    factor: float  # coefficient × basis column × factor is in the slot's unit
    place: Place
    start: int  # index of its first entry in x
    value: float  # fixed value, or prior mean, minus the origin
    origin: float  # subtracted from its values in x and φ, in its unit

    @property
    def mean(self) -> float:
        """Return the prior mean minus the origin, coefficient's unit."""
        return self.coefficient.mean - self.origin

    @property
    def coefficient(self) -> Coefficient:
        return self.effect.coefficients[self.index]

    @property
    def per(self) -> str | None:
        """Return the group with one coefficient per member; None for a single one, and for noise on an input."""
        return None if self.coefficient.per == READING else self.coefficient.per

    @property
    def flat(self) -> bool:
        return self.coefficient.flat

    @property
    def group_sd_name(self) -> str | None:
        """Return the name of the standard deviation between members; None if it is not estimated."""
        is_learned = self.coefficient.group_sd is not None
        return self.effect.group_sd_name(self.index) if is_learned else None

    @property
    def x_slice(self) -> slice:
        """Return the slice of the block's entries in x."""
        return slice(self.start, self.start + self.size)

    def member_names(self, levels: Levels | None = None) -> list[str]:
        """Return one name per group member, with its label in `levels`, or with its number if None, as in φ."""
        per = self.coefficient.per
        if per is None:
            return [self.name]
        members = (levels or {}).get(per, range(self.size))
        return [name_member(self.name, member) for member in members]


@dataclass(frozen=True)
class Unknown:
    """One scalar unknown of a model: an entry of x or of φ."""

    name: str  # full name with group member, such as "bias.run(3)"
    key: str  # common to all members of its group, "bias.run"
    unit: str  # unit of reported values
    effect: str  # name of the effect, or "noise"
    kind: UnknownKind  # "group_sd" also for an amplitude or a length scale of a Gaussian process
    prior: Positive | Normal | FlatLine | None = None  # prior of an entry of φ
    x: int | None = None  # index in x; None if it is in φ
    v: int | None = None  # index in φ; None if it is in x
    block: CoefficientBlock | None = None  # None if it is no coefficient
    member: object = None  # label of its group member, or its number where members have no labels

    @property
    def group(self) -> str | None:
        """Return the group to whose members the unknown belongs; None if there is a single value."""
        return None if self.block is None else self.block.coefficient.per

    @property
    def held(self) -> bool:
        """Return whether the unknown is a constant by definition."""
        return self.block is not None and self.block.index in self.block.effect.constant_indices

    @property
    def prior_sd(self) -> float | None:
        """Return the prior standard deviation, `unit`; None if the prior is flat, has no variance, or is estimated."""
        if self.block is None:
            return compute_sd(self.prior)
        c = self.block.coefficient
        is_learned = c.group_sd is not None or self.block.effect.weights is not None
        return None if c.flat or is_learned else c.size


@static
class Layout:
    """Layout of a model's unknowns for given group sizes; without arrays, so that equal layouts share a program."""

    model: Model
    counts: tuple[tuple[str, int], ...]  # (group, number of members)
    promoted: tuple[str, ...] = ()  # names of coefficients that are entries of φ
    # (coefficient, origin subtracted from outputs in the frame, output unit): the coefficient includes it
    origin: tuple[tuple[str, float], ...] = ()

    @cached_property
    def blocks(self) -> tuple[CoefficientBlock, ...]:
        counts, fixed, origins = dict(self.counts), dict(self.model.fixed), dict(self.origin)
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
                factor = compute_factor(self.model.instrument, effect, coefficient)
                origin = origins.pop(name, 0.0) / factor
                value = fixed.get(name, coefficient.mean) - origin
                fields = (size, factor, place, start, value, origin)
                blocks.append(CoefficientBlock(effect, index, name, slot.name, *fields))
                start += size if place == "x" else 0
        if origins:
            raise ModelError(
                f"outputs are relative to an origin included in {', '.join(origins)}, which the model lacks: "
                f"{', '.join(self.model.names)}"
            )
        return tuple(blocks)

    @property
    def x_blocks(self) -> tuple[CoefficientBlock, ...]:
        return tuple(b for b in self.blocks if b.place == "x")

    def repeat_over_x(self, values: Sequence[float]) -> Float[np.ndarray, "p"]:
        """Repeat one value per block over the block's entries of x (p,)."""
        return np.repeat(np.asarray(values, float), [b.size for b in self.x_blocks])

    @cached_property
    def mean_of_x(self) -> Float[np.ndarray, "p"]:
        """Return the prior means of the entries of x minus their origins (p,)."""
        return self.repeat_over_x([b.mean for b in self.x_blocks])

    @cached_property
    def weight_of_x(self) -> Float[np.ndarray, "p"]:
        """Return 1 where the prior of x is proper, 0 where it is flat (p,)."""
        return self.repeat_over_x([float(not b.flat) for b in self.x_blocks])

    @property
    def x_origins(self) -> Float[np.ndarray, "p"]:
        """Return the origin subtracted from each entry of x, in its unit (p,)."""
        return self.repeat_over_x([b.origin for b in self.x_blocks])

    @property
    def size(self) -> int:
        """Return the length of x."""
        return sum(b.size for b in self.x_blocks)

    @cached_property
    def hypers(self) -> tuple[Unknown, ...]:
        """Return the entries of φ in order: noise, group sds, shapes, promoted coefficients."""
        noise, fixed, unknowns = self.model.noise, dict(self.model.fixed), list[Unknown]()
        for name, prior in noise.parameters().items():
            unit = noise.unit(name, self.model.instrument.unit)
            unknowns.append(Unknown(name, name, unit, "noise", "noise", prior))
        for b in self.blocks:
            if (name := b.group_sd_name) is not None and b.place != "fixed":
                fields = b.coefficient.unit, b.effect.name, "group_sd", b.coefficient.group_sd
                unknowns.append(Unknown(name, name, *fields))
        for effect in self.model.effects:
            for shape in effect.shapes:
                kind = "group_sd" if shape.name in effect.weight_shapes else "shape"
                name = effect.shape_name(shape)
                unknowns.append(Unknown(name, name, shape.unit, effect.name, kind, shape.prior))
        for b in self.blocks:
            if b.place == "phi":
                fields = b.coefficient.unit, b.effect.name, "promoted", _promote_prior(b)
                unknowns += [Unknown(name, name, *fields) for name in b.member_names()]
        free_unknowns = (unknown for unknown in unknowns if unknown.name not in fixed)
        return tuple(replace(unknown, v=i) for i, unknown in enumerate(free_unknowns))

    def hyper(self, v: Float[Any, "d *b"]) -> dict[str, Float[Any, "*b"]]:
        """Return the values of hyper-parameters and fixed unknowns by name, reported units, at coordinates v of φ."""
        pairs = zip(self.hypers, v, strict=True)
        return dict(self.model.fixed) | {h.name: h.prior.value(c) for h, c in pairs}

    def log_prior(self, v: Float[Any, "d *b"]) -> Float[Any, "*b"]:
        """Return the log prior density of φ in its coordinates v, one number per set of coordinates."""
        pairs = zip(self.hypers, v, strict=True)
        return sum((h.prior.log_density(c) for h, c in pairs), np.zeros(v.shape[1:]))

    @cached_property
    def index_in_phi(self) -> dict[str, int]:
        """Return the index in φ of each unknown, by name."""
        return {h.name: i for i, h in enumerate(self.hypers)}

    def shared_indices(self, other: Layout) -> tuple[list[int], list[int]]:
        """Return the indices in this layout's x and φ of the unknowns that another layout also has."""
        shared = {b.name for b in other.x_blocks}
        shared_blocks = (b for b in self.x_blocks if b.name in shared)
        in_x = [i for b in shared_blocks for i in range(b.start, b.start + b.size)]
        return in_x, [i for name, i in self.index_in_phi.items() if name in other.index_in_phi]

    def phi_indices(self, *kinds: UnknownKind) -> list[int]:
        """Return the indices in φ of all entries of the given kinds."""
        return [i for i, h in enumerate(self.hypers) if h.kind in kinds]

    @property
    def nonlinear_phi(self) -> list[int]:
        """Return the indices in φ of the entries that the Jacobian of the expected output depends on."""
        return self.phi_indices(*NONLINEAR_KINDS)

    def promote(self, *names: str) -> Layout:
        return replace(self, promoted=(*self.promoted, *names))

    @property
    def is_improper(self) -> bool:
        """Return whether any prior is flat, hence improper: the evidence is then undefined."""
        is_flat = any(b.flat for b in self.blocks if b.place in ("x", "phi"))
        return is_flat or any(isinstance(h.prior, (Flat, FlatLine)) for h in self.hypers)


@dataclass(frozen=True)
class Unknowns:
    """All unknowns of a model for readings: coefficients, noise parameters, group standard deviations, shapes."""

    layout: Layout
    rows: tuple[Unknown, ...]

    @classmethod
    def of(cls, layout: Layout, levels: Levels | None = None) -> Unknowns:
        """List the unknowns of a layout; group members are named by their labels in `levels`, otherwise by number."""
        rows = list[Unknown]()
        for b in (b for b in layout.blocks if b.place in ("x", "phi")):
            names, phi_names, in_x = b.member_names(levels), b.member_names(), b.place == "x"
            labels = (levels or {}).get(str(b.coefficient.per), range(b.size))
            for i, name in enumerate(names):
                index = {"x": b.start + i} if in_x else {"v": layout.index_in_phi[phi_names[i]]}
                fields = name, b.name, b.coefficient.unit, b.effect.name, "coefficient"
                rows.append(Unknown(*fields, **index, block=b, member=labels[i]))
        rows += [h for h in layout.hypers if h.kind != "promoted"]
        return cls(layout, tuple(rows))

    def __iter__(self) -> Iterator[Unknown]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(u.name for u in self.rows)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(u.unit for u in self.rows)

    @cached_property
    def index(self) -> dict[str, int]:
        """Return the index of each unknown in the table, by name."""
        return {u.name: i for i, u in enumerate(self.rows)}

    @cached_property
    def by_key(self) -> dict[str, slice]:
        """Return the slice of the table with all group members of a key, such as "bias.run", by key."""
        slices: dict[str, slice] = {}
        for i, u in enumerate(self.rows):
            slices[u.key] = slice(slices[u.key].start if u.key in slices else i, i + 1)
        return slices

    def values(
        self, x: Float[np.ndarray, "*draws p"], v: Float[np.ndarray, "*draws d"]
    ) -> Float[np.ndarray, "*draws unknowns"]:
        """Convert posterior draws of x and v to values of all unknowns, in reported units."""
        hyper, phi = self.layout.hyper(np.moveaxis(v, -1, 0)), self.layout.hypers
        values = np.empty((*np.shape(x)[:-1], len(self.rows)))
        for k, u in enumerate(self.rows):
            value = hyper[phi[u.v].name] if u.v is not None else x[..., u.x]
            if (b := u.block) is not None:
                value = b.origin + value
                if u.v is not None and (name := b.group_sd_name) is not None:
                    value = b.coefficient.mean + hyper[name] * value
            values[..., k] = value
        return values

    def select(self, values: Float[np.ndarray, "*draws unknowns"], name: str) -> np.ndarray:
        """Select the values of one unknown (…), or of all members of a group by their key (…, members)."""
        members = self.by_key.get(name)
        is_grouped = members is not None and self.rows[members.start].group is not None
        return values[..., members if is_grouped else self.index[name]]


def _promote_prior(block: CoefficientBlock) -> Normal | FlatLine:
    c = block.coefficient
    if c.group_sd is not None:
        return Normal(0.0, 1.0)  # in units of the learned standard deviation
    return FlatLine(c.size) if c.flat else Normal(block.mean, c.size)


def bind(
    model: Model,
    readings: Measurements,
    extras: Iterable[Effect] = (),
    reference: Mapping[str, Any] = NO_REFERENCE,
) -> tuple[Layout, dict[str, tuple[str, ...]]]:
    """Return the layout of the model's unknowns for these readings, and the members of each group.

    extras: effects that may be added later, whose groups are included. reference: reference constants.

    Raises:
        ModelError: too few readings for the flat priors, a group without members, or the noise law does not apply.
    """
    extra_groups = (
        c.per for effect in extras for c in effect.coefficients if c.per not in (None, READING)
    )
    groups = dict.fromkeys((*GROUPS, *model.groups, *map(str, extra_groups)))
    available = {group for group in groups if group in GROUPS or readings.has(group)}
    levels = {group: readings.groups(group)[0] if group in available else () for group in groups}
    counts = {group: len(names) for group, names in levels.items()}
    origin = {name: o for terms in select_origins(reference).values() for name, o in terms.items()}
    layout = Layout(model, tuple(counts.items()), origin=tuple(origin.items()))
    flat_count = sum(b.size for b in layout.x_blocks if b.coefficient.flat)
    if len(readings) <= flat_count:
        raise ModelError(
            f"{readings.file} has {len(readings)} readings for {flat_count} coefficients with a flat prior: "
            "measure more, remove effects, or give them a Normal prior"
        )
    input_effects = [b.effect.name for b in layout.blocks if b.place == "input"]
    if not model.noise.independent and input_effects:
        raise ModelError(
            f"Effect {input_effects[0]!r} is noise on an input of each reading, which cannot be combined with "
            f"{model.noise.law} noise: remove the effect, or use White() noise"
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
                f"{readings.file} has none: name them in a column, or remove the effect"
            )
    return layout, levels
