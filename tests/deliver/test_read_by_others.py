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
from tests.deliver.test_one_program import AT, triad
from tests.support.inside import text_of

STANDARD_GRAVITY = 9.80665  # m/s²
ACCELEROMETER, GYROSCOPE = triad("accelerometer_triad"), triad("gyro_triad")
FACTOR = {"g": STANDARD_GRAVITY, "deg/s": np.pi / 180}  # to m/s², rad/s
OUTPUTS = np.random.default_rng(4).standard_normal((20, 3))
CLOSE = {"rtol": 0.0, "atol": 1e-9}


def corrected(c: bc.VectorCorrection, beside: Any = None) -> np.ndarray:
    """What acts by the correction itself, m/s² or rad/s."""
    return c(OUTPUTS, noise=0.0, secondary_input=beside).vector * FACTOR[c.unit]


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
    return replace(c, terms=terms, covariance=np.zeros((12, 12)), secondary_columns=())


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


# A form that cannot hold a term gets the nearest that it can.


SPHERE = np.random.default_rng(1).standard_normal((20_000, 3))
SPHERE /= np.linalg.norm(SPHERE, axis=1)[:, None]


def bent(instrument: str, order: int = 3, powers: int = 3) -> bc.VectorCorrection:
    """Terms of all orders, over temperature, as large as they come."""
    made = triad(instrument, order, powers)
    terms = made.terms * 40.0 ** -np.arange(powers)[:, None]
    terms[:, 12:30] /= AT[instrument]
    terms[:, 30:33] /= AT[instrument] ** 2
    scale = np.where(made.terms == 0, 1.0, terms / made.terms).ravel()
    covariance = made.covariance * np.outer(scale, scale)
    return replace(made, terms=terms, covariance=covariance, max_input=AT[instrument])


def expected(c: bc.VectorCorrection, force: Any, warm: Any, beside: Any = None) -> np.ndarray:
    """Outputs by the terms, written out."""
    p = ((warm - c.reference)[:, None] ** np.arange(len(c.terms))) @ c.terms
    found = p[:, :3] + np.einsum("nij,nj->ni", p[:, 3:12].reshape(-1, 3, 3), force)
    x, y, z = force.T
    if c.order > 1:
        products = np.stack([x * x, y * y, z * z, x * y, x * z, y * z], axis=1)
        found = found + np.einsum("nim,nm->ni", p[:, 12:30].reshape(-1, 3, 6), products)
    if c.order > 2:
        found = found + p[:, 30:33] * force**3
    if beside is not None:
        found = found + np.einsum("nij,nj->ni", p[:, -9:].reshape(-1, 3, 3), beside)
    return found


def over_the_calibration(c: bc.VectorCorrection) -> tuple[np.ndarray, np.ndarray]:
    assert c.low is not None and c.high is not None
    warm = np.random.default_rng(2).permutation(np.linspace(c.low, c.high, len(SPHERE)))
    return c.max_input * SPHERE, warm


@pytest.mark.parametrize(("order", "powers"), [(2, 1), (3, 3)])
def test_an_accelerometer_of_an_autopilot_is_right_on_its_axes(order: int, powers: int) -> None:
    """Offset and scale that take the outputs of a sphere to what acts with the least error left."""
    c = bent("accelerometer_triad", order, powers)
    c = replace(c, covariance=0 * c.covariance)
    lines = (line.split(",") for line in text_of(c, "ardupilot-params").splitlines() if "," in line)
    values = {line[0]: float(line[1]) for line in lines if line[0].startswith("INS_ACC")}
    force, warm = over_the_calibration(c)
    outputs = expected(c, force, warm)
    for i, a in enumerate("XYZ"):
        offset = values[f"INS_ACCOFFS_{a}"] / 9.80665
        left = (outputs[:, i] - offset) * values[f"INS_ACCSCAL_{a}"] - force[:, i]
        lever = np.column_stack([np.ones(len(force)), force[:, i]])
        best = np.linalg.lstsq(lever, outputs[:, i], rcond=None)[0]
        least = (outputs[:, i] - best[0]) / best[1] - force[:, i]
        assert np.std(left) < 1.01 * np.std(least) + 1e-6
        assert abs(left.mean()) < 5 * np.std(left) / np.sqrt(len(left))
