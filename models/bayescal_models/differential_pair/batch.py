"""A simulated batch: readings of all its devices, and the truth behind them.

made = simulate_batch(seed=1)
made.readings, made.sensitivity, made.environment
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import bayescal as bc
from bayescal_models.differential_pair.campaign import Campaign
from bayescal_models.differential_pair.model import INSTRUMENT
from bayescal_models.differential_pair.simulator import Truth, columns_and_truth


@dataclass(frozen=True)
class SimulatedBatch(Truth):
    """Measurements of all devices of a batch, and the truth behind them."""

    readings: bc.Measurements = field(repr=False)


def simulate_batch(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> SimulatedBatch:
    """A batch with these effects hidden in it, and the truth; arguments as of `simulate`.

    Raises:
        ValueError: an unknown effect, or a size that is not finite.
    """
    columns, truth = columns_and_truth(effects, seed=seed, campaign=campaign)
    readings = bc.Measurements.from_arrays(INSTRUMENT, **columns)
    return SimulatedBatch(**vars(truth), readings=readings)
