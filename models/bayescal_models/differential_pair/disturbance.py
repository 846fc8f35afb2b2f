"""What disturbs the devices: a thermal transient and slow oscillations, shared or a device's own.

Time runs from 0 to 1 over the record. None of it is a polynomial.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WARMING = 0.45  # time constant of the fixture's heating by windage, in records


def _transient(random: np.random.Generator, time: Array) -> Array:
    """A body that is heated from the start on, of unit rise in the long run."""
    return 1.0 - np.exp(-time / random.uniform(0.2, 0.7))


def _wave(random: np.random.Generator, time: Array) -> Array:
    """A slow oscillation, such as of the room's air, of period 1 to 2.5 records."""
    return np.sin(2 * np.pi * (time / random.uniform(1.0, 2.5) + random.uniform()))


def shared(random: np.random.Generator, time: Array) -> Array:
    """The shared disturbance, of unit rms over the record."""
    transient = random.choice([-1.0, 1.0]) * random.uniform(0.8, 1.6) * _transient(random, time)
    waves = [random.uniform(0.2, 0.7) * _wave(random, time) for _ in range(2)]
    made = transient + waves[0] + waves[1]
    return made / np.sqrt(np.mean(made**2))


def departures(random: np.random.Generator, time: Array, count: int) -> Array:
    """Each device's own disturbance, (count, time): an offset, a transient and a wave, together of rms about 1."""
    made = []
    for _ in range(count):
        offset, heat, slow = random.standard_normal(3) / np.sqrt(3.0)
        transient = _transient(random, time)
        made.append(
            offset
            + heat * transient / np.sqrt(np.mean(transient**2))
            + slow * np.sqrt(2.0) * _wave(random, time)
        )
    return np.array(made)


def warming(time: Array) -> Array:
    """Temperature of the fixture, of unit rise in the long run, with a slow wave of the room."""
    return 1.0 - np.exp(-time / WARMING) + 0.1 * np.sin(2 * np.pi * time / 0.6)
