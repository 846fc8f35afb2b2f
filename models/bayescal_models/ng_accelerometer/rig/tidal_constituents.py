"""The tide's constituents M2, S2, N2, K1 and O1: periods, and how much each plausibly tilts the base."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

TIDE: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "M2": (12.4206012, 50.0),
        "S2": (12.0, 25.0),
        "N2": (12.6583475, 10.0),
        "K1": (23.9344721, 30.0),
        "O1": (25.8193387, 20.0),
    }
)
"""Tidal constituents: period, h, and prior standard deviation of each cosine and sine, nrad (ours)."""
