"""A form that cannot hold a term gets the nearest that it can, and says what is left out and how large that is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from tests.deliver.test_one_program import AT, triad
from tests.support.inside import text_of

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
        made, terms=terms, covariance=made.covariance * np.outer(scale, scale), reach=AT[instrument]
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
