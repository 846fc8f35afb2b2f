"""Plan of poses of a triad."""

from __future__ import annotations

from dataclasses import dataclass

from bayescal_models.simulated import validate_options

POSE_KINDS = ("random", "six", "twelve", "planar", "level")  # of directions
# Options of a plan of two sessions at several temperatures.
TWO_SESSIONS = {"poses": 14, "temperatures": (-20.0, 0.0, 25.0, 50.0, 70.0), "runs": 2}


@dataclass(frozen=True)
class Campaign:
    """Plan of poses at rest, at successive temperatures.

    Attributes:
        poses: number of poses at each temperature.
        kind: kind of directions: "random", "six", "twelve", "planar" or "level" (within 10°).
        temperatures: temperatures in test order, °C.
        noise: standard deviation of an averaged output, in the output's unit.
        magnitude: magnitude of the input, in the output's unit.
        pose_uncertainty: standard uncertainty of a known direction about each cross axis, rad; None if directions
            are unknown.
        interval: time between poses, s.
        runs: number of sessions; each repeats the whole plan.

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
        validate_options(self, kind=POSE_KINDS)
