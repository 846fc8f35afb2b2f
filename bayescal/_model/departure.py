"""The smooth departure of a real law from the form of a named effect: tied to it in size, and orthogonal to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bayescal._core.jit import given
from bayescal._model.effect import Effect, Shape, matrix
from bayescal._model.static import static
from bayescal._model.unknown_effect import (
    process_along,
    process_sizes,
    resolution,
    standard_normals,
)

PARTS = (0.01, 0.3)  # of what a named effect contributes, by which a real law departs from its form
DIGITS = 6  # of its numbers: enough for any reading, and the same once saved

Basis = tuple[Callable[..., Any], int, str]  # with the number of its columns, and whose it is
Rows = tuple[tuple[float, ...], ...]


@static
class Departure(Effect):
    """A Gaussian process along a covariate of a named effect, less what this effect's own columns would take of it.

    Attributes:
        of: the named effect.
        size: amplitude of a process of which as much is left, beside the rest of the model, as the effect contributes.
        at: shapes at which the effect's columns are taken.
        shares: of each of these columns in each of the process's, (p, terms).
        own, curves: basis of the effect, and of the process.
    """

    of: str = ""
    size: float = 0.0
    at: tuple[tuple[str, float], ...] = ()
    shares: Rows = ()
    own: Basis | None = None
    curves: Basis | None = None


def departure(
    of: Effect, unit: str, size: float, at: tuple[tuple[str, float], ...], shares: Rows
) -> Departure:
    """The departure of an effect.

    Args:
        of: the named effect.
        unit: of its slot.
        size, at, shares: see `Departure`.
    """
    covariate, curves = of.departs_along, curves_along(of)
    terms, lengths = resolution(covariate in ("time", "elapsed"))
    own, size = (of.basis, len(of.coefficients), of.name), rounded(size)
    amplitude = Shape("amplitude", unit, low=PARTS[0] * size, high=PARTS[1] * size)
    return Departure(
        f"departure({of.name})",
        of.slot,
        given(_beside, curves[0], own, at, shares),
        coefficients=standard_normals(unit, terms),
        shapes=(Shape("length", "1", *lengths), amplitude),
        weights=given(process_sizes, terms),
        measure="amplitude",
        columns=of.columns,
        varies=of.varies,
        equation=f"f({covariate}),  f a Gaussian process orthogonal to {of.name}",
        source="ours: real laws depart a little from their forms",
        along=covariate,
        of=of.name,
        size=size,
        at=at,
        shares=shares,
        own=own,
        curves=curves,
    )


def curves_along(of: Effect) -> Basis:
    """The process along an effect's covariate, as the placeholder for that covariate has it."""
    covariate = of.departs_along
    terms, _ = resolution(covariate in ("time", "elapsed"))
    return given(process_along, covariate, terms), terms, f"unknown({covariate})"


def rounded(value: float) -> float:
    """A number as it is kept."""
    return float(f"{value:.{DIGITS}g}")


def _beside(
    curves: Callable[..., Any], own: Basis, at: tuple[tuple[str, float], ...], shares: Rows, r: Any
) -> Any:
    """The process less what the effect's columns take of it; the same of whatever size."""
    return curves(r) - matrix(*own, r, dict(at)) @ np.array(shares)
