"""The plan of a tumble on a dividing head: positions, temperatures, runs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Campaign:
    """Positions evenly round the head at each temperature, all of it once a run.

    Attributes:
        positions: round the head, from θ = 0; 24 are every 15°.
        temperatures: of the chamber, °C, soaked at each.
        runs: how often, mounted anew each time.
        soak: before the first position of a temperature, s.
        dwell: between readings, s.
        noise: standard deviation of a reading, µg.
        thermometer_noise: of its temperature about the chamber's, °C.
    """

    positions: int = 24
    temperatures: tuple[float, ...] = (-20.0, 5.0, 25.0, 45.0, 70.0)
    runs: int = 1
    soak: float = 3600.0
    dwell: float = 60.0
    noise: float = 5.0
    thermometer_noise: float = 0.1
