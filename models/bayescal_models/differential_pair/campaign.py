"""Plan of a test of accelerometers on a centrifuge arm (source 3), and properties of the population of devices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayescal_models.simulated import Array, raise_if, validate_options

G = 1e6  # µg
RADIUS = 1.0  # m, radius of the arm (our assumption)
GRAVITY = 9.80665  # m/s²
PROFILES = ("steps", "plateau")
PLATEAU_LEVEL_G = 5.0  # g, level of a single plateau
DISTURBANCE_UG = 1000.0  # µg, rms of u over the record
SENSITIVITY_SD = 0.2  # standard deviation of λd over devices
SCALE_SD_PPM = 2000.0  # standard deviation of scale factors over devices, ppm
DEPARTURE_RATIO = 0.05  # rms of a device's departure v relative to that of u


@dataclass(frozen=True)
class Campaign:
    """Plan of a centrifuge test, and properties of the tested devices.

    Attributes:
        outer, inner: number of devices in each group.
        duration: duration of the record, s.
        samples: number of readings of each device, each averaged over duration/samples.
        profile: "steps": plateaus at `levels` with ramps between them; "plateau": constant 5 g.
        levels: accelerations of the plateaus, g; if they are monotonic, a slow disturbance resembles a scale error.
        ramp: duration of a change of level, s; the speed of the arm changes smoothly.
        noise: standard deviation of white noise averaged over 1 s, µg; of a reading averaged over τ s: noise/√τ.
        warming: temperature rise of the fixture, °C.
        thermometer: standard deviation of the thermometer's noise, °C; None: no temperature column.
        alike: whether devices differ by noise only (λd = 1, no departures, equal scale factors).
    """

    outer: int = 3
    inner: int = 3
    duration: float = 600.0
    samples: int = 40
    profile: str = "steps"
    levels: tuple[float, ...] = (2.0, 10.0, 4.0, 8.0, 1.0, 6.0)
    ramp: float = 40.0
    noise: float = 100.0
    warming: float = 5.0
    thermometer: float | None = 0.05
    alike: bool = False

    def __post_init__(self) -> None:
        """Raise a ValueError if the profile is unknown, or ramps leave no plateau."""
        validate_options(self, profile=PROFILES)
        raise_if(
            self.ramp * len(self.levels) >= self.duration,
            f"Campaign(ramp={self.ramp:g} s): {len(self.levels)} levels in {self.duration:g} s leave "
            "no plateau: shorten the ramps",
        )

    @property
    def time(self) -> Array:
        """Return the mid-times of the readings, s."""
        return (np.arange(self.samples) + 0.5) * self.duration / self.samples
