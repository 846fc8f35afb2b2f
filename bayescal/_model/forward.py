"""One composition, four readings of it: expected output and Jacobian, log density, simulation.

(The fourth, the NumPyro program, stands in `_inference/nuts.py`, because only there NumPyro is needed.)

Everything here is a pure JAX function of a `Layout` (static), a `Frame`, and values. Each reading's output
depends on that reading's own slots alone, so one forward derivative per slot gives the whole Jacobian.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal._model.frame import Frame
from bayescal._model.noise_law import in_time
from bayescal._model.parameters import CoefficientBlock, Layout

Values = dict[str, Float[Array, "..."]]


class Linearised(NamedTuple):
    """The expected output and its derivatives, at one point.

    mean (n,); jacobian by x (n, p); rows: by each coefficient that has one value per reading (n, k).
    """

    mean: Float[Array, "n"]
    jacobian: Float[Array, "n p"]
    rows: Float[Array, "n k"]


def hyper_values(layout: Layout, v: Float[Array, "d"]) -> Values:
    """The entries of φ at coordinate v, by name, in reported units; fixed ones included."""
    values = {h.name: h.prior.value(v[i]) for i, h in enumerate(layout.hypers)}
    return {**{name: jnp.asarray(value) for name, value in layout.model.fixed}, **values}


def hyper_log_prior(layout: Layout, v: Float[Array, "d"]) -> Float[Array, ""]:
    """Log prior density of φ in its coordinates."""
    return sum((h.prior.log_density(v[i]) for i, h in enumerate(layout.hypers)), jnp.zeros(()))


def prior_mean(layout: Layout) -> Float[Array, "p"]:
    return _fill(layout, [jnp.full(b.size, b.mean) for b in layout.x_blocks])


def prior_sd(
    layout: Layout, hyper: Values, flat: Float[Array, "p"] | float = 1.0
) -> Float[Array, "p"]:
    """Prior standard deviation of x given φ; where the prior is flat, the scale `flat` of its column."""
    flat = jnp.broadcast_to(jnp.asarray(flat), (layout.size,))
    parts = []
    for b in layout.x_blocks:
        if b.coefficient.group_sd is not None:
            sd = jnp.full(b.size, hyper[b.group_sd_name])
        elif b.coefficient.flat:
            sd = flat[b.start : b.start + b.size]
        else:
            sd = jnp.full(b.size, b.coefficient.size)
        if b.effect.weights is not None:
            named = {name: hyper[f"{b.effect.name}.{name}"] for name in b.effect.weight_shapes}
            count = len(b.effect.coefficients)
            sd = sd * jnp.broadcast_to(b.effect.weights(**named), (count,))[b.index]
        parts.append(sd)
    return _fill(layout, parts)


def prior_weight(layout: Layout) -> Float[Array, "p"]:
    """1 where the prior of x is proper, 0 where it is flat."""
    return _fill(
        layout, [jnp.full(b.size, 0.0 if b.coefficient.flat else 1.0) for b in layout.x_blocks]
    )


def row_sd(layout: Layout) -> Float[Array, "k"]:
    """Prior standard deviations of the coefficients that have one value per reading."""
    return jnp.asarray([b.coefficient.size for b in layout.row_blocks], dtype=float)


def _fill(layout: Layout, parts: list[Float[Array, "..."]]) -> Float[Array, "p"]:
    return jnp.concatenate(parts) if parts else jnp.zeros(0)


def coefficients(
    layout: Layout, x: Float[Array, "p"], rows: Float[Array, "n k"], hyper: Values
) -> Values:
    """The value of every coefficient by name, (size,) each, in its reported unit."""
    values, row = {}, 0
    for b in layout.blocks:
        if b.place == "fixed":
            values[b.name] = jnp.full(b.size, b.value)
        elif b.place == "x":
            values[b.name] = x[b.start : b.start + b.size]
        elif b.place == "row":
            values[b.name] = rows[:, row]
            row += 1
        else:
            value = jnp.stack([hyper[name] for name in b.member_names()])
            if b.coefficient.group_sd is not None:
                value = b.mean + hyper[b.group_sd_name] * value
            values[b.name] = value
    return values


def _members(block: CoefficientBlock, frame: Frame) -> Float[Array, "n m"]:
    """Which member of its group each reading belongs to, as an indicator matrix."""
    per = block.coefficient.per
    assert per is not None
    return jax.nn.one_hot(frame.codes[per], block.size, dtype=float)


def _columns(
    blocks: Iterable[CoefficientBlock], frame: Frame, hyper: Values, found: dict[int, Array]
) -> list[tuple[CoefficientBlock, Array]]:
    """The basis column of each block, in slot units per reported unit; `found` keeps the matrices by effect."""
    return [(b, _matrix(b, frame, hyper, found)[:, b.index] * b.factor) for b in blocks]


def _matrix(
    block: CoefficientBlock, frame: Frame, hyper: Values, found: dict[int, Array]
) -> Float[Array, "n p"]:
    """The basis of a block's effect, computed once for all its blocks."""
    effect = block.effect
    if id(effect) not in found:
        shapes = {s.name: hyper[effect.shape_name(s)] for s in effect.shapes}
        found[id(effect)] = effect.evaluate(frame, shapes)
    return found[id(effect)]


