"""What is written for others is read by them, and then corrects as the correction does, to 1e-9.

Each reader here follows the source of what reads the file: its keys, the order of its numbers, its equation.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from tests.deliver.test_noise_at_rest import told
from tests.deliver.test_one_program import GRAVITY, triad
from tests.support.inside import text_of

yaml = pytest.importorskip("yaml")
STANDARD_GRAVITY = 9.80665  # m/s²
ACCELEROMETER, GYROSCOPE = triad("accelerometer_triad"), triad("gyro_triad")
FACTOR = {"g": STANDARD_GRAVITY, "deg/s": np.pi / 180, "uT": 1e-2}  # to m/s², rad/s, gauss
OUTPUTS = np.random.default_rng(4).standard_normal((20, 3))
CLOSE = {"rtol": 0.0, "atol": 1e-9}


def corrected(c: bc.VectorCorrection, beside: Any = None) -> np.ndarray:
    """What acts by the correction itself, m/s², rad/s or gauss."""
    return c(OUTPUTS, noise=0.0, beside=beside).vector * FACTOR[c.unit]


def measured(c: bc.VectorCorrection) -> np.ndarray:
    return OUTPUTS * FACTOR[c.unit]


def kalibr_noise(text: str) -> dict[str, float]:
    """kalibr_common/ConfigReader.py, ImuParameters: the keys that it reads, and what it refuses."""
    data = yaml.safe_load(text)
    if not isinstance(data["rostopic"], str):
        raise RuntimeError("rostopic has to be a string")
    names = [
        f"{k}_{w}" for k in ("accelerometer", "gyroscope") for w in ("noise_density", "random_walk")
    ]
    for name in ("update_rate", *names):
        if data[name] <= 0.0:
            raise RuntimeError(f"invalid {name}")
    return data


def test_noise_for_kalibr_is_read_by_kalibr() -> None:
    found = kalibr_noise(bc.kalibr_yaml({"x": told("rad/s"), "y": told("m/s^2")}, topic="/imu/raw"))
    assert found["rostopic"] == "/imu/raw"


def test_kalibrs_intrinsics() -> None:
    """imu_models, scale-misalignment: a = M⁻¹·(y − b), ω = C⁻¹·M⁻¹·(y − b − A·C·a), in the axes of the first M."""
    both = yaml.safe_load(text_of(ACCELEROMETER, "yaml", others=[GYROSCOPE]))["imu0"]
    acc, gyro = both["accelerometers"], both["gyroscopes"]
    turn = np.array(acc["R"])
    a = np.linalg.solve(np.array(acc["M"]), (measured(ACCELEROMETER) - acc["bias"]).T).T
    np.testing.assert_allclose(a @ turn, corrected(ACCELEROMETER), **CLOSE)
    to_gyro = np.array(gyro["C_gyro_i"])
    acts = np.array(gyro["A"]) @ to_gyro @ turn @ GRAVITY * STANDARD_GRAVITY
    rate = np.linalg.solve(
        np.array(gyro["M"]) @ to_gyro, (measured(GYROSCOPE) - gyro["bias"] - acts).T
    )
    np.testing.assert_allclose(rate.T @ turn, corrected(GYROSCOPE, GRAVITY), **CLOSE)


def px4(text: str) -> dict[str, float]:
    """A parameter file of QGroundControl: vehicle, component, name, value, type, between tabs."""
    rows = [line.split("\t") for line in text.splitlines() if line and not line.startswith("#")]
    assert all(len(row) == 5 and row[4] in ("6", "9") and len(row[2]) <= 16 for row in rows)
    return {row[2]: float(row[3]) for row in rows}


def ardupilot(text: str) -> dict[str, float]:
    """A parameter file of MAVProxy: name and value."""
    rows = [
        re.split(r"[,\s]+", line) for line in text.splitlines() if line and not line.startswith("#")
    ]
    assert all(len(row) == 2 and len(row[0]) <= 16 for row in rows)
    return {row[0]: float(row[1]) for row in rows}


def only(c: bc.VectorCorrection, matrix: np.ndarray) -> bc.VectorCorrection:
    """The same offset with another matrix, which the autopilot has a place for."""
    terms = np.concatenate([c.terms[0, :3], matrix.ravel()])[None]
    return replace(c, terms=terms, covariance=np.zeros((12, 12)), beside=())


def axes(p: dict[str, float], pattern: str) -> np.ndarray:
    return np.array([p[pattern.format(a)] for a in "XYZ"])


def symmetric(diagonal: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """xy, xz and yz beside the diagonal."""
    xy, xz, yz = beside
    return np.diag(diagonal) + np.array([[0, xy, xz], [xy, 0, yz], [xz, yz, 0]])


DIAGONAL = np.diag([1.012345678912, 0.98, 1.03])
BENT = symmetric(np.array([1.01, 0.97, 1.02]), np.array([0.012, -0.02, 0.005]))
Reader = Callable[[str, np.ndarray], np.ndarray]


def px4_accelerometer(text: str, y: np.ndarray) -> np.ndarray:
    """sensor_calibration/Accelerometer.hpp, Correct."""
    p = px4(text)
    return (y - axes(p, "CAL_ACC0_{}OFF")) * axes(p, "CAL_ACC0_{}SCALE")


def px4_gyroscope(text: str, y: np.ndarray) -> np.ndarray:
    """sensor_calibration/Gyroscope.hpp, Correct."""
    return y - axes(px4(text), "CAL_GYRO0_{}OFF")


def px4_magnetometer(text: str, y: np.ndarray) -> np.ndarray:
    """sensor_calibration/Magnetometer.hpp, Correct: the matrix of ParametersUpdate."""
    p = px4(text)
    scale = symmetric(axes(p, "CAL_MAG0_{}SCALE"), axes(p, "CAL_MAG0_{}ODIAG"))
    return (y - axes(p, "CAL_MAG0_{}OFF")) @ scale.T


def ardupilot_accelerometer(text: str, y: np.ndarray) -> np.ndarray:
    """AP_InertialSensor_Backend::_rotate_and_correct_accel: offsets, then scale."""
    p = ardupilot(text)
    return (y - axes(p, "INS_ACCOFFS_{}")) * axes(p, "INS_ACCSCAL_{}")


def ardupilot_gyroscope(text: str, y: np.ndarray) -> np.ndarray:
    """AP_InertialSensor_Backend::_rotate_and_correct_gyro."""
    return y - axes(ardupilot(text), "INS_GYROFFS_{}")


def ardupilot_compass(text: str, y: np.ndarray) -> np.ndarray:
    """AP_Compass_Backend::correct_field: offsets are added, mG, before the ellipse."""
    p = ardupilot(text)
    matrix = symmetric(axes(p, "COMPASS_DIA_{}"), axes(p, "COMPASS_ODI_{}"))
    return (1e3 * y + axes(p, "COMPASS_OFS_{}")) @ matrix.T / 1e3


@pytest.mark.parametrize(
    ("instrument", "matrix", "format", "read"),
    [
        ("accelerometer_triad", DIAGONAL, "px4-params", px4_accelerometer),
        ("accelerometer_triad", DIAGONAL, "ardupilot-params", ardupilot_accelerometer),
        ("gyro_triad", np.eye(3), "px4-params", px4_gyroscope),
        ("gyro_triad", np.eye(3), "ardupilot-params", ardupilot_gyroscope),
        ("magnetometer_triad", BENT, "px4-params", px4_magnetometer),
        ("magnetometer_triad", BENT, "ardupilot-params", ardupilot_compass),
    ],
)
def test_autopilots(instrument: str, matrix: np.ndarray, format: str, read: Reader) -> None:
    """In double precision; an autopilot computes in single."""
    c = only(triad(instrument), matrix)
    np.testing.assert_allclose(read(text_of(c, format), measured(c)), corrected(c), **CLOSE)


@pytest.mark.parametrize(
    ("format", "read"), [("px4-params", px4_magnetometer), ("ardupilot-params", ardupilot_compass)]
)
def test_a_compass_of_an_autopilot_keeps_the_magnitude(format: str, read: Reader) -> None:
    """Its matrix is symmetric: axes of another one are turned, and no vector changes its length."""
    field = triad("magnetometer_triad")
    found = read(text_of(field, format), measured(field))
    np.testing.assert_allclose(*(np.linalg.norm(v, axis=1) for v in (found, corrected(field))))
