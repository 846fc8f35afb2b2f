"""Readings and choices that make no pairs are refused, in words that say what is possible."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import differential_pair as dp
from bayescal_models.differential_pair.environment import SHARED, order_names
from bayescal_models.differential_pair.pairing.devices import devices_from


def columns(**changed) -> dict[str, Any]:
    """Two records, as a file would have them."""
    given = {
        "device": np.repeat(["a", "b"], 10),
        "group": np.repeat(["outer", "inner"], 10),
        "time": np.tile(np.arange(10.0), 2),
        "acceleration": np.full(20, 1e6),
        "output": np.linspace(-1.0, 1.0, 20) ** 3,
    }
    return {**given, **changed}


DRAWN = {
    "environment.shared[sensitivity]": np.ones((5, 2)),
    "noise.white": np.ones(5),
    **{name: np.arange(5.0) for name in order_names(SHARED.name)},
}


@pytest.mark.parametrize(
    "changed",
    [
        {"group": np.full(20, "outer")},
        {"group": np.tile(["outer", "inner"], 10)},
        {"time": np.r_[np.arange(10.0), np.arange(10.0) + 0.5]},
    ],
)
def test_readings_that_make_no_pairs_are_refused(changed) -> None:
    readings = bc.Measurements.from_arrays(dp.INSTRUMENT, **columns(**changed))
    with pytest.raises(bc.InputError):
        devices_from(DRAWN, readings)