def _sums(
    terms: list[tuple[CoefficientBlock, Array]], values: Values, frame: Frame
) -> dict[str, Array]:
    sums: dict[str, Array] = {}
    for b, column in terms:
        value = values[b.name]
        if b.coefficient.per == "reading":
            share = column * value
        elif b.coefficient.per is None:
            share = column * value[0]
        else:
            share = column * (_members(b, frame) @ value)
        sums[b.slot] = sums.get(b.slot, jnp.zeros(frame.size)) + share
    return sums


def compose(
    layout: Layout,
    frame: Frame,
    values: Values,
    hyper: Values,
    push: Values,
    blocks: Sequence[CoefficientBlock] | None = None,
) -> tuple[Values, Frame, list[tuple[CoefficientBlock, Array]]]:
    """What the response is taken of: each slot's sum with `push` added, and the corrected readings; basis columns too.

    Effects that correct a column see the record, the others the corrected columns. All blocks act, or `blocks`.
    """
    acting = layout.blocks if blocks is None else blocks
    slots, zero = [s.name for s in layout.model.instrument.slots], jnp.zeros(frame.size)
    found: dict[int, Array] = {}
    correcting = _columns((b for b in acting if b.slot not in slots), frame, hyper, found)
    corrections = _sums(correcting, values, frame)
    corrected = frame
    for name in dict.fromkeys((*corrections, *(p for p in push if p not in slots))):
        shifted = frame[name] + corrections.get(name, zero) + push.get(name, zero)
        corrected = corrected.with_column(name, shifted)
    others = _columns((b for b in acting if b.slot in slots), corrected, hyper, found)
    sums = _sums(others, values, frame)
    filled = {name: sums.get(name, zero) + push.get(name, zero) for name in slots}
    return filled, corrected, [*correcting, *others]


def mean(
    layout: Layout, frame: Frame, x: Float[Array, "p"], rows: Float[Array, "n k"], hyper: Values
) -> Float[Array, "n"]:
    """Expected output, output unit."""
    slots, corrected, _ = compose(layout, frame, coefficients(layout, x, rows, hyper), hyper, {})
    return layout.model.instrument.response(slots, corrected)


