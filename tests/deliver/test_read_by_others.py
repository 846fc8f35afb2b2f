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
from tests.deliver.test_one_program import triad
from tests.support.inside import text_of

STANDARD_GRAVITY = 9.80665  # m/s²
ACCELEROMETER, GYROSCOPE = triad("accelerometer_triad"), triad("gyro_triad")
FACTOR = {"g": STANDARD_GRAVITY, "deg/s": np.pi / 180}  # to m/s², rad/s
OUTPUTS = np.random.default_rng(4).standard_normal((20, 3))
CLOSE = {"rtol": 0.0, "atol": 1e-9}


def corrected(c: bc.VectorCorrection, beside: Any = None) -> np.ndarray:
    """What acts by the correction itself, m/s² or rad/s."""
    return c(OUTPUTS, noise=0.0, beside=beside).vector * FACTOR[c.unit]


def measured(c: bc.VectorCorrection) -> np.ndarray:
    return OUTPUTS * FACTOR[c.unit]


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


DIAGONAL = np.diag([1.012345678912, 0.98, 1.03])
Reader = Callable[[str, np.ndarray], np.ndarray]


def px4_accelerometer(text: str, y: np.ndarray) -> np.ndarray:
    """sensor_calibration/Accelerometer.hpp, Correct."""
    p = px4(text)
    return (y - axes(p, "CAL_ACC0_{}OFF")) * axes(p, "CAL_ACC0_{}SCALE")


def px4_gyroscope(text: str, y: np.ndarray) -> np.ndarray:
    """sensor_calibration/Gyroscope.hpp, Correct."""
    return y - axes(px4(text), "CAL_GYRO0_{}OFF")


def ardupilot_accelerometer(text: str, y: np.ndarray) -> np.ndarray:
    """AP_InertialSensor_Backend::_rotate_and_correct_accel: offsets, then scale."""
    p = ardupilot(text)
    return (y - axes(p, "INS_ACCOFFS_{}")) * axes(p, "INS_ACCSCAL_{}")


def ardupilot_gyroscope(text: str, y: np.ndarray) -> np.ndarray:
    """AP_InertialSensor_Backend::_rotate_and_correct_gyro."""
    return y - axes(ardupilot(text), "INS_GYROFFS_{}")


@pytest.mark.parametrize(
    ("instrument", "matrix", "format", "read"),
    [
        ("accelerometer_triad", DIAGONAL, "px4-params", px4_accelerometer),
        ("accelerometer_triad", DIAGONAL, "ardupilot-params", ardupilot_accelerometer),
        ("gyro_triad", np.eye(3), "px4-params", px4_gyroscope),
        ("gyro_triad", np.eye(3), "ardupilot-params", ardupilot_gyroscope),
    ],
)
def test_autopilots(instrument: str, matrix: np.ndarray, format: str, read: Reader) -> None:
    """In double precision; an autopilot computes in single."""
    c = only(triad(instrument), matrix)
    np.testing.assert_allclose(read(text_of(c, format), measured(c)), corrected(c), **CLOSE)
