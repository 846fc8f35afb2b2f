"""Plan of poses of a magnetometer triad: `triad.campaign` with the noise and the field of an electronic compass."""

from __future__ import annotations

from dataclasses import dataclass

from bayescal_models.triad.campaign import Campaign as _TriadCampaign


@dataclass(frozen=True)
class Campaign(_TriadCampaign):
    """Plan of 100 readings in random directions, noise 0.3 µT, in a field of 50 µT."""

    poses: int = 100
    noise: float = 0.3
    magnitude: float = 50.0
