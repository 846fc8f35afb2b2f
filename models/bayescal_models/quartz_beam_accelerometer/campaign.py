"""Plan of a test: four-position tumbles after soaks, and continuous temperature ramps at several attitudes.

    Campaign()                                    # both kinds, −40 … +70 °C
    Campaign(attitudes=())                        # soaked points only
    Campaign(repeats=0, ramp_speeds=(1.0, 3.0))   # ramps only, at two rates
    Campaign(device="beams")                      # a device with non-polynomial errors

Source: source 2 (soak, four-position tumble, two repeats or more); ranges, times and sizes are assumed.
"""

from __future__ import annotations

from dataclasses import dataclass

from bayescal_models.simulated import validate_options

STEP_S = 5.0
"""Integration step of the temperatures, s."""

TUMBLE_G = (0.0, 1.0, 0.0, -1.0)
"""Accelerations of the four-position tumble, g (source 2)."""

DEVICE_KINDS = ("cubic", "beams")
NOISE_LAWS = ("white", "ornstein_uhlenbeck")


@dataclass(frozen=True)
class Campaign:
    """Plan of a test and properties of the simulated device. The defaults give 563 readings in five runs.

    Every run begins with power-on at room temperature, after a pause without power. A tumble run has one reading
    at power-on, which records its time, then a soak at each temperature and readings in four positions. A ramp run
    has one attitude, readings at a constant interval, and temperatures room → coldest → hottest → room.

    Attributes:
        temperatures: soak temperatures in the order of the first run, °C; ramps span them.
        repeats: number of tumble runs; every second one has the temperatures in reverse order.
        soak: time at each temperature before the tumble, s.
        attitudes: input accelerations of the ramp runs, g.
        ramp_speeds: temperature rates, °C/min; there is a ramp run for each attitude at each rate.
        hold: time at the start and at both temperature extremes of a ramp run, s.
        interval: time between readings of a ramp run, s.
        average: averaging time of a reading, s, at most `format_interval`.
        pause: time without power between runs, s.
        chamber_speed: temperature rate of the chamber between soak temperatures, °C/min.
        air_time: first-order time constant of the chamber's air, s.
        device: "cubic": bias and scale factor are cubic polynomials of the head's temperature, so that the baseline
            is the true model unless effects are hidden; "beams": two beams with lags and different temperature
            coefficients, and a circuit, whose errors are not polynomials.
        noise: standard deviation of the white noise of a reading, µg.
        noise_law: "white", or "ornstein_uhlenbeck": plus correlated noise of equal variance and time constant 300 s.
        thermometer_noise: standard deviation of the white error of each thermometer, °C.
        frequency_sum: whether the sum of both beams' frequencies is recorded, Hz.
        T0: reference temperature of all simulated effects, °C.

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
        validate_options(self, device=DEVICE_KINDS, noise_law=NOISE_LAWS)
