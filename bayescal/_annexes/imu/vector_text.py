"""A correction of three axes as JSON, which is read back, and by templates as C99 and Python: these hold all of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayescal import InputError
from bayescal._annexes.imu.vector_correction import NEWTON_STEPS, SIZES, VectorCorrection
from bayescal._use.compensation_program import AGAIN
from bayescal.workshop import (
    as_type,
    c_comment,
    code_template,
    include_guard,
    kept_why,
    python_words,
)

PACKAGE = "bayescal._annexes.imu"  # whose templates these are


@dataclass(frozen=True)
class SavedCorrection:
    """What the JSON of a correction of three axes holds."""

    made_by: str
    calibration: str
    instrument: str
    outputs: tuple[str, str, str]
    unit: str
    equation: str
    order_of_terms: str
    reference_degC: float
    temperatures_degC: tuple[float, float] | None
    reach: float
    terms: list[list[float]]
    covariance: list[list[float]]
    noise: float
    notes: tuple[str, ...]
    beside: tuple[str, ...] = ()
    why_not: str = ""
    axes_of: str = ""
    covariance_with_axes_of: list[list[float]] | None = None


def vector_from_data(found: Any, file: str) -> VectorCorrection:
    """A correction of three axes from JSON.

    Raises:
        InputError: it is none, or damaged.
    """
    try:
        saved = as_type(found, SavedCorrection)
        terms, covariance = (np.array(a, dtype=float) for a in (saved.terms, saved.covariance))
        shared = saved.covariance_with_axes_of
        shared = None if shared is None else np.array(shared, dtype=float)
        fits = terms.ndim == 2 and terms.shape[1] - 9 * bool(saved.beside) in SIZES
        if not fits or covariance.shape != 2 * (terms.size,):
            shapes = f"{terms.shape} with a covariance of shape {covariance.shape}"
            raise ValueError(f"terms of shape {shapes}")
    except ValueError as error:
        raise InputError(f"{file} is damaged: {error}. {AGAIN}") from None
    low, high = saved.temperatures_degC or (None, None)
    return VectorCorrection(
        outputs=saved.outputs,
        unit=saved.unit,
        reference=saved.reference_degC,
        low=low,
        high=high,
        terms=terms,
        covariance=covariance,
        noise=saved.noise,
        notes=saved.notes,
        source=saved.calibration,
        beside=saved.beside,
        instrument=saved.instrument,
        reach=saved.reach,
        axes_of=saved.axes_of,
        shared=shared,
        against=kept_why(found),
    )


def headers(named: Mapping[str, VectorCorrection], uncertainty: bool) -> str:
    """Corrections as C99, one after the other."""
    return "\n".join(_header(name, c, uncertainty) for name, c in named.items())


def _header(name: str, c: VectorCorrection, uncertainty: bool) -> str:
    return code_template("vector.h.jinja", {"comment": c_comment}, package=PACKAGE).render(
        c=c,
        name=name,
        guard=include_guard(
            name, c.terms.tolist(), c.covariance.tolist(), c.reference, c.low, c.high, uncertainty
        ),
        uncertainty=uncertainty,
        recorded=c.low is not None,
        thermal=len(c.terms) > 1,
        # Twelve numbers, and no equation to solve.
        plain=not uncertainty and c.terms.shape == (1, 12),
        inverse=np.linalg.inv(c.matrix).tolist(),
        newton=1 if c.order == 1 else NEWTON_STEPS,
    )


def module(named: Mapping[str, VectorCorrection], uncertainty: bool) -> str:
    """Corrections as one Python module."""
    held = {n: c.data() for n, c in named.items()}
    for one in () if uncertainty else held.values():
        del one["covariance"]
        one.pop("covariance_with_axes_of", None)
    return code_template("vector.py.jinja", {"comment": python_words}, package=PACKAGE).render(
        named=named,
        data={n: repr(one) for n, one in held.items()},
        uncertainty=uncertainty,
        newton=NEWTON_STEPS,
    )
