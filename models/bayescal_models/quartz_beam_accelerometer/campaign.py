"""Plan of a test: soaked four-position tumbles, and continuous ramps at several attitudes.

    Campaign()                                    # both kinds, −40 … +70 °C
    Campaign(attitudes=())                        # soaked points alone
    Campaign(repeats=0, ramp_speeds=(1.0, 3.0))   # ramps alone, at two speeds
    Campaign(device="beams")                      # a device whose truth is no polynomial

Source: source 2 (soak, four-position tumble, two repeats or more); ranges, times and sizes are ours.
"""

from __future__ import annotations

from dataclasses import dataclass

from bayescal_models.simulated import refuse_unknown

GRID = 5.0
"""Step on which temperatures are integrated, s."""

POSITIONS = (0.0, 1.0, 0.0, -1.0)
"""Accelerations of the four-position tumble, g (source 2)."""

DEVICES = ("cubic", "beams")
NOISE_LAWS = ("white", "ornstein_uhlenbeck")


@dataclass(frozen=True)
class Campaign:
    """Plan of a test, and the world it is made in. The defaults give 563 readings in five runs.

    Every run begins with power-on at room temperature, after a pause without power. A tumble run takes one
    reading then (so that the record knows when power came), goes through the temperatures, soaks at each and
    reads the four positions. A ramp run holds one attitude, reads all the time, and goes room → coldest →
    hottest → room.

    Attributes:
        temperatures: soak temperatures in the order of the first run, °C; ramps span them.
        repeats: tumble runs; every second one goes backwards.
        soak: time at each temperature before the tumble, s.
        attitudes: input accelerations of the ramp runs, g.
        ramp_speeds: °C/min; each attitude is gone through at each speed.
        hold: time at the start and at both ends of a ramp run, s.
        interval: between readings of a ramp, s.
        average: time averaged into one reading, s, at most `interval`.
        pause: time without power between runs, s.
        chamber_speed: of the chamber between soak temperatures, °C/min.
        air_time: first-order time constant of the chamber's air, s.
        device: "cubic", whose bias and scale factor follow the head's temperature by a cubic, so that the baseline
            is right unless something is hidden; or "beams", two beams with their own lag, unlike in their
            temperature coefficients, and a circuit: no polynomial.
        noise: standard deviation of one reading, µg.
        noise_law: "white", or "ornstein_uhlenbeck" (correlated noise of the same size beside it, time 300 s).
        thermometer_noise: white error of both thermometers' readings, °C (standard deviation).
        frequency_sum: record the sum of both beams' frequencies, Hz.
        T0: temperature about which every law of the world is written, °C.

    Raises:
        ValueError: an unknown device or noise law.
    """

    temperatures: tuple[float, ...] = tuple(float(t) for t in range(-40, 71, 10))
    repeats: int = 2
    soak: float = 5400.0
    attitudes: tuple[float, ...] = (1.0, 0.0, -1.0)
    ramp_speeds: tuple[float, ...] = (2.0,)
    hold: float = 900.0
    interval: float = 60.0
    average: float = 60.0
    pause: float = 7200.0
    chamber_speed: float = 2.0
    air_time: float = 60.0
    device: str = "cubic"
    noise: float = 5.0
    noise_law: str = "white"
    thermometer_noise: float = 0.002
    frequency_sum: bool = False
    T0: float = 15.0

    def __post_init__(self) -> None:
        refuse_unknown(self, device=DEVICES, noise_law=NOISE_LAWS)
