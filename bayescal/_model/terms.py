"""Terms of a model structure: its coefficients, the specification of their basis columns, and prior deviations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayescal._core.xp import xp
from bayescal._model.effect import Basis, Effect
from bayescal._model.frame import PATH
from bayescal._model.parameters import CoefficientBlock
from bayescal._model.prior import Known


class ColumnSpec(NamedTuple):
    """Specification of an effect's basis columns: the basis, its shapes, and corrections of its input columns.

    shapes: nonlinear parameters of the basis, then of the corrections. names, priors: name in φ and prior of each.
    """

    basis: Basis
    shapes: tuple[str, ...]
    names: tuple[str, ...]
    priors: tuple[Any, ...]
    corrections: tuple[Correction, ...] = ()

    def with_corrections(self, corrections: Sequence[Correction]) -> ColumnSpec:
        """Return a copy of the specification with corrected input columns."""
        specs = self, *(c.spec for c in corrections)
        fields = ("shapes", "names", "priors")
        joined_fields = {name: tuple(chain(*(getattr(s, name) for s in specs))) for name in fields}
        return self._replace(**joined_fields, corrections=tuple(corrections))

    def shift_paths(
        self, values: Sequence[Any], evaluate: Callable[[ColumnSpec, Sequence[Any]], Any]
    ) -> dict[str, Float[Any, "*b n"]]:
        """Return each corrected column's shift at values of the shapes; `evaluate` returns basis columns."""
        shifts, start = dict[str, Any](), len(self.basis_shapes)
        for c in self.corrections:
            stop = start + len(c.spec.shapes)
            column = c.factor * evaluate(c.spec, values[start:stop])[..., c.index]
            shifts[c.column + PATH], start = shifts.get(c.column + PATH, 0.0) + column, stop
        return shifts

    @property
    def basis_shapes(self) -> tuple[str, ...]:
        """Return the names of the shapes that are arguments of the basis."""
        return self.shapes[: len(self.shapes) - sum(len(c.spec.shapes) for c in self.corrections)]

    @property
    def key(self) -> Any:
        """Return a hashable key; specifications with equal keys have equal basis columns."""
        return self.basis, self.priors, self.corrections

    @classmethod
    def from_effect(cls, effect: Effect) -> ColumnSpec:
        shapes = effect.column_shapes
        basis = Basis(effect.basis, len(effect.coefficients), effect.name)
        names = tuple(map(effect.shape_name, shapes))
        return cls(basis, tuple(s.name for s in shapes), names, tuple(s.prior for s in shapes))


class Correction(NamedTuple):
    """Correction of a column at all readings: `factor` times a basis column of another effect."""

    column: str
    spec: ColumnSpec
    index: int
    factor: float

    @classmethod
    def from_block(cls, block: CoefficientBlock) -> Correction:
        spec = ColumnSpec.from_effect(block.effect)
        return cls(block.slot, spec, block.index, block.factor * block.value)


@dataclass(frozen=True)
class Term(CoefficientBlock):
    """One coefficient of a structure, for all its group members, with the specification of its basis columns."""

    columns: ColumnSpec  # specification of its effect's columns
    prior_sd: float  # prior standard deviation, coefficient's unit


