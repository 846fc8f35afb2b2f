"""Measurements from a simulated campaign, and the document's table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import bayescal as bc
from bayescal_models.mems_gyro.campaign import Campaign, simulate_arrays

if TYPE_CHECKING:
    from bayescal import Measurements

TABLE = Path(__file__).parent / "data" / "zero_rate_table.csv"
TABLE_VOLTS = Path(__file__).parent / "data" / "zero_rate_table_volts.csv"


def simulate(
    effects: Mapping[str, float] | None = None,
    *,
    seed: int,
    campaign: Campaign | None = None,
    noise_law: str = "white",
) -> Measurements:
    """Readings of a stepped-chamber campaign with these effects hidden in it.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficient.
        seed: seed of every random number.
        campaign: plan of the test; the default has three runs between 30 and 80 °C.
        noise_law: "white", "student_t" or "ornstein_uhlenbeck".

    Raises:
        ValueError: an unknown effect or noise law.
    """
    from bayescal_models.mems_gyro.model import INSTRUMENT  # the instrument holds this function

    known = {column.name for column in INSTRUMENT.columns}
    made = simulate_arrays(campaign or Campaign(), effects, seed=seed, noise_law=noise_law)
    units = {n: u for n, u in made.units.items() if u is not None and n not in known}
    return bc.Measurements.from_arrays(INSTRUMENT, units=units, **made.columns)