def slot_derivatives(
    layout: Layout, frame: Frame, values: Values, hyper: Values, slots: tuple[str, ...]
) -> dict[str, Float[Array, "n"]]:
    """Derivative of the expected output by each of these slots, or columns, reading by reading."""
    instrument, (zero, one) = layout.model.instrument, (jnp.zeros(frame.size), jnp.ones(frame.size))
    filled, corrected, _ = compose(layout, frame, values, hyper, {})

    def by_column(name):
        def respond(push):  # a column changes what the effects make of it too
            return instrument.response(*compose(layout, frame, values, hyper, {name: push})[:2])

        return jax.jvp(respond, (zero,), (one,))[1]

    def respond(given):
        return instrument.response(given, corrected)

    if instrument.vector is not None:  # of thirty slots: back once, as in the fits
        by_slot = jax.vjp(respond, filled)[1](one)[0]
        return {s: by_slot[s] if s in filled else by_column(s) for s in slots}
    _, forth = jax.linearize(respond, filled)  # traced once, not with each slot
    still = dict.fromkeys(filled, zero)
    return {s: forth({**still, s: one}) if s in filled else by_column(s) for s in slots}


def linearise(
    layout: Layout, frame: Frame, x: Float[Array, "p"], rows: Float[Array, "n k"], hyper: Values
) -> Linearised:
    """Expected output and Jacobian at a point, output unit per reported unit."""
    values = coefficients(layout, x, rows, hyper)
    filled, corrected, columns = compose(layout, frame, values, hyper, {})
    output = layout.model.instrument.response(filled, corrected)
    terms = {b.name: column for b, column in columns}
    free = [b for b in layout.blocks if b.place in ("x", "row")]
    slots = sorted({b.slot for b in free})
    slopes = slot_derivatives(layout, frame, values, hyper, tuple(slots))
    stacked = jnp.stack([slopes[s] for s in slots], 1) if slots else jnp.zeros((frame.size, 0))
    jacobian = []
    for place in ("x", "row"):
        # Slopes are multiplied in all columns at once: in one after the other XLA compiles them into each.
        parts, of = [jnp.zeros((frame.size, 0))], []
        for b in (b for b in free if b.place == place):
            column = terms[b.name][:, None]
            alone = b.coefficient.per in (None, "reading")
            parts.append(column if alone else column * _members(b, frame))
            of += [slots.index(b.slot)] * parts[-1].shape[1]
        jacobian.append(jnp.concatenate(parts, 1) * stacked[:, np.array(of, int)])
    return Linearised(output, *jacobian)


def log_likelihood(
    layout: Layout,
    frame: Frame,
    y: Float[Array, "n"],
    x: Float[Array, "p"],
    rows: Float[Array, "n k"],
    hyper: Values,
) -> Float[Array, "n"]:
    """Log density of each reading given every unknown; in the order of time under correlated noise."""
    noise = layout.model.noise
    ordered, y, expected = in_time(noise, frame, y, mean(layout, frame, x, rows, hyper))
    return noise.log_density(y, expected, hyper, ordered)


def log_prior_x(
    layout: Layout, x: Float[Array, "p"], rows: Float[Array, "n k"], hyper: Values
) -> Float[Array, ""]:
    """Log prior density of x and of the per-reading coefficients given φ; flat ones count nothing."""
    sd, weight = prior_sd(layout, hyper), prior_weight(layout)
    z = (x - prior_mean(layout)) / sd
    own = -0.5 * jnp.sum(weight * (z**2 + 2 * jnp.log(sd) + jnp.log(2 * jnp.pi)))
    spread = row_sd(layout)
    zr = rows / spread
    return own - 0.5 * jnp.sum(zr**2 + 2 * jnp.log(spread) + jnp.log(2 * jnp.pi))


def draw_readings(
    layout: Layout, frame: Frame, x: Array, rows: Array, v: Array, key: Array
) -> Array:
    """Readings simulated by the model's own equation and noise."""
    hyper, noise = hyper_values(layout, v), layout.model.noise
    ordered, expected = in_time(noise, frame, mean(layout, frame, x, rows, hyper))
    drawn = noise.sample(key, expected, hyper, ordered)
    return drawn if noise.independent else jnp.zeros_like(drawn).at[frame.order].set(drawn)