def build_terms(
    blocks: Sequence[CoefficientBlock],
    source: Any = None,
    size_factors: Mapping[str, float] | None = None,
) -> tuple[tuple[Term, ...], tuple[str, ...]]:
    """Build the terms of a structure; return them, and the columns of the readings that some of them correct.

    A correction of a column with known coefficients (the temperature of a lagging body) is part of the other effects'
    column specifications, and not a term, if the response does not use the column; otherwise its slot is the column's
    `PATH`. source: column source; None: no corrections. size_factors: effect → factor of its prior sds.
    """
    correcting_blocks = [b for b in blocks if source is not None and b.slot not in source.slots]
    corrected_columns = tuple(dict.fromkeys(b.slot for b in correcting_blocks))
    correcting_effects = {b.effect.name for b in correcting_blocks}
    corrections: tuple[Correction, ...] = ()
    all_fixed = all(b.place == "fixed" and b.coefficient.per is None for b in correcting_blocks)
    if correcting_blocks and all_fixed and source.response_columns.isdisjoint(corrected_columns):
        corrections, corrected_columns = tuple(map(Correction.from_block, correcting_blocks)), ()
        blocks = [b for b in blocks if b.slot in source.slots]
    specs: dict[str, ColumnSpec] = {}
    for effect in {b.effect.name: b.effect for b in blocks}.values():
        candidates = () if effect.name in correcting_effects else corrections
        selection = [c for c in candidates if c.column in effect.columns]
        specs[effect.name] = ColumnSpec.from_effect(effect).with_corrections(selection)
    factors_by_effect = size_factors or {}

    def make_term(b: CoefficientBlock) -> Term:
        prior_sd = b.coefficient.size * factors_by_effect.get(b.effect.name, 1.0)
        corrects_path = b.slot in corrected_columns and isinstance(b.coefficient.prior, Known)
        slot = b.slot + PATH if corrects_path else b.slot
        return Term(**{**vars(b), "slot": slot}, columns=specs[b.effect.name], prior_sd=prior_sd)

    return tuple(map(make_term, blocks)), corrected_columns


class PriorDeviations:
    """Prior standard deviations of the coefficients x as a function of φ; 1 for a flat prior."""

    def __init__(self, terms: Sequence[Term], effects: Sequence[Effect], size: int):
        self.fixed_sd = np.ones(size)
        self.learned_sd_masks: dict[str, Float[np.ndarray, "p"]] = {}  # group_sd name → 0 or 1
        for term in terms:
            if term.group_sd_name is not None:
                mask = self.learned_sd_masks.setdefault(term.group_sd_name, np.zeros(size))
                mask[term.x_slice] = 1.0
            elif not term.flat:
                self.fixed_sd[term.x_slice] = term.prior_sd
        # Shape name → its effect, and the coefficient's index at each entry of x (−1: not of the effect).
        self.weights_by_shape: dict[str, tuple[Effect, Int[np.ndarray, "p"]]] = {}
        for effect in (e for e in effects if e.weights is not None):
            index = np.full(size, -1)
            for term in terms:
                if term.effect.name == effect.name:
                    index[term.x_slice] = term.index
            names = (f"{effect.name}.{name}" for name in effect.weight_shapes)
            self.weights_by_shape |= dict.fromkeys(names, (effect, index))

    def log_weights(self, name: str, hyper: Mapping[str, Any]) -> Float[np.ndarray, "p"]:
        """Return the log of the weights of one shape's effect (p,): factors of prior sds; 0 for others."""
        return np.log(np.maximum(self._evaluate_weights(name, hyper), 1e-300))

    def _evaluate_weights(
        self, name: str, hyper: Mapping[str, Any], batch: tuple[int, ...] = ()
    ) -> Any:
        effect, index = self.weights_by_shape[name]
        shapes = {shape: hyper[f"{effect.name}.{shape}"] for shape in effect.weight_shapes}
        weights = xp.broadcast_to(effect.weights(**shapes), (*batch, len(effect.coefficients)))
        return xp.where(index >= 0, weights[..., index], 1.0)

    def evaluate(self, hyper: Mapping[str, Any], batch: tuple[int, ...] = ()) -> Float[Any, "*b p"]:
        """Return the prior standard deviations of x at φ; with `batch` (b,) at b values of φ."""
        if batch:
            hyper = {name: np.reshape(value, (-1, 1)) for name, value in hyper.items()}
        # A fixed or learned standard deviation per coefficient, times the factors of effects with weights.
        sd = self.fixed_sd
        for name, mask in self.learned_sd_masks.items():
            sd = xp.where(mask > 0, hyper[name], sd)
        names = {effect.name: name for name, (effect, _) in self.weights_by_shape.items()}
        for name in names.values():
            sd = sd * self._evaluate_weights(name, hyper, batch)
        return xp.broadcast_to(sd, (*batch, len(self.fixed_sd)))
