"""Compiled JAX programs of a non-affine instrument response and its derivatives.

Programs are independent of a model's effects, so that a search over structures compiles nothing. Records are padded to
a few lengths by repeating the last reading, so that records of similar length share programs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.jit import compile_lazily
from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._model.composition import differentiate_response
from bayescal._model.frame import Frame

LENGTH_RATIO = 1.25  # ratio of successive padded lengths
MIN_PADDED_LENGTH = 32  # smallest padded length
# Number of readings at which the run time outweighs twice the compile time.
MIN_OPTIMISED_READINGS = 2000


def padded_length(size: int) -> int:
    """Return the padded length of a record of `size` readings, one of a geometric series of lengths."""
    # A geometric series: padding is an eighth on average, and ten lengths cover a decade.
    step_count = max(0, math.ceil(math.log(size / MIN_PADDED_LENGTH, LENGTH_RATIO) - 1e-9))
    return max(size, round(MIN_PADDED_LENGTH * LENGTH_RATIO**step_count))


def pad_frame(frame: Frame) -> Frame:
    """Pad a frame with copies of the last reading, each a separate run, and convert it to JAX arrays."""
    size = frame.size
    padding_count = padded_length(size) - size

    # A repeated reading is a valid argument of any basis, unlike zeros (log 0).
    def pad(values: Any) -> np.ndarray:
        return np.pad(np.asarray(values), (0, padding_count), mode="edge")

    def extend(values: Mapping[str, Any]) -> dict[str, Any]:
        return {name: pad(v) for name, v in values.items()}

    codes = {g: np.pad(c, (0, padding_count), constant_values=-1) for g, c in frame.codes.items()}
    padded_frame = replace(
        frame,
        **{name: extend(getattr(frame, name)) for name in ("columns", "labels", "rates", "record")},
        codes=codes,
        order=np.append(frame.order, np.arange(size, size + padding_count, dtype=np.int32)),
        step=np.append(frame.step, -np.ones(padding_count)),
    )
    return jax.tree.map(jnp.asarray, padded_frame)


def compile_on_call(function: Callable[..., Any], is_costly: bool = False) -> Callable[..., Any]:
    """Return a function of (static argument, frame, *arrays) that is compiled when first called.

    Fully optimised if `is_costly`, for long records and for laws that loop over readings; otherwise compiled fast.
    """

    def is_long(argument: Any, frame: Frame, *_: Any) -> bool:
        has_loop = not getattr(argument, "independent", True)  # through all readings, at each φ
        return frame.size >= MIN_OPTIMISED_READINGS or has_loop or is_costly

    return compile_lazily(function, is_long)


# Slot values or column shifts by name: (n,), or (b, n) for b draws.
Arrays = dict[str, Array]


@compile_on_call
def respond_many(
    response: Callable[..., Any], frame: Frame, slots: Arrays, shifts: Arrays
) -> Float[Array, "b n"]:
    """Return the expected outputs at b sets of slot values and column shifts."""
    return jax.vmap(partial(_respond, response, frame))((slots, shifts))


class ResponseSpec(NamedTuple):
    """An instrument's response, and whether to differentiate it in reverse mode (all slots at once)."""

    response: Callable[..., Any]
    reverse_mode: bool


@compile_on_call
def differentiate(
    spec: ResponseSpec, frame: Frame, slots: Arrays, shifts: Arrays
) -> tuple[Array, dict[str, Array]]:
    """Return the expected output (n,), and its derivatives with respect to each slot and shifted column (n,)."""

    def respond(slots: Arrays, shifts: Arrays) -> Array:
        return _respond(spec.response, frame, (slots, shifts))

    return differentiate_response(respond, slots, shifts, spec.reverse_mode)


@compile_on_call
def differentiate_many(
    spec: ResponseSpec, frame: Frame, slots: Arrays, shifts: Arrays
) -> tuple[Array, dict[str, Array]]:
    """Return expected outputs and derivatives at b sets of slot values and column shifts."""
    return jax.vmap(partial(differentiate.__wrapped__, spec, frame))(slots, shifts)


def _respond(response: Callable[..., Any], frame: Frame, arguments: tuple[Arrays, Arrays]) -> Array:
    slots, shifts = arguments
    return jnp.broadcast_to(response(slots, frame.shift_columns(shifts)), (frame.size,))
