"""Simulator of zero tests and verifications of an inclinometer with hidden effects.

The simulation includes dividing errors of the table, a hinge whose temperature lags behind the thermometer, a settling
base, a hysteresis that reverses over some degrees, and the measurement equation of both axes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from bayescal_models import simulated
from bayescal_models.inclinometer.campaign import Accelerometer, Campaign
from bayescal_models.inclinometer.geometry import ARCSEC, compute_placement_angle, compute_sine
from bayescal_models.simulated import SUPPLY_V

MEAN_TEMPERATURE_DEGC = 20.0  # °C
RANDOM_STREAMS = ("noise", "run", "table", "thermometer", "device", "supply")
DIVIDING_LIMIT_ARCSEC = 2.0  # arcsec, limit of the table's uniform dividing errors (source 4)
HINGE_TAU_S = 300.0  # s, lag of the hinge behind the thermometer
WARM_UP_S = 900.0  # s, warm-up of the electronics after each mounting
SETTLING_TAU_S = 12 * 3600.0  # s, time constant of the settling base
REVERSAL_DEG = 2.0  # deg, angle in which the hysteresis reverses
DEVICE_SD, DEVICE_SLOPE_SD = 30.0, 0.3  # arcsec, arcsec/deg, standard deviations between devices
PHASES = (0.0, 0.7)  # rad, initial phases of temperature and settling


class Conditions:
    """Conditions of a campaign, one entry per reading, ordered by device and mounting.

    Attributes:
        plan: plan of the test.
        device, axis, run: labels of device, accelerometer and mounting.
        placement_set, tilt: set placement angle (ω, or the other axis' tilt) and set tilt along the axis, rad.
        time: time since the start of the campaign, s.
        sweep_sign: +1 in forward sweeps, −1 in backward ones.
        accelerometer: true errors of the reading's accelerometer, as arrays.
        cross: true tilt of the other axis or, in a zero test, true placement angle, rad.
        placement: true placement angle, rad.
        thermometer: reading of the thermometer, °C.
        hinge: temperature of the lagging hinge minus its mean, °C.
        warm_up_deficit: remaining fraction of the warm-up, 1 at the start of a mounting.
        supply: supply voltage, V.
        settlement: settlement of the base, from −½ to ½ over the campaign.
        hysteresis: state of the hysteresis, −1 … 1: `sweep_sign` with gradual reversals.
        mounting_deviation: random deviation of the mounting's zero, arcsec.
    """

    def __init__(self, plan: Campaign, generators: Mapping[str, np.random.Generator]) -> None:
        self.plan = plan
        rows, start_time = [], 0.0
        for device in range(plan.devices):
            prefix = f"{device + 1}" if plan.devices > 1 else ""
            for labels, columns in (_plan_grid if plan.grid else _plan_zero_test)(plan, prefix):
                n_readings = len(columns[0])
                # Both axes of a verification are read simultaneously.
                step = np.arange(n_readings) % (n_readings // 2 if plan.grid else n_readings)
                time = start_time + plan.interval * step
                start_time = float(time.max()) + plan.pause
                rows.append(([str(device + 1)] * n_readings, *labels, *columns, time))
        self.device, self.axis, self.run, self.placement_set, self.tilt, *motion = map(
            np.concatenate, zip(*rows, strict=True)
        )
        self.sweep_sign, since_reversal, self.time = motion
        phase = 2 * np.pi * self.time / plan.period + PHASES[0]
        tangent = 2 * np.pi * HINGE_TAU_S / plan.period  # of a first-order body's phase lag
        noise = 0.01 * generators["thermometer"].standard_normal(self.time.size)
        self.thermometer = MEAN_TEMPERATURE_DEGC + plan.swing * np.sin(phase) + noise
        self.hinge = plan.swing * np.sin(phase - np.arctan(tangent)) / np.hypot(1.0, tangent)
        self.supply = simulated.simulate_supply(generators["supply"], self.time)
        settlement = 1 - np.exp(-(self.time - self.time.min()) / SETTLING_TAU_S)
        self.settlement = settlement / max(float(settlement.max()), 1e-300) - 0.5
        error_limit = ARCSEC * DIVIDING_LIMIT_ARCSEC
        dividing_errors = generators["table"].uniform(-error_limit, error_limit, self.time.size)
        self.placement = self.cross = self.placement_set + dividing_errors
        if plan.grid and plan.exact:
            self.placement = compute_placement_angle(self.tilt, self.cross, np)
        self.hysteresis = self.sweep_sign * (1 - 2 * np.exp(-since_reversal / REVERSAL_DEG))
        self.accelerometer = self._draw_accelerometers(generators["device"])
        self.share = self.accelerometer.share
        _, codes = np.unique(self.run, return_inverse=True)
        start_times = np.array([self.time[codes == k].min() for k in range(codes.max() + 1)])
        self.warm_up_deficit = np.exp(-(self.time - start_times[codes]) / WARM_UP_S)
        deviates = generators["run"].standard_normal(codes.max() + 1)
        self.mounting_deviation = plan.repeatability * deviates[codes]

    def _draw_accelerometers(self, generator: np.random.Generator) -> Accelerometer:
        by_axis = dict(self.plan.axes)
        accelerometers = [by_axis[axis] for axis in self.axis]
        fields = {
            f: np.array([getattr(accelerometer, f) for accelerometer in accelerometers])
            for f in Accelerometer.__dataclass_fields__
        }
        for device in np.unique(self.device)[1:]:
            for axis in by_axis:
                constant_deviate, slope_deviate = generator.standard_normal(2)
                is_selected = (self.device == device) & (self.axis == axis)
                fields["constant"][is_selected] += DEVICE_SD * constant_deviate
                fields["slope"][is_selected] += DEVICE_SLOPE_SD * slope_deviate
        return Accelerometer(**fields)  # pyright: ignore[reportArgumentType]


def _plan_zero_test(plan: Campaign, prefix: str):
    """Yield labels (axis, run) and columns (placement, tilt, rad; sweep sign; ° since reversal) of each mounting."""
    sweep = np.asarray(plan.angles, dtype=float)
    angles, sweep_sign, since_reversal = sweep, np.ones(sweep.size), np.full(sweep.size, np.inf)
    if plan.backward:
        angles = np.concatenate([sweep, sweep[::-1]])
        sweep_sign = np.concatenate([sweep_sign, -sweep_sign])
        since_reversal = np.concatenate([since_reversal, np.abs(sweep[::-1] - sweep[-1])])
    zero_tilt = np.zeros(angles.size)
    for (axis, _), run in product(plan.axes, range(1, plan.runs + 1)):
        labels = [axis] * angles.size, [f"{prefix}{axis}{run}"] * angles.size
        yield labels, (np.deg2rad(angles), zero_tilt, sweep_sign, since_reversal)


def _plan_grid(plan: Campaign, prefix: str):
    points = plan.pairs()
    ones, infinities = np.ones(2 * len(points)), np.full(2 * len(points), np.inf)
    for run in range(1, plan.runs + 1):
        axis = ["x"] * len(points) + ["y"] * len(points)
        labels = axis, [f"{prefix}{a}{run}" for a in axis]
        tilt, cross = points.T.ravel(), points[:, ::-1].T.ravel()
        yield labels, (cross, tilt, ones, infinities)


class _Terms(NamedTuple):
    """Contributions to the terms of the measurement equation: angles in arcsec, scale factor deviation κ in ppm."""

    zero: Any = 0.0
    electrical: Any = 0.0
    scale: Any = 0.0
    cross_axis: Any = 0.0
    rig: Any = 0.0


def _make_zero_law(law: Callable[[Conditions], Any]) -> Callable[[Conditions, float], _Terms]:
    return lambda test, size: _Terms(zero=test.share * size * law(test))


def _evaluate_electrical_law(test: Conditions, size: float) -> _Terms:
    """Return the contributions of an electrical zero of this size; the mechanical zero is reduced by the same size."""
    return _Terms(zero=-test.share * size, electrical=test.share * size)


def _evaluate_spindle_wobble(test: Conditions) -> np.ndarray:
    """Return the wobble of the spindle: first and second harmonics, cosines and sines of amplitude 1, (n,)."""
    return np.sqrt(2.0) * (np.cos(test.cross - np.pi / 4) + np.cos(2 * test.cross - np.pi / 4))


_LAWS: dict[str, Callable[[Conditions, float], _Terms]] = {
    "zero.placement_quadratic": _make_zero_law(lambda test: np.rad2deg(test.placement) ** 2),
    "zero.projection": _make_zero_law(lambda test: np.cos(test.placement) + np.sin(test.placement)),
    "zero.temperature": _make_zero_law(lambda test: test.hinge),
    "zero.temperature_quadratic": _make_zero_law(lambda test: test.hinge**2),
    "zero.warm_up": _make_zero_law(lambda test: test.warm_up_deficit),
    "zero.supply": _make_zero_law(lambda test: test.supply - SUPPLY_V),
    "zero.temperature_x_supply": _make_zero_law(lambda test: test.hinge * (test.supply - SUPPLY_V)),
    "zero.hysteresis": _make_zero_law(lambda test: test.hysteresis),
    "zero.cross_axis": lambda test, size: _Terms(cross_axis=test.share * size * np.sin(test.cross)),
    "zero.electrical_tilt": _evaluate_electrical_law,
    "zero.exact_placement": _make_zero_law(
        lambda test: np.rad2deg(compute_placement_angle(test.tilt, test.cross, np) - test.cross)
    ),
    "scale.constant": lambda test, size: _Terms(scale=test.share * size),
    "dividing.wobble": lambda test, size: _Terms(rig=size * _evaluate_spindle_wobble(test)),
    "dividing.face": lambda test, size: _Terms(rig=size),
    "base_tilt.drift": lambda test, size: _Terms(rig=size * test.settlement),
}


def simulate_columns(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """Simulate a campaign with hidden effects; return columns by name, in the instrument's units.

    The same seed gives the same noise for any effects.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficients, which all have this size;
            effects on an accelerometer are multiplied by its `share`.
        seed: seed of the random-number generator.
        campaign: plan of the test; the default is source 4's zero test.

    Raises:
        ValueError: an unknown effect, or a size that is not a finite number.
    """
    campaign, effects = campaign or Campaign(), dict(effects or {})
    simulated.validate_effects(effects, _LAWS, "a test of the inclinometer")
    generators = simulated.spawn_generators(RANDOM_STREAMS, seed)
    test = Conditions(campaign, generators)
    noise = campaign.noise * generators["noise"].standard_normal(test.time.size)
    columns: dict[str, Any] = {"device": test.device} if campaign.devices > 1 else {}
    columns |= {
        "axis": test.axis,
        "run": test.run,
        "placement_angle": test.placement_set,
        "time": test.time,
        "temperature": test.thermometer,
        "output": _compute_output(test, effects) + noise,
    }
    if simulated.needs_supply_column(effects):
        columns["supply_voltage"] = test.supply
    if campaign.grid:
        columns["true_angle"] = test.tilt
    else:
        columns["direction"] = np.where(test.sweep_sign > 0, "forward", "backward")
    return columns


def _compute_output(test: Conditions, effects: Mapping[str, float]) -> np.ndarray:
    """Return the noise-free output of each reading, arcsec, (n,)."""
    accelerometer = test.accelerometer
    mechanical_zero = accelerometer.mechanical(test.placement) + test.mounting_deviation
    total = _Terms(mechanical_zero, accelerometer.electrical, accelerometer.scale)
    for name, size in effects.items():
        parts = zip(total, _LAWS[name](test, size), strict=True)
        total = _Terms(*(subtotal + term for subtotal, term in parts))
    tilt = test.tilt + ARCSEC * total.rig
    sine = compute_sine(
        np.sin(tilt),
        ARCSEC * total.zero,
        np.cos(tilt),
        ARCSEC * total.electrical,
        1e-6 * total.scale,
        ARCSEC * total.cross_axis,
    )
    return np.arcsin(np.clip(sine, -1.0, 1.0)) / ARCSEC
