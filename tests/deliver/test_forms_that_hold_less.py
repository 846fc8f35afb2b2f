"""A form that cannot hold a term gets the nearest that it can, and says what is left out and how large that is."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._annexes.imu.plain_correction import plain_correction
from bayescal._annexes.imu.vector_parameters import autopilot_parameters, left_out
from tests.deliver.test_one_program import AT, triad
from tests.support.inside import text_of

yaml = pytest.importorskip("yaml")
SPHERE = np.random.default_rng(1).standard_normal((20_000, 3))
SPHERE /= np.linalg.norm(SPHERE, axis=1)[:, None]


def bent(instrument: str, order: int = 3, powers: int = 3) -> bc.VectorCorrection:
    """Terms of all orders, over temperature, as large as they come."""
    made = triad(instrument, order, powers)
    terms = made.terms * 40.0 ** -np.arange(powers)[:, None]
    terms[:, 12:30] /= AT[instrument]
    terms[:, 30:33] /= AT[instrument] ** 2
    scale = np.where(made.terms == 0, 1.0, terms / made.terms).ravel()
    return replace(
        made,
        terms=terms,
        covariance=made.covariance * np.outer(scale, scale),
        reach=AT[instrument],
    )


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
    return c.reach * SPHERE, warm


@pytest.mark.parametrize("instrument", ["accelerometer_triad", "magnetometer_triad"])
def test_offset_and_matrix_are_those_of_least_squares(instrument: str) -> None:
    c = bent(instrument)
    c = replace(c, covariance=0 * c.covariance)
    force, warm = over_the_calibration(c)
    outputs = expected(c, force, warm)
    lever = np.column_stack([np.ones(len(force)), force])
    found = np.linalg.lstsq(lever, outputs, rcond=None)[0]
    plain = plain_correction(c)
    left = np.std(outputs - lever @ found, axis=0)
    error = 4 * np.max(left) / np.sqrt(len(force))  # of points drawn at random
    assert np.max(np.abs(found[0] - plain.offset)) < error
    assert np.max(np.abs(found[1:].T - plain.matrix)) < 2 * error / c.reach
    together = np.sqrt(sum(one.rms**2 for one in plain.left))
    assert together == pytest.approx(np.max(left), rel=0.15)


def test_at_rest_a_gyroscope_has_the_bias_of_its_calibration() -> None:
    c = bent("gyro_triad", 2, 1)
    plain = plain_correction(c)
    assert np.array_equal(plain.offset, c.offset)
    assert [one.what for one in plain.left] == ["second order"]
    with_gravity = plain_correction(c, "none", beside=False)
    assert np.array_equal(with_gravity.matrix, np.eye(3))
    names = ["second order", "what acts beside (of size 1)", "scale factors and misalignments"]
    assert sorted(one.what for one in with_gravity.left) == sorted(names)


def test_uncertainties_are_those_of_what_is_written() -> None:
    c = bent("accelerometer_triad")
    draws = np.random.default_rng(3).multivariate_normal(c.terms.ravel(), c.covariance, 400)
    made = [plain_correction(replace(c, terms=d.reshape(c.terms.shape))).terms for d in draws]
    plain = plain_correction(c)
    assert np.std(made, axis=0) == pytest.approx(plain.uncertainty, rel=0.15)
    text = yaml.safe_load(text_of(c, "yaml"))["imu0"]["accelerometers"]
    assert np.array(text["bias"]) / 9.80665 == pytest.approx(plain.offset, rel=1e-7)
    assert np.array(text["bias_uncertainty"]) / 9.80665 == pytest.approx(
        plain.uncertainty[:3], rel=1e-7
    )


@pytest.mark.parametrize(
    ("instrument", "format"),
    [
        ("accelerometer_triad", "yaml"),
        ("gyro_triad", "yaml"),
        ("accelerometer_triad", "px4-params"),
        ("gyro_triad", "ardupilot-params"),
        ("magnetometer_triad", "px4-params"),
    ],
)
def test_files_say_what_they_leave_out(instrument: str, format: str) -> None:
    text = " ".join(text_of(bent(instrument), format).split())
    said = re.search(r"# Left out, for want of a place: .*? 70 deg C\)\.[^#\n]*", text)
    assert said is not None
    for number in re.findall(r"[\d.e-]+ \S+ ?\S* rms", said[0]):
        assert float(number.split()[0]) > 0


def test_what_holds_all_says_so() -> None:
    straight = replace(triad("accelerometer_triad"), covariance=np.zeros((12, 12)))
    terms = straight.terms.copy()
    terms[0, 3:12] = np.diag([1.01, 0.99, 1.02]).ravel()
    straight = replace(straight, terms=terms)
    assert not left_out(straight, "px4-params") and not left_out(bent("gyro_triad"), "c")


def test_an_accelerometer_of_an_autopilot_is_right_on_its_axes() -> None:
    """Offset and scale that take the outputs of a sphere to what acts with the least error left."""
    c = replace(bent("accelerometer_triad", 2, 1), covariance=np.zeros((30, 30)))
    values, _ = autopilot_parameters(c, "ardupilot-params")
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
