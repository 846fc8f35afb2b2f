"""The numbers that decide what is kept of a fleet's devices and said of their population."""

from __future__ import annotations

from dataclasses import dataclass

from bayescal._core.settings_in_force import OutcomeSettings, in_force


@dataclass(frozen=True)
class FleetSettings(OutcomeSettings):
    """What is kept and said of a fleet.

    Attributes:
        stands_out: devices of so small a posterior predictive p, expected by chance in the whole fleet, below which a
            device is said not to be like the others: one fleet in a hundred has such a device by chance.
        kept: probability from which an effect of a device is kept, and printed of the whole: as that of a noise law.
        behind: nats behind a device's best structure, up to which others are kept: D devices know the
            odds of a share up to about D, and ln 10⁶ = 13.8: no fleet of a million brings back what is farther behind.
        few: share of the devices up to which those that have an effect, or lack one, are named one by one.
        fewest_devices: from which a standard deviation between them can be learned: of two, it is their distance.
        enough_of_population: effective draws of a population's standard deviations, from which their means and
            standard uncertainties are known well enough: to 1/√(2·50), a tenth.
    """

    stands_out: float = 0.01
    kept: float = 0.01
    behind: float = 15.0
    few: float = 0.1
    fewest_devices: int = 3
    enough_of_population: int = 50


def fleet_settings() -> FleetSettings:
    """The settings of fleets that hold here."""
    return in_force(FleetSettings)
