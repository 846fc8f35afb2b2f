"""Simulator of zero tests and verifications with hidden effects.

The test is simulated physically: true angles with the table's dividing errors, a hinge that lags behind the
thermometer, a settling base, a hysteresis that reverses over some degrees, and the equation of both axes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from bayescal_models import simulated
from bayescal_models.inclinometer.campaign import Accelerometer, Campaign
from bayescal_models.inclinometer.geometry import ARCSEC, exact_placement, sensed

MEAN_TEMPERATURE = 20.0  # °C
STREAMS = ("noise", "run", "table", "thermometer", "device", "supply")
DIVIDING = 2.0  # arcsec, limit of the table's dividing errors, uniform (source 4)
LAG_TIME = 300.0  # s, lag of the hinge behind the thermometer
WARM_UP_TIME = 900.0  # s, warm-up of the electronics in a mounting
SETTLING_TIME = 12 * 3600.0  # s, time constant of the settling base
REVERSAL = 2.0  # deg, over which hysteresis follows a reversal
DEVICE_SPREAD, DEVICE_SLOPE = (
    30.0,
    0.3,
)  # arcsec and arcsec/deg, standard deviations between devices
PHASES = (0.0, 0.7)  # rad, initial phases of temperature and settling


class World:
    """True quantities of a campaign, device by device and mounting by mounting: one entry per reading.

    Attributes:
        plan: plan of the test.
        device, axis, run: labels.
        placement_set, tilt: set placement angle (ω, or the other axis' tilt) and set tilt along the axis, rad.
        time: s.
        forward: +1 in forward sweeps, −1 in backward ones.
        accelerometer: arrays of its constants; hidden effects are multiplied by its `share`.
        cross: true tilt of the other axis, or true placement angle, rad.
        placement: placement angle of the zero's equation, rad.
        thermometer, warmth: its reading, and the lagging hinge's temperature minus the mean, °C.
        started: remaining fraction of each mounting's warm-up.
        supply: voltage of the supply, V.
        settled: fraction of the base's settling, from −½ to ½.
        sweep: direction of the sweep, with gradual reversal.
        mounted: deviation of each mounting's zero, arcsec.
    """

    def __init__(self, plan: Campaign, random: Mapping[str, np.random.Generator]) -> None:
        self.plan = plan
        rows, clock = [], 0.0
        for device in range(plan.devices):
            prefix = f"{device + 1}" if plan.devices > 1 else ""
            for labels, columns in (_verification if plan.grid else _zero_test)(plan, prefix):
                count = len(columns[0])
                # Both axes of a verification are read at one time.
                step = np.arange(count) % (count // 2 if plan.grid else count)
                time = clock + plan.interval * step
                clock = float(time.max()) + plan.pause
                rows.append(([str(device + 1)] * count, *labels, *columns, time))
        self.device, self.axis, self.run, self.placement_set, self.tilt, *motion = map(
            np.concatenate, zip(*rows, strict=True)
        )
        self.forward, turned, self.time = motion
        phase = 2 * np.pi * self.time / plan.period + PHASES[0]
        turn = 2 * np.pi * LAG_TIME / plan.period  # of a first-order body, phase lag of the swing
        noise = 0.01 * random["thermometer"].standard_normal(self.time.size)
        self.thermometer = MEAN_TEMPERATURE + plan.swing * np.sin(phase) + noise
        self.warmth = plan.swing * np.sin(phase - np.arctan(turn)) / np.hypot(1.0, turn)
        self.supply = simulated.wandering_supply(random["supply"], self.time)
        settled = 1 - np.exp(-(self.time - self.time.min()) / SETTLING_TIME)
        self.settled = settled / max(float(settled.max()), 1e-300) - 0.5
        limit = ARCSEC * DIVIDING
        error = random["table"].uniform(-limit, limit, self.time.size)
        self.placement = self.cross = self.placement_set + error
        if plan.grid and plan.exact:
            self.placement = exact_placement(self.tilt, self.cross, np)
        self.sweep = self.forward * (1 - 2 * np.exp(-turned / REVERSAL))
        self.accelerometer = self._accelerometers(random["device"])
        self.share = self.accelerometer.share
        _, codes = np.unique(self.run, return_inverse=True)
        first = np.array([self.time[codes == k].min() for k in range(codes.max() + 1)])
        self.started = np.exp(-(self.time - first[codes]) / WARM_UP_TIME)
        drawn = random["run"].standard_normal(codes.max() + 1)
        self.mounted = plan.repeatability * drawn[codes]

    def _accelerometers(self, random: np.random.Generator) -> Accelerometer:
        by_axis = dict(self.plan.axes)
        parameters = [by_axis[axis] for axis in self.axis]
        fields = {
            f: np.array([getattr(parameter, f) for parameter in parameters])
            for f in Accelerometer.__dataclass_fields__
        }
        for device in np.unique(self.device)[1:]:
            for axis in by_axis:
                shift, slope = random.standard_normal(2)
                chosen = (self.device == device) & (self.axis == axis)
                fields["constant"][chosen] += DEVICE_SPREAD * shift
                fields["slope"][chosen] += DEVICE_SLOPE * slope
        return Accelerometer(**fields)  # pyright: ignore[reportArgumentType]


def _zero_test(plan: Campaign, prefix: str):
    """Yield each mounting's labels (axis, run) and columns (placement, tilt, forward, angle since reversal, deg)."""
    sweep = np.asarray(plan.angles, dtype=float)
    angles, forward, turned = sweep, np.ones(sweep.size), np.full(sweep.size, np.inf)
    if plan.backward:
        angles = np.concatenate([sweep, sweep[::-1]])
        forward = np.concatenate([forward, -forward])
        turned = np.concatenate([turned, np.abs(sweep[::-1] - sweep[-1])])
    zero = np.zeros(angles.size)
    for (axis, _), run in product(plan.axes, range(1, plan.runs + 1)):
        labels = [axis] * angles.size, [f"{prefix}{axis}{run}"] * angles.size
        yield labels, (np.deg2rad(angles), zero, forward, turned)


def _verification(plan: Campaign, prefix: str):
    points = plan.pairs()
    ones, infinite = np.ones(2 * len(points)), np.full(2 * len(points), np.inf)
    for run in range(1, plan.runs + 1):
        axis = ["x"] * len(points) + ["y"] * len(points)
        labels = axis, [f"{prefix}{a}{run}" for a in axis]
        tilt, cross = points.T.ravel(), points[:, ::-1].T.ravel()
        yield labels, (cross, tilt, ones, infinite)


class _Sum(NamedTuple):
    """Sums of effects: angles in arcsec, κ in ppm."""

    zero: Any = 0.0
    electrical: Any = 0.0
    scale: Any = 0.0
    leak: Any = 0.0
    rig: Any = 0.0


def _zero(law: Callable[[World], Any]) -> Callable[[World, float], _Sum]:
    return lambda w, size: _Sum(zero=w.share * size * law(w))


def _electrical(w: World, size: float) -> _Sum:
    """Return the electrical part of the zero, which does not tilt with the axis."""
    return _Sum(zero=-w.share * size, electrical=w.share * size)


def _wobble(w: World) -> np.ndarray:
    """Return the wobble of the spindle axis, once and twice per turn; every sine and cosine of amplitude 1."""
    return np.sqrt(2.0) * (np.cos(w.cross - np.pi / 4) + np.cos(2 * w.cross - np.pi / 4))


_LAWS: dict[str, Callable[[World, float], _Sum]] = {
    "zero.placement_quadratic": _zero(lambda w: np.rad2deg(w.placement) ** 2),
    "zero.projection": _zero(lambda w: np.cos(w.placement) + np.sin(w.placement)),
    "zero.temperature": _zero(lambda w: w.warmth),
    "zero.temperature_quadratic": _zero(lambda w: w.warmth**2),
    "zero.warm_up": _zero(lambda w: w.started),
    "zero.supply": _zero(lambda w: w.supply - simulated.SUPPLY),
    "zero.temperature_x_supply": _zero(lambda w: w.warmth * (w.supply - simulated.SUPPLY)),
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
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """Simulate a campaign with hidden effects: columns by name, in the instrument's units.

    The same seed gives the same noise whatever the effects.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficients, which all have that size;
            effects on an accelerometer are multiplied by its `share`.
        seed: seed of the random-number generator.
        campaign: the test; the default is source 4's zero test.

    Raises:
        ValueError: an unknown effect, or a size that is not a finite number.
    """
    campaign, effects = campaign or Campaign(), dict(effects or {})
    simulated.refuse_effects(effects, _LAWS, "a test of the inclinometer")
    random = simulated.generators(STREAMS, seed)
    world = World(campaign, random)
    output = _reading(world, effects) + campaign.noise * random["noise"].standard_normal(
        world.time.size
    )
    columns: dict[str, Any] = {"device": world.device} if campaign.devices > 1 else {}
    columns |= {
        "axis": world.axis,
        "run": world.run,
        "placement_angle": world.placement_set,
        "time": world.time,
        "temperature": world.thermometer,
        "output": output,
    }
    if simulated.supplied(effects):
        columns["supply_voltage"] = world.supply
    if campaign.grid:
        columns["true_angle"] = world.tilt
    else:
        columns["direction"] = np.where(world.forward > 0, "forward", "backward")
    return columns


def _reading(world: World, effects: Mapping[str, float]) -> np.ndarray:
    """Return readings without noise, arcsec."""
    accelerometer = world.accelerometer
    mechanical = accelerometer.mechanical(world.placement) + world.mounted
    total = _Sum(mechanical, accelerometer.electrical, accelerometer.scale)
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
