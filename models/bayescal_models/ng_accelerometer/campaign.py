"""Plan of a test on the tilted table (positions, tilts, temperatures, runs), and the simulated instrument.

Campaign()                                   instrument A as source 0 tested it: 12 positions at 0.45°
replace(INSTRUMENT_A, positions=4)           four positions
Campaign(tilts=(0.45 * DEGREE, -0.45 * DEGREE))    each cell at two tilts: separates γ2⊥ from the scale factor
Campaign(tilts=(0.45 * DEGREE, 179.55 * DEGREE))   with the face inverted: separates γ1 from the bias
fixed_point_heating()                        one position per run, with temperature steps
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple

from bayescal_models.simulated import DEGREE, HOUR, raise_if

STEP_S = 10.0  # s, integration step of the simulated test
FULL_SCALE_UG = 10e3  # µg, largest input

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
"""True coefficients of the simulated instrument A, assumed; between cells they vary as in source 0 (60 to 100 ppm)."""


class SetUp(NamedTuple):
    """Tilt γ and position θ of the table in one set-up, rad."""

    tilt: float
    position: float


@dataclass(frozen=True)
class Campaign:
    """Plan of a test on the tilted table, its environment, and the true coefficients of the instrument.

    The defaults are source 0's test of instrument A: 12 positions × 5 temperatures × 3 runs = 180 readings.
    Values that source 0 does not state are assumed.

    Attributes:
        tilts: tilts γ of the face, rad; each cell has all positions at each tilt.
        positions: number of positions θ, equally spaced over a turn from 0.
        set_ups: fixed tilt and position of each run (fixed-point heating); replaces `tilts`, `positions` and `runs`.
        repeats: number of readings at each position.
        temperatures: set points in the order of the first run, °C.
        runs: number of repetitions of the series of set points.
        alternate: whether every second run has the set points in reverse order.
        soak: time at a set point before the first reading, s.
        ramp: rate of the chamber's set point, °C/min.
        pause: time between runs with the power off, s; the chamber moves to the first set point of the next run.
        noise: standard deviation of the noise of a reading, µg.
        thermometer_noise: standard deviation of the error of an averaged temperature, °C.
        chamber_wander: standard deviation of the chamber's temperature about its set point, °C (source 0: 0.1 °C).
        laboratory: mean laboratory temperature, °C (source 0: 23 ± 1).
        laboratory_wander: standard deviation of the laboratory temperature from hour to hour, °C.
        laboratory_daily: amplitude of the daily variation of the laboratory temperature, °C.
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
        """Raise a ValueError if the input exceeds full scale."""
        for tilt, position in self.set_ups or [(tilt, math.pi / 2) for tilt in self.tilts]:
            input_ug = abs(1e6 * math.sin(tilt) * math.sin(position))
            raise_if(
                input_ug > FULL_SCALE_UG,
                f"Campaign: a tilt of {tilt / DEGREE:g}° gives {input_ug / 1e3:.3g} mg, more than the full scale of "
                f"{FULL_SCALE_UG / 1e3:g} mg: reduce the tilt",
            )

    @property
    def T0(self) -> float:
        """Return the reference temperature of the true polynomials: the mean set point rounded to 1 °C, °C."""
        return float(round(sum(self.temperatures) / len(self.temperatures)))


INSTRUMENT_A = Campaign()
"""Test of source 0: 10 mg range, γ = 0.45° (7.9 mg), 12 positions, 20 to 40 °C in 5 °C steps, 1 h soak, three runs."""


def fixed_point_heating(campaign: Campaign = INSTRUMENT_A, readings: int = 12) -> Campaign:
    """Plan fixed-point heating, the older method: a run of temperature steps at each of the inputs 0 and ±g·sin γ.

    Args:
        campaign: campaign whose first tilt γ, temperatures and true coefficients are used.
        readings: number of readings at each temperature.
    """
    tilt = campaign.tilts[0]
    set_ups = tuple(SetUp(tilt, angle * DEGREE) for angle in (0.0, 90.0, 270.0))
    return replace(campaign, set_ups=set_ups, repeats=readings)
