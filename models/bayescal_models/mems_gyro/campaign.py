"""Plan of a stepped-chamber test of a gyro, after source 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayescal_models.simulated import Array, raise_if

STEP_S, LOGGING_INTERVAL_S = 1.0, 5.0  # s, steps of the simulated test and of the logger


@dataclass(frozen=True)
class Campaign:
    """Plan of a stepped-chamber test of one gyro, and properties of the simulated gyro.

    The defaults follow source 1 (30 … 80 °C in 5 °C steps of 300 s, logged every 5 s) with two additional runs:
    330 readings. Values are our assumptions unless a source is stated.

    Attributes:
        temperatures: chamber set points in the order of the first run, °C.
        dwell: time at each set point, s.
        runs: number of repetitions of the series.
        alternate: whether every second run has the set points in reverse order.
        pause: time with the power off between runs, s; the chamber moves to the first set point of the next run.
        chamber_time: first-order time constant of the chamber's air, s.
        chamber_ramp: largest rate of the chamber's set point, °C/min.
        average: averaging time of a reading, s, a multiple of `LOGGING_INTERVAL_S`.
        rate_input: rates of the turntable, °/s, one per step, cycled over all steps of all runs; None: the gyro
            is at rest, and there is no column `rate_input`.
        noise: standard deviation of the white noise of one averaged reading, °/s.
        thermometer_noise: white error of the column `temperature`, °C (standard deviation).
        constant: zero-rate output at `T0`, °/s.
        slope: tempco of the zero-rate output, °/s/°C (source 1's table, least squares).
        T0: reference temperature of the simulated effects, °C.
        nonlinearity: factor of the higher-order terms in the laws of `bias.temperature_quadratic`,
            `bias.temperature_cubic` and `bias.drift`; 1: physical law, 0: leading term only.
        lag_time: time constant of the die's lag behind the ambient thermometer, s.

    Raises:
        ValueError: `pause`, `average` or `dwell` is not a multiple of `STEP_S`, `LOGGING_INTERVAL_S` or `average`.
    """

    temperatures: tuple[float, ...] = tuple(float(t) for t in range(30, 81, 5))
    dwell: float = 300.0
    runs: int = 3
    alternate: bool = True
    pause: float = 3600.0
    chamber_time: float = 60.0
    chamber_ramp: float = 5.0
    average: float = 30.0
    rate_input: tuple[float, ...] | None = None
    noise: float = 0.05
    thermometer_noise: float = 0.0
    constant: float = 21.5
    slope: float = 0.0535
    T0: float = 55.0
    nonlinearity: float = 1.0
    lag_time: float = 300.0

    def __post_init__(self) -> None:
        # Attribute → the time of which it is a multiple.
        divisors = {"pause": STEP_S, "dwell": self.average, "average": LOGGING_INTERVAL_S}
        for name, divisor in divisors.items():
            time = getattr(self, name)
            raise_if(
                abs(time / divisor - round(time / divisor)) > 1e-9,
                f"Campaign({name}={time!r}): give a multiple of {divisor:g} s.",
            )

    @property
    def run_duration(self) -> float:
        """Return the duration of one run, s."""
        return self.dwell * len(self.temperatures)

    @property
    def run_starts(self) -> Array:
        """Return the time from the first power-on to the power-on of each run, s, (runs,)."""
        return np.arange(self.runs) * (self.run_duration + self.pause)

    @property
    def readings(self) -> int:
        """Return the number of readings of the campaign."""
        return round(self.runs * self.run_duration / self.average)

    def set_points(self, run: int) -> tuple[float, ...]:
        """Return the set points of a run, counted from 0, in test order, °C."""
        is_reversed = self.alternate and run % 2 == 1
        return self.temperatures[::-1] if is_reversed else self.temperatures
