"""Origin of outputs: a constant far larger than their noise is subtracted before anything is summed.

Of 10 MHz read to 2 mHz a double holds the noise to six digits, and sums of its squares hold nothing of it. A constant
of the model moves every reading alike: outputs and constant are counted from the same number, so that a residual keeps
its digits, and the number is put back where values leave.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._core.lazy_jax import jax, jnp
from bayescal._data.measurements import Measurements
from bayescal._inference.record import AFFINE, Record, record_of
from bayescal._model.effect import READING
from bayescal._model.frame import Reference, origins_of, reference_name
from bayescal._model.instrument import factor_of
from bayescal._model.model import Model
from bayescal._model.terms import ColumnSpec

RANGES = 4  # an origin is a multiple of so many output ranges, to a power of two


def with_origin(model: Model, readings: Measurements, reference: Reference) -> Reference:
    """Add the outputs' origins to a reference, where outputs are far from zero and the model has a constant.

    An origin is a multiple of a power of two no finer than the digits of the outputs, so that taking it off rounds
    nothing. Of three axes each has its own.
    """
    existing = origins_of(reference)
    plain = {name: v for name, v in reference.items() if name not in existing}
    far = {n: _nearest_origin(readings[n]) for n in model.instrument.outputs or ("output",)}
    if not any(far.values()):
        return plain
    pairs = {n: [*existing.get(reference_name(n), {}).items()] for n in far}
    names = {e.coefficient_name(i) for e in model.effects for i in range(len(e.coefficients))}
    if all(len(o) == 1 and o[0][0] in names and o[0][1] == far[n] for n, o in pairs.items()):
        return dict(reference)  # these readings' origins already, from a smaller model
    record = record_of(model.instrument, readings, plain)
    constants = [_constant_coefficient(model, record, i) for i in range(len(far))]
    if None in constants:
        return plain
    pairs = {reference_name(n): {c: o} for (n, o), c in zip(far.items(), constants, strict=True)}
    return {**plain, **pairs}  # pyright: ignore[reportReturnType]


def _nearest_origin(values: Float[np.ndarray, "n"]) -> float:
    """Return the multiple of a few ranges nearest to an output; zero for most."""
    step = 2.0 ** math.ceil(math.log2(RANGES * float(np.ptp(values)) or 1.0))
    return step * round(float(np.median(values)) / step)


def _constant_coefficient(model: Model, record: Record, output: int) -> str | None:
    """Find the coefficient of widest prior that shifts an output one to one in every reading; None if none."""
    instrument, sizes = model.instrument, dict[str, float]()
    for effect in model.effects:
        for i, c in enumerate(effect.coefficients):
            slot = c.slot or effect.slot
            if c.group_sd is not None or c.per == READING or effect.column_shapes:
                continue
            belong = c.per is None or (record.codes[c.per] >= 0).all()
            column = record.columns(ColumnSpec.from_effect(effect), ())[:, i]
            if belong and np.all(column == 1.0) and _has_unit_slope(record, slot, output):
                size = math.inf if c.flat else c.size * factor_of(instrument, effect, c)
                sizes[effect.coefficient_name(i)] = size
    return max(sizes, key=sizes.__getitem__) if sizes else None


def _has_unit_slope(record: Record, slot: str, output: int) -> bool:
    """Return whether an output's slope by a slot is one, and the other axes' zero, at random values."""
    vector, random = record.instrument.vector, np.random.default_rng(0)
    if slot not in record.slots:
        return False
    for _ in range(2):
        at = {name: random.standard_normal(record.size) for name in record.slots}
        if vector is None:
            slopes = record.respond(at, {})[1][slot][:, None]
        else:
            acting = random.standard_normal((record.size, 3))

            def respond(value: Any, at=at, acting=acting) -> Any:
                return vector.equation({**at, slot: value}, record.frame)(jnp.asarray(acting))

            slopes = np.asarray(jax.jvp(respond, (at[slot],), (np.ones(record.size),))[1])
        if not np.max(np.abs(slopes - np.eye(slopes.shape[1])[output])) <= AFFINE:
            return False
    return True
