"""The compiled pieces: the responses of an instrument that is not affine, and their slopes.

None knows which effects a model has, so that a search over structures compiles nothing. Records are padded to a few
lengths by repeating the last reading, so that another record of about the same length compiles nothing either.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial, wraps
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from bayescal._core.jit import ALWAYS, QUICK, known
from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._model.composition import differentiate_response
from bayescal._model.frame import Frame

STEP = 1.25  # from one padded length to the next
# Readings that a program is padded to at least: few programs serve all short records.
SHORTEST_LENGTH = 32
# Readings from which a program is run often enough to be worth twice the time to compile.
OPTIMISED_READINGS = 2000


def padded_length(size: int) -> int:
    """Return the next of a few lengths that records are padded to."""
    # Lengths grow by a quarter: a record is padded by an eighth on average, and ten lengths cover a decade.
    steps = max(0, math.ceil(math.log(size / SHORTEST_LENGTH, STEP) - 1e-9))
    return max(size, round(SHORTEST_LENGTH * STEP**steps))


def padded(frame: Frame) -> Frame:
    """Pad readings with copies of the last one, each a run of its own."""
    size = frame.size
    missing = padded_length(size) - size

    # A repeated reading is as valid an argument of any effect as the reading itself: no logarithm of zero.
    def longer(values: Any) -> np.ndarray:
        return np.pad(np.asarray(values), (0, missing), mode="edge")

    def all_of(values: Mapping[str, Any]) -> dict[str, Any]:
        return {name: longer(v) for name, v in values.items()}

    codes = {g: np.pad(c, (0, missing), constant_values=-1) for g, c in frame.codes.items()}
    padded_frame = replace(
        frame,
        **{name: all_of(getattr(frame, name)) for name in ("columns", "labels", "rates", "record")},
        codes=codes,
        order=np.append(frame.order, np.arange(size, size + missing, dtype=np.int32)),
        step=np.append(frame.step, -np.ones(missing)),
    )
    return jax.tree.map(jnp.asarray, padded_frame)


def program(function: Callable[..., Any], costly: bool = False) -> Callable[..., Any]:
    """Compile a function of something that is no array, of a frame, and of arrays, when it is first called.

    It is optimised if `costly`, whatever the number of readings: computing then counts for more than compiling.
    """

    @cache
    def compile_once(optimised: bool) -> Callable[..., Any]:
        options = known(ALWAYS if optimised else QUICK)
        return jax.jit(function, static_argnums=0, compiler_options=options)

    @wraps(function)
    def call(what: Any, frame: Frame, *args: Any) -> Any:
        loops = not getattr(what, "independent", True)  # through all readings, at each φ
        optimised = frame.size >= OPTIMISED_READINGS or loops or costly
        return compile_once(optimised)(what, frame, *args)

    return call


# Slots, or shifts of columns: a number a reading; of several draws, one row each.
ByName = dict[str, Array]


@program
def responses(
    response: Callable[..., Any], frame: Frame, slots: ByName, shifts: ByName
) -> Float[Array, "b n"]:
    """Return expected outputs of several sets of slots, columns of the readings moved for each."""
    return jax.vmap(partial(_respond, response, frame))((slots, shifts))


class Responding(NamedTuple):
    """An instrument's response, and whether its slopes by all slots are taken backward, in one pass."""

    response: Callable[..., Any]
    backward: bool


@program
def response_slopes(
    what: Responding, frame: Frame, slots: ByName, shifts: ByName
) -> tuple[Array, dict[str, Array]]:
    """Return the expected output, and its derivatives by each slot and moved column, by reading."""

    def respond(slots: ByName, shifts: ByName) -> Array:
        return _respond(what.response, frame, (slots, shifts))

    return differentiate_response(respond, slots, shifts, what.backward)


@program
def slopes_of_draws(
    what: Responding, frame: Frame, slots: ByName, shifts: ByName
) -> tuple[Array, dict[str, Array]]:
    """Return expected outputs of several sets of slots and moved columns, and their derivatives."""
    return jax.vmap(partial(response_slopes.__wrapped__, what, frame))(slots, shifts)


def _respond(response: Callable[..., Any], frame: Frame, both: tuple[ByName, ByName]) -> Array:
    slots, shifts = both
    return jnp.broadcast_to(response(slots, frame.moved(shifts)), (frame.size,))
