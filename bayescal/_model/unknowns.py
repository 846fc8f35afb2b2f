"""Table of a model's unknowns: name, unit, effect, group member, index in x or φ, prior; and values from draws."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from bayescal._model.parameters import Layout, Levels, Unknown


@dataclass(frozen=True)
class Unknowns:
    """All unknowns of a model bound to readings: coefficients, noise parameters, between-group deviations, shapes."""

    layout: Layout
    rows: tuple[Unknown, ...]

    @classmethod
    def of(cls, layout: Layout, levels: Levels | None = None) -> Unknowns:
        """List the unknowns of a layout; group members are named by their labels in `levels`, otherwise by number."""
        rows = list[Unknown]()
        for b in (b for b in layout.blocks if b.place in ("x", "phi")):
            names, in_phi = b.member_names(levels), b.member_names()
            labels = (levels or {}).get(str(b.coefficient.per), range(b.size))
            for i, name in enumerate(names):
                at = {"x": b.start + i} if b.place == "x" else {"v": layout.index_in_phi[in_phi[i]]}
                fields = name, b.name, b.coefficient.unit, b.effect.name, "coefficient"
                rows.append(Unknown(*fields, **at, block=b, member=labels[i]))
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
        """Return name → index in the table."""
        return {u.name: i for i, u in enumerate(self.rows)}

    @cached_property
    def by_key(self) -> dict[str, slice]:
        """Return key → slice of its group members in the table."""
        slices: dict[str, slice] = {}
        for i, u in enumerate(self.rows):
            slices[u.key] = slice(slices[u.key].start if u.key in slices else i, i + 1)
        return slices

    def values(
        self, x: Float[np.ndarray, "*draws p"], v: Float[np.ndarray, "*draws d"]
    ) -> Float[np.ndarray, "*draws unknowns"]:
        """Convert posterior draws of x and v to values of all unknowns, in reported units."""
        phi = [np.asarray(h.prior.value(v[..., i])) for i, h in enumerate(self.layout.hypers)]
        fixed, phi_index = dict(self.layout.model.fixed), self.layout.index_in_phi
        table = np.empty((*np.shape(x)[:-1], len(self.rows)))
        for k, u in enumerate(self.rows):
            value = phi[u.v] if u.v is not None else x[..., u.x]
            if (b := u.block) is not None:
                value = b.origin + value
                if u.v is not None and (name := b.group_sd_name) is not None:
                    group_sd = fixed[name] if name in fixed else phi[phi_index[name]]
                    value = b.coefficient.mean + group_sd * value
            table[..., k] = value
        return table

    def select(self, values: Float[np.ndarray, "*draws unknowns"], name: str) -> np.ndarray:
        """Select the values of one unknown (…), or of all members of a group by their key (…, members)."""
        members = self.by_key.get(name)
        is_grouped = members is not None and self.rows[members.start].group is not None
        return values[..., members if is_grouped else self.index[name]]
