"""Plan of poses of a triad."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bayescal_models.simulated import refuse_unknown

KINDS = ("random", "six", "twelve", "planar", "level")  # of poses

# Two sessions over temperature in directions known to 0.5 mrad.
TWO_SESSIONS: dict[str, Any] = {
    "poses": 14,
    "temperatures": (-20.0, 0.0, 25.0, 50.0, 70.0),
    "runs": 2,
    "pose_uncertainty": 5e-4,
}


@dataclass(frozen=True)
class Campaign:
    """Poses at rest, at successive temperatures.

    Attributes:
        poses: number of poses at each temperature.
        kind: kind of directions: "random", "six", "twelve", "planar" or "level" (within 10°).
        temperatures: °C.
        noise: standard deviation of an averaged output, in the output's unit.
        magnitude: magnitude of the input, in that unit.
        pose_uncertainty: standard uncertainty of a known direction about each cross axis, rad; None if directions
            are unknown.
        interval: time between poses, s.
        runs: number of sessions, each the whole plan.

    Raises:
        ValueError: an unknown kind.
    """

    poses: int = 24
    kind: str = "random"
    temperatures: tuple[float, ...] = (25.0,)
    noise: float = 5e-4
    magnitude: float = 1.0
    pose_uncertainty: float | None = None
    interval: float = 20.0
    runs: int = 1

    def __post_init__(self) -> None:
        refuse_unknown(self, kind=KINDS)
