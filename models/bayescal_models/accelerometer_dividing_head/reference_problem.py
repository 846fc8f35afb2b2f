"""The reference problem of a tumble on a dividing head; what one is for stands in `bayescal_models`."""

from __future__ import annotations

from collections.abc import Mapping

import bayescal as bc
from bayescal_models.accelerometer_dividing_head.campaign import Campaign
from bayescal_models.accelerometer_dividing_head.model import INSTRUMENT, simulate

CAMPAIGN = Campaign(positions=12, temperatures=(0.0, 25.0, 50.0))
UP_AND_DOWN = Campaign(temperatures=(-20.0, 25.0, 70.0, 25.0, -20.0), runs=3)

model = INSTRUMENT.baseline
"""The baseline, lines over temperature; its priors are proper as they stand."""


def readings(seed: int = 0) -> bc.Measurements:
    """36 readings, µg: 12 positions at three temperatures."""
    return simulate(seed=seed, campaign=CAMPAIGN)


def hidden(effects: Mapping[str, float], seed: int) -> bc.Measurements:
    """A fuller test, three mountings up and down, with effects hidden in it."""
    return simulate(effects, seed=seed, campaign=UP_AND_DOWN)
