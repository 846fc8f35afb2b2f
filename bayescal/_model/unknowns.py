"""One table of a model's unknowns: name, unit, effect, group member, place in x or φ, prior; and values from draws."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float

from bayescal._model.parameters import CoefficientBlock, Hyper, Layout, Levels
from bayescal._model.prior import deviation


@dataclass(frozen=True)
class Unknown:
    """One scalar unknown.

    Attributes:
        name: its own, with its group member, such as "bias.run(3)".
        key: name that it shares with the other members of its group, "bias.run".
        unit: in which it is reported.
        effect: name of its effect, or "noise".
        kind: what it is.
        x: index in x; None where it stands in φ.
        v: index in φ; None where it stands in x.
        block: the coefficient, where it is one.
        hyper: the entry of φ, where it is none.
        member: label of its group member, or its number where members have no labels.
    """

    name: str
    key: str
    unit: str
    effect: str
    kind: Literal["coefficient", "noise", "group_sd", "shape", "promoted"]
    x: int | None = None
    v: int | None = None
    block: CoefficientBlock | None = None
    hyper: Hyper | None = None
    member: object = None

    @property
    def group(self) -> str | None:
        """The group of which it is one member's; None for one value."""
        return None if self.block is None else self.block.coefficient.per

    @property
    def held(self) -> bool:
        """Whether it is a number by definition."""
        return self.block is not None and self.block.index in self.block.effect.held

    @property
    def prior_sd(self) -> float | None:
        """Prior standard deviation, `unit`; None where the prior is flat, learned, or has no variance."""
        if self.hyper is not None:
            return deviation(self.hyper.prior)
        assert self.block is not None
        c = self.block.coefficient
        learned = c.group_sd is not None or self.block.effect.weights is not None
        return None if c.flat or learned else c.size


@dataclass(frozen=True)
class Unknowns:
    """All unknowns of a model bound to readings: coefficients, member by member, then noise, spreads and shapes."""

    layout: Layout
    rows: tuple[Unknown, ...]

    @classmethod
    def of(cls, layout: Layout, levels: Levels | None = None) -> Unknowns:
        """The unknowns of a layout, group members by their labels in `levels`, or else by number."""
        rows = list[Unknown]()
        for b in (b for b in layout.blocks if b.place in ("x", "phi")):
            names, in_phi = b.member_names(levels), b.member_names()
            labels = (levels or {}).get(str(b.coefficient.per), range(b.size))
            for i, name in enumerate(names):
                at = {"x": b.start + i} if b.place == "x" else {"v": layout.index_in_phi[in_phi[i]]}
                own = name, b.name, b.coefficient.unit, b.effect.name, "coefficient"
                rows.append(Unknown(*own, **at, block=b, member=labels[i]))
        for i, h in enumerate(layout.hypers):
            if h.kind != "promoted":
                rows.append(Unknown(h.name, h.name, h.unit, h.effect, h.kind, v=i, hyper=h))
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
        """Index by name."""
        return {u.name: i for i, u in enumerate(self.rows)}

    @cached_property
    def by_key(self) -> dict[str, slice]:
        """Where the members of each key are."""
        found: dict[str, slice] = {}
        for i, u in enumerate(self.rows):
            found[u.key] = slice(found[u.key].start if u.key in found else i, i + 1)
        return found

    def values(
        self, x: Float[np.ndarray, "*draws p"], v: Float[np.ndarray, "*draws d"]
    ) -> Float[np.ndarray, "*draws unknowns"]:
        """Return the values of draws, in reported units."""
        phi = [np.asarray(h.prior.value(v[..., i])) for i, h in enumerate(self.layout.hypers)]
        fixed, at = dict(self.layout.model.fixed), self.layout.index_in_phi
        found = np.empty((*np.shape(x)[:-1], len(self.rows)))
        for k, u in enumerate(self.rows):
            value = phi[u.v] if u.v is not None else x[..., u.x]
            if (b := u.block) is not None:
                value = b.origin + value
                if u.v is not None and (name := b.group_sd_name) is not None:
                    value = (
                        b.coefficient.mean
                        + (fixed[name] if name in fixed else phi[at[name]]) * value
                    )
            found[..., k] = value
        return found

    def select(self, values: Float[np.ndarray, "*draws unknowns"], name: str) -> np.ndarray:
        """Return the values of a key or of one unknown: (…) of one value, (…, members) of a group."""
        own = self.by_key.get(name)
        grouped = own is not None and self.rows[own.start].group is not None
        return values[..., own if grouped else self.index[name]]
