"""The models that samplers are timed on: each a model and its readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

import bayescal as bc
from bayescal import effects
from bayescal_models import mems_gyro, ng_accelerometer, quartz_beam_accelerometer
from bayescal_models.mems_gyro import reference_problem
from bayescal_models.quartz_beam_accelerometer.model import two_thermometers

DEVICES, SEED = 50, 20261121
OFFSETS, SLOPES = 5.0, 0.02  # standard deviations over the fleet, °/s, °/s/°C
Given = tuple[bc.Model, bc.Measurements]


def ng() -> Given:
    """The ng accelerometer's baseline on its own campaign: 12 positions × 5 temperatures × 3 runs."""
    return ng_accelerometer.INSTRUMENT.baseline(), ng_accelerometer.simulate(seed=0)


def quartz_beam() -> Given:
    """The quartz beam accelerometer's two-thermometer model on its own campaign."""
    return two_thermometers(), quartz_beam_accelerometer.simulate(seed=0)


def fleet() -> Given:
    """Fifty gyroscopes, a line over temperature each, that share the spreads of their offsets and slopes."""
    random = np.random.default_rng(SEED)
    one = reference_problem.readings()
    rows = len(one)
    offset, slope = (
        OFFSETS * random.standard_normal(DEVICES),
        SLOPES * random.standard_normal(DEVICES),
    )
    temperature = np.tile(one["temperature"], DEVICES)
    device = np.repeat(np.arange(DEVICES), rows)
    mean = 22.0 + offset[device] + (0.05 + slope[device]) * (temperature - 55.0)
    readings = bc.Measurements.from_arrays(
        mems_gyro.INSTRUMENT,
        run=np.array([f"device {i}" for i in device]),
        temperature=temperature,
        output=mean + 0.2 * random.standard_normal(len(mean)),
    )
    own = bc.Effect(
        "bias.slope",
        "bias",
        basis=lambda r: r.centred(),
        coefficients=(
            bc.Coefficient(
                "°/s/°C", bc.Normal(0.0, SLOPES), per="run", group_sd=bc.HalfNormal(SLOPES)
            ),
        ),
        columns=("run", "temperature"),
        equation="d[run]·(T − T0),  d ~ N(0, s²)",
        source="ours",
    )
    offsets = effects.deviation("bias", "run", OFFSETS, "°/s", source="ours")
    return mems_gyro.INSTRUMENT.baseline() + offsets + own, readings


PROBLEMS: Mapping[str, Callable[[], Given]] = MappingProxyType(
    {"ng accelerometer": ng, "quartz beam accelerometer": quartz_beam, "fleet": fleet}
)
