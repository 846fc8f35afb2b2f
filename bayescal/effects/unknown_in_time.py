"""What no named effect describes, in time: a jump at an unknown moment, a cycle of unknown period.

A smooth process follows both, but spends most of its freedom on what is not there: a record that jumps once, or goes
up and down evenly, is then more probable as noise that wanders. Each of these forms needs one shape and one or two
coefficients, scaled by an amplitude as the smooth process is.
"""

from __future__ import annotations

import functools
import math

import jax.numpy as jnp

from bayescal._coefficient import Coefficient, Shape
from bayescal._effect import Effect
from bayescal._prior import Normal

PLACES = (0.05, 0.95)  # of a jump, in parts of the record
SHARP = 0.01  # half width of a jump, in parts of the record: as good as sudden, and its place has a slope
CYCLES = (1.5, 15.0)  # in the record


@functools.cache
def jump(slot: str, low: float, high: float, unit: str) -> Effect:
    """A slot's value changes at one moment of the record, and stays.

    Args:
        low, high: plausible amplitudes (half the change), in `unit`.
    """

    def basis(r, place, amplitude):
        return amplitude * jnp.tanh((r.position("time") - place) / SHARP)

    place = Shape("place", "1", *PLACES, scale="linear", ragged=True)
    return _in_time("jump", slot, basis, 1, place, (low, high), unit, "±a, from one moment on")


@functools.cache
def cycle(slot: str, low: float, high: float, unit: str) -> Effect:
    """A slot's value goes up and down evenly in time.

    Args:
        low, high: plausible amplitudes, in `unit`.
    """

    def basis(r, cycles, amplitude):
        angle = 2 * math.pi * cycles * r.position("time")
        return amplitude * jnp.stack([jnp.sin(angle), jnp.cos(angle)], axis=1)

    cycles = Shape("cycles", "1", *CYCLES, ragged=True)
    return _in_time("cycle", slot, basis, 2, cycles, (low, high), unit, "a·sin(2π·cycles·t + φ)")


def _in_time(form, slot, basis, count, shape, amplitudes, unit, equation) -> Effect:
    return Effect(
        f"unknown(time, {form})",
        slot,
        basis,
        coefficients=tuple(Coefficient(unit, Normal(), part=f"{i + 1}") for i in range(count)),
        shapes=(shape, Shape("amplitude", unit, *amplitudes)),
        measure="amplitude",
        columns=("time",),
        varies=("time",),
        equation=equation,
        source="ours: not in the catalogue; find out what it is, and name it",
    )
