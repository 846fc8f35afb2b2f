"""Columns of simulated zero tests and verifications, with effects hidden in them.

The world is made by its physics: true angles behind the table's dividing errors, a hinge that lags behind the
thermometer, a base that settles, a hysteresis that needs some degrees to turn round, and the equation of both axes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayescal_models import simulated
from bayescal_models.inclinometer.campaign import Accelerometer, Campaign, Plan, plan
from bayescal_models.inclinometer.geometry import ARCSEC, exact_placement, sensed

MEAN_TEMPERATURE = 20.0  # °C
PHASES = (0.0, 0.7)  # rad, where temperature and the base's settling start: not in step


@dataclass(frozen=True)
class _World:
    """What is true at each reading, one entry each."""

    accelerometer: Accelerometer  # arrays of its constants
    share: np.ndarray  # multiple at which hidden effects come
    tilt: np.ndarray  # true, along the axis, rad
    cross: np.ndarray  # true tilt of the other axis, or true placement angle, rad
    placement: np.ndarray  # placement angle that the zero follows, rad
    warmth: np.ndarray  # hinge temperature − mean, °C
    settled: np.ndarray  # part of the base's tilting that has happened, from −½ to ½
    sweep: np.ndarray  # direction of the sweep, turning round gradually


class _Sum(NamedTuple):
    """What effects add up to: angles in arcsec, κ in ppm."""

    zero: Any = 0.0
    electrical: Any = 0.0
    scale: Any = 0.0
    leak: Any = 0.0
    rig: Any = 0.0


def _zero(law: Callable[[_World], Any]) -> Callable[[_World, float], _Sum]:
    return lambda w, size: _Sum(zero=w.share * size * law(w))


def _electrical(w: _World, size: float) -> _Sum:
    """As much of the zero as `size` is electrical: it does not tilt with the axis."""
    return _Sum(zero=-w.share * size, electrical=w.share * size)


def _wobble(w: _World) -> np.ndarray:
    """The spindle's axis goes round a cone, once and twice a turn; every sine and cosine of size 1."""
    return np.sqrt(2.0) * (np.cos(w.cross - np.pi / 4) + np.cos(2 * w.cross - np.pi / 4))


_LAWS: dict[str, Callable[[_World, float], _Sum]] = {
    "zero.placement_quadratic": _zero(lambda w: np.rad2deg(w.placement) ** 2),
    "zero.projection": _zero(lambda w: np.cos(w.placement) + np.sin(w.placement)),
    "zero.temperature": _zero(lambda w: w.warmth),
    "zero.hysteresis": _zero(lambda w: w.sweep),
    "zero.cross_axis": lambda w, size: _Sum(leak=w.share * size * np.sin(w.cross)),
    "zero.electrical_tilt": _electrical,
    "zero.exact_placement": _zero(
        lambda w: np.rad2deg(exact_placement(w.tilt, w.cross, np) - w.cross)
    ),
    "scale.constant": lambda w, size: _Sum(scale=w.share * size),
    "dividing.wobble": lambda w, size: _Sum(rig=size * _wobble(w)),
    "dividing.face": lambda w, size: _Sum(rig=size),
    "base_tilt.drift": lambda w, size: _Sum(rig=size * w.settled),
}


def simulated_columns(
    effects: Mapping[str, float] | None = None,
    *,
    seed: int,
    campaign: Campaign | None = None,
) -> dict[str, Any]:
    """A campaign with these effects hidden in it: its columns, by name, in the instrument's units.

    The same seed gives the same noise whatever the effects.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficients, which all have that size;
            effects on an accelerometer come at its own `share` of it.
        seed: of every random number.
        campaign: the test; the default is source 4's zero test.

    Raises:
        ValueError: an unknown effect, or a size that is no number.
    """
    campaign, effects = campaign or Campaign(), dict(effects or {})
    simulated.refuse_effects(effects, _LAWS, "a test of the inclinometer")
    random = simulated.generators(("noise", "run", "table", "thermometer", "device"), seed)
    laid = plan(campaign)
    temperature, world = _world(campaign, laid, random)
    output = _reading(campaign, laid, world, effects, _repeated(campaign, laid, random["run"]))
    output = output + campaign.noise * random["noise"].standard_normal(output.size)
    columns: dict[str, Any] = {
        "axis": laid.axis,
        "run": laid.run,
        "placement_angle": laid.placement,
        "time": laid.time,
        "temperature": temperature,
        "output": output,
    }
    if campaign.devices > 1:
        columns = {"device": laid.device, **columns}
    if laid.verification:
        columns["true_angle"] = laid.tilt
    else:
        columns["direction"] = np.where(laid.forward > 0, "forward", "backward")
    return columns


