"""The plan of a test on the tilted table: positions, tilts, temperatures, runs; and what is true of the instrument.

Campaign()                                   instrument A as source 0 tested it: 12 positions at 0.45°
replace(INSTRUMENT_A, positions=4)           four positions
Campaign(tilts=(0.45 * DEGREE, -0.45 * DEGREE))    each cell at two tilts: separates γ2⊥ from the scale factor
Campaign(tilts=(0.45 * DEGREE, 179.55 * DEGREE))   the face inverted: separates γ1 from the bias
fixed_point_heating()                        one position a run, temperature stepped
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple

from bayescal_models.simulated import DEGREE, HOUR, refuse

GRID = 10.0  # s, integration step of the simulated test
FULL_SCALE = 10e3  # µg, largest input

TRUTH_A: Mapping[str, float] = MappingProxyType(
    {
        "bias.constant": 850.0,
        "bias.temperature": 10.0,
        "bias.cell": 2.0,
        "scale.constant": 1500.0,
        "scale.temperature": 60.0,
        "scale.cell": 30.0,
        "fixture_tilt.constant": 150.0,
        "fixture_tilt.cell": 6.0,
        "base_tilt.constant[parallel]": 0.6,
        "base_tilt.constant[perp]": -0.5,
        "base_tilt.cell": 0.5,
        "rotation.constant": 0.05,
        "tilt.setting": 0.4,
    }
)
"""Instrument A's true coefficients, ours, with the scatter between cells that source 0 saw (60 to 100 ppm)."""


class SetUp(NamedTuple):
    """A tilt γ and a position θ, rad, that a run of fixed-point heating stays at."""

    tilt: float
    position: float


@dataclass(frozen=True)
class Campaign:
    """Plan of a test, the surroundings it is made in, and the instrument's own truth.

    The defaults are source 0's test of instrument A, and give 180 readings: 12 positions × 5 temperatures × 3 runs.
    What source 0 does not say is ours.

    Attributes:
        tilts: γ of the face, rad; each cell goes through all positions at each.
        positions: how many, equally spaced over a turn from θ = 0.
        set_ups: tilt and position of each run, which then stays there (fixed-point heating) in place of `tilts`,
            `positions` and `runs`.
        repeats: readings at each position.
        temperatures: set points in the order of the first run, °C.
        runs: number of repetitions of the series.
        alternate: every second run goes through the set points backwards.
        soak: time at a set point before the first reading, s.
        ramp: pace of the chamber's set point, °C/min.
        pause: between runs, power off, the chamber going to the next start, s.
        noise: standard deviation of a reading, µg.
        thermometer_noise: of an averaged temperature, °C.
        chamber_wander: standard deviation of the chamber's temperature, °C (source 0: held to 0.1 °C).
        laboratory: mean temperature of the laboratory, °C (source 0: 23 ± 1).
        laboratory_wander: its standard deviation from hour to hour, °C.
        laboratory_daily: amplitude of its daily course, °C.
        truth: true baseline coefficients, by name and in their units; for `.cell`, the standard deviation.
    """

    tilts: tuple[float, ...] = (0.45 * DEGREE,)
    positions: int = 12
    set_ups: tuple[SetUp, ...] = ()
    repeats: int = 1
    temperatures: tuple[float, ...] = (20.0, 25.0, 30.0, 35.0, 40.0)
    runs: int = 3
    alternate: bool = False
    soak: float = HOUR
    ramp: float = 1.0
    pause: float = 12 * HOUR
    noise: float = 0.5
    thermometer_noise: float = 0.002
    chamber_wander: float = 0.03
    laboratory: float = 23.0
    laboratory_wander: float = 0.3
    laboratory_daily: float = 0.4
    truth: Mapping[str, float] = field(default_factory=lambda: TRUTH_A)

    def __post_init__(self) -> None:
        """Refuse an input beyond full scale by a ValueError."""
        for tilt, position in self.set_ups or [(tilt, math.pi / 2) for tilt in self.tilts]:
            needed = abs(1e6 * math.sin(tilt) * math.sin(position))
            refuse(
                needed > FULL_SCALE,
                f"Campaign: a tilt of {tilt / DEGREE:g}° gives {needed / 1e3:.3g} mg, beyond the full scale of "
                f"{FULL_SCALE / 1e3:g} mg: tilt less",
            )

    @property
    def T0(self) -> float:
        """Return the mean set point rounded to 1 °C, about which the true polynomials are, °C."""
        return float(round(sum(self.temperatures) / len(self.temperatures)))


INSTRUMENT_A = Campaign()
"""Range 10 mg, γ = 0.45° (7.9 mg), 12 positions, 20 to 40 °C by 5 °C, 1 h soak, three runs upwards (source 0)."""


def fixed_point_heating(campaign: Campaign = INSTRUMENT_A, readings: int = 12) -> Campaign:
    """Plan the older method: zero, near + and near − full scale, one position a run in temperature steps.

    Args:
        campaign: whose tilt (the first), temperatures and truth are taken.
        readings: at each temperature.
    """
    tilt = campaign.tilts[0]
    set_ups = tuple(SetUp(tilt, angle * DEGREE) for angle in (0.0, 90.0, 270.0))
    return replace(campaign, set_ups=set_ups, repeats=readings)
