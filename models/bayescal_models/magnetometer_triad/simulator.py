"""Columns of a simulated campaign of three magnetometers; the world is that of `triad/simulator.py`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayescal_models.magnetometer_triad.campaign import Campaign
from bayescal_models.triad.simulator import COUNTS, poses_of

# The triad that is there unless effects say otherwise: bias µT, scale ppm, misalignment mrad; x, y, z (xy, xz, yz).
BASELINE = {
    "bias.constant": (15.0, -25.0, 8.0),
    "scale.constant": (60000.0, -40000.0, 90000.0),
    "misalignment.constant": (30.0, -20.0, 40.0),
}

KNOWN = tuple(
    name for name in COUNTS if not name.startswith(("square", "cross", "cube", "bias.thermal"))
)


def simulated_columns(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """Columns of poses with these effects hidden in them, by name.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficients, whose members come at their own
            `SHARES` of it; bias, scale and misalignment are there unless given otherwise.
        seed: of every random number.
        campaign: the poses; 100 random ones if not given.

    Raises:
        ValueError: an unknown effect, or a size that is no number.
    """
    return poses_of(BASELINE, KNOWN, 1.0, effects, seed, campaign or Campaign())
