"""Origin of outputs: a constant subtracted from outputs and model against cancellation in sums of squares.

At 10 MHz, read to 2 mHz, a double has six digits of the noise, and a sum of squared outputs has none. A constant
coefficient of the model shifts every reading equally: the same origin is subtracted from outputs and coefficient, so
that residuals keep their precision, and is added to reported values.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._core.lazy_jax import jax, jnp
from bayescal._data.measurements import Measurements
from bayescal._inference.record import AFFINE_TOLERANCE, Record, record_of
from bayescal._model.effect import READING
from bayescal._model.frame import Reference, origins_of, reference_name
from bayescal._model.instrument import factor_of
from bayescal._model.model import Model
from bayescal._model.terms import ColumnSpec

ORIGIN_STEP_RANGES = 4  # output ranges, rounded to a power of two, of which origins are multiples


def with_origin(model: Model, readings: Measurements, reference: Reference) -> Reference:
    """Add the outputs' origins to a reference, where outputs are far from zero and the model has a constant.

    An origin is a multiple of a power of two coarser than the outputs' last digits, so that its subtraction is exact.
    Each of three axes has one.
    """
    stored_origins = origins_of(reference)
    without_origins = {name: v for name, v in reference.items() if name not in stored_origins}
    far = {n: _nearest_origin(readings[n]) for n in model.instrument.outputs or ("output",)}
    if not any(far.values()):
        return without_origins
    origins = {n: [*stored_origins.get(reference_name(n), {}).items()] for n in far}
    names = {e.coefficient_name(i) for e in model.effects for i in range(len(e.coefficients))}
    if all(len(o) == 1 and o[0][0] in names and o[0][1] == far[n] for n, o in origins.items()):
        return dict(reference)  # these readings' origins already, from a smaller model
    record = record_of(model.instrument, readings, without_origins)
    constants = [_constant_coefficient(model, record, i) for i in range(len(far))]
    if None in constants:
        return without_origins
    origins = {reference_name(n): {c: o} for (n, o), c in zip(far.items(), constants, strict=True)}
    return {**without_origins, **origins}  # pyright: ignore[reportReturnType]


def _nearest_origin(output: Float[np.ndarray, "n"]) -> float:
    """Return the multiple of four output ranges nearest to the median output; usually zero."""
    step = 2.0 ** math.ceil(math.log2(ORIGIN_STEP_RANGES * float(np.ptp(output)) or 1.0))
    return step * round(float(np.median(output)) / step)


def _constant_coefficient(model: Model, record: Record, output: int) -> str | None:
    """Find the coefficient of widest prior that shifts an output one to one in every reading; None if none."""
    instrument, prior_sds = model.instrument, dict[str, float]()
    for effect in model.effects:
        for i, c in enumerate(effect.coefficients):
            slot = c.slot or effect.slot
            if c.group_sd is not None or c.per == READING or effect.column_shapes:
                continue
            in_every_reading = c.per is None or (record.codes[c.per] >= 0).all()
            column = record.columns(ColumnSpec.from_effect(effect), ())[:, i]
            if in_every_reading and np.all(column == 1.0) and _has_unit_slope(record, slot, output):
                prior_sd = math.inf if c.flat else c.size * factor_of(instrument, effect, c)
                prior_sds[effect.coefficient_name(i)] = prior_sd
    return max(prior_sds, key=prior_sds.__getitem__) if prior_sds else None


def _has_unit_slope(record: Record, slot: str, output: int) -> bool:
    """Return whether ∂output/∂slot is one, and zero for the other axes, at random values of all slots."""
    vector, random = record.instrument.vector, np.random.default_rng(0)
    if slot not in record.slots:
        return False
    for _ in range(2):
        slots = {name: random.standard_normal(record.size) for name in record.slots}
        if vector is None:
            jacobian = record.respond(slots, {})[1][slot][:, None]
        else:
            x = random.standard_normal((record.size, 3))

            def evaluate(value: Any, slots=slots, x=x) -> Any:
                return vector.equation({**slots, slot: value}, record.frame)(jnp.asarray(x))

            jacobian = np.asarray(jax.jvp(evaluate, (slots[slot],), (np.ones(record.size),))[1])
        if not np.max(np.abs(jacobian - np.eye(jacobian.shape[1])[output])) <= AFFINE_TOLERANCE:
            return False
    return True
