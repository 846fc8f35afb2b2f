"""Plan of a test of accelerometers on a centrifuge arm (source 3), and the population of devices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayescal_models.simulated import Array, refuse, refuse_unknown

G = 1e6  # µg
RADIUS = 1.0  # m, radius of the arm (ours)
GRAVITY = 9.80665  # m/s²
PROFILES = ("steps", "plateau")
LEVEL = 5.0  # g, level of a single plateau
DISTURBANCE = 1000.0  # µg rms, of u over the record
SENSITIVITY_SPREAD = 0.2  # standard deviation of λd over devices
SCALE_SPREAD = 2000.0  # standard deviation of scale factors over devices, ppm
DEPARTURE = 0.05  # rms of a device's own environment, in parts of the disturbance


@dataclass(frozen=True)
class Campaign:
    """The plan of a test and the population that its devices come from.

    Attributes:
        outer, inner: number of devices in each group.
        duration: duration of the record, s.
        samples: readings of each device, each an average over duration/samples.
        profile: "steps", through `levels` with ramps between them; "plateau", at 5 g throughout.
        levels: plateaus, g; up and down, or a slow disturbance looks like a wrong scale factor.
        ramp: time of a change of level, s; the speed of the arm changes smoothly.
        noise: white, of an output averaged over 1 s, µg; a reading, averaged over τ seconds, has noise/√τ.
        warming: rise of the fixture's temperature, °C.
        thermometer: noise of the thermometer, °C; None leaves the column out.
        alike: devices identical but for noise: λd = 1, no departures, one scale factor.
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
        """Refuse an unknown profile, and ramps longer than the plateaus, by a ValueError."""
        refuse_unknown(self, profile=PROFILES)
        refuse(
            self.ramp * len(self.levels) >= self.duration,
            f"Campaign(ramp={self.ramp:g} s): {len(self.levels)} levels in {self.duration:g} s leave "
            "no plateau; shorten the ramps",
        )

    @property
    def time(self) -> Array:
        """Return the mid-times of the readings, s."""
        return (np.arange(self.samples) + 0.5) * self.duration / self.samples
