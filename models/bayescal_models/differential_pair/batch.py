"""A simulated batch: readings of all its devices, and the truth behind them.

made = simulate_batch(seed=1)
made.readings, made.sensitivity, made.environment
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

import bayescal as bc
from bayescal_models.differential_pair.campaign import Campaign
from bayescal_models.differential_pair.model import INSTRUMENT
from bayescal_models.differential_pair.simulator import columns_and_truth

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SimulatedBatch:
    """Readings of a batch and the truth behind them; devices in the order outer, inner.

    Attributes:
        readings: measurements of all devices.
        names: of the devices.
        outer: number of outer devices.
        scale: 1 + κ of each device, (K,).
        sensitivity: λd of each device, (K,).
        environment: λd·u + v of each device, averaged as the readings are, µg, (K, T).
        acceleration: commanded, µg, (T,).
        seed: of every random number.
    """

    readings: bc.Measurements = field(repr=False)
    names: tuple[str, ...]
    outer: int
    scale: Array
    sensitivity: Array
    environment: Array
    acceleration: Array
    seed: int


def simulate_batch(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> SimulatedBatch:
    """A batch with these effects hidden in it, and the truth; arguments as of `simulate`.

    Raises:
        ValueError: an unknown effect, or a size that is not finite.
    """
    columns, truth = columns_and_truth(effects, seed=seed, campaign=campaign)
    return SimulatedBatch(bc.Measurements.from_arrays(INSTRUMENT, **columns), **vars(truth))
