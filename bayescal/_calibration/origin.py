"""What outputs are counted from: a constant far larger than their noise is taken off before anything is summed.

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
from bayescal._model.frame import Reference, origins, reference_name
from bayescal._model.instrument import factor_of
from bayescal._model.model import Model
from bayescal._model.terms import ColumnsOf

RANGES = 4  # of the output, to a power of two, that an origin is a multiple of: others lie about zero already


def with_origin(model: Model, readings: Measurements, reference: Reference) -> Reference:
    """The reference with what outputs are counted from, where they lie far from zero and the model has a constant.

    An origin is a multiple of a power of two no finer than the digits of the outputs, so that taking it off rounds
    nothing. Of three axes each has its own.
    """
    known = origins(reference)
    plain = {name: v for name, v in reference.items() if name not in known}
    far = {n: _far(readings[n]) for n in model.instrument.outputs or ("output",)}
    if not any(far.values()):
        return plain
    own = {n: [*known.get(reference_name(n), {}).items()] for n in far}
    there = {e.coefficient_name(i) for e in model.effects for i in range(len(e.coefficients))}
    if all(len(o) == 1 and o[0][0] in there and o[0][1] == far[n] for n, o in own.items()):
        return dict(reference)  # of these readings, as a smaller model was counted from
    record = record_of(model.instrument, readings, plain)
    constants = [_constant(model, record, i) for i in range(len(far))]
    if None in constants:
        return plain
    own = {reference_name(n): {c: o} for (n, o), c in zip(far.items(), constants, strict=True)}
    return {**plain, **own}  # pyright: ignore[reportReturnType]


def _far(values: Float[np.ndarray, "n"]) -> float:
    """The multiple of a few ranges of an output that is nearest to it; zero for most."""
    step = 2.0 ** math.ceil(math.log2(RANGES * float(np.ptp(values)) or 1.0))
    return step * round(float(np.median(values)) / step)


def _constant(model: Model, record: Record, output: int) -> str | None:
    """The coefficient of the widest prior that moves an output by itself in every reading, whatever all else is."""
    instrument, found = model.instrument, dict[str, float]()
    for effect in model.effects:
        for i, c in enumerate(effect.coefficients):
            slot = c.slot or effect.slot
            if c.group_sd is not None or c.per == READING or effect.column_shapes:
                continue
            belong = c.per is None or (record.codes[c.per] >= 0).all()
            column = record.columns(ColumnsOf.of(effect), ())[:, i]
            if belong and np.all(column == 1.0) and _moves_it_alone(record, slot, output):
                size = math.inf if c.flat else c.size * factor_of(instrument, effect, c)
                found[effect.coefficient_name(i)] = size
    return max(found, key=found.__getitem__) if found else None


def _moves_it_alone(record: Record, slot: str, output: int) -> bool:
    """Whether an output has the slope one by a slot, and of three axes the others none, at random values of all."""
    vector, random = record.instrument.vector, np.random.default_rng(0)
    if slot not in record.slots:
        return False
    for _ in range(2):
        at = {name: random.standard_normal(record.size) for name in record.slots}
        if vector is None:
            slopes = record.respond(at, {})[1][slot][:, None]
        else:
            acting = random.standard_normal((record.size, 3))

            def respond(own: Any, at=at, acting=acting) -> Any:
                return vector.equation({**at, slot: own}, record.frame)(jnp.asarray(acting))

            slopes = np.asarray(jax.jvp(respond, (at[slot],), (np.ones(record.size),))[1])
        if not np.max(np.abs(slopes - np.eye(slopes.shape[1])[output])) <= AFFINE:
            return False
    return True
