"""What no named effect describes, in time: a jump at an unknown moment, a cycle of unknown period.

A smooth process follows both, but spends most of its freedom on what is not there: a record that jumps once, or goes
up and down evenly, is then more probable as noise that wanders. Each of these forms needs one shape and one or two
coefficients, scaled by an amplitude as the smooth process is. Beyond the record a jump stays, and a cycle goes on.
"""

from __future__ import annotations

import functools
import math

import jax.numpy as jnp
import numpy as np

from bayescal._model.coefficient import Coefficient, Shape
from bayescal._model.effect import Effect
from bayescal._model.prior import Normal
from bayescal._readings.measurements import Measurements

PLACES = (0.05, 0.95)  # of a jump, in parts of the record
SHARP = 0.01  # half width of a jump, in parts of the record: as good as sudden, and its place has a slope
CYCLES = (1.5, 15.0)  # in the record
FEWEST = 30  # different times, twice the most cycles: fewer leave a period undetermined


@functools.cache
def jump(slot: str, low: float, high: float, unit: str, *, name: str = "") -> Effect:
    """A slot's value changes at one moment of the record, and stays.

    Args:
        low, high: plausible changes, in `unit`.
        name: canonical; `unknown(time, jump)` if not given.
    """

    def basis(r, place, amplitude):
        return 0.5 * amplitude * jnp.tanh((r.position("time") - place) / SHARP)

    place = Shape("place", "1", *PLACES, scale="linear", ragged=True)
    equation = "−a/2 before one moment, a/2 after it"
    name = name or "unknown(time, jump)"
    return _in_time(name, slot, basis, 1, place, (low, high), unit, equation)


@functools.cache
def cycle(slot: str, low: float, high: float, unit: str, *, name: str = "") -> Effect:
    """A slot's value goes up and down evenly in time.

    Args:
        low, high: plausible amplitudes, in `unit`.
        name: canonical; `unknown(time, cycle)` if not given.
    """

    def basis(r, cycles, amplitude):
        angle = 2 * math.pi * cycles * r.position("time")
        return amplitude * jnp.stack([jnp.sin(angle), jnp.cos(angle)], axis=1)

    cycles = Shape("cycles", "1", *CYCLES, ragged=True)
    equation = "a·sin(2π·cycles·t + φ)"
    name = name or "unknown(time, cycle)"
    return _in_time(name, slot, basis, 2, cycles, (low, high), unit, equation)


def _too_few(readings: Measurements) -> str | None:
    count = np.unique(readings["time"]).size
    return None if count >= FEWEST else f"needs {FEWEST} different times; there are {count}"


def _in_time(name, slot, basis, count, shape, amplitudes, unit, equation) -> Effect:
    return Effect(
        name,
        slot,
        basis,
        coefficients=tuple(Coefficient(unit, Normal(), part=f"{i + 1}") for i in range(count)),
        shapes=(shape, Shape("amplitude", unit, *amplitudes)),
        measure="amplitude",
        columns=("time",),
        varies=("time",),
        untestable=_too_few,
        equation=equation,
        source="ours: not in the catalogue; find out what it is, and name it",
    )
