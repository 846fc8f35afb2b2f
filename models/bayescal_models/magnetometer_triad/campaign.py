"""Plan of poses of a magnetometer triad: that of any triad, with the noise and field of a compass."""

from __future__ import annotations

from dataclasses import dataclass

from bayescal_models.triad.campaign import Campaign as _Poses


@dataclass(frozen=True)
class Campaign(_Poses):
    """Plan of 100 readings turned by hand, noise in µT, in a field of 50 µT."""

    poses: int = 100
    noise: float = 0.3
    magnitude: float = 50.0
