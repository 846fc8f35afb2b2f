"""The six instruments of the benchmark of faulty records."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from bayescal._data.unit_conversion import STANDARD_GRAVITY
from bayescal_models import differential_pair, mems_gyro
from bayescal_models.differential_pair.simulator import simulate_batch
from bayescal_models.inclinometer.campaign import X, Y
from bayescal_models.inclinometer.simulator import MEAN_TEMPERATURE_DEGC
from bayescal_models.ng_accelerometer.campaign import TRUTH_A
from bayescal_models.quartz_beam_accelerometer.simulator import CUBIC_COEFFICIENTS
from benchmarks.spoilt_records.subject import Columns, Shift, Subject


def _ones(c: Columns) -> np.ndarray:
    return np.ones(len(c["output"]))


def _opposed(c: Columns) -> np.ndarray:
    """Return the output of an accelerometer on the arm per ppm of scale factor."""
    return 1e-6 * np.where(c["group"] == "outer", 1.0, -1.0) * c["acceleration"]


def _tilted(c: Columns) -> np.ndarray:
    """Return the output of an accelerometer on the tilted table per ppm of scale factor, without nuisance angles."""
    return np.sin(c["tilt"]) * np.sin(c["position_angle"])


def _of_devices(seed: int, hidden: Mapping[str, float]) -> dict[str, float]:
    """Return the scale factors of the accelerometers on the arm, ppm."""
    _, truth = simulate_batch(hidden, seed=seed, campaign=BATCH)
    pairs = zip(truth.names, truth.scale, strict=True)
    return {f"scale.device({name})": 1e6 * (scale - 1.0) for name, scale in pairs}


BATCH = differential_pair.Campaign(samples=80)
DEVICES = tuple(f"scale.device({side} {k})" for side in ("outer", "inner") for k in (1, 2, 3))
GYRO = mems_gyro.Campaign(rate_input=(0.0, 100.0, -100.0), nonlinearity=0.0)
_CUBIC = ("", "_quadratic", "_cubic")

SUBJECTS = {
    s.name: s
    for s in (
        Subject(
            "mems_gyro",
            hidden=(("bias.temperature_quadratic", 1e-3), ("bias.thermal_lag", 0.05)),
            true={"bias.constant": 21.5, "bias.temperature": 0.0535},
            exact={"bias.temperature_quadratic": {"bias.temperature_quadratic": 1.0}},
            noise=0.05,
            zero=Shift(("bias.constant",), 50.0, _ones),
            slope=Shift(("bias.temperature",), 0.05, lambda c: c["temperature"] - GYRO.T0),
            partner="board_temperature",
            sibling="board_temperature",
            input="rate_input",
            wrong_unit=math.pi / 180.0,
            sign=True,
            polynomials=(("bias.constant", "bias.temperature", "bias.temperature_quadratic"),),
            T0=GYRO.T0,
            lag="bias.thermal_lag",
            options={"campaign": GYRO},
        ),
        Subject(
            "still_sensor",
            hidden=(("bias.temperature_quadratic", 0.4), ("bias.thermal_lag", 15.0)),
            true={"bias.constant": 2000.0, "bias.temperature": 40.0},
            exact={"bias.temperature_quadratic": {"bias.temperature_quadratic": 1.0}},
            noise=20.0,
            zero=Shift(("bias.constant",), 2000.0, _ones),
            slope=Shift(("bias.temperature",), 40.0, lambda c: c["temperature"] - 27.0),
            polynomials=(("bias.constant", "bias.temperature", "bias.temperature_quadratic"),),
            T0=27.0,
            partner="time",
            lag="bias.thermal_lag",
        ),
        Subject(
            "quartz_beam_accelerometer",
            hidden=(("second_order", 30.0), ("bias.thermal_lag", 20.0)),
            true=CUBIC_COEFFICIENTS,
            exact={"second_order": {"second_order": 1.0}},
            noise=5.0,
            zero=Shift(("bias.constant_head",), 20_000.0, _ones),
            slope=Shift(("scale.constant_head",), 5000.0, lambda c: 1e-6 * c["acceleration"]),
            thermometer="temperature_head",
            partner="temperature_circuit",
            sibling="temperature_circuit",
            input="acceleration",
            wrong_unit=STANDARD_GRAVITY,
            sign=True,
            polynomials=tuple(
                (f"{s}.constant_head", *(f"{s}.temperature_head{p}" for p in _CUBIC))
                for s in ("bias", "scale")
            ),
            T0=15.0,
            lag="bias.thermal_lag",
        ),
        Subject(
            "ng_accelerometer",
            hidden=(("second_order", 0.15), ("bias.temperature_quadratic", 0.15)),
            true={name: TRUTH_A[name] for name in TRUTH_A if not name.endswith(".cell")},
            exact={"second_order": {"second_order": 1.0}},
            noise=0.5,
            zero=Shift(("bias.constant",), 5000.0, _ones),
            slope=Shift(("scale.constant",), 10_000.0, _tilted),
            partner="lab_temperature",
            input="tilt",
            wrong_unit=180.0 / math.pi,
            sign=True,
            polynomials=(
                ("bias.constant", "bias.temperature"),
                ("scale.constant", "scale.temperature"),
            ),
            T0=30.0,
            lag="bias.thermal_lag",
        ),
        Subject(
            "inclinometer",
            hidden=(("zero.temperature", 6.0), ("zero.hysteresis", 6.0)),
            true={
                "zero.constant(x)": X.constant,
                "zero.constant(y)": Y.constant,
                "zero.placement(x)": X.slope,
                "zero.placement(y)": Y.slope,
            },
            exact={
                "zero.temperature": {"zero.temperature(x)": X.share, "zero.temperature(y)": Y.share}
            },
            noise=2.0,
            zero=Shift(("zero.constant(x)", "zero.constant(y)"), 1000.0, _ones),
            slope=Shift(
                ("zero.placement(x)", "zero.placement(y)"),
                2.0,
                lambda c: np.rad2deg(c["placement_angle"]),
            ),
            partner="placement_angle",
            input="placement_angle",
            wrong_unit=math.pi / 180.0,
            polynomials=tuple(
                (f"zero.constant({axis})", f"zero.temperature({axis})") for axis in "xy"
            ),
            T0=MEAN_TEMPERATURE_DEGC,
        ),
        Subject(
            "differential_pair",
            hidden=(("bias.device", 10_000.0), ("scale.second_order", 1000.0)),
            true={},
            exact={},
            noise=BATCH.noise / math.sqrt(BATCH.duration / BATCH.samples),
            zero=Shift((), 10_000.0, _ones),
            slope=Shift(DEVICES, 5000.0, _opposed),
            partner="acceleration",
            input="acceleration",
            wrong_unit=STANDARD_GRAVITY,
            sign=True,
            group="device",
            one_unit=True,
            drawn=_of_devices,
            options={"campaign": BATCH},
        ),
    )
}