def _world(
    campaign: Campaign, laid: Plan, random: Mapping[str, np.random.Generator]
) -> tuple[np.ndarray, _World]:
    """The thermometer's column, °C, and what is true."""
    phase = 2 * np.pi * laid.time / campaign.period + PHASES[0]
    turn = 2 * np.pi * campaign.lag_time / campaign.period  # of a body of first order, in its swing
    thermometer = campaign.swing * np.sin(phase)
    warmth = campaign.swing * np.sin(phase - np.arctan(turn)) / np.hypot(1.0, turn)
    noise = 0.01 * random["thermometer"].standard_normal(laid.time.size)
    settled = 1 - np.exp(-(laid.time - laid.time.min()) / campaign.settling_time)
    settled = settled / max(float(settled.max()), 1e-300) - 0.5
    limit = ARCSEC * campaign.dividing
    error = random["table"].uniform(-limit, limit, laid.time.size)
    cross = laid.placement + error
    placement = cross
    if laid.verification and campaign.exact:
        placement = exact_placement(laid.tilt, cross, np)
    turning = 1 - 2 * np.exp(-laid.turned / campaign.reversal)
    own, share = _accelerometers(campaign, laid, random["device"])
    world = _World(
        *(own, share, laid.tilt, cross, placement),
        warmth=warmth,
        settled=settled,
        sweep=laid.forward * turning,
    )
    return MEAN_TEMPERATURE + thermometer + noise, world


def _accelerometers(
    campaign: Campaign, laid: Plan, random: np.random.Generator
) -> tuple[Accelerometer, np.ndarray]:
    """Each reading's accelerometer, as one of arrays, and its share of hidden effects."""
    known = dict(campaign.axes)
    own = [known[axis] for axis in laid.axis]
    made = {
        f: np.array([getattr(one, f) for one in own]) for f in Accelerometer.__dataclass_fields__
    }
    for device in np.unique(laid.device)[1:]:
        for axis in known:
            shift, slope = random.standard_normal(2)
            chosen = (laid.device == device) & (laid.axis == axis)
            made["constant"][chosen] += campaign.device_spread * shift
            made["slope"][chosen] += campaign.device_slope * slope
    return Accelerometer(**made), made["share"]  # pyright: ignore[reportArgumentType]


def _repeated(campaign: Campaign, laid: Plan, random: np.random.Generator) -> np.ndarray:
    """What each mounting adds, arcsec."""
    _, codes = np.unique(laid.run, return_inverse=True)
    return campaign.repeatability * random.standard_normal(codes.max() + 1)[codes]


def _reading(
    campaign: Campaign, laid: Plan, world: _World, effects: Mapping[str, float], mounted: np.ndarray
) -> np.ndarray:
    """Readings without noise, arcsec."""
    one = world.accelerometer
    total = _Sum(one.mechanical(world.placement) + mounted, one.electrical, one.scale)
    for name, size in effects.items():
        parts = zip(total, _LAWS[name](world, size), strict=True)
        total = _Sum(*(whole + part for whole, part in parts))
    tilt = world.tilt + ARCSEC * total.rig
    sine = sensed(
        np.sin(tilt),
        ARCSEC * total.zero,
        np.cos(tilt),
        ARCSEC * total.electrical,
        1e-6 * total.scale,
        ARCSEC * total.leak,
    )
    return np.arcsin(np.clip(sine, -1.0, 1.0)) / ARCSEC
