"""Plan of a stepped-chamber test of a gyro, after source 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayescal_models.simulated import Array, refuse

GRID, LOGGING_INTERVAL = 1.0, 5.0  # s, steps of the simulated test and of the logger


@dataclass(frozen=True)
class Campaign:
    """Plan of a stepped-chamber test of one gyro, and the world it is made in.

    The defaults follow source 1 (30…80 °C by 5 °C, 300 s a step, logged every 5 s) with two runs
    more, and give 330 readings. Sizes are ours unless stated.

    Attributes:
        temperatures: chamber set points in the order of the first run, °C.
        dwell: time at each set point, s.
        runs: number of repetitions of the series.
        alternate: whether every second run has the set points in reverse order (up, down, up).
        pause: time with the power off between runs, s; the chamber moves to the next start.
        chamber_time: first-order time constant of the chamber's air, s.
        chamber_ramp: largest rate of the chamber's set point, °C/min.
        average: time averaged into one reading, s, a multiple of `LOGGING_INTERVAL`.
        rate_input: rates of the turntable, °/s, one per step, cycled over all steps of all runs;
            None leaves the gyro at rest, and the column out.
        noise: standard deviation of the white noise of one averaged reading, °/s.
        thermometer_noise: white error of the column `temperature`, °C (standard deviation).
        constant: zero-rate output at `T0`, °/s.
        slope: tempco of the zero-rate output, °/s/°C (source 1's table, least squares).
        T0: reference temperature of the simulated effects, °C.
        nonlinearity: 1 gives the world's own laws for quadratic, cubic and drift, 0 exactly
            their leading terms, numbers between or beyond a mixture.
        lag_time: time constant of the die behind the ambient thermometer, s.

    Raises:
        ValueError: times that do not divide one another.
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
        # Every time of the plan is a multiple of the next shorter one.
        shorter = {"pause": GRID, "dwell": self.average, "average": LOGGING_INTERVAL}
        for name, unit in shorter.items():
            time = getattr(self, name)
            refuse(
                abs(time / unit - round(time / unit)) > 1e-9,
                f"Campaign({name}={time!r}): it has to be a multiple of {unit:g} s.",
            )

    @property
    def run_duration(self) -> float:
        """Return the logged time of one run, s."""
        return self.dwell * len(self.temperatures)

    @property
    def run_starts(self) -> Array:
        """Return the power-on time of each run, s from the first."""
        return np.arange(self.runs) * (self.run_duration + self.pause)

    @property
    def readings(self) -> int:
        """Return the number of readings of the campaign."""
        return round(self.runs * self.run_duration / self.average)

    def set_points(self, run: int) -> tuple[float, ...]:
        """Set points of a run (0 is the first) in the order they are gone through, °C."""
        backwards = self.alternate and run % 2 == 1
        return self.temperatures[::-1] if backwards else self.temperatures
