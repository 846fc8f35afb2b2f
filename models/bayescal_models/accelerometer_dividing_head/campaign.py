"""Plan of a tumble test on a dividing head."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Campaign:
    """Plan of a tumble test: equally spaced positions of the head at each temperature, once per run.

    Attributes:
        positions: number of positions over a turn, from θ = 0; 24: every 15°.
        temperatures: soak temperatures of the chamber, °C.
        runs: number of runs, each with a new mounting.
        soak: time before the first position at a temperature, s.
        dwell: time between positions, s.
        noise: standard deviation of the noise of a reading, µg.
        thermometer_noise: standard deviation of the measured temperature about the set point, °C.
    """

    positions: int = 24
    temperatures: tuple[float, ...] = (-20.0, 5.0, 25.0, 45.0, 70.0)
    runs: int = 1
    soak: float = 3600.0
    dwell: float = 60.0
    noise: float = 5.0
    thermometer_noise: float = 0.1
