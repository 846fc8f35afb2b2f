"""The terms of a structure in plain data: one for each coefficient with all its members."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from bayescal._engine.record import ColumnsOf, Record
from bayescal._model.effect import Effect
from bayescal._model.parameters import CoefficientBlock


class Known(NamedTuple):
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

    @classmethod
    def of_block(cls, block: CoefficientBlock) -> Known:
        coefficient, effect = block.coefficient, block.effect
        return cls(
            effect=effect,
            of=effect.name,
            per=coefficient.per,
            mean=coefficient.mean,
            prior_sd=coefficient.size,
            flat=coefficient.flat,
            learned=coefficient.spread is not None,
            columns=ColumnsOf.of(effect),
            shape_names=tuple(effect.shape_name(s) for s in effect.column_shapes),
        )


class Term(NamedTuple):
    """One coefficient of the structure with all its members."""

    known: Known
    index: int
    slot: str
    size: int
    place: str
    factor: float
    value: float
    prior_sd: float
    spread_name: str | None
    members: tuple[str, ...]
    at: slice  # its entries of x

    @classmethod
    def of_block(cls, block: CoefficientBlock, record: Record, spread: Mapping[str, float]) -> Term:
        key = (id(block.effect), block.index)
        if key not in record.plain:
            record.plain[key] = Known.of_block(block)
        known: Known = record.plain[key]
        return cls(
            known=known,
            index=block.index,
            slot=block.slot,
            size=block.size,
            place=block.place,
            factor=block.factor,
            value=block.value,
            prior_sd=known.prior_sd * spread.get(known.of, 1.0),
            spread_name=block.spread_name if known.learned else None,
            members=tuple(block.member_names()) if block.place == "phi" else (),
            at=slice(block.start, block.start + block.size),
        )
