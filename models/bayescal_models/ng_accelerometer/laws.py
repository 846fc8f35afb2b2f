"""What can be hidden in a simulated test: one small physical law per effect.

A law takes the world of the test and returns what one unit of the effect adds to its slot, moment by moment. None
uses the columns from which a candidate builds its basis (set points, the thermometer's record, the clock of the
readings), and most are not quite of its form, so that a fitted model is an approximation here as it is in life.

An effect on the base tilt acts on both components with the size given; `name[parallel]` and `name[perp]` set one
alone. The size of `base_tilt.tide` is each component's largest tilt of the month, nrad.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from bayescal_models.ng_accelerometer.campaign import Campaign
from bayescal_models.ng_accelerometer.rig.world import Array, World
from bayescal_models.ng_accelerometer.sizes import ARCSEC, BASELINE_SIZES, DEGREE, SIZES

SATURATION = 40.0  # °C, over which a curved law departs from its leading power
UNEVEN = 0.002  # 1/°C, by which a warming fixture bends more, the warmer it is
HIGHER = 0.1  # share of the next lobes in what is uneven around a turn
UNITS = {
    "ug": 1.0,
    "1": 1.0,
    "ppm": 1e-6,
    "urad": 1e-6,
    "nrad": 1e-9,
    "arcsec": ARCSEC,
    "deg": DEGREE,
}
BY_CELL = ("bias", "scale", "fixture_tilt", "base_tilt_parallel", "base_tilt_perp")
BY_RUN = ("bias", "scale", "fixture_tilt", "fixture_tilt.temperature")

Curve = Callable[[World, Campaign], Array]


class Law(NamedTuple):
    """The slot that a law adds to, and what one unit of the effect adds, in `unit`."""

    slot: str
    unit: str
    curve: Curve

    def contribution(self, size: float, world: World, campaign: Campaign) -> Array:
        """In the slot's own unit, (n, m)."""
        return size * UNITS.get(self.unit.split("/")[0], 1.0) * self.curve(world, campaign)


def _warmer(world: World, campaign: Campaign) -> Array:
    return world.device - campaign.T0


def _square(world: World, campaign: Campaign) -> Array:
    """2w²(cosh(ΔT/w) − 1): ΔT² and a little more."""
    return 2 * SATURATION**2 * (np.cosh(_warmer(world, campaign) / SATURATION) - 1)


def _cube(world: World, campaign: Campaign) -> Array:
    """6w³(sinh(ΔT/w) − ΔT/w): ΔT³ and a little more."""
    ratio = _warmer(world, campaign) / SATURATION
    return 6 * SATURATION**3 * (np.sinh(ratio) - ratio)


def _fixture(world: World, campaign: Campaign) -> Array:
    """Expansion of the fixture, whose coefficient itself grows a little with temperature, °C."""
    change = world.fixture - campaign.T0
    return change + UNEVEN * change**2


def _lobed(world: World) -> Array:
    """Two and three lobes around a turn, and higher ones."""
    waves = [wave(m * world.angle) for m in (2, 3) for wave in (np.cos, np.sin)]
    return sum(waves) + HIGHER * (np.cos(4 * world.angle) + np.sin(5 * world.angle))


def _settled(world: World) -> Array:
    """A foundation that settles: fast first, then slower; 1 over the test."""
    return np.expm1(-2 * world.share) / np.expm1(-2.0)


def _eccentric(world: World, campaign: Campaign) -> Array:
    """Circle of the table mounted off its centre, seen by its reading head, in parts of the error."""
    small = np.sqrt(2) * ARCSEC
    angle = world.angle + np.pi / 4
    return np.arctan2(small * np.sin(angle), 1 + small * np.cos(angle)) / ARCSEC


def _ones(world: World, campaign: Campaign) -> Array:
    return np.ones_like(world.time)


