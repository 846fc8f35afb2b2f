"""Columns of a simulated campaign of three accelerometers; the world is that of `triad/simulator.py`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayescal_models.triad.campaign import Campaign
from bayescal_models.triad.simulator import COUNTS, poses_of

# The triad that is there unless effects say otherwise: bias mg, scale ppm, misalignment mrad; x, y, z (xy, xz, yz).
BASELINE = {
    "bias.constant": (12.0, -20.0, 35.0),
    "scale.constant": (8000.0, -5000.0, 12000.0),
    "misalignment.constant": (4.0, -6.0, 3.0),
}


def simulated_columns(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """Columns of poses with these effects hidden in them, by name.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficients, whose members come at their own
            `SHARES` of it; bias, scale and misalignment are there unless given otherwise.
        seed: of every random number.
        campaign: the poses; 24 random ones if not given.

    Raises:
        ValueError: an unknown effect, or a size that is no number.
    """
    return poses_of(BASELINE, tuple(COUNTS), 1e-3, effects, seed, campaign or Campaign())
