"""The campaigns that `compensation` calibrates from, an instrument each, and the readings that verify them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

import bayescal as bc
from bayescal_models import (
    inclinometer,
    mems_gyro,
    ng_accelerometer,
    quartz_beam_accelerometer,
)
from bayescal_models.mems_gyro.reference_problem import TURNING
from bayescal_models.ng_accelerometer import reference_problem as ng_problem
from bayescal_models.ng_accelerometer.model import accelerations
from bayescal_models.still_sensor import reference_problem as still_problem
from benchmarks.instruments.compensation_trial import Trial

VERIFIED = 60  # readings of a verification


def _made(instrument: bc.Instrument, **columns: Any) -> bc.Measurements:
    return bc.Measurements.from_arrays(instrument, output=np.zeros(VERIFIED), **columns)


def _gyro(random: np.random.Generator) -> Trial:
    """The instrument's own campaign, 30 … 80 °C in three runs, turning, so that the scale factor shows."""
    plan = mems_gyro.simulate(seed=0, campaign=mems_gyro.Campaign(rate_input=TURNING))
    rate = random.uniform(-100, 100, VERIFIED)
    temperature = random.uniform(30, 80, VERIFIED)
    made = _made(mems_gyro.INSTRUMENT, temperature=temperature, rate_input=rate)
    model = mems_gyro.INSTRUMENT.baseline() + "scale.constant"
    return Trial("mems_gyro", model, plan, verification=made, stimulus=rate)


def _inclinometer(random: np.random.Generator) -> Trial:
    """Source 4's own zero test, and a grid of tilts of axis x in a new mounting."""
    plan = inclinometer.simulate(seed=0)
    tilt, other = np.deg2rad(random.uniform(-40, 40, (2, VERIFIED)))
    made = _made(
        inclinometer.INSTRUMENT,
        axis=np.full(VERIFIED, "x"),
        run=np.full(VERIFIED, "x new"),
        placement_angle=other,
        true_angle=tilt,
    )
    return Trial(
        "inclinometer",
        inclinometer.INSTRUMENT.baseline(),
        plan,
        verification=made,
        stimulus=tilt,
        members=(("axis", "x"),),
        aside=("zero.constant",),
    )


def _still(random: np.random.Generator) -> Trial:
    """The reference problem's two runs of ramps; whatever is then added to the output is the stimulus."""
    plan = still_problem.readings()
    low, high = plan["temperature"].min(), plan["temperature"].max()
    temperature = random.uniform(low, high, VERIFIED)
    sensor, hours = still_problem.SENSOR, 60.0 * np.arange(VERIFIED)
    made = _made(sensor, temperature=temperature, time=hours)
    return Trial(
        "still_sensor",
        still_problem.model(),
        plan,
        verification=made,
        stimulus=random.uniform(-1e3, 1e3, VERIFIED),
        added=True,
    )


def _quartz(random: np.random.Generator) -> Trial:
    """The instrument's own campaign: tumbles and ramps over −40 … 70 °C."""
    plan = quartz_beam_accelerometer.simulate(seed=0)
    head = random.uniform(plan["temperature_head"].min(), plan["temperature_head"].max(), VERIFIED)
    acceleration = random.uniform(-1e6, 1e6, VERIFIED)
    made = _made(
        quartz_beam_accelerometer.INSTRUMENT,
        temperature_circuit=head,
        temperature_head=head,
        acceleration=acceleration,
    )
    model = quartz_beam_accelerometer.INSTRUMENT.baseline()
    return Trial("quartz_beam_accelerometer", model, plan, verification=made, stimulus=acceleration)


def _ng(random: np.random.Generator) -> Trial:
    """Source 0's test of instrument A, 180 readings; the reference problem's priors, since those of a first calibration
    are flat in effect. Verified at its positions and temperatures anew, the face and the base without tilt errors.

    Cell by cell the fixture tilts by its own spread, an alias of the bias' own; where its spread is the larger one, it
    costs the tempco more than the verification, which is without it, shows of the least error: ratios rise.
    """
    campaign = replace(ng_problem.CAMPAIGN, temperatures=(20.0, 25.0, 30.0, 35.0, 40.0), runs=3)
    plan = ng_accelerometer.simulate(seed=0, campaign=campaign)
    made = ng_accelerometer.simulate(seed=1, campaign=campaign)
    none = jnp.zeros(len(made))
    tilt, angle = jnp.asarray(made["tilt"]), jnp.asarray(made["position_angle"])
    return Trial(
        "ng_accelerometer",
        ng_problem.model(),
        plan,
        verification=made,
        stimulus=np.asarray(accelerations(tilt, angle, none, none, none).along),
        aside=("bias.constant", "scale.constant"),
        proposals=8192,
    )


TRIALS: dict[str, Callable[[np.random.Generator], Trial]] = {
    "mems_gyro": _gyro,
    "still_sensor": _still,
    "inclinometer": _inclinometer,
    "quartz_beam_accelerometer": _quartz,
    "ng_accelerometer": _ng,
}


def trial(name: str) -> Trial:
    """The trial of an instrument; its verification readings are the same every time."""
    return TRIALS[name](np.random.default_rng(sorted(TRIALS).index(name)))
