"""Simulator of records of a sensor at rest on temperature ramps, with hidden effects.

The test is simulated in steps of 1 s and logged every 10 s; effects are laws of the true temperature and of its true
rate (the catalogue's rate is an estimate from the preceding readings).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bayescal_models.simulated import (
    SUPPLY_V,
    apply_low_pass,
    correlated_noise,
    needs_supply_column,
    raise_if,
    simulate_supply,
    validate_effects,
)

RAMPS = ((0.0, 25.0), (10.0, -15.0), (25.0, 65.0), (40.0, 25.0))  # min, °C: knots of the set point
PAUSE_S = 3600.0  # s, between runs
CHAMBER_TAU_S, LAG_TAU_S, SLOW_TAU_S = 60.0, 300.0, 2400.0  # s, time constants
REVERSAL_TAU_S = 30.0  # s, time constant of the hysteresis after a reversal
WARM_UP_S, NOISE_TAU_S = 600.0, 300.0  # s, time constants
NOISE_LAWS = ("white", "ornstein_uhlenbeck")
BASELINE = {"bias.constant": 2000.0, "bias.temperature": 40.0}
NOISE_SD = 20.0  # output unit, standard deviation of white noise and of additional correlated noise


class Conditions:
    """True conditions, in steps of 1 s, in a chamber whose air follows temperature ramps with a lag.

    Attributes:
        run_time: time since the start of a run, s, (m,).
        ambient: air temperature T, °C, (m,), the same in every run.
        departure: T − T0, °C, (m,), with T0 the mean of T rounded to 1 °C.
        run_starts: start time of each run, s, (runs, 1).
        run_deviates: standard normal deviate of each run, (runs, 1).
        supply: supply voltage, V, (runs, m).
    """

    def __init__(self, run_deviates: np.ndarray, seed: int) -> None:
        minutes, targets = np.array(RAMPS).T
        self.run_time = np.arange(60.0 * minutes[-1] + 1)
        self.ambient = self.low_pass(np.interp(self.run_time, 60 * minutes, targets), CHAMBER_TAU_S)
        self.departure = self.ambient - round(float(self.ambient.mean()))
        self.run_starts = np.arange(len(run_deviates))[:, None] * (self.run_time[-1] + PAUSE_S)
        self.run_deviates = run_deviates[:, None]
        self.supply = simulate_supply(
            np.random.default_rng([seed, 1]), self.run_starts + self.run_time
        )

    def low_pass(self, drive: np.ndarray, time_constant: float) -> np.ndarray:
        return apply_low_pass(drive, time_constant, 1.0)

    @property
    def rate(self) -> np.ndarray:
        """Return the temperature rate dT/dt, °C/min, (m,)."""
        return 60 * np.gradient(self.ambient)

    @property
    def lag(self) -> np.ndarray:
        """Return the lag T̃ − T of a first-order body behind the air, °C, (m,)."""
        return self.low_pass(self.ambient, LAG_TAU_S) - self.ambient

    @property
    def progress(self) -> np.ndarray:
        """Return the normalised time (t − t̄)/(tmax − tmin) of all runs, (runs, m)."""
        elapsed = self.run_starts + self.run_time
        return (elapsed - elapsed.mean()) / np.ptp(elapsed)


_LAWS: dict[str, Callable[[Conditions], np.ndarray]] = {
    "bias.constant": lambda test: np.ones_like(test.run_time),
    "bias.temperature": lambda test: test.departure,
    "bias.temperature_quadratic": lambda test: test.departure**2,
    "bias.temperature_cubic": lambda test: test.departure**3,
    "bias.temperature_quartic": lambda test: test.departure**4,
    "bias.rate": lambda test: test.rate,
    "bias.thermal_lag": lambda test: test.lag,
    "bias.thermal_lag_slow": lambda test: test.low_pass(test.ambient, SLOW_TAU_S) - test.ambient,
    "bias.temperature_x_lag": lambda test: test.departure * test.lag,
    "bias.hysteresis": lambda test: test.low_pass(np.sign(test.rate), REVERSAL_TAU_S),
    "bias.warm_up": lambda test: np.exp(-test.run_time / WARM_UP_S),
    "bias.drift": lambda test: test.progress,
    "bias.run": lambda test: test.run_deviates,
    "bias.supply": lambda test: test.supply - SUPPLY_V,
    "bias.temperature_x_supply": lambda test: test.departure * (test.supply - SUPPLY_V),
}


def simulate_columns(
    effects: Mapping[str, float] | None = None,
    *,
    seed: int,
    unit: str = "ug",
    runs: int = 3,
    interval: int = 10,
    noise_law: str = "white",
) -> dict[str, Any]:
    """Simulate temperature ramps 25 → −15 → 65 → 25 °C of 40 minutes with hidden effects; return columns by name.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficient. Baseline effects have the
            sizes in `BASELINE` unless given here.
        seed: seed of the random-number generators.
        unit: unit of the output, of sizes and of the noise (20).
        runs: number of repetitions of the ramps, an hour apart.
        interval: time between readings, s.
        noise_law: "white", or "ornstein_uhlenbeck": white plus correlated noise, time constant 300 s.

    Raises:
        ValueError: an unknown effect or noise law, or a size that is not finite.
    """
    sizes = {**BASELINE, **(effects or {})}
    validate_effects(sizes, _LAWS, "a sensor at rest")
    choices = ", ".join(NOISE_LAWS)
    raise_if(noise_law not in NOISE_LAWS, f"noise law {noise_law!r} is not one of {choices}")
    rng = np.random.default_rng(seed)
    test = Conditions(rng.standard_normal(runs), seed)
    shape = (runs, test.run_time.size)
    contributions = (size * _LAWS[name](test) for name, size in sizes.items())
    signal = sum(contributions, start=np.zeros(shape))
    noise = NOISE_SD * rng.standard_normal(shape)
    if noise_law == "ornstein_uhlenbeck":
        noise += NOISE_SD * correlated_noise(rng, shape, NOISE_TAU_S, 1.0)
    log_slice = slice(0, None, interval)
    count = test.run_time[log_slice].size
    columns = {
        "run": np.repeat(np.arange(1, runs + 1), count).astype(str),
        "time": (test.run_starts + test.run_time)[:, log_slice].ravel(),
        "temperature": np.tile(test.ambient[log_slice], runs),
        f"output [{unit}]": (signal + noise)[:, log_slice].ravel(),
    }
    if needs_supply_column(sizes):
        columns["supply_voltage"] = test.supply[:, log_slice].ravel()
    return columns