_CURVES: Mapping[str, tuple[str, Curve]] = {
    "bias.constant": ("bias", _ones),
    "bias.temperature": ("bias", _warmer),
    "scale.constant": ("scale", _ones),
    "scale.temperature": ("scale", _warmer),
    "fixture_tilt.constant": ("fixture_tilt", _ones),
    "rotation.constant": ("rotation", _ones),
    "tilt.setting": ("base_tilt_perp", _ones),
    "bias.temperature_quadratic": ("bias", _square),
    "bias.temperature_cubic": ("bias", _cube),
    "scale.temperature_quadratic": ("scale", _square),
    "scale.temperature_cubic": ("scale", _cube),
    "bias.drift": ("bias", lambda w, c: np.log2(1 + w.share)),  # ageing
    "bias.warm_up": ("bias", lambda w, c: w.warmth),
    "bias.rate": ("bias", lambda w, c: w.heating),
    "bias.thermal_lag": ("bias", lambda w, c: w.element - w.device),
    "bias.hysteresis": ("bias", lambda w, c: w.direction),
    "fixture_tilt.temperature": ("fixture_tilt", _fixture),
    "fixture_tilt.position": ("fixture_tilt", lambda w, c: (w.fixture - c.T0) * _lobed(w)),
    "second_order": ("second_order", _ones),
    "third_order": ("third_order", _ones),
    "cross_coupling": ("cross_coupling", _ones),
    "cross_coupling.temperature": ("cross_coupling", _warmer),
    "rotation.harmonic": ("rotation", _eccentric),
    "rotation.wobble": ("fixture_tilt", lambda w, c: _lobed(w) + 0 * w.time),
}
_BASE_CURVES: Mapping[str, Callable[[int], Curve]] = {
    "base_tilt.constant": lambda side: _ones,
    "base_tilt.lab_temperature": lambda side: lambda w, c: w.foundation - c.laboratory,
    "base_tilt.temperature": lambda side: lambda w, c: w.base - c.T0,
    "base_tilt.tide": lambda side: lambda w, c: w.tide[side],
    "base_tilt.drift": lambda side: lambda w, c: _settled(w),
}


def _unit(name: str) -> str:
    if name == "base_tilt.tide":
        return "nrad"
    return (BASELINE_SIZES.get(name) or SIZES[name]).unit


def _scatter(what: str, group: str) -> Law:
    """One deviation for each cell or run; the size is their standard deviation."""
    slot, _, cause = what.partition(".")
    name = f"{slot.split('_p')[0]}.{group}{'_' + cause if cause else ''}"

    def curve(world: World, campaign: Campaign) -> Array:
        draws = world.by_cell[what] if group == "cell" else world.by_run[what]
        return draws * (_fixture(world, campaign) if cause else np.ones_like(world.time))

    return Law(slot, _unit(name), curve)


def _all() -> dict[str, tuple[Law, ...]]:
    laws: dict[str, tuple[Law, ...]] = {
        name: (Law(slot, _unit(name), curve),) for name, (slot, curve) in _CURVES.items()
    }
    for name, curve_of in _BASE_CURVES.items():
        sides = [
            Law(f"base_tilt_{s}", _unit(name), curve_of(k))
            for k, s in enumerate(("parallel", "perp"))
        ]
        laws |= {name: tuple(sides), f"{name}[parallel]": (sides[0],), f"{name}[perp]": (sides[1],)}
    for slot in ("bias", "scale", "fixture_tilt"):
        laws[f"{slot}.cell"] = (_scatter(slot, "cell"),)
        laws[f"{slot}.run"] = (_scatter(slot, "run"),)
    laws["fixture_tilt.run_temperature"] = (_scatter("fixture_tilt.temperature", "run"),)
    sides = [_scatter(f"base_tilt_{s}", "cell") for s in ("parallel", "perp")]
    laws["base_tilt.cell"] = tuple(sides)
    laws |= {"base_tilt.cell[parallel]": (sides[0],), "base_tilt.cell[perp]": (sides[1],)}
    return laws


LAWS: Mapping[str, tuple[Law, ...]] = MappingProxyType(_all())
"""Every effect that can be in a test, baseline and hidden, by canonical name."""
